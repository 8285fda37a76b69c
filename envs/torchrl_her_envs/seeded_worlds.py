"""What batches of worlds have in common whose randomness is all made of their seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her_envs.seeding import block_keys


class SeededWorlds(EnvBase):
    """N worlds that are nothing but a dataclass of tensors and a key for each of them.

    Attributes:
        worlds: where the worlds are now: a dataclass of tensors with N rows, ``episode`` among them, which
            counts the resets of a world.
    """

    worlds: Any

    def world_state_dict(self) -> dict[str, Tensor]:
        """A copy of all that the worlds are, row by row; they resume exactly from it."""
        state = {field.name: getattr(self.worlds, field.name).clone() for field in fields(self.worlds)}
        return state | {"key": torch.from_numpy(self._keys.view(np.int64).copy())}

    def load_world_state_dict(self, state: dict[str, Tensor]) -> None:
        """Puts the worlds back to where :meth:`world_state_dict` was taken."""
        entries = {field.name: state[field.name].clone() for field in fields(self.worlds)}
        self.worlds = type(self.worlds)(**entries)
        self._keys = state["key"].numpy().copy().view(np.uint64)

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds R equal blocks of worlds, each as if it were alone.

        Args:
            seeds: R of them.

        Raises:
            ValueError: the worlds cannot be shared out among R blocks, or a seed is out of range.
        """
        self._keys = block_keys(seeds, self.batch_size[0])
        self.worlds.episode.zero_()

    def _set_seed(self, seed: int | None) -> None:
        self.set_seeds([seed or 0])
