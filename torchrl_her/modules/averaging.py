"""A policy whose weights are the average of those that another one had."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.optim.swa_utils import AveragedModel


class PolicyAverage(AveragedModel):
    """The exponential moving average of a policy's weights over gradient steps.

    While a policy learns, its success swings from one evaluation to the next. Their average, which does not
    learn, is steadier and usually better: Polyak and Juditsky, Acceleration of stochastic approximation by
    averaging, 1992. So play, evaluate and export ``module``, and collect with the policy itself.

    At first the decay is ``(1 + n) / (10 + n)`` after n steps, so that the first weights are soon forgotten.
    Buffers, such as running statistics, are copied.

    Args:
        policy: the one that learns.

    Keyword Args:
        decay: what stays of the average in a gradient step: 0.999 averages over about 1,000 steps.

    Attributes:
        module: a copy of the policy, with the average weights.
        policy: the one that learns.
        steps: gradient steps so far.

    Raises:
        ValueError: the decay is not between 0 and 1.

    Example:
        >>> from torchrl_her import make_actor
        >>> actor = make_actor((9, 2), 3)
        >>> average = PolicyAverage(actor, decay=0.999)
        >>> for parameter in actor.parameters():  # in place of a gradient step
        ...     parameter.data += 1.0
        >>> average.follow()
        >>> before, now = next(actor.parameters()) - 1.0, next(average.module.parameters())
        >>> (now - before).mean().item()  # 1 - 2 / 11, of the way
        0.8181...
    """

    steps: Tensor

    def __init__(self, policy: TensorDictModuleBase, *, decay: float = 0.999) -> None:
        if not 0 < decay < 1:
            raise ValueError(f"decay must be between 0 and 1, got {decay}")
        super().__init__(policy, multi_avg_fn=self._mix)
        self.module.requires_grad_(False)
        self.decay, self._rest = decay, 1.0
        self._policy = (policy,)  # in a tuple, it is no submodule of this one
        self.n_averaged.fill_(1)  # else the first call copies the weights
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))

    @property
    def policy(self) -> TensorDictModuleBase:
        return self._policy[0]

    def follow(self, steps: int = 1) -> None:
        """Moves the average towards the policy, which has made some gradient steps since the last call."""
        self.steps += steps
        done = int(self.steps)
        self._rest = min(self.decay, (1 + done) / (10 + done)) ** steps
        self.update_parameters(self.policy)

    @torch.no_grad()
    def _mix(self, average: Sequence[Tensor], now: Sequence[Tensor], count: Tensor | int) -> None:
        torch._foreach_lerp_(list(average), list(now), 1.0 - self._rest)
