"""Converts the entries of ``info`` that an environment's rewards read to entries of transitions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, Unbounded

from torchrl_her_envs.common.goal_env import INFO, info_rows


class Infos:
    """Named entries of ``info``: numbers, or arrays of one shape.

    Args:
        names: names of the entries.
        examples: the infos of some steps, each of which must have all these entries.
        env: name of the environment, for messages.

    Raises:
        ValueError: an entry is missing, is no number or array of numbers, or changes its shape.

    Example:
        >>> infos = Infos(["cost"], [{"cost": 0.5}, {"cost": 1}], "walk")
        >>> infos.stack([{"cost": 2.0}, {"cost": 3.0}])
        {'cost': array([2., 3.])}
        >>> infos.rows({"cost": np.array([2.0, 3.0])})["cost"].tolist()
        [[2.0], [3.0]]
    """

    def __init__(self, names: Sequence[str], examples: Sequence[Mapping[str, Any]], env: str) -> None:
        if isinstance(names, str) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"info_keys must be a list of keys of info, as in [cost], got {names!r}")
        self._env = env
        self._kinds = {name: self._kind(name, examples) for name in names}

    def _kind(self, name: str, examples: Sequence[Mapping[str, Any]]) -> tuple[tuple[int, ...], np.dtype]:
        """Returns shape and type of an entry."""
        lacking = [info for info in examples if name not in info]
        if lacking:
            raise ValueError(self._lacks(name, lacking[0]))
        values = [np.asarray(info[name]) for info in examples]
        shape, dtype = values[0].shape, np.result_type(*values)
        if any(value.shape != shape for value in values) or dtype.kind not in "fiub":
            raise ValueError(
                f"{self._env}: info[{name!r}] must be a number, or an array of numbers of one shape, got "
                f"{examples[0][name]!r}"
            )
        return shape, np.dtype(np.int64) if dtype.kind == "u" else dtype

    def _lacks(self, name: str, info: Iterable[str]) -> str:
        known = [key for key in info if not key.startswith("_")]
        return (
            f"{self._env}: info_keys names {name!r}, which the info of a step lacks; it has "
            f"{', '.join(known) or 'nothing'}"
        )

    @property
    def keys(self) -> list[tuple[str, str]]:
        """Keys of the entries in transitions."""
        return [(INFO, name) for name in self._kinds]

    def spec(self, count: int) -> Composite:
        """Returns the spec of the entries of some environments: single numbers are [count, 1]."""
        specs = {
            name: Unbounded((count, *(shape or (1,))), dtype=torch.from_numpy(np.empty(0, dtype)).dtype)
            for name, (shape, dtype) in self._kinds.items()
        }
        return Composite(specs, shape=(count,))

    def stack(self, infos: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
        """Stacks the infos of single environments to entries [n, ...]."""
        return {name: np.array([info[name] for info in infos], kind[1]) for name, kind in self._kinds.items()}

    def of_batch(self, infos: Mapping[str, Any], count: int, *, reset: bool = False) -> dict[str, np.ndarray]:
        """Returns the entries [count, ...] of a vector environment's info; 0 where a reset lacks one.

        Raises:
            ValueError: an environment's step lacks an entry.
        """
        out = {}
        for name, (shape, dtype) in self._kinds.items():
            present = infos.get(f"_{name}", np.zeros(count, np.bool_))
            if not (reset or present.all()):
                raise ValueError(self._lacks(name, infos))
            out[name] = np.zeros((count, *shape), dtype)
            for index in present.nonzero()[0]:
                out[name][index] = infos[name][index]
        return out

    def rows(self, entries: Mapping[str, np.ndarray]) -> TensorDict:
        """Converts entries [n, ...] of :meth:`of_batch` for transitions, [n, 1] for single numbers."""
        count = len(next(iter(entries.values())))
        tensors = {
            name: torch.from_numpy(value).view(count, *(self._kinds[name][0] or (1,)))
            for name, value in entries.items()
        }
        return TensorDict(tensors, [count])

    def read(self, transitions: TensorDictBase, shape: torch.Size) -> dict[str, np.ndarray]:
        """Reads the entries of transitions, broadcast to a shape [...], as rows [B, ...]."""
        entries = info_rows(transitions, self._kinds, shape)
        return {
            name: entry.reshape(-1, *self._kinds[name][0]).cpu().numpy() for name, entry in entries.items()
        }
