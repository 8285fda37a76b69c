"""The base of the toy environments: states are places on a lattice, and a goal is a place too."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from numbers import Integral
from typing import ClassVar

import torch
from torch import Tensor
from torchrl.data import Bounded, Categorical

from torchrl_her_envs.common.batched_env import BatchedEnv
from torchrl_her_envs.common.seeding import as_seeds, uniform
from torchrl_her_envs.toy.goals import LatticeGoals
from torchrl_her_envs.toy.pictures import WIDTH, Sheet, draw

MOST_STEPS = (1 << 20) - 1  # most steps of an episode, since random numbers are reserved for each step


@dataclass
class ToyState:
    """The state of N toy environments: places and goals [N, size], steps and episodes [N], all int64.

    ``step`` counts the steps of the episode, ``episode`` the resets.
    """

    place: Tensor
    goal: Tensor
    step: Tensor
    episode: Tensor


class ToyEnv(BatchedEnv):
    """N environments whose states are places on a lattice, and whose goals are such places too.

    Keys: ``observation`` (the place), ``achieved_goal`` (the place, too, or its last part in
    a :class:`Chain` of stages), ``desired_goal``, ``state`` (the observation followed by the desired
    goal), ``action`` (a whole number), ``reward`` (0 where the goal is achieved, -1 elsewhere),
    ``terminated`` (the goal is achieved), ``truncated`` (the last step, or an end that says nothing
    about the goal), ``done``.

    Actions are ``Categorical``, [N] of int64, and not one-hot. If several actions are equally good, TorchRL's
    ``QValueActor`` then takes the first one, while a one-hot action would have a 1 for each. A replay buffer
    also stores just one number a row. ``DQNLoss`` and ``EGreedyModule`` take either form.

    No episode starts at its goal, since such an episode would end without an action. The environments are
    independent: environment k with a given seed does the same in every batch, and a partial reset leaves the
    others as they are.

    Args:
        goals: distribution of the desired goals.
        places: number of places along each coordinate.
        low: observed value of the first place.
        high: observed value of the last place.
        num_actions: number of actions.
        max_steps: number of steps after which an episode is truncated.
        num_envs: N, the number of environments.
        seed: seed of all random numbers; R seeds for R equal blocks of environments, each as if alone.
        size: number of coordinates of a place; a goal has fewer if it is about some of them only.

    Attributes:
        threshold: half the distance of two neighboring places, as the agent sees them.
        worlds: the state of all environments.

    Raises:
        ValueError: a number is out of its range, or environments cannot be shared out among the seeds.
    """

    name: ClassVar[str]  # name of the task

    def __init__(
        self,
        goals: LatticeGoals,
        *,
        places: int,
        low: float,
        high: float,
        num_actions: int,
        max_steps: int,
        num_envs: int,
        seed: int | Sequence[int],
        size: int | None = None,
    ) -> None:
        max_steps = check_whole("max_steps", max_steps, 1, MOST_STEPS)
        num_envs = check_whole("num_envs", num_envs, 1, None)
        super().__init__(num_envs)
        self.max_steps, self.num_actions = max_steps, num_actions
        self._goals, self._low, self._high = goals, low, high
        self._last = places - 1
        self.threshold = (high - low) / self._last / 2
        size = size or len(goals.low)
        self.worlds = ToyState(
            *(torch.zeros(shape, dtype=torch.int64) for shape in ((num_envs, size),) * 2 + ((num_envs,),) * 2)
        )
        self._make_specs(
            size,
            len(goals.low),
            seen=partial(Bounded, low, high, dtype=torch.float32),
            action=Categorical(n=num_actions, shape=(num_envs,), dtype=torch.int64),
        )
        self.set_seeds(as_seeds(seed))

    # The task

    @property
    def task_name(self) -> str:
        return self.name

    @property
    def goal_distribution(self) -> LatticeGoals:
        """The distribution of desired goals, in the coordinates that the agent sees."""
        return self._goals

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Returns whether achieved and desired goals [..., g] are equal, as bool [..., 1].

        Raises:
            ValueError: goals do not have width g.
        """
        size = len(self._goals.low)
        for goal in (achieved_goal, desired_goal):
            if goal.shape[-1:] != (size,):
                raise ValueError(f"goals must be of shape [..., {size}], got {list(goal.shape)}")
        apart = (achieved_goal - desired_goal).square().sum(-1, keepdim=True)
        return apart < self.threshold**2

    # Pictures

    @property
    def can_render(self) -> bool:
        return True

    def _draw_worlds(self, worlds: Sequence[int], size: int | None) -> list[Tensor]:
        """Returns pictures three fifths as high as they are wide."""
        return [draw(WIDTH if size is None else size, partial(self._draw, world=world)) for world in worlds]

    # Methods that subclasses implement or override

    @abstractmethod
    def _draw(self, sheet: Sheet, world: int) -> None:
        """Draws one environment as it is now."""

    @abstractmethod
    def _start(self, which: Tensor) -> tuple[Tensor, Tensor]:
        """Draws start places and goals of the given environments [M]: both [M, size], always different."""

    @abstractmethod
    def _move(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        """Returns the next places [N, size], and a mask [N] of episodes that end without success."""

    def _goal_of(self, place: Tensor) -> Tensor:
        """Returns the part [N, g] of places [N, size] that goals are about."""
        return place

    # One step, and the start of an episode

    def _start_episodes(self, which: Tensor) -> None:
        self.worlds.place[which], self.worlds.goal[which] = self._start(which)

    def _advance(self, action: Tensor) -> Tensor | None:
        self.worlds.place, ended = self._move(action)
        return ended

    def _is_achieved(self, entries: dict[str, Tensor]) -> Tensor:
        return (self.worlds.place == self.worlds.goal).all(-1, keepdim=True)

    def _uniform(self, which: Tensor, count: int) -> Tensor:
        """Returns random numbers [M, count] for the given environments at their present step."""
        w = self.worlds
        moment = w.episode[which] * (MOST_STEPS + 1) + w.step[which]
        return uniform(self._keys[which.numpy()], moment, count)

    def _check_action(self, action: Tensor) -> None:
        (n,) = self.batch_size
        if action.shape != (n,) or action.is_floating_point():
            got = f"shape {list(action.shape)} of {action.dtype}"
            raise ValueError(f"actions must be whole numbers of shape [{n}], got {got}")
        wrong = (action < 0) | (action >= self.num_actions)
        if bool(wrong.any()):
            env = int(wrong.nonzero()[0])
            raise ValueError(
                f"actions must be from 0 to {self.num_actions - 1}, "
                f"got {int(action[env])} in environment {env}"
            )

    def _show(self) -> dict[str, Tensor]:
        place, goal = self._scale(self.worlds.place), self._scale(self._goal_of(self.worlds.goal))
        return {
            "state": torch.cat((place, goal), -1),
            "observation": place,
            "achieved_goal": self._goal_of(place).clone(),
            "desired_goal": goal,
        }

    def _scale(self, place: Tensor) -> Tensor:
        """Converts places to the agent's coordinates, in float64 as for the goals that are sampled."""
        steps = place.to(torch.float64)
        return (self._low + steps * (self._high - self._low) / self._last).to(torch.float32)


def check_whole(name: str, value: int, low: int, high: int | None) -> int:
    """Returns an option as an int; raises a ValueError if it is not a whole number from ``low`` to ``high``.

    Example:
        >>> check_whole("bits", 5, 1, 127)
        5
    """
    if isinstance(value, Integral) and not isinstance(value, bool):
        whole = int(value)
        if low <= whole and (high is None or whole <= high):
            return whole
    allowed = f"at least {low}" if high is None else f"from {low} to {high}"
    raise ValueError(f"{name} must be a whole number {allowed}, got {value!r}")


def check_flag(name: str, value: bool) -> bool:
    """Returns an option that is True or False; raises a ValueError for anything else.

    Example:
        >>> check_flag("reset_state", True)
        True
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return value
