"""Exploration: replaces a decaying fraction epsilon of the greedy actions by random ones."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_her.checks import check_finite, check_whole


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
    """Replaces some greedy actions by noisy ones, and a few by uniform ones.

    This is the exploration of appendix B of the thesis. With ``epsilon=1``, every action that is not uniform
    has noise, as in OpenAI's HER and in MRL. They use ``epsilon=1, uniform_share=0.2, noise=0.05``: 20 % of
    the actions are uniform, and noise has a standard deviation of 0.1 on actions from -1 to 1.

    Args:
        greedy: [..., a], the actions of the policy.
        low: [a], least actions.
        high: [a], greatest actions.
        epsilon: share of actions that explore, broadcast against [..., 1].
        noise: standard deviation of the noise, as a fraction of the range of actions.
        uniform_share: the part of epsilon that draws uniform actions; the rest adds noise.
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


def explore_actions(
    greedy: Tensor, actions: int, epsilon: Tensor | float, *, generator: torch.Generator | None = None
) -> Tensor:
    """Replaces greedy actions by uniformly drawn ones with probability epsilon.

    Args:
        greedy: [...] of integers, the actions of the policy.
        actions: number of actions.
        epsilon: share of actions that are drawn uniformly.
        generator: source of the random numbers.

    Example:
        >>> explore_actions(torch.tensor([1, 2]), 3, 0.0).tolist()
        [1, 2]
    """
    choice = torch.rand(greedy.shape, device=greedy.device, generator=generator)
    anything = torch.randint(actions, greedy.shape, device=greedy.device, generator=generator)
    return torch.where(choice < epsilon, anything, greedy)


