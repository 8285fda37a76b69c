"""The interface of every environment with goals: throwing, toy, gymnasium's or a user's own."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import EnvBase

from torchrl_her_envs.common.rendering.pictures import captioned

E = TypeVar("E", bound=EnvBase)
Box = tuple[list[float], list[float]]  # the least and the greatest coordinates
Names = str | Sequence[str]  # name of an entry of observations, or of several
INFO = "info"  # entry of transitions for the values that rewards read besides goals
_HAIR = 1e-6  # width of the bounds of a fixed action, relative to its value


class GoalEnv(EnvBase):
    """Base class of TorchRL environments with goals, N of them in one batch.

    Subclasses set ``max_steps`` and the specs, and implement rewards, termination and seeding. All other
    members have defaults to override.

    Attributes:
        max_steps: length of the longest episode.
        missed_reward, achieved_reward: rewards of a missed and of an achieved goal.
        dense_reward: whether missed goals have many different rewards.
        first_action: number of the first discrete action in the task itself, which is 0 in ``action``.
    """

    max_steps: int
    missed_reward: float = -1.0
    achieved_reward: float = 0.0
    dense_reward: bool = False
    first_action: int = 0

    @abstractmethod
    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Returns the rewards [..., 1] of pairs of achieved and desired goals [..., g]."""

    @abstractmethod
    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Returns whether an episode terminates, as bool [..., 1], for pairs of goals [..., g]."""

    @abstractmethod
    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds R equal blocks of environments, each of which then does the same as if it were alone."""

    @property
    def task_name(self) -> str:
        """The name of the task, for messages."""
        return type(self).__name__

    @property
    def info_keys(self) -> Sequence[NestedKey]:
        """Entries of a step that rewards depend on besides the goals.

        ``compute_reward`` and ``compute_terminated`` get them as a third argument, a tensordict.
        """
        return ()

    @property
    def goal_sigma(self) -> float:
        """The final sigma of IBS, as a share of the width of the goals' box.

        Practice at one goal also helps at the task's goals within about this distance.
        """
        return 0.2

    @property
    def starts_near_goals(self) -> bool:
        """Whether goals lie where episodes start.

        If so, IBS is of no use: it prefers virtual goals near the real ones, and many of these are achieved
        without any action.
        """
        return False

    @property
    def can_render(self) -> bool:
        """Whether :meth:`render` returns pictures."""
        return False

    @property
    def continues_after_termination(self) -> bool:
        """Whether the environment can be stepped further after it terminated an episode.

        Episodes of a curriculum's stages then continue, too, since stages have goals of their own.
        """
        return False

    @property
    def batched(self) -> bool:
        """Whether a batch is stepped as a whole, at little cost for each of its environments."""
        return False

    def stages(self) -> list[dict[str, Any]]:
        """Returns the stages of the task's curriculum, in the order of training; the last is the full task.

        Returns:
            For each stage its ``name``; ``observation``, ``achieved_goal`` and ``desired_goal``, which are
            lists of indices into the state; ``threshold``, the distance below which a goal is achieved (not
            in the last stage, which has the task's own reward); and ``instructive``, whether IBS weights
            apply in it. The state is the observation followed by the desired goal.

        Raises:
            ValueError: the task has no curriculum.

        Example:
            >>> from torchrl_her_envs import make_env
            >>> reach, throw = make_env("hand_v1").stages()
            >>> reach["name"], reach["achieved_goal"], reach["desired_goal"]
            ('reach', [0, 1], [5, 6])
        """
        raise ValueError(f"{self.task_name} has no curriculum: give its stages as curriculum=FILE.yaml")

    def state_names(self) -> dict[str, list[int]]:
        """Returns names for entries of the state, which is the observation followed by the desired goal.

        The stages of a curriculum may use them in place of indices.

        Example:
            >>> from torchrl_her_envs import make_env
            >>> make_env("hand_v1").state_names()["hole"], make_env("bit_flip", bits=2).state_names()
            ([9, 10], {'observation': [0, 1], 'desired_goal': [2, 3]})
        """
        observed, goal = (self.observation_spec[key].shape[-1] for key in ("observation", "desired_goal"))
        return {"observation": list(range(observed)), "desired_goal": list(range(observed, observed + goal))}

    def action_limits(self) -> tuple[Tensor, Tensor]:
        """Returns the lowest and the highest action, [entries] each, in the dtype of the task itself.

        Both are equal where the task fixes an entry. The bounds of ``action_spec`` differ even there, since
        actions are scaled by the difference of the bounds.

        Example:
            >>> from torchrl_her_envs import make_env
            >>> make_env("hand_v1").action_limits()
            (tensor([-1., -1., -1.]), tensor([1., 1., 1.]))
        """
        space = self.action_spec_unbatched.space
        return space.low, space.high

    def goal_box(self) -> Box | None:
        """Returns the least and greatest coordinates of achieved goals; None if the task does not state them.

        Example:
            >>> from torchrl_her_envs import make_env
            >>> make_env("hand_v1").goal_box(), make_env("chain").goal_box()
            (([-1.0, -1.0], [1.0, 1.0]), None)
        """
        return None

    def picture_box(self) -> Box | None:
        """Returns coordinates of a picture's corners, (left, bottom) and (right, top); None if unknown.

        Goals can be drawn on a picture only if these coordinates are known. If pictures have a margin, this
        box is larger than :meth:`goal_box`.

        Example:
            >>> from torchrl_her_envs import make_env
            >>> make_env("hand_v1").picture_box(), make_env("chain").picture_box()
            (([-1.08, -1.08], [1.08, 1.08]), None)
        """
        return None

    def regions(self) -> dict[str, Box]:
        """Returns boxes to draw over pictures, by name, in the coordinates that the agent sees.

        Example:
            >>> from torchrl_her_envs import make_env
            >>> list(make_env("hand_v1").regions()), make_env("chain").regions()
            (['goals', 'reach'], {})
        """
        return {}

    def trail_points(self) -> Tensor | None:
        """Returns the present points [N, ...] of bodies that leave a trail in videos; None without trails."""
        return None

    def render(
        self,
        worlds: int | Sequence[int] | None = None,
        *,
        size: int | None = None,
        trail: Sequence[Tensor] = (),
        caption: str = "",
    ) -> Tensor:
        """Draws environments as they are now.

        Args:
            worlds: an index, several, or None for all environments of the batch.
            size: longer side of each picture in pixels; the environment's own choice if None.
            trail: earlier values of :meth:`trail_points`, oldest first.
            caption: a line of text in each picture.

        Returns:
            Pictures [len(worlds), height, width, 3] of uint8; without the first dimension for one index.

        Raises:
            ValueError: the environment gives no pictures, an index is out of range, or rendering fails.
        """
        pictures = self._draw_worlds(choose_indices(self.batch_size[0], worlds), size)
        pictures = [captioned(picture, caption) for picture in pictures]
        return pictures[0] if isinstance(worlds, int) else torch.stack(pictures)

    def _draw_worlds(self, worlds: Sequence[int], size: int | None) -> list[Tensor]:
        """Returns pictures [height, width, 3] of some environments, without a caption; for :meth:`render`."""
        raise ValueError(f"{self.task_name} gives no pictures")


