"""Measures seconds and frames up to a success rate, for this library, Stable-Baselines3 and SBX with HER.

    python benchmarks/time_to_learn.py --out time_to_learn.md
    python benchmarks/time_to_learn.py --preset benchmarks/presets/fetch_push.yaml --only SBX-SAC \\
        --aim 2 --repeats 5 --epochs 12 --epoch-frames 10000 --curves push_sac
    python benchmarks/time_to_learn.py --task gym:FetchPush-v4 --only this Zoo-TQC Zoo-SAC Zoo-SBX-TQC \\
        --aim 0.95 --window 2 --minutes 60 --epochs 200 --epoch-frames 5000 --first-seed 100 --repeats 1 \\
        --curves push_seconds

All contenders train in the same task with the same number of environments, networks, batches, discount and
number of gradient steps, except those named Zoo, which have the RL Zoo's options for the task. After each
epoch the success of greedy episodes in the same environment is measured, which is not timed. Seconds are
processor time on one core. Contenders take turns. A run ends when its last evaluations reach the aim on
average (never, if the aim is above 1). With ``--curves``, finished runs are written to a file and not trained
again, so each setting needs a file of its own.
"""

from __future__ import annotations

import argparse
import csv
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from machine import describe, one_core, publish, table
from matplotlib.figure import Figure
from peers.sb3 import make_sb3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_her import success
from torchrl_her_recipes import Recipe, build, make_recipe
from torchrl_her_recipes.components.envs import TaskEnvs, evaluation_envs, play_episodes
from torchrl_her_recipes.config.presets import load_preset
from torchrl_her_recipes.config.shortcuts import merge

HAND = merge(load_preset("throwing"), {"task": "hand_v0", "algo": "her"})

Policy = Callable[[TensorDictBase], TensorDictBase]
Learned = tuple[Policy, EnvBase]  # a greedy policy and environments to evaluate it in


class Point(NamedTuple):
    """A point of a learning curve: success after a number of frames and of seconds of training."""

    frames: int
    seconds: float
    success: float


def ours(recipe: Recipe, _noise: float) -> Iterator[Learned]:
    """Trains this library's learner of a recipe, and yields the greedy policy after each epoch."""
    components = build(recipe)
    if components.curriculum is not None and not components.curriculum.progress.by_episode:
        raise ValueError(f"algo={recipe.hindsight.algo} learns stages, which only torchrl-her train supports")
    trainer = components.trainer()
    while True:
        trainer.epoch()
        yield components.player, components.eval_env


def ddpg(recipe: Recipe, noise: float) -> Iterator[Learned]:
    """Trains DDPG of Stable-Baselines3, and yields the greedy policy after each epoch."""
    return _learn(recipe, make_sb3(recipe, noise=noise))


def sac(recipe: Recipe, _noise: float) -> Iterator[Learned]:
    """Trains SAC of SBX, which explores by its stochastic policy, and yields the policy after each epoch."""
    from peers.sbx_sac import make_sac  # noqa: PLC0415  # only those who ask for it wait for JAX

    return _learn(recipe, make_sac(recipe))


def zoo(algorithm: str) -> Callable[[Recipe, float], Iterator[Learned]]:
    """Returns a function that trains an algorithm with the RL Zoo's options on a recipe's task and seed."""

    def train(recipe: Recipe, _noise: float) -> Iterator[Learned]:
        from peers.zoo import make_zoo  # noqa: PLC0415  # as above

        return _learn(recipe, make_zoo(algorithm, recipe))

    return train


def _learn(recipe: Recipe, model: OffPolicyAlgorithm) -> Iterator[Learned]:
    """Trains another library's model, and yields its greedy policy after each epoch."""
    worlds = evaluation_envs(recipe.task.name, recipe.evaluation.episodes)
    env = TaskEnvs.of(recipe).make(worlds, [recipe.run.seed + (1 << 32)], scaled=False)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        keys = ("observation", "achieved_goal", "desired_goal")
        action, _ = model.predict({key: tensordict[key].numpy() for key in keys}, deterministic=True)
        return tensordict.set("action", torch.from_numpy(action))

    while True:
        model.learn(recipe.collection.epoch_frames, reset_num_timesteps=False)
        yield policy, env


Curves = Mapping[str, Sequence[Sequence[Point]]]  # curves of all seeds, by contender
Runs = dict[tuple[str, int], list[Point]]  # curves by contender and seed

CONTENDERS = {"this": ours, "Stable-Baselines3": ddpg, "SBX-SAC": sac} | {
    f"Zoo-{name}": zoo(name) for name in ("TQC", "SAC", "SBX-TQC")
}


def race(name: str, recipe: Recipe, *, noise: float, aim: float, window: int, minutes: float) -> list[Point]:
    """Trains until the mean of the last evaluations reaches the aim, or a limit; returns the curve."""
    curve: list[Point] = []
    training, seconds = CONTENDERS[name](recipe, noise), 0.0
    for epoch in range(1, recipe.run.epochs + 1):
        began = time.process_time()
        policy, env = next(training)
        seconds += time.process_time() - began
        rollout = play_episodes(env, policy, recipe.evaluation.episodes)
        frames, share = epoch * recipe.collection.epoch_frames, success(rollout).float().mean().item()
        curve.append(Point(frames, seconds, share))
        print(f"{name}, seed {recipe.run.seed}: {curve[-1]}", flush=True)
        last = [point.success for point in curve[-window:]]
        if (len(last) == window and statistics.fmean(last) >= aim) or seconds >= 60 * minutes:
            break
    return curve


