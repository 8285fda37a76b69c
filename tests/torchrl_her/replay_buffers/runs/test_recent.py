"""What runs remember of recent episodes. Goals are tagged with environment, episode and state."""

from __future__ import annotations

import pytest
import torch

from torchrl_her import HindsightOptions
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.runs.recent import RecentGoals

from ...her_data import make_batch

KEYS = HindsightOptions().transition_keys()
ROWS = make_batch([[2], [3]]).reshape(-1)  # two episodes; the third row is of an open one
EPISODES = Episodes(torch.tensor([[0, 1, 1], [3, 4, 5]]), torch.tensor([2, 3]))
RUN = torch.tensor([0, 1])


def remembered(recent: RecentGoals, name: str) -> list[list[float] | None]:
    return [None if own is None else own[:, 0].tolist() for own in recent.goals[name]]


def after(recent: RecentGoals, run: torch.Tensor | None = RUN, **sizes: int) -> RecentGoals:
    return recent.after(ROWS, EPISODES, run, KEYS, sizes=sizes)


def test_only_what_is_asked_for_is_remembered_and_of_it_the_newest() -> None:
    recent = after(RecentGoals.none(2), achieved=4)
    assert remembered(recent, "actual") == [None, None]
    recent = after(recent, achieved=4)
    assert remembered(recent, "achieved") == [[1.0, 2.0, 1.0, 2.0], [1003.0, 1001.0, 1002.0, 1003.0]]


def test_of_more_goals_than_are_kept_those_of_all_environments_are_remembered() -> None:
    recent = after(after(RecentGoals.none(2), achieved=9), achieved=2)
    assert remembered(recent, "achieved") == [[1.0, 2.0], [1001.0, 1003.0]]  # of the newest batch only
    assert remembered(after(RecentGoals.none(1), None, achieved=3), "achieved") == [[1.0, 1001.0, 1002.0]]
    rows = make_batch([[50]] * 64).reshape(-1)
    episodes = Episodes(torch.arange(3_200).view(64, 50), torch.full((64,), 50))
    for size, least in ((2_000, 28), (64, 1), (128, 2)):
        recent = RecentGoals.none(1).after(rows, episodes, None, KEYS, sizes={"achieved": size})
        (own,) = recent.goals["achieved"]
        assert own is not None
        tags = own[:, 0].long()
        assert len(tags.unique()) == size
        counts = (tags // 1000).bincount(minlength=64)
        assert counts.min() >= least
        assert counts.max() <= size / 64 + 3
        steps = (tags % 1000).float()
        assert steps.mean().item() == pytest.approx(25.5, abs=1.0)  # at all times of an episode
        assert len(steps.unique()) > 30


def test_wanted_goals_get_the_type_of_achieved_ones() -> None:
    rows = ROWS.clone().set("desired_goal", ROWS["desired_goal"].double())
    recent = RecentGoals.none(1).after(rows, EPISODES, None, KEYS, sizes={"actual": 9})
    (own,) = recent.goals["actual"]
    assert own is not None
    assert own.dtype == torch.float32
