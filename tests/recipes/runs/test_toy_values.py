"""Metrics of values in toy environments, against networks whose values are known."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import QValueActor

from torchrl_her_envs import BitFlip, TreasureHunt
from torchrl_her_recipes.runs.toy_values import measure_values

KEYS = ["observation", "desired_goal"]


class KnowsBits(nn.Module):
    """1 for a needed flip, -1 for a needless one, and the number of wrong bits for the last action."""

    def forward(self, place: Tensor, goal: Tensor) -> Tensor:
        differs = place != goal
        return torch.cat((differs * 2.0 - 1.0, differs.sum(-1, keepdim=True)), -1)


class KnowsTheWay(nn.Module):
    """How far the treasure is to the left, and to the right."""

    def forward(self, place: Tensor, goal: Tensor) -> Tensor:
        return torch.cat((place - goal, goal - place), -1)


class TwoOpinions(nn.Module):
    """Of two runs: the first as above, the second thinks nothing of the last action."""

    def forward(self, place: Tensor, goal: Tensor) -> Tensor:
        values = KnowsBits()(place, goal)
        values[len(values) // 2 :, -1] = -1.0
        return values


class AlwaysLeft(nn.Module):
    def forward(self, place: Tensor, goal: Tensor) -> Tensor:
        return torch.cat((place * 0 + 1, place * 0), -1)


def test_what_two_runs_make_of_the_useless_action() -> None:
    env = BitFlip(4, useless_action=True)
    actor = QValueActor(TwoOpinions(), spec=Categorical(5), in_keys=KEYS, action_space="categorical")
    measured = measure_values(actor, env, 2)
    # One value more than a needed flip for each wrong bit beyond the first, over 1 to 4; then never.
    assert measured["useless_margin"].tolist() == [1.5, -2.0]
    assert measured["useless_share"].tolist() == [0.75, 0.0]
    assert measure_values(actor, BitFlip(4), 2) == {}


def test_the_right_way_is_towards_the_treasure() -> None:
    actor = QValueActor(KnowsTheWay(), spec=Categorical(2), in_keys=KEYS, action_space="categorical")
    assert measure_values(actor, TreasureHunt(20), 1)["right_way"].tolist() == [1.0]
    always_left = QValueActor(AlwaysLeft(), spec=Categorical(2), in_keys=KEYS, action_space="categorical")
    assert measure_values(always_left, TreasureHunt(20), 1)["right_way"].tolist() == [0.5]
