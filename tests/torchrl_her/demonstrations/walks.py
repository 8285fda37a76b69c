"""Demonstrations of walks on a line, whose numbers tell where they come from."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from torchrl_her.demonstrations import Demonstrations


def walks(*lengths: int, goal: float | None = None, states: bool = True, **facts: Any) -> Demonstrations:
    """Episode e goes from 100 e by steps of 1; its goal is its end, unless it is given."""
    e = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    t = torch.cat([torch.arange(own) for own in lengths])
    at = (100.0 * e + t).unsqueeze(-1)
    end = torch.tensor([100.0 * own + length for own, length in enumerate(lengths)])
    wanted = end[e].unsqueeze(-1) if goal is None else torch.full_like(at, goal)
    last = (t + 1 == torch.tensor(lengths)[e]).unsqueeze(-1)
    achieved = at + 1 == wanted
    rows = TensorDict(
        {
            "observation": at,
            "achieved_goal": at,
            "desired_goal": wanted,
            "action": at / 1000,
            "next": {
                "observation": at + 1,
                "achieved_goal": at + 1,
                "desired_goal": wanted,
                "reward": achieved.float() - 1,
                "terminated": last & achieved,
                "truncated": last & ~achieved,
                "done": last,
            },
        },
        [len(at)],
    )
    own = {"place": at.double(), "goal": wanted.clone()} if states else None
    return Demonstrations(rows, torch.tensor(lengths), states=own, task="walk", **facts)