class Exploration(TensorDictModuleBase):
    """Replaces a share epsilon of greedy actions by exploring ones; each run has its own, decaying epsilon.

    Actions stay greedy under ``set_exploration_type(ExplorationType.DETERMINISTIC)`` (or MODE, MEAN).

    Keyword Args:
        start: epsilon before the first :meth:`step`.
        decay: factor of epsilon in each step.
        end: the least epsilon.
        generators: sources of the random numbers, one for each of R independent runs, whose actions are R
            equal blocks of the batch in this order. None for one run and torch's own generator.
        action_key: key of the action, which is read and written.

    Attributes:
        epsilon: [R], the present share of exploring actions of each run.

    Raises:
        ValueError: ``0 <= end <= start <= 1`` does not hold, or the decay is outside of (0, 1].
    """

    def __init__(
        self,
        *,
        start: float = 1.0,
        decay: float = 0.95,
        end: float = 0.05,
        generators: Sequence[torch.Generator] | None = None,
        action_key: NestedKey = "action",
    ) -> None:
        if not 0.0 <= end <= start <= 1.0:
            raise ValueError(f"epsilon needs 0 <= end <= start <= 1, got start={start}, end={end}")
        if not 0.0 < decay <= 1.0:
            raise ValueError(f"decay must be in (0, 1], got {decay}")
        super().__init__()
        self.in_keys = self.out_keys = [action_key]
        self.start, self.decay, self.end = start, decay, end
        self.generators = [None] if generators is None else list(generators)
        self.register_buffer("epsilon", torch.full((len(self.generators),), start, dtype=torch.float64))

    def step(self) -> None:
        """Multiplies epsilon by ``decay``; to be called at the end of each epoch."""
        self.epsilon.mul_(self.decay).clamp_(min=self.end)

    def restart(self, start: float | None = None, *, run: int | None = None) -> None:
        """Sets epsilon of one run, or of all runs, to ``start`` or back to its initial value.

        Raises:
            ValueError: ``start`` is outside of [0, 1].
        """
        if start is not None and not 0.0 <= start <= 1.0:
            raise ValueError(f"epsilon must be in [0, 1], got {start}")
        epsilon = self.epsilon if run is None else self.epsilon[run]
        epsilon.fill_(self.start if start is None else start)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces greedy actions by exploring ones, unless exploration is switched off.

        Raises:
            ValueError: the batch cannot be cut into R equal blocks.
        """
        if exploration_type() not in (ExplorationType.RANDOM, None):
            return tensordict
        key = self.in_keys[0]
        action = tensordict.get(key)
        greedy = torch.atleast_1d(action)  # a discrete action of a single environment has no dimension
        runs = len(self.generators)
        if len(greedy) % runs:
            raise ValueError(f"the number of rows must be a multiple of runs={runs}, got {len(greedy)}")
        blocks = greedy.chunk(runs)
        actions = [
            self._explore(block, epsilon, generator)
            for block, epsilon, generator in zip(blocks, self.epsilon, self.generators, strict=True)
        ]
        return tensordict.set(key, torch.cat(actions).view(action.shape))

    @abstractmethod
    def _explore(self, greedy: Tensor, epsilon: Tensor, generator: torch.Generator | None) -> Tensor:
        """Returns the actions of one run, some of them exploring."""


class DecayingEpsilon(Exploration):
    """Exploration of continuous actions; put it after a policy in a TensorDictSequential.

    Args:
        low: [a], least actions.
        high: [a], greatest actions.

    Keyword Args:
        noise, uniform_share: see :func:`~torchrl_her.modules.explore`.
        **options: options of :class:`~torchrl_her.modules.Exploration`.

    Raises:
        ValueError: ``noise`` is negative, ``uniform_share`` is outside of [0, 1], or the actions' bounds are
            not finite or ``low`` is above ``high``.

    Example:
        >>> exploration = DecayingEpsilon(-torch.ones(3), torch.ones(3), start=1.0, decay=0.5)
        >>> exploration.step()
        >>> exploration.epsilon.tolist()
        [0.5]
    """

    def __init__(
        self, low: Tensor, high: Tensor, *, noise: float = 0.05, uniform_share: float = 0.2, **options: Any
    ) -> None:
        if not 0.0 <= noise < torch.inf:
            raise ValueError(f"noise must be at least 0 and finite, got {noise}")
        if not 0.0 <= uniform_share <= 1.0:
            raise ValueError(f"uniform_share must be in [0, 1], got {uniform_share}")
        check_finite({"low": low, "high": high})
        if bool((wrong := low > high).any()):
            raise ValueError(f"low must be at most high={high[wrong][0].item()}, got {low[wrong][0].item()}")
        super().__init__(**options)
        self.noise, self.uniform_share = noise, uniform_share
        self.register_buffer("low", low.clone())
        self.register_buffer("high", high.clone())

    def _explore(self, greedy: Tensor, epsilon: Tensor, generator: torch.Generator | None) -> Tensor:
        return explore(
            greedy,
            self.low,
            self.high,
            epsilon.to(greedy.dtype),
            noise=self.noise,
            uniform_share=self.uniform_share,
            generator=generator,
        )


class DecayingEpsilonGreedy(Exploration):
    """Epsilon-greedy exploration of discrete actions, given as integers (``Categorical``).

    Args:
        actions: number of actions.

    Keyword Args:
        **options: options of :class:`~torchrl_her.modules.Exploration`.

    Raises:
        ValueError: ``actions`` is below 1.

    Example:
        >>> from tensordict import TensorDict
        >>> exploration = DecayingEpsilonGreedy(4, start=0.0, end=0.0)
        >>> exploration(TensorDict({"action": torch.tensor([3, 0])}, [2]))["action"].tolist()
        [3, 0]
    """

    def __init__(self, actions: int, **options: Any) -> None:
        check_whole(actions=actions)
        super().__init__(**options)
        self.actions = actions

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces greedy actions by exploring ones, unless exploration is switched off.

        Raises:
            ValueError: as in :class:`~torchrl_her.modules.Exploration`, or actions are not whole numbers.
        """
        action = tensordict.get(self.in_keys[0])
        one_hot = self.actions > 1 and action.shape[tensordict.ndim :] == (self.actions,)
        if one_hot or action.is_floating_point() or action.dtype is torch.bool:
            raise ValueError(
                f"actions must be whole numbers (categorical), got {action.dtype} of shape "
                f"{list(action.shape)} (one-hot?)"
            )
        return super().forward(tensordict)

    def _explore(self, greedy: Tensor, epsilon: Tensor, generator: torch.Generator | None) -> Tensor:
        return explore_actions(greedy, self.actions, epsilon.to(torch.float32), generator=generator)
