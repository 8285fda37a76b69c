"""Wall-clock to 80 % success on `hand_v0`, beside Stable-Baselines3's DDPG with HER.

    python benchmarks/time_to_learn.py --out time_to_learn.md

Both train in 64 worlds of the same task with the same networks, batches, discount and number of gradient
steps; both are asked every so often for the success of 100 greedy episodes in the same environment, which is
not timed. Ours is the default recipe with `algo=her`. Runs are taken in turns.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from machine import describe, table
from stable_baselines3.common.noise import NormalActionNoise
from tensordict import TensorDictBase
from update_speed import ENVS, TASK, make_sb3

from torchrl_her import evaluate, success
from torchrl_her_envs import make_env
from torchrl_her_recipes import Recipe

EVERY, CAP, AIM = 20_480, 614_400, 0.8

Progress = Iterator[Callable[[TensorDictBase], TensorDictBase]]


def ours(seed: int) -> Progress:
    """Trains, and hands out the greedy policy every so many frames."""
    recipe = Recipe(task=TASK, algo="her", seed=seed, num_envs=ENVS, epoch_frames=EVERY, compile="always")
    parts = recipe.build()
    trainer = parts.trainer()
    while True:
        trainer.epoch()
        yield parts.policy


def peer(seed: int) -> Progress:
    model = make_sb3(
        action_noise=NormalActionNoise(np.zeros(3), np.full(3, 0.1)),
        batch_size=256,
        gradient_steps=3,  # 64 frames are worth 3.2; it counts in whole ones
        learning_starts=3_200,
        seed=seed,  # of its environments, too
    )

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        keys = ("observation", "achieved_goal", "desired_goal")
        action, _ = model.predict({key: tensordict[key].numpy() for key in keys}, deterministic=True)
        return tensordict.set("action", torch.from_numpy(action))

    while True:
        model.learn(EVERY, reset_num_timesteps=False)
        yield policy


def race(contender: Callable[[int], Progress], seed: int) -> tuple[float, int, float]:
    """Seconds and frames until the aim, or until the cap, and the best success on the way."""
    test = make_env(TASK, num_envs=100, seed=seed + (1 << 32))
    seconds, frames, best = 0.0, 0, 0.0
    training = contender(seed)
    while best < AIM and frames < CAP:
        began = time.perf_counter()
        policy = next(training)
        seconds += time.perf_counter() - began
        frames += EVERY
        rollout = evaluate(test, policy, max_steps=test.world.max_steps)
        best = max(best, float(success(rollout).float().mean()))
    return seconds, frames, best


def column(values: Sequence[float], form: str) -> str:
    return (
        format(statistics.median(values), form) + f" ({', '.join(format(value, form) for value in values)})"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=3, help="seeds")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    contenders = {"this": ours, "Stable-Baselines3": peer}
    results: dict[str, list[tuple[float, int, float]]] = {name: [] for name in contenders}
    for seed in range(options.repeats):
        for name, contender in contenders.items():
            results[name].append(race(contender, seed))
    rows = []
    for name, runs in results.items():
        seconds, frames, best = (list(values) for values in zip(*runs, strict=True))
        reached = sum(value >= AIM for value in best)
        rows.append(
            [
                name,
                f"{reached} of {len(runs)}",
                column(seconds, ".0f"),
                column(frames, ",.0f"),
                column(best, ".0%"),
            ]
        )
    header = (
        f"{TASK} to {AIM:.0%}",
        "reached",
        "seconds: median (each)",
        f"frames, at most {CAP:,}",
        "best success",
    )
    text = "\n\n".join((describe("torch", "torchrl", "stable-baselines3"), table(header, rows)))
    print(text)
    if options.out is not None:
        options.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
