"""Transitions of a game that nobody can win: every reward is -1."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.data import Bounded

SPEC = Bounded(-2.0, 2.0, (3,))


def rows(n: int, *, action: torch.Tensor, runs: int = 1) -> TensorDict:
    def seen() -> dict[str, torch.Tensor]:
        return {"observation": torch.randn(runs, n, 4), "desired_goal": torch.randn(runs, n, 2)}

    off = torch.zeros(runs, n, 1, dtype=torch.bool)
    after = seen() | {"reward": -torch.ones(runs, n, 1), "done": off, "terminated": off.clone()}
    return TensorDict(seen() | {"action": action, "next": after}, [runs, n])
