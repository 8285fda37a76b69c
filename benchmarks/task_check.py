"""Shows that every task can be solved, and that none is solved by chance.

For each task a scripted controller and a random policy play the first episode of many environments. The table
has the share of episodes that achieve their goal. The exit status is 1 if a task is outside its limits.

    python benchmarks/task_check.py --out tasks.md
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from tensordict import TensorDictBase

from torchrl_her_envs import TASKS, ThrowingEnv, make_controller, make_env

SCRIPTED_AT_LEAST = 0.95
RANDOM_AT_MOST = {"v0": 0.10, "v1": 0.01, "v2": 0.10}  # by suffix of the name; reaching tasks have no limit
HEADER = ("task", "scripted %", "random %", "limits")


def success_rate(env: ThrowingEnv, policy: Callable[[TensorDictBase], TensorDictBase] | None) -> float:
    """Returns the share of first episodes that achieve their goal; a policy of None acts at random."""
    after = env.rollout(env.world.max_steps, policy, break_when_any_done=False)["next"]
    done = after["done"].long()
    first = done.cumsum(1) - done == 0  # steps after the first end belong to the next episode
    return (after["terminated"] & first).any(1).double().mean().item()


def check(name: str, *, episodes: int, seed: int) -> tuple[tuple[str, ...], bool]:
    """Measures a task; returns a row of the table, and whether the task is within its limits."""
    env = make_env(name, num_envs=episodes, seed=seed)
    scripted = success_rate(env, make_controller(env))
    env.set_seed(seed)
    torch.manual_seed(seed)
    chance = success_rate(env, None)
    most = RANDOM_AT_MOST.get(name.rsplit("_", 1)[-1], 1.0)
    limits = f">= {SCRIPTED_AT_LEAST:.0%}" + (f", <= {most:.0%}" if most < 1 else "")
    return (
        name,
        f"{scripted:.1%}",
        f"{chance:.1%}",
        limits,
    ), scripted >= SCRIPTED_AT_LEAST and chance <= most


def as_markdown(rows: Sequence[Sequence[str]]) -> str:
    """Formats a Markdown table whose first row is the header."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]
    rule = "| " + " | ".join("-" * width for width in widths) + " |"
    return "\n".join([lines[0], rule, *lines[1:]])


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Success of a scripted controller and of a random policy in first episodes of each task.",
    )
    parser.add_argument(
        "tasks", nargs="*", metavar="TASK", help="tasks to check; all eleven if none is named"
    )
    parser.add_argument(
        "--episodes", type=int, default=1000, help="episodes of each task and policy (%(default)s)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of starts, goals and random actions (%(default)s)"
    )
    parser.add_argument("--out", type=Path, help="write the table to this markdown file, too")
    options = parser.parse_args(arguments)
    unknown = set(options.tasks) - set(TASKS)
    if unknown:
        parser.error(f"unknown tasks {', '.join(sorted(unknown))}; the tasks are {', '.join(TASKS)}")
    if options.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {options.episodes}")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    options = parse(arguments)
    torch.set_num_threads(1)  # small tensors are slower with more
    rows: list[tuple[str, ...]] = [HEADER]
    fine = True
    for name in options.tasks or TASKS:
        row, within = check(name, episodes=options.episodes, seed=options.seed)
        rows.append(row)
        fine &= within
    table = as_markdown(rows)
    print(table)
    if options.out:
        options.out.write_text(table + "\n")
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
