"""What is measured at the end of an epoch."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from torchrl_her.replay_buffers import empty_run, rows_of_run
from torchrl_her_envs import make_env
from torchrl_her_recipes import Components, build
from torchrl_her_recipes.runs.curriculum import play_greedily
from torchrl_her_recipes.runs.evaluation import measure
from torchrl_her_recipes.runs.virtual_goals import ask_for_virtual_goals, at_virtual_goals

from ..small import small


def measured(components: Components) -> dict[str, torch.Tensor]:
    return measure(components, play_greedily(components, components.eval_env, 0))


def set_last_biases(components: Components, change: Any) -> None:
    """Changes the last layers of the critics that the loss trains."""
    loss = components.loss
    params = getattr(loss, "qvalue_network_params", None)
    params = loss.value_network_params if params is None else params
    bias = params["module", "rest", "2", "bias"].data
    bias.add_(torch.tensor(change).view(-1, *[1] * (bias.ndim - 1)).expand_as(bias))


@pytest.mark.parametrize(
    ("options", "change", "expected"),
    [
        ({"learner": "ddpg"}, [-1.0], [-1.0]),
        ({"learner": "ddpg", "num_runs": 2}, [-1.0, -2.0], [-1.0, -2.0]),
        ({"learner": "td3"}, [-1.0, -1.0], [-1.0]),
        ({"learner": "sac"}, [-1.0, -1.0], [-1.0]),
        ({"learner": "tqc"}, [-1.0, -1.0], [-1.0]),
        ({"learner": "redq", "critics": 4}, [-1.0, -2.0, -3.0, -2.0], [-2.0]),
    ],
)
def test_q_is_that_of_the_critics_that_are_trained(
    options: dict[str, Any], change: list[float], expected: list[float]
) -> None:
    components = build(small(task="hand_v0", **options))
    before = measured(components)
    set_last_biases(components, change)
    after = measured(components)
    for name in ("q", "q_bias"):
        torch.testing.assert_close(after[name] - before[name], torch.tensor(expected))


@pytest.mark.parametrize("learner", ["td3", "sac"])
def test_q_is_the_lesser_one_of_two_critics(learner: str) -> None:
    components = build(small(task="hand_v0", learner=learner))
    before = measured(components)
    set_last_biases(components, [0.0, 100.0])  # the second one is never the lesser one any more
    first = measured(components)["q"]
    set_last_biases(components, [100.0, -100.0])  # and now the first one
    second = measured(components)["q"]
    assert -1e-3 <= float(first - before["q"]) < 50.0
    assert -1e-3 <= float(second - before["q"]) < 50.0
    assert float(first) != float(second)


def test_q_is_not_logged_if_nobody_knows_it() -> None:
    components = build(small(task="hand_v0"))
    components.loss = torch.nn.Module()  # type: ignore[assignment]
    components.loss.tensor_keys = None
    assert not {"q", "q_bias"} & measured(components).keys()


@pytest.mark.parametrize("algo", ["her", "cher"])
def test_few_worlds_play_as_many_episodes_as_asked(algo: str) -> None:
    options: dict[str, Any] = {"task": "gym:torchrl_her/HandThrow-v1", "algo": algo, "episodes": 25}
    if algo == "cher":
        options["curriculum"] = make_env("hand_v1", num_envs=1).stages()
    components, alone = build(small(num_runs=2, **options)), build(small(seed=1, **options))
    for each in (components, alone):
        each.actor.load_state_dict({name: value * 0 for name, value in each.actor.state_dict().items()})
    assert components.eval_env.batch_size == (2 * 13,)
    played = play_greedily(components, components.eval_env, 3)
    assert played.batch_size[0] == 2 * 25
    goals = played["desired_goal"][:, 0]
    assert len(goals.unique(dim=0)) == 2 * 25
    other = play_greedily(alone, alone.eval_env, 3)
    assert torch.equal(other["desired_goal"], played["desired_goal"][25:])  # as if it were alone
    assert torch.equal(other["observation"], played["observation"][25:])
    assert measure(components, played)["success"].shape == (2,)


def test_episodes_may_ask_for_virtual_goals() -> None:
    components = build(small(task="hand_v1", algo="her", num_runs=2, virtual_goals=True))
    before = at_virtual_goals(components, 0)
    assert all(value.isnan().all() for value in before.values())
    assert list(before) == ["virtual_success", "virtual_q", "virtual_q_bias"]
    components.trainer().epoch()
    rows = at_virtual_goals(components, 1)
    assert all(value.isfinite().all() for value in rows.values())
    again = at_virtual_goals(components, 1)
    assert all(torch.equal(value, again[name]) for name, value in rows.items())
    assert ask_for_virtual_goals(components, components.virtual_env, 1) == [True, True]
    wanted = components.virtual_env.reset()["desired_goal"].view(2, -1, 2)
    for run, goals in enumerate(wanted):
        own = rows_of_run(components.buffer, run)
        known = own["desired_goal"][own["virtual"].squeeze(-1)]
        assert all((known == goal).all(-1).any() for goal in goals)


def test_a_run_without_virtual_goals_leaves_the_others_theirs() -> None:
    components = build(small(task="hand_v1", algo="her", num_runs=2, virtual_goals=True))
    components.trainer().epoch()
    empty_run(components.buffer, 0)
    assert at_virtual_goals(components, 1)["virtual_q"].isnan().tolist() == [True, False]


def test_virtual_goals_are_asked_for_in_every_round() -> None:
    components = build(small(task="hand_v0", algo="her", virtual_goals=True))
    components.trainer().epoch()
    env = components.virtual_env
    assert ask_for_virtual_goals(components, env, 1) == [True]
    own = rows_of_run(components.buffer, 0)
    known = own["desired_goal"][own["virtual"].squeeze(-1)]
    for _ in range(3):
        rows = env.rollout(10, break_when_any_done=False)
        assert all((known == goal).all(-1).any() for goal in rows["desired_goal"][:, 0])


def test_with_stages_for_episodes_they_are_goals_of_the_last() -> None:
    components = build(small(task="hand_v1", algo="unfiltered_cher", order="all_at_once", virtual_goals=True))
    components.trainer().epoch()
    env = components.virtual_env
    assert ask_for_virtual_goals(components, env, 1) == [True]
    own = rows_of_run(components.buffer, 0)
    last = own["virtual"].squeeze(-1) & (own["stage"].squeeze(-1) == 1)
    assert all((own["desired_goal"][last] == goal).all(-1).any() for goal in env.reset()["desired_goal"])


def test_virtual_goals_of_lower_stages_are_not_those_of_the_task() -> None:
    components = build(small(task="hand_v1", algo="cher", num_runs=2, virtual_goals=True))
    components.trainer().epoch()
    components.curriculum.progress.set_stage(1, 1)
    assert at_virtual_goals(components, 1)["virtual_success"].isnan().tolist() == [True, False]


def test_without_it_there_is_no_environment_for_virtual_goals() -> None:
    components = build(small(task="hand_v1", algo="her"))
    assert components.virtual_env is None
    assert at_virtual_goals(components, 0) == {}
