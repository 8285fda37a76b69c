"""Compares gradient steps and training loops with SBX, Stable-Baselines3 and TorchRL's loss and buffer.

    python benchmarks/update_speed.py --out update_speed.md
    python benchmarks/update_speed.py --tables steps --repeats 15

All contenders train in one process on one core, in turns, after compilation. They have the same task, number
of environments, networks (three hidden layers), batches, discount, learning rate, target updates, share of
virtual transitions, frames between two rounds of gradient steps, and gradient steps in a round. Remaining
differences are listed below the tables.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from machine import CLOCKS, describe, medians, one_core, table
from peers.ours import Ours, OursHalf, OursSAC, OursTD3, TorchRLPieces
from peers.peer import Peer
from peers.sb3 import SB3DDPG, SB3TD3
from peers.sbx_td3 import SBXTD3

from torchrl_her_recipes import Recipe, load_preset, make_recipe

TASK = "hand_v1"
FILL = 20_480  # frames in the buffers before anything is timed
STEPS = 200  # gradient steps in one measurement
RUNS = 15

STEP_SETTINGS = ((64, 64), (64, 256), (256, 256))  # width of the hidden layers, batch size
STEP_PEERS: tuple[type[Peer], ...] = (
    Ours,
    OursHalf,
    OursTD3,
    OursSAC,
    SBXTD3,
    SB3DDPG,
    SB3TD3,
    TorchRLPieces,
)
LOOP_SETTINGS = tuple((batch, frames) for batch in (64, 256) for frames in (1, 5, 20))  # frames per update
LOOP_PEERS: tuple[type[Peer], ...] = (Ours, OursHalf, SBXTD3, SB3DDPG)
ROUNDS = {1: 1, 5: 5, 20: 10}  # rounds in one measurement, by frames per gradient step
ENV_COUNTS = (1, 8, 16, 64, 160)


class Timing(NamedTuple):
    """Settings of measurements: number of repeats, and the clock."""

    repeats: int
    clock: str

    def medians(self, contenders: Mapping[str, Callable[[], int]]) -> dict[str, float]:
        """Measures the median seconds for a unit of each contender's work."""
        return medians(contenders, repeats=self.repeats, clock=self.clock, warm_up=2)


def recipe_for(**options: Any) -> Recipe:
    """Makes the recipe of a run that is so long that ``compile=auto`` compiles it."""
    return make_recipe(load_preset("throwing"), task=TASK, algo="her", episodes=1, epochs=1_000, **options)


def frames_in_round(recipe: Recipe) -> int:
    """Returns the number of frames that are collected between two rounds of gradient steps."""
    return recipe.collection.num_envs * recipe.collection.steps_per_batch


def filled(peer: Peer) -> Peer:
    peer.fill(FILL)
    return peer


def times(one: float, other: float) -> str:
    return f"{one / other:.2f}x"


def differences(peers: Sequence[type[Peer]]) -> str:
    return "What differs:\n\n" + "\n".join(f"- **{peer.name}**: {peer.differs}" for peer in peers)


def steps_table(timing: Timing) -> str:
    """Measures complete gradient steps (see ``Peer.gradient_steps``), and formats a table."""
    rows = []
    for hidden, batch in STEP_SETTINGS:
        recipe = recipe_for(hidden=hidden, batch_size=batch)
        peers = [filled(kind(recipe)) for kind in STEP_PEERS]
        seconds = timing.medians({peer.name: partial(peer.gradient_steps, STEPS) for peer in peers})
        sbx, sb3 = seconds[SBXTD3.name], seconds[SB3DDPG.name]
        ddpg, half, td3, sac = (seconds[kind.name] for kind in (Ours, OursHalf, OursTD3, OursSAC))
        ratios = (times(sbx, td3), times(sbx, ddpg), times(sbx, half), times(sb3, ddpg), times(sac, td3))
        milliseconds = (f"{1e3 * own:.2f}" for own in seconds.values())
        rows.append([f"3 x {hidden}, batch {batch}", *ratios, *milliseconds])
    header = (
        "gradient step",
        "TD3, rate over SBX's TD3",
        "DDPG, rate over SBX's TD3",
        "with bfloat16",
        "DDPG, rate over Stable-Baselines3's",
        "SAC, time over TD3's",
    )
    columns = (*header, *(f"{kind.name}, ms" for kind in STEP_PEERS))
    asked = f"Each is asked for {STEPS} gradient steps in one call."
    return "\n\n".join((table(columns, rows), asked, differences(STEP_PEERS)))