def column(values: Sequence[float], form: str) -> str:
    return (
        format(statistics.median(values), form) + f" ({', '.join(format(value, form) for value in values)})"
    )


def line(name: str, curves: Sequence[Sequence[Point]], aim: float, window: int) -> list[str]:
    """Returns a row of the table, with one number for each seed in each column."""
    best = [max(point.success for point in curve) for curve in curves]
    ends = [statistics.fmean(point.success for point in curve[-window:]) for curve in curves]
    return [
        name,
        f"{sum(value >= aim for value in ends)} of {len(curves)}",
        column([curve[-1].seconds for curve in curves], ".0f"),
        column([curve[-1].frames for curve in curves], ",.0f"),
        column([curve[-1].success for curve in curves], ".0%"),
        column(best, ".0%"),
    ]


def write_runs(runs: Runs, path: Path) -> None:
    part = path.with_suffix(".part")  # renamed when complete, so an interruption loses nothing
    with open(part, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("contender", "seed", *Point._fields))
        for run, curve in runs.items():
            writer.writerows((*run, *(f"{value:.6g}" for value in point)) for point in curve)
    part.replace(path)


def read_runs(path: Path) -> Runs:
    """Reads the runs in a file; returns an empty dict if there is no file."""
    runs: Runs = {}
    if path.is_file():
        with open(path, newline="") as file:
            for row in csv.DictReader(file):
                point = Point(int(float(row["frames"])), float(row["seconds"]), float(row["success"]))
                runs.setdefault((row["contender"], int(row["seed"])), []).append(point)
    return runs


def draw_curves(curves: Curves, path: Path, *, title: str) -> None:
    """Draws success over frames, and over seconds of training, with a line for each seed."""
    figure = Figure(figsize=(9.4, 3.8), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, field in zip(panels, ("frames", "seconds"), strict=True):
        for number, (name, runs) in enumerate(curves.items()):
            for seed, curve in enumerate(runs):
                label = name if seed == 0 else None
                places = [getattr(point, field) for point in curve]
                axes.plot(places, [point.success for point in curve], color=f"C{number}", label=label)
        axes.set(
            xlabel="environment steps" if field == "frames" else "seconds of training", ylim=(-0.02, 1.02)
        )
        axes.grid(alpha=0.3)
    panels[0].set(ylabel="success", title=title)
    panels[0].legend(loc="upper left")
    figure.savefig(path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    ask = parser.add_mutually_exclusive_group()
    ask.add_argument("--preset", help="of torchrl-her (default: HER on hand_v0)")
    ask.add_argument("--task", help="the default agent on this task, in place of a preset")
    parser.add_argument("--only", nargs="+", choices=CONTENDERS, default=["this", "Stable-Baselines3"])
    parser.add_argument("--aim", type=float, default=0.8, help="success at which a run ends")
    parser.add_argument("--noise", type=float, default=0.1, help="of Stable-Baselines3's actions")
    parser.add_argument("--window", type=int, default=1, help="evaluations whose mean has to be at the aim")
    parser.add_argument("--minutes", type=float, default=math.inf, help="of training, after which a run ends")
    parser.add_argument("--repeats", type=int, default=3, help="number of seeds")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--epochs", type=int, help="in place of the preset's")
    parser.add_argument("--epoch-frames", type=int, help="likewise")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    parser.add_argument("--curves", type=Path, help="write all points to this name with .csv, and draw .png")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    values: dict[str, Any] = load_preset(options.preset) if options.preset else HAND
    if options.task:
        values = {"task": {"name": options.task}}
    seeds = range(options.first_seed, options.first_seed + options.repeats)
    limits = {"aim": options.aim, "window": options.window, "minutes": options.minutes}
    asked = {"epochs": options.epochs, "epoch_frames": options.epoch_frames}
    asked = {name: value for name, value in asked.items() if value is not None}
    kept = options.curves and options.curves.with_suffix(".csv")
    runs = read_runs(kept) if kept else {}
    for seed in seeds:
        recipe = make_recipe(values, seed=seed, **asked)
        for name in options.only:
            if (name, seed) not in runs:
                runs[name, seed] = race(name, recipe, noise=options.noise, **limits)
                if kept:
                    write_runs(runs, kept)
    curves = {name: [runs[name, seed] for seed in seeds] for name in options.only}
    header = (
        recipe.task.name,
        f"reached {options.aim:.0%}",
        "seconds: median (each)",
        "frames",
        "last",
        "best",
    )
    rows = [line(name, curves[name], options.aim, options.window) for name in options.only]
    text = "\n\n".join((describe("torch", "torchrl", "stable-baselines3"), table(header, rows)))
    publish(text, options.out)
    if options.curves is not None:
        draw_curves(curves, options.curves.with_suffix(".png"), title=recipe.task.name)


if __name__ == "__main__":
    with one_core():
        main()