def goal_env(env: EnvBase) -> GoalEnv:
    """Returns the environment with goals below any transforms.

    Raises:
        TypeError: no environment with goals is found.

    Example:
        >>> from torchrl.envs import StepCounter, TransformedEnv
        >>> from torchrl_her_envs import make_env
        >>> goal_env(TransformedEnv(make_env("hand_v1"), StepCounter())).max_steps
        50
    """
    # mypy refuses an abstract class, but isinstance takes it.
    return first_below(env, GoalEnv, "an environment with goals")  # type: ignore[type-abstract]


def first_below(env: object, kind: type[E], what: str) -> E:
    """Returns the first environment of a class, from an environment down through its transforms.

    Raises:
        TypeError: no such environment is found; the message says that ``what`` was expected.
    """
    inner: object = env
    while not isinstance(inner, kind):
        inner = getattr(inner, "base_env", None)
        if inner is None:
            raise TypeError(f"expected {what}, got {type(env).__name__}")
    return inner


def choose_indices(count: int, worlds: int | Sequence[int] | None) -> list[int]:
    """Converts the argument ``worlds`` to a list of indices of environments, and checks them.

    Args:
        count: number of environments in the batch.
        worlds: an index, several, or None for all.

    Raises:
        ValueError: there is no index, or one is out of range.

    Example:
        >>> choose_indices(3, None), choose_indices(3, 1)
        ([0, 1, 2], [1])
    """
    if worlds is None:
        return list(range(count))
    chosen = [worlds] if isinstance(worlds, int) else list(worlds)
    if not chosen or not all(0 <= world < count for world in chosen):
        raise ValueError(f"worlds must be one or more indices from 0 to {count - 1}, got {worlds}")
    return chosen


def bounded_actions(low: Tensor, high: Tensor, count: int) -> Bounded:
    """Makes the spec of float32 actions [count, entries] from one environment's bounds, of any shape.

    A fixed entry, ``low`` = ``high``, gets a tiny width, since scaling actions divides by the width.

    Example:
        >>> bounded_actions(torch.tensor([[-1.0, 3.0]]), torch.tensor([[1.0, 3.0]]), 4).shape
        torch.Size([4, 2])
    """
    low, high = (side.float().reshape(1, -1).expand(count, -1) for side in (low, high))
    high = torch.where(high > low, high, low + _HAIR * low.abs().clamp(min=1))
    return Bounded(low=low, high=high, shape=low.shape, dtype=torch.float32)


def info_rows(transitions: TensorDictBase, names: Iterable[str], shape: torch.Size) -> dict[str, Tensor]:
    """Returns entries [..., w] of transitions that rewards read, broadcast to the shape of pairs of goals.

    Example:
        >>> from tensordict import TensorDict
        >>> steps = TensorDict({"info": {"cost": torch.ones(2, 1, 3)}}, [2, 1])
        >>> info_rows(steps, ["cost"], torch.Size([2, 5]))["cost"].shape
        torch.Size([2, 5, 3])
    """
    entries = {name: transitions.get((INFO, name)) for name in names}
    return {name: entry.expand(*shape, *entry.shape[transitions.ndim :]) for name, entry in entries.items()}


def needs_info(env: GoalEnv) -> str:
    """Returns the message for rewards that read info besides goals, if no info is given."""
    return (
        f"compute_reward of {env.task_name} reads {env.info_keys} of transitions: pass them, as "
        "EnvReward.of(env) does"
    )


def reward_range(env: GoalEnv) -> tuple[float, float]:
    """Returns the rewards of a missed and of an achieved goal; -1 and 0 unless the environment has others.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> reward_range(make_env("hand_v1"))
        (-1.0, 0.0)
    """
    return env.missed_reward, env.achieved_reward


def reward_bounds(env: GoalEnv) -> tuple[float, float]:
    """Returns the least and the greatest possible reward, to clamp targets; infinite if rewards are dense.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> reward_bounds(make_env("hand_v1"))
        (-1.0, 0.0)
    """
    return (-math.inf, math.inf) if env.dense_reward else reward_range(env)
