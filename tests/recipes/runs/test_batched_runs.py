"""Runs side by side are the runs that they would be alone."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from torchrl_her.modules import take_run
from torchrl_her.replay_buffers import rows_of_run
from torchrl_her.replay_buffers.runs.buffer import empty_run, sizes_of
from torchrl_her_recipes import Callback, Components, Recipe, RunView, build, run

from ..small import small

RUNS = 3


def train(recipe: Recipe) -> tuple[Components, list[dict[str, float]]]:
    components = build(recipe)
    return components, run(components, progress=False).rows


def weights(components: Components, run: int) -> Tensor:
    state = {
        **components.actor.state_dict(),
        **{f"critic {k}": v for k, v in components.critic.state_dict().items()},
    }
    return torch.cat(
        [value.flatten() for value in take_run(state, run, components.recipe.run.num_runs).values()]
    )


def priorities(components: Components, run: int) -> Tensor:
    return components.buffer.sampler.state_dict()["values"][run]


@pytest.mark.parametrize("algo", ["filtered_her_ibs", "cher"])
def test_each_run_follows_the_single_run_with_its_seed(algo: str) -> None:
    """Over two hundred updates."""
    options: dict[str, Any] = {
        "algo": algo,
        "dtype": "float64",
        "frames_per_update": 4.0,
    }
    together, rows = train(small(num_runs=RUNS, seed=5, **options))
    assert together.recipe.total_frames / together.recipe.collection.frames_per_update >= 200
    pairs = [(epoch, index) for epoch in (1, 2) for index in range(RUNS)]
    assert [(row["epoch"], row["run"], row["seed"]) for row in rows] == [(e, i, 5 + i) for e, i in pairs]
    assert not torch.allclose(weights(together, 0), weights(together, 1))
    for index in range(RUNS):
        alone, _ = train(small(seed=5 + index, **options))
        torch.testing.assert_close(weights(together, index), weights(alone, 0), rtol=1e-7, atol=1e-9)
        stored, single = rows_of_run(together.buffer, index), rows_of_run(alone.buffer)
        assert len(stored) == len(single)
        for key in ("desired_goal", "action", ("next", "reward")):
            torch.testing.assert_close(stored[key], single[key], rtol=1e-7, atol=1e-9)
        torch.testing.assert_close(priorities(together, index), priorities(alone, 0), rtol=1e-6, atol=1e-9)


def test_nothing_of_a_run_reaches_another() -> None:
    spoiled, whole = (build(small(num_runs=2, epochs=1)) for _ in range(2))
    with torch.no_grad():
        for parameter in spoiled.actor.parameters():
            parameter[1].mul_(-3.0)
        for parameter in spoiled.critic.parameters():
            parameter[1].mul_(100.0)
    for components in (spoiled, whole):
        run(components, progress=False)
    assert torch.equal(weights(spoiled, 0), weights(whole, 0))
    assert not torch.equal(weights(spoiled, 1), weights(whole, 1))


LATER: dict[str, Any] = {
    "frames_per_update": 32.0,
    "hidden": 16,
    "epochs": 1,
    "epoch_frames": 960,
    "seed": 5,
}
LEARNERS: list[dict[str, Any]] = [
    {"learner": "ddpg"},
    {"learner": "td3"},
    {"learner": "sac"},
    {"learner": "redq", "critics": 3},
    {"learner": "tqc", "quantiles": 5},
    {"learner": "ddpg", "hard_update_interval": 7},
]


class Emptying(Callback):
    """Empties the buffer of each run after as many frames as its seed says, and notes when it has no rows."""

    def __init__(self) -> None:
        self.idle: list[list[bool]] = []

    def on_batch(self, run: RunView) -> None:
        recipe = run.components.recipe
        for index, seed in enumerate(recipe.seeds):
            if run.trainer.frames == recipe.collection.num_envs * recipe.collection.steps_per_batch * (
                6 + seed % 3
            ):
                empty_run(run.components.buffer, index)
        self.idle.append([size == 0 for size in sizes_of(run.components.buffer)])


Trained = tuple[Components, list[dict[str, float]]]


def train_alone(options: dict[str, Any]) -> list[Trained]:
    """Trains the runs one by one."""
    trained = []
    for index in range(RUNS):
        alone = build(small(**{**options, "seed": options["seed"] + index}))
        trained.append((alone, run(alone, callbacks=[Emptying()], progress=False).rows))
    return trained


def check_like_alone(
    options: dict[str, Any], *, alone: list[Trained] | None = None, tolerance: float = 1e-6
) -> list[dict[str, float]]:
    """Trains runs side by side and alone, compares their metrics and weights, and returns the metrics."""
    together, emptying = build(small(num_runs=RUNS, **options)), Emptying()
    rows = run(together, callbacks=[emptying], progress=False).rows
    assert any(any(own) and not all(own) for own in emptying.idle)
    for index, (single, expected_rows) in enumerate(alone or train_alone(options)):
        for own, other in zip(rows[index::RUNS], expected_rows, strict=True):
            names = [name for name in own if name not in ("seconds", "run", "updates")]
            expected = {name: pytest.approx(other[name], rel=tolerance, nan_ok=True) for name in names}
            assert {name: own[name] for name in names} == expected
        torch.testing.assert_close(
            weights(together, index), weights(single, 0), rtol=tolerance, atol=tolerance
        )
    return rows


@pytest.mark.parametrize("options", LEARNERS, ids=lambda own: "_".join(map(str, own.values())))
def test_a_run_that_learns_later_than_others_is_what_it_is_alone(options: dict[str, Any]) -> None:
    """By compiled steps and without, which learn the same."""
    shared = {**LATER, "task": "hand_v2", "dtype": "float64", **options}
    alone = train_alone(shared)
    for compile in ("auto", "never"):
        check_like_alone({**shared, "compile": compile}, alone=alone)


def test_a_run_with_discrete_actions_that_learns_later_is_what_it_is_alone() -> None:
    check_like_alone({**LATER, "task": "bit_flip", "task.options.bits": 12}, tolerance=1e-4)


@pytest.mark.parametrize(("learner", "seed"), [("ddpg", 7), ("sac", 15)])
def test_runs_in_different_stages_of_a_curriculum_are_what_they_are_alone(learner: str, seed: int) -> None:
    """The first run reaches the second stage after an epoch."""
    options = {"algo": "cher", "task": "hand_v1", "learner": learner, "seed": seed, "dtype": "float64"}
    stages = {"window": 4, "success_threshold": 0.25, "guided_share": 0.5, "epochs": 3, "epoch_frames": 480}
    rows = check_like_alone({**LATER, **options, **stages})
    assert [row["stage"] for row in rows] == [0, 0, 0, 1, 0, 0, 1, 0, 0]
