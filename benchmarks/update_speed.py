"""Gradient steps and the whole training loop, beside TorchRL's own pieces and Stable-Baselines3, in one run.

    python benchmarks/update_speed.py --out update_speed.md

An update counts everything: drawing rows, loss, backward, optimizer, target networks, priorities.
Stable-Baselines3 (the extra `bench`) has no prioritized replay and relabels while it samples.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from machine import describe, medians, publish, table
from peer_sb3 import make_sb3
from stable_baselines3 import DDPG

from torchrl_her import LossLearner, Trainer
from torchrl_her_recipes import build, make_recipe

TASK, ENVS, BATCH = "hand_v0", 64, 64
FILL = 6_400  # frames in the buffers before anything is timed
UPDATES = 40  # in one measurement


def ours(
    runs: int,
    *,
    frames_per_update: float = 20.0,
    fused: bool = True,
    per_draw: int = 8,
    batch: int = BATCH,
    compiled: str = "always",
) -> Trainer:
    """A trainer with filled buffers."""
    recipe = make_recipe(
        task=TASK,
        algo="her",
        num_runs=runs,
        num_envs=ENVS,
        batch_size=batch,
        frames_per_update=frames_per_update,
        batches_per_sample=per_draw,
        epoch_frames=FILL,
        warmup_frames=FILL,
        buffer_size=200_000,
        episodes=1,
        compile=compiled,
    )
    components = build(recipe)
    trainer = components.trainer()
    if not fused:
        trainer.learner = LossLearner(components.loss, components.optimizer, components.target, runs=runs)
    trainer.epoch()
    return trainer


def updates_of(trainer: Trainer) -> Callable[[], int]:
    """Gradient steps alone, with their rows and priorities."""

    def work() -> int:
        trainer._credit = float(UPDATES)
        trainer._learn()
        return UPDATES

    return work


def frames_of(trainer: Trainer, frames: int) -> Callable[[], int]:
    """The whole loop, for some environment steps of one run."""

    def work() -> int:
        before = trainer.frames
        trainer.run(frames)
        return trainer.frames - before

    return work


def sb3(*, gradient_steps: int) -> DDPG:
    """Stable-Baselines3's model with its buffer filled."""
    recipe = make_recipe(task=TASK, num_envs=ENVS, batch_size=BATCH, warmup_frames=FILL)
    model = make_sb3(recipe, gradient_steps=gradient_steps)
    model.learn(FILL + ENVS)
    return model


def sb3_updates(model: DDPG) -> Callable[[], int]:
    def work() -> int:
        model.train(gradient_steps=UPDATES, batch_size=BATCH)
        return UPDATES

    return work


def sb3_frames(model: DDPG, frames: int) -> Callable[[], int]:
    def work() -> int:
        before = model.num_timesteps
        model.learn(frames, reset_num_timesteps=False)
        return model.num_timesteps - before

    return work


def update_table(repeats: int) -> str:
    names = ("this, one run", "this, 15 runs", "TorchRL's loss and buffer", "Stable-Baselines3")
    trainers = (ours(1), ours(15), ours(1, fused=False, per_draw=1))
    work = [*(updates_of(trainer) for trainer in trainers), sb3_updates(sb3(gradient_steps=1))]
    seconds = medians(dict(zip(names, work, strict=True)), repeats=repeats)
    seconds[names[1]] /= 15
    peer = seconds[names[-1]]
    rows = [[name, f"{peer / value:.1f}x", f"{1e3 * value:.2f}"] for name, value in seconds.items()]
    return table(("update", "rate over Stable-Baselines3", "ms for an update of one run"), rows)


def loop_table(repeats: int) -> str:
    rows = []
    for label, frames_per_update, steps, frames in (("20", 20.0, 3, 3_200), ("1", 1.0, 64, 640)):
        # 64 frames make 3.2 updates: Stable-Baselines3, which counts in whole ones, does 3
        contenders = {
            "this": frames_of(ours(1, frames_per_update=frames_per_update), frames),
            "Stable-Baselines3": sb3_frames(sb3(gradient_steps=steps), frames),
        }
        seconds = medians(contenders, repeats=repeats)
        this, peer = seconds.values()
        rows.append([label, f"{peer / this:.1f}x", f"{1 / this:,.0f}", f"{1 / peer:,.0f}"])
    header = ("frames for each update", "rate over Stable-Baselines3", "this, frames/s", "Stable-Baselines3")
    return table(header, rows)


def runs_table(repeats: int) -> str:
    rows = []
    for batch in (64, 256):
        contenders = {
            runs: frames_of(
                ours(runs, batch=batch, compiled="never" if runs * batch > 2_000 else "always"), 1_280
            )
            for runs in (1, 15)
        }
        seconds = medians({str(runs): work for runs, work in contenders.items()}, repeats=repeats)
        one, fifteen = seconds.values()
        rows.append([str(batch), f"{fifteen / one:.1f}x", f"{1 / one:,.0f}", f"{15 / fifteen:,.0f}"])
    header = ("batch", "wall-clock of 15 runs over one", "one run, frames/s", "15 runs together, frames/s")
    return table(header, rows)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--repeats", type=int, default=7, help="measurements of each, taken in turns (default: 7)"
    )
    parser.add_argument("--out", type=Path, help="write the tables to this file, too")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)  # as in runs
    machine = describe("torch", "torchrl", "stable-baselines3")
    tables = (update_table, loop_table, runs_table)
    text = "\n\n".join((machine, *(make(options.repeats) for make in tables)))
    publish(text, options.out)


if __name__ == "__main__":
    main()
