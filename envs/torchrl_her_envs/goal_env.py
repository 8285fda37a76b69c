"""What every environment with goals offers here, whatever is inside: throwing, small worlds, gymnasium."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, cast

from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import EnvBase


class GoalEnv(Protocol):
    """N worlds with goals, besides all that TorchRL's ``EnvBase`` has.

    ``max_steps`` is the length of the longest episode, ``compute_reward`` and ``compute_terminated``
    map goals [..., g] that were achieved and desired to [..., 1], and ``set_seeds`` seeds R equal
    blocks of worlds, each as if it were alone.
    """

    @property
    def max_steps(self) -> int: ...

    @property
    def observation_spec(self) -> Composite: ...

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor: ...

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor: ...

    def set_seeds(self, seeds: Sequence[int]) -> None: ...


def goal_env(env: EnvBase) -> GoalEnv:
    """The environment with goals below any transforms.

    Raises:
        TypeError: there is none.

    Example:
        >>> from torchrl.envs import StepCounter, TransformedEnv
        >>> from torchrl_her_envs import make_env
        >>> goal_env(TransformedEnv(make_env("hand_v1"), StepCounter())).max_steps
        50
    """
    inner = first_below(env, _has_goals)
    if inner is None:
        raise TypeError(f"expected an environment with goals, got {type(env).__name__}")
    return cast(GoalEnv, inner)


def first_below(env: EnvBase, fits: Callable[[object], bool]) -> object | None:
    """The environment, or the first one below its transforms, that fits; None if none does."""
    inner: object | None = env
    while inner is not None and not fits(inner):
        inner = getattr(inner, "base_env", None)
    return inner


def reward_range(env: GoalEnv) -> tuple[float, float]:
    """The reward of a goal that was missed and of one that was achieved; -1 and 0 unless it says otherwise.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> reward_range(make_env("hand_v1"))
        (-1.0, 0.0)
    """
    return getattr(env, "missed_reward", -1.0), getattr(env, "achieved_reward", 0.0)


def _has_goals(env: object) -> bool:
    """Whether it is one by itself: TransformedEnv passes on what it does not have."""
    return all(hasattr(type(env), name) for name in ("compute_reward", "compute_terminated", "set_seeds"))
