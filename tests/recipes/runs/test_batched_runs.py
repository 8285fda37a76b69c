"""Runs side by side are the runs that they would be alone."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from torchrl_her.modules import take_run
from torchrl_her.replay_buffers.runs import rows_of_run
from torchrl_her.replay_buffers.runs.buffer import empty_run, sizes_of
from torchrl_her_recipes import Callback, Components, Recipe, RunView, build, run

from ..small import small

RUNS = 3


def train(recipe: Recipe) -> Components:
    components = build(recipe)
    run(components, progress=False)
    return components


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


@pytest.fixture(scope="module", params=["her", "filtered_her_ibs", "cher"])
def runs(request: pytest.FixtureRequest) -> tuple[Components, list[Components]]:
    options: dict[str, Any] = {
        "algo": request.param,
        "dtype": "float64",
        "frames_per_update": 8.0,
        "seed": 5,
    }
    return (
        train(small(num_runs=RUNS, **options)),
        [train(small(**{**options, "seed": 5 + run})) for run in range(RUNS)],
    )


def test_at_least_two_hundred_updates_were_made(runs: tuple[Components, list[Components]]) -> None:
    recipe = runs[0].recipe
    assert recipe.total_frames / recipe.collection.frames_per_update >= 200


@pytest.mark.parametrize("run", range(RUNS))
def test_each_run_follows_the_single_run_with_its_seed(
    runs: tuple[Components, list[Components]], run: int
) -> None:
    together, alone = runs[0], runs[1][run]
    torch.testing.assert_close(weights(together, run), weights(alone, 0), rtol=1e-7, atol=1e-9)
    rows, own = rows_of_run(together.buffer, run), rows_of_run(alone.buffer)
    assert len(rows) == len(own)
    for key in ("desired_goal", "action", ("next", "reward")):
        torch.testing.assert_close(rows[key], own[key], rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(priorities(together, run), priorities(alone, 0), rtol=1e-6, atol=1e-9)


def test_runs_differ_from_each_other(runs: tuple[Components, list[Components]]) -> None:
    assert not torch.allclose(weights(runs[0], 0), weights(runs[0], 1))


def test_nothing_of_a_run_reaches_another() -> None:
    spoiled, whole = build(small(num_runs=2)), build(small(num_runs=2))
    with torch.no_grad():
        for parameter in spoiled.actor.parameters():
            parameter[1].mul_(-3.0)
        for parameter in spoiled.critic.parameters():
            parameter[1].mul_(100.0)
    for components in (spoiled, whole):
        run(components, progress=False)
    assert torch.equal(weights(spoiled, 0), weights(whole, 0))
    assert not torch.equal(weights(spoiled, 1), weights(whole, 1))


def test_the_table_has_a_row_for_each_run_and_epoch() -> None:
    result = run(build(small(num_runs=2, seed=7)), progress=False)
    assert [(row["epoch"], row["run"], row["seed"]) for row in result.rows] == [
        (1, 0, 7),
        (1, 1, 8),
        (2, 0, 7),
        (2, 1, 8),
    ]


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


def check_like_alone(options: dict[str, Any], *, tolerance: float = 1e-6) -> None:
    """Trains runs side by side and alone, and compares what they measured and their weights."""
    together, emptying = build(small(num_runs=RUNS, **options)), Emptying()
    rows = run(together, callbacks=[emptying], progress=False).rows
    assert any(any(own) and not all(own) for own in emptying.idle)
    for index in range(RUNS):
        alone = build(small(**{**options, "seed": options["seed"] + index}))
        single = run(alone, callbacks=[Emptying()], progress=False).rows
        for own, other in zip(rows[index::RUNS], single, strict=True):
            names = [name for name in own if name not in ("seconds", "run", "updates")]
            expected = {name: pytest.approx(other[name], rel=tolerance, nan_ok=True) for name in names}
            assert {name: own[name] for name in names} == expected
        torch.testing.assert_close(
            weights(together, index), weights(alone, 0), rtol=tolerance, atol=tolerance
        )


@pytest.mark.parametrize("compile", ["auto", "never"])
@pytest.mark.parametrize("options", LEARNERS, ids=lambda own: "_".join(map(str, own.values())))
def test_a_run_that_learns_later_than_others_is_what_it_is_alone(
    options: dict[str, Any], compile: str
) -> None:
    own = {"task": "hand_v2", "frames_per_update": 16.0, "hidden": 16, "compile": compile}
    check_like_alone({**own, "dtype": "float64", "seed": 5, **options})


def test_a_run_with_discrete_actions_that_learns_later_is_what_it_is_alone() -> None:
    own = {"task": "bit_flip", "task.options.bits": 12, "frames_per_update": 16.0, "hidden": 16}
    check_like_alone({**own, "seed": 5}, tolerance=1e-4)


@pytest.mark.parametrize("learner", ["ddpg", "sac"])
def test_runs_in_different_stages_of_a_curriculum_are_what_they_are_alone(learner: str) -> None:
    own = {"algo": "cher", "task": "hand_v1", "learner": learner, "hidden": 16, "frames_per_update": 16.0}
    stages = {"window": 4, "success_threshold": 0.25, "guided_share": 0.5, "epochs": 4}
    check_like_alone({**own, **stages, "dtype": "float64", "seed": 7})
