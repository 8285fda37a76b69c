"""A policy whose weights are the average of those that another one had."""

from __future__ import annotations

from copy import deepcopy

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn


class PolicyAverage(nn.Module):
    """The exponential moving average of a policy's weights over gradient steps.

    While a policy learns, its success swings from one evaluation to the next. Their average, which does not
    learn, is steadier and usually better: Polyak and Juditsky, Acceleration of stochastic approximation by
    averaging, 1992. So play, evaluate and export ``module``, and collect with the policy itself.

    At first the decay is ``(1 + n) / (10 + n)`` after n steps, so that the first weights are soon forgotten.
    Buffers, such as running statistics, are copied. Other than torch's ``AveragedModel`` it takes many
    gradient steps at once, and next to no time, since it is called every few milliseconds.

    Args:
        policy: the one that learns.

    Keyword Args:
        decay: what stays of the average in a gradient step: 0.999 averages over about 1,000 steps.

    Attributes:
        module: a copy of the policy, with the average weights.
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
        super().__init__()
        self.module = deepcopy(policy).requires_grad_(False)
        self.decay, self._policy = decay, (policy,)  # in a tuple, it is no submodule of this one
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))
        self._averaged = [list(own.parameters()) for own in (self.module, policy)]
        self._copied = [list(own.buffers()) for own in (self.module, policy)]

    @property
    def policy(self) -> TensorDictModuleBase:
        """The one that learns."""
        return self._policy[0]

    @torch.no_grad()
    def follow(self, steps: int = 1) -> None:
        """Moves the average towards the policy, which has made some gradient steps since the last call."""
        self.steps += steps
        done = int(self.steps)
        kept = min(self.decay, (1 + done) / (10 + done)) ** steps
        torch._foreach_lerp_(*self._averaged, 1.0 - kept)
        for own, now in zip(*self._copied, strict=True):
            own.copy_(now)
