"""Values of goals are those of the loss's own critics, for each of several runs."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.objectives import LossModule

from torchrl_her import make_actor, make_critic, make_ddpg_loss
from torchrl_her.behavior import GoalValues
from torchrl_her.objectives import critic_value, critic_values, make_td3_loss

WIDTHS = (3, 2)


def agent(*, runs: int = 1, critics: int = 1) -> tuple[LossModule, TensorDictBase]:
    torch.manual_seed(0)
    actor = make_actor(WIDTHS, 1, runs=runs)
    every = [make_critic(WIDTHS, 1, runs=runs) for _ in range(critics)]
    if critics == 1:
        return make_ddpg_loss(actor, every[0]), actor
    return make_td3_loss(actor, every, action_spec=Bounded(-1.0, 1.0, (1,))), actor


def by_hand(loss: LossModule, actor: TensorDictBase, observation: Tensor, goals: Tensor) -> Tensor:
    rows = TensorDict({"observation": observation, "desired_goal": goals}, [len(goals)])
    value = critic_value(loss, actor(rows))
    assert value is not None
    return value.squeeze(-1)


def test_one_observation_and_many_goals() -> None:
    loss, actor = agent()
    observation, goals = torch.randn(4, 3), torch.randn(4, 5, 2)
    values = GoalValues(loss, actor)(observation, goals, [4])
    assert values.shape == (4, 5, 1)
    own = by_hand(loss, actor, observation[2].expand(5, -1), goals[2])
    torch.testing.assert_close(values[2, :, 0], own)


def test_many_observations_and_one_goal() -> None:
    loss, actor = agent()
    observation, goal = torch.randn(4, 5, 3), torch.randn(4, 1, 2)
    values = GoalValues(loss, actor)(observation, goal, [4])
    own = by_hand(loss, actor, observation[1], goal[1].expand(5, -1))
    torch.testing.assert_close(values[1, :, 0], own)


def test_each_run_asks_its_own_networks() -> None:
    loss, actor = agent(runs=3)
    observation, goals = torch.randn(1, 3).expand(4, -1), torch.randn(1, 1, 2).expand(4, -1, -1)
    values = GoalValues(loss, actor, runs=3)(observation, goals, [1, 0, 3])
    every = by_hand(loss, actor, observation[:3], goals[:3, 0])  # a row for each run
    torch.testing.assert_close(values.flatten(), every[[0, 2, 2, 2]])


def test_each_critic_has_a_value() -> None:
    loss, actor = agent(critics=3)
    observation, goals = torch.randn(2, 3), torch.randn(2, 4, 2)
    values = GoalValues(loss, actor)(observation, goals, [2])
    assert values.shape == (2, 4, 3)
    own = by_hand(loss, actor, observation[0].expand(4, -1), goals[0])
    torch.testing.assert_close(values[0].amin(-1), own)
    rows = actor(TensorDict({"observation": observation, "desired_goal": goals[:, 0]}, [2]))
    assert critic_values(loss, rows).shape == (2, 3)  # type: ignore[union-attr]


def test_what_comes_before_the_networks() -> None:
    loss, actor = agent()
    seen = []

    def note(name: str):
        def prepare(rows: TensorDictBase) -> TensorDictBase:
            seen.append((name, "action" in rows.keys()))
            return rows.clone().set("observation", torch.zeros_like(rows["observation"]))

        return prepare

    values = GoalValues(loss, actor, before_actor=note("actor"), before_critic=note("critic"))
    goals = torch.randn(2, 4, 2)
    own = values(torch.randn(2, 3), goals, [2])
    assert seen == [("actor", False), ("critic", True)]
    torch.testing.assert_close(own[1, :, 0], by_hand(loss, actor, torch.zeros(4, 3), goals[1]))


def test_a_loss_without_critics_is_refused() -> None:
    class Strange(LossModule):
        def __init__(self) -> None:
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(1))

        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            return tensordict

    _, actor = agent()
    with pytest.raises(ValueError, match="Strange has no critics like those of"):
        GoalValues(Strange(), actor)(torch.zeros(1, 3), torch.zeros(1, 1, 2), [1])