def loop_table(timing: Timing) -> str:
    """Measures the whole training loop (collecting, storing and learning), and formats a table."""
    rows = []
    for batch, frames_per_update in LOOP_SETTINGS:
        recipe = recipe_for(batch_size=batch, frames_per_update=frames_per_update)
        frames = ROUNDS[frames_per_update] * frames_in_round(recipe)
        peers = [filled(kind(recipe)) for kind in LOOP_PEERS]
        seconds = timing.medians({peer.name: partial(peer.loop, frames) for peer in peers})
        ours, half, sbx, sb3 = (seconds[kind.name] for kind in LOOP_PEERS)
        rates = (f"{1 / own:,.0f}" for own in seconds.values())
        ratios = (times(peer, own) for peer in (sbx, sb3) for own in (ours, half))
        rows.append([str(batch), str(frames_per_update), *ratios, *rates])
    header = (
        "batch",
        "frames for a gradient step",
        "DDPG over SBX's TD3",
        "with bfloat16",
        "DDPG over Stable-Baselines3's",
        "with bfloat16",
    )
    columns = (*header, *(f"{kind.name}, frames/s" for kind in LOOP_PEERS))
    recipe = recipe_for()
    note = (
        f"{frames_in_round(recipe)} frames of {recipe.collection.num_envs} environments are collected "
        "between two rounds of gradient steps. Our environments are stepped as a batch and have exploration; "
        "those of the others are lean ones of plain Python (`peers/env.py`), without exploration."
    )
    return "\n\n".join((table(columns, rows), note, differences(LOOP_PEERS)))


def envs_table(timing: Timing) -> str:
    """Measures loops of other libraries by number of environments, where environments take most time."""
    base = recipe_for(batch_size=64, frames_per_update=20)
    in_round = frames_in_round(base)
    recipes = {
        str(count): base.replace(num_envs=count, steps_per_batch=in_round // count) for count in ENV_COUNTS
    }
    frames = ROUNDS[20] * in_round
    rows = []
    for kind in (SBXTD3, SB3DDPG):
        peers = {count: filled(kind(recipe)) for count, recipe in recipes.items()}
        seconds = timing.medians({name: partial(peer.loop, frames) for name, peer in peers.items()})
        rows.append([kind.name, *(f"{1 / own:,.0f}" for own in seconds.values())])
    header = ("frames/s, batch 64, 20 frames for a step", *(f"{count} environments" for count in ENV_COUNTS))
    return table(header, rows)


def runs_table(timing: Timing) -> str:
    """Compares 15 runs trained side by side with a single run, and formats a table."""
    rows = []
    for batch in (64, 256):
        one, together = (filled(Ours(recipe_for(batch_size=batch, num_runs=runs))) for runs in (1, RUNS))
        step, steps = timing.medians(
            {"one": partial(one.gradient_steps, 80), "together": partial(together.gradient_steps, 80)}
        ).values()
        frame, frames = timing.medians(
            {"one": partial(one.loop, 1_280), "together": partial(together.loop, 1_280)}
        ).values()
        milliseconds = (f"{1e3 * own:.2f}" for own in (step, steps / RUNS))
        rates = (f"{own:,.0f}" for own in (1 / frame, RUNS / frames))
        rows.append([str(batch), times(steps / RUNS, step), *milliseconds, times(frames, frame), *rates])
    header = (
        "batch",
        f"a run's gradient step among {RUNS} over that of one run",
        "ms, one run",
        f"ms, each of {RUNS}",
        f"loop: wall-clock of {RUNS} runs over one",
        "one run, frames/s",
        f"{RUNS} runs together, frames/s",
    )
    return table(header, rows)


TABLES: dict[str, Callable[[Timing], str]] = {
    "steps": steps_table,
    "loop": loop_table,
    "envs": envs_table,
    "runs": runs_table,
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--repeats", type=int, default=7, help="measurements of each, taken in turns (default: 7)"
    )
    parser.add_argument(
        "--tables", nargs="+", choices=TABLES, default=list(TABLES), help="some of them (default: all)"
    )
    parser.add_argument("--core", type=int, help="where to run (default: the last one)")
    parser.add_argument(
        "--clock", choices=CLOCKS, default="wall", help="cpu: for a core that is shared with other work"
    )
    parser.add_argument("--out", type=Path, help="write the tables to this file, too")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)  # as a run of the recipes does
    parts = [describe("torch", "torchrl", "stable-baselines3", "sbx-rl", "jax")]
    print(parts[0], flush=True)
    with one_core(options.core):
        for name in options.tables:
            parts.append(TABLES[name](Timing(options.repeats, options.clock)))
            print(f"\n{parts[-1]}", flush=True)
    if options.out is not None:
        options.out.write_text("\n\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
