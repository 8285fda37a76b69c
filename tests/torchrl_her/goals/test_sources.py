"""Goal sources: what is checked of them, and what they are called. More in ``replay_buffers``."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_her.goals.sources import check_goal_sources, sources_name


def soon(time: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    return time, torch.minimum(time + 5, lengths)


def test_functions_are_sources_too() -> None:
    sources = check_goal_sources({soon: 2, "achieved": 1, "final": 1})
    assert sources == {soon: 2, "achieved": 1, "final": 1}
    assert sources_name(sources) == "soon: 2, achieved: 1, final: 1"


def test_numbers_are_made_plain_and_the_mapping_is_a_copy() -> None:
    given = {"future": torch.ones(3, dtype=torch.int64).numpy().sum()}
    checked = check_goal_sources(given)
    assert type(checked["future"]) is int
    given["future"] = 9
    assert checked == {"future": 3}
