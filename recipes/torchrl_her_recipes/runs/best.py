"""The best policy of a run so far."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import Tensor


class BestPolicy:
    """The policy of the evaluation with the best success so far; of several as good ones, the last.

    Of several runs side by side the median counts, and the policies of all of them are kept.

    Attributes:
        state: the weights ``actor``, and the ``epoch`` and ``success`` of the evaluation; None before the
            first one.
        is_new: whether the state changed since somebody last set this to False.

    Example:
        >>> from torchrl_her.modules import make_actor
        >>> actor, best = make_actor([3, 2], 2), BestPolicy()
        >>> for epoch, success in ((1, 0.5), (2, 0.8), (3, 0.8), (4, 0.6)):
        ...     best.see([{"run": 0, "epoch": epoch, "success": success}], actor)
        >>> best.state["epoch"], best.state["success"]
        (3, 0.8)
    """

    def __init__(self, state: dict[str, Any] | None = None) -> None:
        self.state, self.is_new = state, state is not None

    def see(self, rows: Sequence[dict[str, float]], actor: TensorDictModuleBase) -> None:
        """Takes a policy if its evaluation is at least as good as the best one before."""
        success = statistics.median(row["success"] for row in rows)
        if self.state is not None and success < self.state["success"]:
            return
        weights = {name: _kept(value) for name, value in actor.state_dict().items()}
        self.state = {"actor": weights, "epoch": int(rows[0]["epoch"]), "success": success}
        self.is_new = True


def _kept(value: Any) -> Any:
    """A copy that further gradient steps leave alone."""
    return value.detach().to("cpu", copy=True) if isinstance(value, Tensor) else value
