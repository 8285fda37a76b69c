"""Saves a part of a replay buffer as a file in a folder, with the methods that TorchRL's buffers call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from torchrl_her.files.reading import read_tensors

_NAME = "state.pt"


class StateFile:
    """Base class whose ``dumps`` saves the ``state_dict`` of a part of a replay buffer in one file."""

    def dumps(self: Any, path: str | Path) -> None:
        """Writes the state into a folder, which is made if its parent exists."""
        Path(path).mkdir(exist_ok=True)
        torch.save(self.state_dict(), Path(path) / _NAME)

    def loads(self: Any, path: str | Path) -> None:
        """Restores the state that :meth:`dumps` wrote."""
        self.load_state_dict(read_tensors(Path(path) / _NAME))
