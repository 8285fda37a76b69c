"""Summarizes evaluations of runs: results at the end, the score that searches maximize, the best policy."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import Tensor

LAST = 3  # number of last evaluations whose mean is the result of a run
_SCORED = 5  # number of last evaluations whose mean is the score of a run in searches


def at_the_end(rows: Sequence[dict[str, float]], name: str, *, evaluations: int = LAST) -> list[float]:
    """Returns a metric at the end of each run, as the mean of its last ``evaluations`` evaluations.

    Returns:
        One number for each run, in the order of the runs.

    Example:
        >>> rows = [{"run": 0, "success": success} for success in (0.0, 0.5, 0.75, 1.0)]
        >>> at_the_end(rows, "success")
        [0.75]
    """
    runs: dict[float, list[float]] = {}
    for row in rows:
        runs.setdefault(row["run"], []).append(row[name])
    return [statistics.fmean(values[-evaluations:]) for _, values in sorted(runs.items())]


def last_success(rows: Sequence[dict[str, float]]) -> list[float]:
    """Returns the success of each run in the last evaluation."""
    return at_the_end(rows, "success", evaluations=1)


def median_run(rows: Sequence[dict[str, float]]) -> int:
    """Returns the index of the run with the median success in the last evaluation."""
    values = last_success(rows)
    return sorted(range(len(values)), key=values.__getitem__)[len(values) // 2]


def score(rows: Sequence[dict[str, float]], *, last: int = _SCORED) -> float:
    """Computes the score that searches maximize: the median over the runs of mean success at the end.

    Args:
        rows: the table of metrics, with a row for each epoch and run.
        last: number of evaluations, the last ones, over which success is averaged.

    Returns:
        A number from 0 to 1; 0 if there was no evaluation.

    Raises:
        ValueError: ``last`` is below 1.

    Example:
        >>> good = [{"run": 0, "epoch": 1, "success": 0.5}, {"run": 0, "epoch": 2, "success": 1.0}]
        >>> bad = [{"run": 1, "epoch": 1, "success": 0.0}, {"run": 1, "epoch": 2, "success": 0.5}]
        >>> score(good), score(good + bad), score(good + bad, last=1)
        (0.75, 0.5, 0.75)
    """
    if last < 1:
        raise ValueError(f"last must be at least 1, got {last}")
    return statistics.median(at_the_end(rows, "success", evaluations=last) or [0.0])


class BestPolicy:
    """Keeps the policy with the best success in an evaluation; if several are equal, the latest.

    If several runs are trained side by side, their median success decides, and all their policies are kept.

    Attributes:
        state: weights (``actor``), ``epoch`` and ``success`` of the best evaluation; None before the first.
        is_new: whether the state was not written to a file yet; the caller sets it to False after writing.

    Example:
        >>> from torchrl_her.modules import make_actor
        >>> actor, best = make_actor([3, 2], 2), BestPolicy()
        >>> for epoch, success in ((1, 0.5), (2, 0.8), (3, 0.8), (4, 0.6)):
        ...     best.see([{"run": 0, "epoch": epoch, "success": success}], actor)
        >>> best.state["epoch"], best.state["success"]
        (3, 0.8)
    """

    def __init__(self) -> None:
        self.state: dict[str, Any] | None = None
        self.is_new = False

    def state_dict(self) -> dict[str, Any] | None:
        """Returns the best policy's weights, epoch and success; None before the first evaluation."""
        return self.state

    def load_state_dict(self, state: dict[str, Any] | None) -> None:
        """Restores the state that :meth:`state_dict` returned."""
        self.state, self.is_new = state, state is not None

    def see(self, rows: Sequence[dict[str, float]], actor: TensorDictModuleBase) -> None:
        """Keeps a policy if its median success, in ``rows`` of an evaluation, is at least the best so far."""
        success = statistics.median(row["success"] for row in rows)
        if self.state is not None and success < self.state["success"]:
            return
        weights = {
            name: value.detach().to("cpu", copy=True) if isinstance(value, Tensor) else value
            for name, value in actor.state_dict().items()  # copied: gradient steps change weights
        }
        self.load_state_dict({"actor": weights, "epoch": int(rows[0]["epoch"]), "success": success})
