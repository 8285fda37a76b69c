"""Samplers for a buffer of several runs, which draw the same number of transitions of each in one call."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, Sampler
from torchrl.data.replay_buffers.storages import Storage

from torchrl_her.files.state import StateFile
from torchrl_her.randomness import Generators, check_generators, uniform
from torchrl_her.replay_buffers.runs.trees import SumTrees
from torchrl_her.torchrl_private import generator_of


class _BlockSampler(StateFile, Sampler):
    """Sampler of a storage that is R equal blocks of rows, one block for each run."""

    capacity: int  # number of rows in the block of each run
    runs: int
    generators: list[torch.Generator] | None
    _home: torch.device
    _sizes: Tensor  # [R], filled rows of each block

    @property
    def device(self) -> torch.device:
        """Device on which rows are drawn, and priorities kept."""
        return self._home

    def _share(self, storage: Storage, batch_size: int) -> int:
        """Returns the number of transitions of each run in a batch, checked."""
        if not bool(self._sizes.any()):
            raise RuntimeError("an empty buffer cannot be sampled from")
        if batch_size % self.runs:
            raise ValueError(f"batch_size must be a multiple of {self.runs} runs, got {batch_size}")
        if storage.max_size != self.runs * self.capacity:
            raise ValueError(
                f"the storage must have {self.runs} blocks of {self.capacity:,} rows, "
                f"got one of {storage.max_size:,} rows"
            )
        return batch_size // self.runs

    def _sources(self) -> Generators:
        """Returns a generator for each run."""
        return [generator_of(self)] if self.generators is None else self.generators

    def _rows(self, place: Tensor, filled: Sequence[bool]) -> Tensor:
        """Converts places [R, n] in the blocks to rows [R * n]; empty runs get the rows of a filled run."""
        first_rows = torch.arange(0, self.runs * self.capacity, self.capacity, device=place.device)
        row = place + first_rows.unsqueeze(-1)
        if not all(filled):
            stand_in = list(filled).index(True)
            row = row[[run if has_rows else stand_in for run, has_rows in enumerate(filled)]]
        return row.flatten()

    def _run_and_place(self, index: int | Tensor) -> tuple[Tensor, Tensor]:
        """Returns the run of each row that was written, and its place in the run's block."""
        index = torch.as_tensor(index, dtype=torch.int64, device=self.device).flatten()
        if len(index) and int(index.min()) < 0:
            index = index[index >= 0]  # writers give -1 for rows that they did not write
        run = index.div(self.capacity, rounding_mode="floor")
        return run, index - run * self.capacity

    def _note(self, run: Tensor, place: Tensor) -> None:
        """Enlarges the sizes of blocks so that they hold rows that were written."""
        self._sizes.scatter_reduce_(0, run, place + 1, "amax")

    def _check_state(self, state_dict: dict[str, Any]) -> None:
        if len(state_dict["sizes"]) != self.runs:
            raise ValueError(f"the state must have {self.runs} runs, got {len(state_dict['sizes'])}")
        if (most := int(state_dict["sizes"].max())) > self.capacity:
            raise ValueError(f"the state must have at most {self.capacity:,} rows of each run, got {most:,}")


