"""Exploration by a mixture of greedy, noisy and uniform actions, with a decaying share of the latter two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type


def explore(
    greedy: Tensor,
    low: Tensor,
    high: Tensor,
    epsilon: Tensor | float,
    *,
    noise: float = 0.05,
    uniform_share: float = 0.2,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The exploration of appendix B.

    Args:
        greedy: [..., a], the actions of the policy.
        low: [a], least actions.
        high: [a], greatest actions.
        epsilon: share of actions that explore, broadcast against [..., 1].
        noise: standard deviation of the noise, as a fraction of the range of actions.
        uniform_share: which part of epsilon draws uniform actions; the rest adds noise.
        generator: source of the random numbers.

    Returns:
        [..., a]: greedy with probability 1 - epsilon, greedy plus normal noise (clamped to the
        range) with ``(1 - uniform_share) * epsilon``, uniform with ``uniform_share * epsilon``.

    Example:
        >>> explore(torch.zeros(1), torch.tensor([-1.0]), torch.tensor([1.0]), 0.0)
        tensor([0.])
    """
    span = high - low

    def random(draw: Any, *shape: int) -> Tensor:
        return draw(*shape, dtype=greedy.dtype, device=greedy.device, generator=generator)

    choice = random(torch.rand, *greedy.shape[:-1], 1)
    noisy = (greedy + noise * span * random(torch.randn, *greedy.shape)).clamp(low, high)
    anywhere = low + span * random(torch.rand, *greedy.shape)
    action = torch.where(choice < epsilon, noisy, greedy)
    return torch.where(choice < uniform_share * epsilon, anywhere, action)


class DecayingEpsilon(TensorDictModuleBase):
    """Turns greedy actions into exploring ones; put it behind a policy in a TensorDictSequential.

    Actions stay greedy under ``set_exploration_type(ExplorationType.DETERMINISTIC)`` (or MODE, MEAN).

    Args:
        low: [a], least actions.
        high: [a], greatest actions.

    Keyword Args:
        start: epsilon before the first :meth:`step`.
        decay: what each step multiplies it by.
        end: where it stops.
        noise, uniform_share: see :func:`explore`.
        generators: sources of the random numbers, one for each of R independent runs; actions
            [..., a] are then R equal blocks of rows, run after run. None for torch's own.
        action: key.

    Attributes:
        epsilon: [R], the present share of exploring actions of each run.

    Raises:
        ValueError: not ``0 <= end <= start <= 1``, or a decay outside of (0, 1].

    Example:
        >>> exploration = DecayingEpsilon(-torch.ones(3), torch.ones(3), start=1.0, decay=0.5)
        >>> exploration.step()
        >>> exploration.epsilon.tolist()
        [0.5]
    """

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        *,
        start: float = 1.0,
        decay: float = 0.95,
        end: float = 0.05,
        noise: float = 0.05,
        uniform_share: float = 0.2,
        generators: Sequence[torch.Generator] | None = None,
        action: NestedKey = "action",
    ) -> None:
        if not 0.0 <= end <= start <= 1.0:
            raise ValueError(f"epsilon needs 0 <= end <= start <= 1, got start={start}, end={end}")
        if not 0.0 < decay <= 1.0:
            raise ValueError(f"decay must be in (0, 1], got {decay}")
        super().__init__()
        self.in_keys = self.out_keys = [action]
        self.start, self.decay, self.end = start, decay, end
        self.noise, self.uniform_share = noise, uniform_share
        self.generators = [None] if generators is None else list(generators)
        self.register_buffer("low", low.clone())
        self.register_buffer("high", high.clone())
        self.register_buffer("epsilon", torch.full((len(self.generators),), start, dtype=torch.float64))

    def step(self) -> None:
        """Lets epsilon decay: call it at the end of an epoch."""
        self.epsilon.mul_(self.decay).clamp_(min=self.end)

    def restart(self, start: float | None = None, *, run: int | None = None) -> None:
        """Sets epsilon back to a given start, or to its own; of one run, or of all."""
        epsilon = self.epsilon if run is None else self.epsilon[run]
        epsilon.fill_(self.start if start is None else start)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the greedy action by an exploring one, where exploring is asked for."""
        if exploration_type() not in (ExplorationType.RANDOM, None):
            return tensordict
        key = self.in_keys[0]
        greedy = tensordict.get(key)
        actions = [
            explore(
                own,
                self.low,
                self.high,
                epsilon,
                noise=self.noise,
                uniform_share=self.uniform_share,
                generator=generator,
            )
            for own, epsilon, generator in zip(
                greedy.reshape(len(self.generators), -1, greedy.shape[-1]),
                self.epsilon.to(greedy.dtype),
                self.generators,
                strict=True,
            )
        ]
        return tensordict.set(key, torch.stack(actions).view_as(greedy))
