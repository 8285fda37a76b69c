"""Memory of the goals that were achieved most recently, from which goals of new episodes are taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_her.checks import check_whole
from torchrl_her.randomness import Generators, uniform


class AchievedGoals:
    """The newest achieved goals of R runs, with the observations in which they were achieved.

    Each run has its own ring buffer, on the device of the first goals that are added.

    Args:
        capacity: number of goals that each run keeps.

    Keyword Args:
        runs: R, the number of independent runs.

    Raises:
        ValueError: ``capacity`` or ``runs`` is below 1; a run adds more goals at once than its capacity.

    Example:
        >>> memory = AchievedGoals(3, runs=2)
        >>> goals = torch.tensor([[1.0], [2.0], [3.0], [4.0]])  # two environments of each run
        >>> memory.add(goals, goals * 10, which=torch.tensor([True, True, False, True]))
        >>> memory.sizes
        [2, 1]
        >>> index = memory.draw([0, 1], 2, [None, torch.Generator().manual_seed(0)])
        >>> memory.goals(index).tolist(), memory.observations(index).tolist()
        ([[[4.0], [4.0]]], [[[40.0], [40.0]]])
    """

    def __init__(self, capacity: int = 50_000, *, runs: int = 1) -> None:
        check_whole(capacity=capacity, runs=runs)
        self.capacity, self.runs = capacity, runs
        self._written = torch.zeros(runs, dtype=torch.int64)
        self._rows: tuple[Tensor, Tensor] | None = None  # goals and observations, [R * capacity, ...]

    @property
    def sizes(self) -> list[int]:
        """Number of goals that each run has stored."""
        return self._written.clamp(max=self.capacity).tolist()

    def add(self, goals: Tensor, observations: Tensor, *, which: Tensor | None = None) -> None:
        """Adds goals of all runs; a full memory drops the oldest ones. Goals that are not finite are skipped.

        Args:
            goals: [N, g], R equal blocks in the order of the runs.
            observations: [N, o], the observations in which the goals were achieved.

        Keyword Args:
            which: [N] of bool, the goals that are added; None for all.
        """
        number = len(goals) // self.runs
        if number * self.runs != len(goals):
            raise ValueError(f"the number of goals must be a multiple of runs={self.runs}, got {len(goals)}")
        if number > self.capacity:
            raise ValueError(f"{number} goals of each run do not fit into a memory of {self.capacity}")
        if self._rows is None:
            self._rows = self._empty(goals), self._empty(observations)
        # The tensors may have been loaded on another device.
        if self._written.device != goals.device or self._rows[0].device != goals.device:
            self._rows = self._rows[0].to(goals.device), self._rows[1].to(goals.device)
            self._written = self._written.to(goals.device)
        finite = goals.isfinite().all(-1)
        which = finite if which is None else finite & which.to(goals.device)
        run = torch.arange(self.runs, device=goals.device)
        blocks = which.view(self.runs, -1)
        rank, added = blocks.cumsum(1) - 1, blocks.sum(1)
        place = (self._written.unsqueeze(1) + rank) % self.capacity + run.unsqueeze(1) * self.capacity
        self._written += added
        flat = place.flatten()
        for stored, new in zip(self._rows, (goals, observations), strict=True):
            stored[flat[which]] = new[which].to(stored)

    def draw(self, counts: Sequence[int], width: int, generators: Generators) -> Tensor:
        """Draws stored goals for new episodes of R runs, uniformly from the goals of the episode's run.

        Args:
            counts: number of new episodes of each run; must be 0 for runs without goals.
            width: number of goals that are drawn for each episode.
            generators: R generators, one for each run; None for torch's own.

        Returns:
            Positions in the memory, [sum of counts, width] int64, sorted by run, which :meth:`goals` and
            :meth:`observations` take.
        """
        run = torch.arange(self.runs).repeat_interleave(torch.tensor(list(counts))).to(self._written.device)
        size = self._written.clamp(max=self.capacity)[run].unsqueeze(1)
        numbers = uniform(counts, width, generators, device=run.device)
        return run.unsqueeze(1) * self.capacity + (numbers * size).long()

    def goals(self, index: Tensor) -> Tensor:
        """Returns the goals [..., g] at the given positions [...] of the memory."""
        return self._at(0, index)

    def observations(self, index: Tensor) -> Tensor:
        """Returns the observations [..., o] in which the goals at the given positions [...] were achieved."""
        return self._at(1, index)

    def clear(self, run: int) -> None:
        """Forgets the goals of a run."""
        self._written[run] = 0

    def state_dict(self) -> dict[str, Any]:
        """Returns the stored goals and observations of all runs, as tensors and plain data."""
        rows = []
        for part in self._rows or ():
            blocks = zip(part.split(self.capacity), self.sizes, strict=True)
            rows.append([ring[:size].clone() for ring, size in blocks])
        return {"written": self._written.clone(), "capacity": self.capacity, "rows": rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned.

        Raises:
            ValueError: the state has another number of runs, or another capacity.
        """
        written, capacity = state["written"], state["capacity"]
        if (len(written), capacity) != (self.runs, self.capacity):
            raise ValueError(
                f"the state must have {self.runs} runs with {self.capacity} goals each, got "
                f"{len(written)} runs with {capacity}"
            )
        self._written, self._rows = written.clone(), None
        if state["rows"]:
            goals, observations = (self._empty(blocks[0]) for blocks in state["rows"])
            for part, blocks in zip((goals, observations), state["rows"], strict=True):
                for ring, block in zip(part.split(capacity), blocks, strict=True):
                    ring[: len(block)] = block
            self._rows = goals, observations

    def _empty(self, like: Tensor) -> Tensor:
        return like.new_zeros(self.runs * self.capacity, *like.shape[1:])

    def _at(self, part: int, index: Tensor) -> Tensor:
        if self._rows is None:
            raise ValueError("no goals were added yet")
        rows = self._rows[part]
        return rows.index_select(0, index.flatten()).view(*index.shape, *rows.shape[1:])