class RunsSampler(_BlockSampler):
    """Draws the same number of transitions of each of R runs, uniformly within each run.

    The storage is R equal blocks of rows, as :class:`~torchrl_her.HERWriter` fills them. A batch is R equal
    blocks, too, in the order of the runs. What a run draws does not depend on the other runs. A run
    without transitions gets rows of the first run that has some.

    Args:
        capacity: number of rows in each run's block.

    Keyword Args:
        runs: R, the number of independent runs.
        generators: R sources of random numbers, on the device; None for the buffer's (``buffer.set_rng``),
            with one run.
        device: device on which rows are drawn. The storage may be on another one.

    Raises:
        ValueError: there is no run, or not a generator for each of several; when sampling, the batch cannot
            be divided equally among the runs, or the storage is of another size.
    """

    def __init__(
        self,
        capacity: int,
        *,
        runs: int = 1,
        generators: Sequence[torch.Generator] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.capacity, self.runs, self._home = capacity, runs, torch.device(device)
        self.generators = check_generators(runs, generators)
        self._sizes = torch.zeros(runs, dtype=torch.int64, device=device)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draws indices [batch_size] of rows: R equal blocks."""
        n, sizes = self._share(storage, batch_size), self._sizes.tolist()
        place = torch.zeros(self.runs, n, dtype=torch.int64, device=self.device)
        for block, size, generator in zip(place, sizes, self._sources(), strict=True):
            if size:
                block.random_(size, generator=generator)
        return self._rows(place, [size > 0 for size in sizes]), {}

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Registers rows that were written."""
        self._note(*self._run_and_place(index))

    def empty_run(self, run: int) -> None:
        """Forgets the transitions of a run."""
        self._sizes[run] = 0

    def state_dict(self) -> dict[str, Any]:
        return {"sizes": self._sizes.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._check_state(state_dict)
        self._sizes.copy_(state_dict["sizes"])

    def _empty(self) -> None:
        self._sizes.zero_()


class RunsPrioritizedSampler(_BlockSampler, PrioritizedSampler):
    """Draws transitions of each of R runs in proportion to their priorities.

    It is TorchRL's ``PrioritizedSampler`` for R runs: with ``p = (|priority| + eps) ** alpha``, a row is
    drawn with probability p over the sum of its run, and a new row gets the largest priority that its run has
    seen. ``priority_weight`` is (p / the least p of its run in the batch) ** -beta, at most 1.
    A run whose p are all 0 draws all its rows equally often, with weight 1.
    Schaul et al., Prioritized Experience Replay, 2016.

    Storage, batches, runs without transitions, and the arguments ``capacity``, ``runs``, ``generators`` and
    ``device`` are as in :class:`~torchrl_her.replay_buffers.RunsSampler`.

    Args:
        alpha: how much priorities count; 0 for not at all.
        beta: how far importance weights make up for priorities; 1 for fully.

    Keyword Args:
        eps: constant that is added to priorities.
        reduction: how several priorities of one row are reduced to one, such as ``"max"``.

    Raises:
        ValueError: there is no run, or not a generator for each of several; alpha or beta is negative; when
            sampling, the batch cannot be divided equally among the runs, or the storage is of another size.

    Example:
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> sampler = RunsPrioritizedSampler(4, alpha=1.0, beta=1.0)
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(4), sampler=sampler, batch_size=2)
        >>> index = buffer.extend(torch.arange(3))
        >>> buffer.update_priority(index, torch.tensor([0.0, 5.0, 0.0]))
        >>> buffer.sample().tolist()
        [1, 1]
    """

    _alpha: float
    _beta: float

    def __init__(
        self,
        capacity: int,
        alpha: float,
        beta: float,
        *,
        runs: int = 1,
        generators: Sequence[torch.Generator] | None = None,
        eps: float = 1e-8,
        reduction: str = "max",
        device: torch.device | str = "cpu",
    ) -> None:
        self.capacity, self.runs, self._home = capacity, runs, torch.device(device)
        self.generators = check_generators(runs, generators)
        super().__init__(runs * capacity, alpha, beta, eps=eps, reduction=reduction)

    def _init(self) -> None:
        """Makes the trees; called by TorchRL's constructor."""
        self._trees = SumTrees(self.capacity, runs=self.runs, device=self.device)
        self._sizes = torch.zeros(self.runs, dtype=torch.int64, device=self.device)
        # The largest priority of each run.
        self._most = torch.ones(self.runs, dtype=torch.float32, device=self.device)
        self._warned: set[int] = set()  # runs that had priorities that are not finite

    @property
    def alpha(self) -> float:
        """Exponent of priorities. It cannot change once there are priorities, which are stored as powers."""
        return self._alpha

    @alpha.setter
    def alpha(self, value: float) -> None:
        if value != self._alpha and bool(self._sizes.any()):
            raise ValueError(
                f"alpha is {self._alpha} and cannot become {value}: rows have priorities already"
            )
        self._alpha = value

    @property
    def default_priority(self) -> Tensor | float:
        """Priority of new rows; [R] if there are several runs."""
        return float(self._most[0]) if self.runs == 1 else self._most.clone()

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draws indices [batch_size] of rows, R equal blocks, with their importance weights."""
        n = self._share(storage, batch_size)
        filled = (self._sizes > 0).tolist()
        counts = [n * has_rows for has_rows in filled]
        u = uniform(counts, 1, self._sources(), dtype=torch.float64, device=self.device)
        if not all(filled):
            drawn = torch.tensor(filled, device=u.device).view(-1, 1, 1).expand(-1, n, 1)
            u = u.new_zeros(self.runs, n, 1).masked_scatter_(drawn, u)
        u = u.view(self.runs, n)
        place, p = self._trees.draw(u)
        least = p.amin(-1, keepdim=True)
        weight = (p / least).pow_(-self._beta)
        if bool((none := least == 0).any()):  # runs without rows, or without any priority above 0
            sizes = self._sizes.unsqueeze(-1)
            evenly = torch.minimum((u * sizes).long(), sizes - 1).clamp_min_(0)
            place = torch.where(none, evenly, place)
            weight.masked_fill_(none, 1.0)
        return self._rows(place, filled), {"priority_weight": weight.flatten()}

    @torch.no_grad()
    def update_priority(
        self, index: int | Tensor, priority: float | Tensor, *, storage: Storage | None = None
    ) -> None:
        """Sets the priorities of some rows.

        Skips rows that have not been written since their run was last emptied. Also skips priorities that are
        not finite, before or after they are raised to the power: these rows keep their old priorities, and a
        warning names their run the first time.

        Args:
            index: [n], indices of rows; -1 is skipped.
            priority: [n], or one for all.

        Keyword Args:
            storage: storage of the rows; with a single run, all rows in it count as written.

        Raises:
            RuntimeError: the number of priorities is neither one nor the number of rows.
        """
        index = torch.as_tensor(index, dtype=torch.int64, device=self.device).flatten()
        priority = torch.as_tensor(priority, dtype=torch.float32, device=self.device).detach().abs().flatten()
        if priority.numel() not in (1, index.numel()):
            raise RuntimeError(f"got {priority.numel()} priorities for {index.numel()} rows")
        run, place = self._run_and_place(index)
        priority = priority.expand(index.shape)
        if len(run) < len(index):
            priority = priority[index >= 0]
        value = (priority + self._eps).pow(self._alpha)
        sizes = self._sizes
        if self.runs == 1 and storage is not None:
            # A buffer that is made around a filled storage registers the rows only by this call.
            sizes = sizes.clamp_min(len(storage))
        if not self._all_known(run, place, sizes) or not _all_finite(priority, value):
            written = place < sizes.index_select(0, run)
            finite = priority.isfinite() & value.isfinite()
            self._warn_of(run[written & ~finite])
            good = written & finite
            run, place, priority, value = run[good], place[good], priority[good], value[good]
        self._most.scatter_reduce_(0, run, priority, "amax")
        self._note(run, place)
        self._trees.set(run, place, value)

    def _all_known(self, run: Tensor, place: Tensor, sizes: Tensor) -> bool:
        """Returns whether rows [n] are all filled, given the sizes [R] of the runs."""
        # If all blocks are full, as most of the time, rows need no check.
        return int(sizes.min()) >= self.capacity or bool((place < sizes.index_select(0, run)).all())

    def _warn_of(self, run: Tensor) -> None:
        """Warns about priorities that are not finite, once for each run [n]."""
        for run_index in sorted(set(run.tolist()) - self._warned):
            self._warned.add(run_index)
            warnings.warn(
                f"run {run_index} was given priorities that are not finite; they are ignored, now and later",
                RuntimeWarning,
                stacklevel=4,
            )

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Gives rows that were written the largest priority of their run."""
        run, place = self._run_and_place(index)
        self._note(run, place)
        value = (self._most + self._eps).pow(self._alpha)
        self._trees.set(run, place, value.index_select(0, run), sorted=True)

    def empty_run(self, run: int) -> None:
        """Forgets the transitions of a run and their priorities."""
        self._trees.clear(run)
        self._sizes[run], self._most[run] = 0, 1.0

    def add(self, index: Tensor | int) -> None:
        """Does nothing: :meth:`mark_update` has already set the new rows' priorities."""

    def extend(self, index: Tensor | tuple[Tensor, ...]) -> None:
        """Does nothing: :meth:`mark_update` has already set the new rows' priorities."""

    def state_dict(self) -> dict[str, Any]:
        """Returns the powers of the priorities of filled rows, as tensors and plain data."""
        sizes = self._sizes.tolist()
        return {
            "sizes": self._sizes.clone(),
            "values": [self._trees.get(run, size) for run, size in enumerate(sizes)],
            "most": self._most.clone(),
            "alpha": float(self._alpha),
            "beta": float(self._beta),
            "eps": float(self._eps),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned."""
        self._check_state(state_dict)
        self._init()
        self._sizes.copy_(state_dict["sizes"])
        self._most.copy_(state_dict["most"])
        self._alpha, self._beta, self._eps = (state_dict[key] for key in ("alpha", "beta", "eps"))
        for run, value in enumerate(state_dict["values"]):
            leaf = torch.arange(len(value), device=self.device)
            self._trees.set(torch.full_like(leaf, run), leaf, value.to(self.device), sorted=True)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(runs={self.runs}, alpha={self._alpha}, beta={self._beta})"


def _all_finite(priority: Tensor, value: Tensor) -> bool:
    """Returns whether priorities [n] and their powers are finite; with alpha 0 all powers are 1."""
    return len(value) == 0 or math.isfinite(float(priority.max()) + float(value.max()))  # NaN is the largest
