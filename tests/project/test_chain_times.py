"""Appendix C's times: formulas against learners that are played out, and what is read from runs."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from torchrl_her_envs import Chain
from torchrl_her_recipes import Recipe, make_recipe

from .pages import script

chain_times = script("docs/make_chain_times.py")
episodes_to_solve, plot_times = chain_times.episodes_to_solve, chain_times.plot_times
ideal_episodes, learning_steps = chain_times.ideal_episodes, chain_times.learning_steps


def played_out(length: int, stages: int, algo: str, p: float, learners: int) -> float:
    """Mean episodes of learners that know their way to a place of the chain, and go on at random."""
    env = Chain(length, 1.0, stages=stages, alternating=True, reset_state=True, num_envs=learners)
    generator = torch.Generator().manual_seed(0)
    known = torch.zeros(learners, dtype=torch.int64)
    episodes = torch.zeros(learners)
    hidden = {"no_hindsight": length - 1, "her": length - length // stages, "cher": 0}[algo]
    while bool((known < length).any()):
        episodes += known < length
        shown = env.reset()
        furthest, failed = torch.zeros_like(known), torch.zeros(learners, dtype=torch.bool)
        for step in range(length):
            right = (torch.rand(learners, generator=generator) < p) | (step < known)
            action = right.long() ^ (step % 2)
            shown = env.step(shown.set("action", action))["next"].exclude("reward")
            failed |= ~right
            closed = (shown["observation"] > 0).sum(-1)
            furthest = torch.where(failed, furthest, closed)
        known = torch.maximum(known, torch.where(furthest > hidden, furthest, 0))
    return float(episodes.mean())


@pytest.mark.parametrize("algo", ["no_hindsight", "her", "cher"])
@pytest.mark.parametrize("p", [0.5, 0.8])
def test_ideal_learners_in_the_chain_itself_take_as_long_as_the_formula_says(algo: str, p: float) -> None:
    expected = ideal_episodes(learning_steps(6, 3, algo), p)
    assert played_out(6, 3, algo, p, learners=2000) == pytest.approx(expected, rel=0.12)


@given(st.integers(1, 12), st.integers(1, 6), st.floats(0.1, 1.0))
@settings(deadline=None)
def test_curricula_take_polynomial_and_hindsight_over_sub_tasks_exponential_time(
    part: int, stages: int, p: float
) -> None:
    n = part * stages
    alone, her, cher = (
        ideal_episodes(learning_steps(n, stages, algo), p) for algo in ("no_hindsight", "her", "cher")
    )
    assert alone == pytest.approx(p**-n)
    assert cher == pytest.approx(1 + n * (1 / p - 1))
    assert cher <= n / p + 1e-9
    assert cher <= her + 1e-6 * her
    assert her <= alone * (1 + 1e-6)
    assert her >= p ** -(n - part + 1) * (1 - 1e-9)
    assert all(sum(learning_steps(n, stages, algo)) == n for algo in ("no_hindsight", "her", "cher"))


def test_the_first_success_of_each_run_counts() -> None:
    rows = [
        {"run": run, "frames": 12 * epoch, "success": float(epoch in solved)}
        for epoch in (1, 2, 3)
        for run, solved in enumerate([(2,), (), (1, 3)])
    ]
    assert episodes_to_solve(rows, 4) == [6.0, math.inf, 3.0]


def chain(**options: object) -> Recipe:
    return make_recipe(task="chain", options=options, algo="her", epochs=1, epoch_frames=640)


def test_times_are_drawn_whether_chains_were_solved_or_not(tmp_path: Path) -> None:
    cells = [
        (
            chain(length=n, stages=2),
            [{"run": run, "frames": 640, "success": float(n < 8)} for run in range(3)],
        )
        for n in (4, 8)
    ]
    plot_times(cells, tmp_path / "times.png")
    with Image.open(tmp_path / "times.png") as picture:
        assert min(picture.size) > 400


def test_times_of_other_runs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"times are drawn of runs of chain, got \['hand_v0'\]"):
        plot_times([(make_recipe(), [])], tmp_path / "times.png")
    with pytest.raises(ValueError, match=r"of one number of stages, got \[1, 2\]"):
        plot_times([(chain(length=4), []), (chain(length=4, stages=2), [])], tmp_path / "times.png")
