"""A policy whose weights are an average over time of the trained policy's weights."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn


class PolicyAverage(nn.Module):
    """The exponential moving average of a policy's weights over gradient steps.

    While a policy learns, its success swings from one evaluation to the next. An average of its weights over
    time is steadier and usually better: Polyak and Juditsky, Acceleration of stochastic approximation by
    averaging, 1992. So use ``module`` to act, evaluate and export, and the policy itself to collect.

    At first the decay is ``(1 + n) / (10 + n)`` after n steps, so that the first weights are soon forgotten.
    Buffers, such as running statistics, are copied. Unlike in torch's ``AveragedModel``, one call covers many
    gradient steps. A call takes so little time that it can be made every few milliseconds.

    Args:
        policy: the policy that is trained.

    Keyword Args:
        decay: fraction of the average that a gradient step keeps: 0.9995 averages over about 2,000 steps.
        runs: R independent runs, whose weights are stacked along the first dimension of each parameter.

    Attributes:
        module: a copy of the policy, with the average weights.
        steps: [R], gradient steps of each run so far.

    Raises:
        ValueError: the decay is not between 0 and 1, or a parameter is not stacked for R runs.

    Example:
        >>> from torchrl_her import make_actor
        >>> actor = make_actor((9, 2), 3)
        >>> average = PolicyAverage(actor)
        >>> for parameter in actor.parameters():  # in place of a gradient step
        ...     parameter.data += 1.0
        >>> average.follow()
        >>> before, now = next(actor.parameters()) - 1.0, next(average.module.parameters())
        >>> (now - before).mean().item()  # 1 - 2 / 11 of the way to the new weights
        0.8181...
    """

    steps: Tensor

    def __init__(self, policy: TensorDictModuleBase, *, decay: float = 0.9995, runs: int = 1) -> None:
        if not 0 < decay < 1:
            raise ValueError(f"decay must be between 0 and 1, got {decay}")
        super().__init__()
        self.module = deepcopy(policy).requires_grad_(False)
        self.decay, self._policy = decay, (policy,)  # in a tuple, so that it is not a submodule
        self.register_buffer("steps", torch.zeros(runs, dtype=torch.int64))
        self._weights = [list(module.parameters()) for module in (self.module, policy)]
        self._copies = next(self.module.buffers(), None) is not None
        wrong = [weight.shape for weight in self._weights[0] if runs > 1 and weight.shape[:1] != (runs,)]
        if wrong:
            raise ValueError(f"the weights of {runs} runs must be stacked, got a parameter {list(wrong[0])}")

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy that is trained."""
        return self._policy[0]

    @torch.no_grad()
    def follow(self, steps: int = 1, *, idle: Sequence[int] = ()) -> None:
        """Moves the average towards the policy, by the number of gradient steps since the last call.

        Args:
            steps: number of gradient steps since the last call.
            idle: the runs that made no gradient step.
        """
        updates = [0 if run in idle else steps for run in range(len(self.steps))]
        self.steps += torch.tensor(updates, device=self.steps.device)
        decays = [self._kept(done) ** count for done, count in zip(self.steps.tolist(), updates, strict=True)]
        averaged, learned = self._weights
        if len(set(decays)) == 1:
            torch._foreach_lerp_(averaged, learned, 1.0 - decays[0])
        else:
            for average, now in zip(averaged, learned, strict=True):
                share = torch.tensor(
                    [1.0 - each for each in decays], dtype=average.dtype, device=average.device
                )
                average.lerp_(now, share.view(-1, *[1] * (average.ndim - 1)))
        if self._copies:
            self._copy_buffers()

    @torch.no_grad()
    def restart(self) -> None:
        """Restarts the average from the policy's present weights."""
        self.steps.zero_()
        for average, now in zip(*self._weights, strict=True):
            average.copy_(now)
        self._copy_buffers()

    def _kept(self, done: int) -> float:
        """Returns the decay of the average in one gradient step, after a number of steps."""
        return min(self.decay, (1 + done) / (10 + done))

    def _copy_buffers(self) -> None:
        for buffer, now in zip(self.module.buffers(), self.policy.buffers(), strict=True):
            buffer.copy_(now)
