"""Running normalization: gives each input of networks about mean 0 and standard deviation 1.

The statistics are computed over all written transitions, virtual ones included. Andrychowicz et al.,
Hindsight experience replay, 2017, appendix A.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn

from torchrl_her.checks import check_blocks, check_whole, entry_of
from torchrl_her.modules.networks import by_run

_RELATIVE_STD = 1e-4  # least deviation relative to the mean; smaller ones may be float32's rounding


class Moments(NamedTuple):
    """Number, mean and variance of values, each [...] of float64.

    Attributes:
        n: number of values; not a whole number if values have weights.
        mean: mean of the values.
        var: mean squared deviation of the values from the mean.
    """

    n: Tensor
    mean: Tensor
    var: Tensor


def moments(values: Tensor) -> Moments:
    """Computes number, mean and variance of values [n, width], n at least 1.

    Example:
        >>> n, mean, var = moments(torch.tensor([[1.0, 5.0], [3.0, 5.0]]))
        >>> n.tolist(), mean.tolist(), var.tolist()
        ([2.0, 2.0], [2.0, 5.0], [1.0, 0.0])
    """
    wide = values.double()
    mean = wide.mean(0)
    var = (wide - mean).square_().mean(0)  # several times as fast as torch.var_mean
    return Moments(torch.full_like(mean, len(values)), mean, var)


def merge(one: Moments, other: Moments) -> Moments:
    """Combines the moments of two sets of values, each of which may be empty.

    Chan, Golub and LeVeque, Updating formulae and a pairwise algorithm for computing sample variances, 1979.

    Example:
        >>> merge(moments(torch.tensor([[1.0]])), moments(torch.tensor([[3.0], [5.0]]))).mean.tolist()
        [3.0]
    """
    n = one.n + other.n
    share = other.n / n.clamp(min=torch.finfo(torch.float64).tiny)
    gap = other.mean - one.mean
    mean = one.mean + gap * share
    var = one.var * (1.0 - share) + other.var * share + gap.square() * share * (1.0 - share)
    return Moments(n, mean, var)


def normalize(values: Tensor, mean: Tensor, std: Tensor, limit: Tensor) -> Tensor:
    """Computes ``(values - mean) / std``, clipped to [-limit, limit]; arguments are broadcast.

    Example:
        >>> normalize(torch.tensor([4.0, 90.0]), torch.tensor(2.0), torch.tensor(4.0), torch.tensor(5.0))
        tensor([0.5000, 5.0000])
    """
    return ((values - mean) / std).clamp(-limit, limit)


class RunningNorm(nn.Module):
    """Running mean and variance of observations and goals, and the normalization by them.

    Transitions are collected, relabeled and stored with raw values. These are normalized where networks read
    them: in sampled batches by :class:`~torchrl_her.modules.NormalizeBatch`, and while acting by
    :class:`~torchrl_her.modules.NormalizedPolicy`. So virtual goals are normalized like desired ones, and old
    transitions by the same statistics as new ones.

    Only :meth:`update` and :meth:`count` change the statistics; a :class:`~torchrl_her.HERWriter` calls
    :meth:`update` with all rows that it writes (``on_write=norm.update``), virtual transitions included.
    Acting, evaluating and learning leave them as they are. Before anything was counted, normalization changes
    nothing.

    R independent runs have statistics of their own; batches are R equal blocks, in the order of the runs.
    ``state_dict`` holds all statistics; so does the ``state_dict`` of a policy with this normalization. Each
    coordinate is normalized by itself, so concatenated entries have the concatenated statistics.

    Args:
        widths: widths of the entries that are normalized, by their keys.

    Keyword Args:
        runs: R, the number of independent runs.
        clip: normalized values are clipped to [-clip, clip].
        least_std: least standard deviation, in the unit of the values, so that coordinates that hardly ever
            change are not blown up. None for one ten-thousandth of their mean, whatever the unit.

    Attributes:
        n, mean, var: [R, W] of float64, the moments of all coordinates of all entries, in their order.
        frozen: whether :meth:`update` and :meth:`count` do nothing. It is no part of ``state_dict``.

    Raises:
        ValueError: there is no entry, or a number is too small.

    Example:
        >>> from tensordict import TensorDict
        >>> norm = RunningNorm({"observation": 1, "desired_goal": 1}, clip=5.0)
        >>> seen, goals = torch.tensor([[1.0], [5.0]]), torch.tensor([[0.0], [0.2]])
        >>> rows = TensorDict({"observation": seen, "desired_goal": goals}, [2])
        >>> _ = norm.update(rows)  # means 3 and 0.1, standard deviations 2 and 0.1
        >>> norm(rows)["observation"].tolist()
        [[-1.0], [1.0]]
        >>> norm.normalize("desired_goal", torch.tensor([[0.15], [7.0]]))
        tensor([[0.5000],
                [5.0000]])
    """

    n: Tensor
    mean: Tensor
    var: Tensor

    def __init__(
        self,
        widths: Mapping[NestedKey, int],
        *,
        runs: int = 1,
        clip: float = 5.0,
        least_std: float | None = None,
    ) -> None:
        super().__init__()
        if not widths:
            raise ValueError("widths must name at least one entry to normalize, got none")
        check_whole(runs=runs, **{f"the width of {key!r}": size for key, size in widths.items()})
        for name, number in (("clip", clip), ("least_std", least_std)):
            if number is not None and not number > 0:
                raise ValueError(f"{name} must be above 0, got {number}")
        self.widths = {unravel_key(key): width for key, width in widths.items()}
        self.runs, self.clip, self.least_std, self.frozen = runs, clip, least_std, False
        ends = list(accumulate(self.widths.values(), initial=0))
        self._columns = {key: slice(*bounds) for key, bounds in zip(self.widths, pairwise(ends), strict=True)}
        # Before the first values, mean 0 and variance 1 make normalization change nothing.
        for name, start in (("n", 0.0), ("mean", 0.0), ("var", 1.0)):
            self.register_buffer(name, torch.full((runs, ends[-1]), start, dtype=torch.float64))

    @property
    def keys(self) -> list[NestedKey]:
        """Keys of the entries that are normalized."""
        return list(self.widths)

    def moments_of(self, key: NestedKey, run: int = 0) -> Moments:
        """Returns number, mean and variance of an entry's values so far, [width] each, as views."""
        columns = self.columns_of(key)
        return Moments(*(statistic[run, columns] for statistic in (self.n, self.mean, self.var)))

    @property
    def std(self) -> Tensor:
        """Returns the standard deviations [R, W] by which values are divided; 1 where nothing was counted."""
        rounding = self.mean.abs() * _RELATIVE_STD + torch.finfo(torch.float32).tiny
        least = rounding if self.least_std is None else rounding.new_tensor(self.least_std)
        return self.var.sqrt().maximum(least)

    def restart(
        self, run: int | None = None, *, key: NestedKey | None = None, places: Sequence[int] | None = None
    ) -> None:
        """Resets the statistics of one run, or of all.

        Args:
            run: index of the run; None for all.

        Keyword Args:
            key: the entry; None for all.
            places: positions of coordinates in the entry; None for all.
        """
        columns = torch.arange(self.n.shape[-1], device=self.n.device)
        columns = columns if key is None else columns[self.columns_of(key)]
        columns = columns if places is None else columns[list(places)]
        for statistic, start in ((self.n, 0.0), (self.mean, 0.0), (self.var, 1.0)):
            (statistic if run is None else statistic[run : run + 1])[:, columns] = start

    @torch.no_grad()
    def update(
        self, rows: TensorDictBase, runs: Sequence[int] | None = None, counts: Sequence[int] | None = None
    ) -> Callable[[], None]:
        """Adds the root entries of transitions to the statistics; none of them if an entry is invalid.

        Args:
            rows: transitions of any shape; with ``runs`` they are run after run, otherwise R equal blocks.
            runs: indices of the runs that the rows belong to; None for all R runs.
            counts: number of rows of each of these runs; None if all have the same.

        Returns:
            A function that undoes the call, see :meth:`snapshot`.

        Raises:
            KeyError: an entry is missing.
            ValueError: an entry has another width or is not finite, or rows cannot be divided among the runs.
        """
        undo = self.snapshot()
        if self.frozen:
            return undo
        if runs is None:
            check_blocks(rows.shape, self.runs)
            runs = range(self.runs)
        shares = [rows.numel() // len(runs)] * len(runs) if counts is None else list(counts)
        entries = {key: entry_of(rows, key, by="normalization") for key in self.widths}
        for key, values in entries.items():
            self._check(key, values)
        new = [
            (self.moments_of(key, run), self._finite_moments(key, part))
            for key, values in entries.items()
            for run, part in zip(runs, values.reshape(-1, values.shape[-1]).split(shares), strict=True)
            if len(part) > 0
        ]
        for running, moments_of_part in new:
            _add(running, moments_of_part)
        return undo

    def snapshot(self) -> Callable[[], None]:
        """Returns a function that restores the present statistics.

        Example:
            >>> norm = RunningNorm({"observation": 1})
            >>> put_back = norm.snapshot()
            >>> norm.count("observation", torch.ones(3, 1))
            >>> put_back()
            >>> norm.n.tolist()
            [[0.0]]
        """
        before = [(statistic, statistic.clone()) for statistic in (self.n, self.mean, self.var)]

        def put_back() -> None:
            for statistic, value in before:
                statistic.copy_(value)

        return put_back

    @torch.no_grad()
    def count(self, key: NestedKey, values: Tensor, *, run: int = 0, weight: float = 1.0) -> None:
        """Adds values of one entry to the statistics.

        Args:
            key: key of the entry.
            values: [..., width]; narrower values are the first coordinates of the entry.

        Keyword Args:
            run: index of the run that the values belong to.
            weight: how often each value counts.

        Raises:
            ValueError: the values are wider than the entry or not finite; the weight is negative or infinite.
        """
        width, running = values.shape[-1], self.moments_of(key, run)
        if width > len(running.mean):
            raise ValueError(f"{key!r} must have a width of at most {len(running.mean)}, got {width}")
        if not 0 <= weight < math.inf:
            raise ValueError(f"weight must be at least 0 and finite, got {weight}")
        if self.frozen or values.numel() == 0 or weight == 0:
            return
        new = self._finite_moments(key, values)
        _add(Moments(*(each[:width] for each in running)), new._replace(n=new.n * weight))

    def normalize(self, key: NestedKey, values: Tensor) -> Tensor:
        """Returns normalized values of one entry.

        Args:
            key: key of the entry.
            values: [..., width], R equal blocks in the order of the runs.

        Returns:
            Normalized values [..., width] in the same dtype; in torch's default dtype for integers and flags.

        Raises:
            ValueError: the values have another width, or cannot be divided among the runs.
        """
        columns = self.columns_of(key)
        self._check(key, values)
        check_blocks(values.shape[:-1], self.runs)
        if not values.is_floating_point():  # else means and deviations would be rounded to integers
            values = values.to(torch.get_default_dtype())
        n, mean, std = (statistic[:, columns] for statistic in (self.n, self.mean, self.std))
        limit = torch.where(n > 0, self.clip, torch.inf)  # before the first update nothing is clipped
        mean, std, limit = (tensor.to(values).unsqueeze(1) for tensor in (mean, std, limit))
        return normalize(by_run(values, self.runs), mean, std, limit).view(values.shape)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns a shallow copy with normalized entries, in the root and, where present, under ``next``.

        Raises:
            KeyError: an entry is missing in the root.
        """
        out = tensordict.copy()
        for key in self.widths:
            out.set(key, self.normalize(key, entry_of(out, key, by="normalization")))
            after = unravel_key(("next", key))
            value = out.get(after, None)
            if value is not None:
                out.set(after, self.normalize(key, value))
        return out

    def columns_of(self, key: NestedKey) -> slice:
        """Returns the columns of an entry in ``n``, ``mean``, ``var`` and ``std``."""
        columns = self._columns.get(unravel_key(key))
        if columns is None:
            raise KeyError(f"{key!r} is not normalized, only {', '.join(map(repr, self.widths))}")
        return columns

    def _finite_moments(self, key: NestedKey, values: Tensor) -> Moments:
        """Computes number, mean and variance of values [..., width]; raises if a value is not finite."""
        new = moments(values.reshape(-1, values.shape[-1]).to(self.mean.device))
        if not bool(new.var.isfinite().all()):  # one NaN or infinity among the values is enough
            raise ValueError(f"{key!r} must be finite to be counted, got NaN or infinity in it")
        return new

    def _check(self, key: NestedKey, values: Tensor) -> None:
        """Raises if an entry has another width."""
        if values.shape[-1] != (width := self.widths[unravel_key(key)]):
            raise ValueError(f"{key!r} must have a width of {width}, got {values.shape[-1]}")

    def extra_repr(self) -> str:
        return f"{self.widths}, runs={self.runs}, clip={self.clip}, least_std={self.least_std}"


def _add(running: Moments, new: Moments) -> None:
    """Merges moments into others, in place: other processes may share their memory."""
    for each, value in zip(running, merge(running, new), strict=True):
        each.copy_(value)
