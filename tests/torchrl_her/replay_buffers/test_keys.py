"""Keys of transitions, and the entries that relabeling changes."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_her import EnvKeys, HindsightOptions
from torchrl_her.checks import entry_of
from torchrl_her.replay_buffers.keys import in_root_and_next, under_next


def test_keys_under_next() -> None:
    assert under_next("reward") == ("next", "reward")
    assert under_next(("agent", "reward")) == ("next", "agent", "reward")
    assert in_root_and_next(["state", ("agent", "seen")]) == [
        "state",
        ("next", "state"),
        ("agent", "seen"),
        ("next", "agent", "seen"),
    ]
    assert in_root_and_next([]) == []


def test_what_relabeling_changes_by_hand() -> None:
    names = EnvKeys(desired_goal=("agent", "wanted"), reward="cost")
    keys = HindsightOptions(keys=names).transition_keys()
    goals, reward = torch.tensor([[1.0], [2.0]]), torch.tensor([[0.0], [-1.0]])
    terminated, truncated = torch.tensor([[True], [False]]), torch.tensor([False, True])
    changes = keys.changes(goals, reward, terminated, truncated)
    assert list(changes) == [
        ("agent", "wanted"),
        ("next", "agent", "wanted"),
        ("next", "cost"),
        ("next", "terminated"),
        ("next", "done"),
    ]
    assert changes["next", "done"].tolist() == [[True], [True]]
    assert changes["next", "terminated"].tolist() == [[True], [False]]


def test_a_missing_entry_is_named_with_those_that_are_there() -> None:
    transitions = TensorDict({"here": torch.zeros(2)}, [2])
    assert entry_of(transitions, "here").tolist() == [0.0, 0.0]
    with pytest.raises(KeyError, match=r"relabeling needs the entry 'gone', got \['here'\]"):
        entry_of(transitions, "gone")
