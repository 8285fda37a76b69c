"""Callbacks: user code that is called during training and can stop a run."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from torchrl_her.trainers.trainer import Trainer
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.runs.folder import RunFolder


@dataclass(frozen=True)
class RunView:
    """The state of a run in progress, which is passed to callbacks.

    Attributes:
        components: components of the run.
        trainer: the training loop, with its counters ``frames``, ``updates`` and ``epochs``.
        rows: the table of metrics so far, with a row for each epoch and run.
        folder: folder of the run, or None.
    """

    components: Components
    trainer: Trainer
    rows: list[dict[str, float]]
    folder: RunFolder | None


class Callback:
    """Base class of callbacks. Override the methods that you need; those of this class do nothing.

    ``on_batch`` and ``on_epoch`` can return True to stop the run. The run then writes its checkpoint,
    pictures and policy as at its end, and :func:`~torchrl_her_recipes.resume` can continue it. All callbacks
    are called in order, even if an earlier one returns True. If a callback raises an error, the run ends at
    once, and ``on_end`` is not called.

    Checkpoints do not contain callbacks. A callback that decides from ``rows`` alone decides the same when
    the run is resumed.

    Example:
        >>> class FrameLimit(Callback):
        ...     def on_batch(self, run: RunView) -> bool:
        ...         return run.trainer.frames >= 100_000
    """

    def on_start(self, run: RunView) -> None:
        """Called before the first batch, also when a run is resumed."""

    def on_batch(self, run: RunView) -> bool | None:
        """Called after each collected batch and its gradient steps; returns whether to stop."""
        return None

    def on_epoch(self, run: RunView) -> bool | None:
        """Called after each evaluation; returns whether to stop.

        The new rows are at the end of ``rows``. The table and the checkpoint of the epoch are written after
        this call, so changes that it makes, for instance to these rows, are saved.
        """
        return None

    def on_end(self, run: RunView) -> None:
        """Called after all files were written, also if Ctrl-C or a callback stopped the run."""


class EarlyStopping(Callback):
    """Stops a run when a metric was within a bound in a given number of evaluations in a row.

    If several runs are trained side by side, their median counts.

    Args:
        metric: a column of the table of metrics.

    Keyword Args:
        at_least: lower bound of the metric.
        at_most: upper bound, for metrics such as ``distance``. Give exactly one of the bounds.
        epochs: number of evaluations in a row in which the metric must be within the bound.

    Raises:
        ValueError: both bounds or none are given, or ``epochs`` is below 1; during a run, the table has no
            such column.

    Example:
        >>> stopping = EarlyStopping("success", at_least=0.9, epochs=2)
        >>> rows = [{"run": 0, "epoch": epoch, "success": 0.95} for epoch in (1, 2)]
        >>> stopping.reached(rows[:1]), stopping.reached(rows)
        (False, True)
    """

    def __init__(
        self,
        metric: str = "success",
        *,
        at_least: float | None = None,
        at_most: float | None = None,
        epochs: int = 1,
    ) -> None:
        if (at_least is None) == (at_most is None):
            raise ValueError(f"give at_least or at_most, got at_least={at_least} and at_most={at_most}")
        if epochs < 1:
            raise ValueError(f"epochs must be at least 1, got {epochs}")
        self.metric, self.at_least, self.at_most, self.epochs = metric, at_least, at_most, epochs

    def on_epoch(self, run: RunView) -> bool:
        """Returns whether to stop the run; see :meth:`reached`."""
        return self.reached(run.rows)

    def reached(self, rows: Sequence[dict[str, float]]) -> bool:
        """Returns whether the metric was within its bound in the last ``epochs`` evaluations; NaN never is.

        Args:
            rows: the table, with a row for each epoch and run.

        Raises:
            ValueError: the table has no column with the name of the metric.
        """
        last = sorted({row["epoch"] for row in rows})[-self.epochs :]
        if rows and not any(self.metric in row for row in rows) and rows[-1].get("updates", 1) > 0:
            # Raised only after the first gradient step, since columns of losses are missing before.
            raise ValueError(f"metric must be one of {', '.join(rows[-1])}, got {self.metric!r}")
        return len(last) == self.epochs and all(
            self._is_good([row.get(self.metric, math.nan) for row in rows if row["epoch"] == epoch])
            for epoch in last
        )

    def _is_good(self, values: Iterable[float]) -> bool:
        if self.at_least is not None:
            return statistics.median(-math.inf if math.isnan(v) else v for v in values) >= self.at_least
        assert self.at_most is not None
        return statistics.median(math.inf if math.isnan(v) else v for v in values) <= self.at_most


class Stopped(Exception):
    """Raised when a callback stops the run in the middle of an epoch."""
