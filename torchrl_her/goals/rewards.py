"""Reward functions of goals, and functions that call reward functions and check their results."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, Protocol, Self, TypeAlias

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her.checks import check_finite

_FORM = (
    "the reward function must take (achieved_goal, desired_goal) and return (reward, terminated), "
    "tensors [..., 1]; wrap one that reads further entries as EnvReward(function, info_keys=[...])"
)
# Achieved goals [..., g], or a tensordict of goals and info if the reward function reads further entries.
Outcome: TypeAlias = Tensor | TensorDictBase
_LOOKED_AT = 100  # number of infos that are tried to see whether goals end episodes


class RewardFunction(Protocol):
    """Maps achieved and desired goals [..., g] to (reward, terminated), each [..., 1].

    The achieved goal comes first, as in gymnasium's ``compute_reward``. A function that has an attribute
    ``info_keys`` gets a third argument, the info: a tensordict of these entries of the transition, whose
    dimensions [...] are broadcast against those of the goals. Entries are read under ``next``, or in the root
    if ``next`` lacks them, as it lacks ``action``. When the relabeling filter calls the function for goals
    that were achieved before the action, entries are read in the root first.

    A goal is achieved if its reward is at least ``achieved_reward``, an attribute that the function may have;
    without it, or if it is None, at least 0. A transition that terminated with a lower reward failed, such as
    by a fall; for other goals it terminates, too, at the same cost.
    """

    def __call__(self, achieved_goal: Tensor, desired_goal: Tensor, /) -> tuple[Tensor, Tensor]: ...


def distance(achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Returns the Euclidean distance between goals.

    Args:
        achieved_goal: [..., g], the achieved goals.
        desired_goal: [..., g], broadcast against ``achieved_goal``.

    Returns:
        Distances [...].

    Example:
        >>> distance(torch.tensor([0.0, 3.0]), torch.tensor([4.0, 0.0]))
        tensor(5.)
    """
    return torch.linalg.vector_norm(achieved_goal - desired_goal, dim=-1)


def achieved(achieved_goal: Tensor, desired_goal: Tensor, threshold: float) -> Tensor:
    """Returns whether the achieved goal is nearer to the desired goal than a threshold.

    Args:
        achieved_goal: [..., g], the achieved goals.
        desired_goal: [..., g], broadcast against ``achieved_goal``.
        threshold: distance below which a goal is achieved, in the unit of the goals.

    Returns:
        Mask [...] of achieved goals.
    """
    width, wanted = achieved_goal.shape[-1], desired_goal.shape[-1]
    if width != wanted:
        raise ValueError(f"goals must have one width, got {width} and {wanted}")
    if achieved_goal.dtype not in (torch.float32, torch.float64):  # squares of int8 overflow, for example
        achieved_goal, desired_goal = achieved_goal.double(), desired_goal.double()
    # Coordinates are added one by one: torch takes several times as long to sum over a short dimension.
    pairs = zip(achieved_goal.unbind(-1), desired_goal.unbind(-1), strict=True)
    return reduce(torch.add, [(one - other).square() for one, other in pairs]) < threshold**2


class GoalReward:
    """Sparse reward: 0 where the goal is achieved, -1 elsewhere; achieving it terminates the episode.

    Args:
        threshold: goals nearer than this count as achieved; in the unit of the goals.

    Keyword Args:
        missed_reward, achieved_reward: rewards of a missed and of an achieved goal.
        terminates: whether achieving the goal terminates the episode; if not, it pays to stay there.

    Raises:
        ValueError: ``threshold`` is not positive, or not finite.

    Example:
        >>> reward, terminated = GoalReward(0.1)(torch.zeros(2, 2), torch.tensor([[0.05, 0.0], [0.2, 0.0]]))
        >>> reward.tolist(), terminated.tolist()
        ([[0.0], [-1.0]], [[True], [False]])
    """

    def __init__(
        self,
        threshold: float,
        *,
        missed_reward: float = -1.0,
        achieved_reward: float = 0.0,
        terminates: bool = True,
    ) -> None:
        if not 0 < threshold < torch.inf:
            raise ValueError(f"threshold must be positive and finite, got {threshold}")
        self.threshold, self.missed_reward, self.achieved_reward = threshold, missed_reward, achieved_reward
        self.terminates = terminates

    def __call__(self, achieved_goal: Tensor, desired_goal: Tensor) -> tuple[Tensor, Tensor]:
        """Returns (reward, terminated), each [..., 1], for goals [..., g]."""
        met = achieved(achieved_goal, desired_goal, self.threshold).unsqueeze(-1)
        dtype = achieved_goal.dtype if achieved_goal.is_floating_point() else torch.get_default_dtype()
        reward = torch.where(met, self.achieved_reward, self.missed_reward).to(dtype)
        return reward, met if self.terminates else torch.zeros_like(met)


class EnvReward:
    """An environment's own functions as a :class:`~torchrl_her.goals.RewardFunction`.

    Args:
        compute_reward: maps (achieved, desired) goals [..., g] to rewards [..., 1].
        compute_terminated: maps (achieved, desired) goals [..., g] to bool [..., 1]: whether the episode
            terminates. If None, no goal terminates an episode.

    Keyword Args:
        info_keys: further entries of the transition, which both functions get as a third argument; see
            :class:`~torchrl_her.goals.RewardFunction`.
        achieved_reward: the least reward of an achieved goal; None for 0.

    Raises:
        TypeError: ``info_keys`` is a single key.
        ValueError: ``achieved_reward`` is not finite.

    Example:
        >>> rule = EnvReward(lambda a, d: -(a - d).abs(), lambda a, d: a == d)
        >>> rule(torch.tensor([1.0]), torch.tensor([3.0]))
        (tensor([-2.]), tensor([False]))
        >>> costly = EnvReward(lambda a, d, info: -(a - d).abs() - info["cost"], info_keys=["cost"])
        >>> costly(torch.tensor([1.0]), torch.tensor([3.0]), TensorDict({"cost": torch.tensor([0.5])}))[0]
        tensor([-2.5000])
    """

    def __init__(
        self,
        compute_reward: Callable[..., Tensor],
        compute_terminated: Callable[..., Tensor] | None = None,
        *,
        info_keys: Sequence[NestedKey] = (),
        achieved_reward: float | None = None,
    ) -> None:
        if isinstance(info_keys, str):  # each character would be taken for a key
            raise TypeError(f"info_keys must be a list, got {info_keys!r}: write [{info_keys!r}]")
        if achieved_reward is not None and not math.isfinite(achieved_reward):
            raise ValueError(f"achieved_reward must be finite, got {achieved_reward}")
        self.compute_reward = compute_reward
        self.compute_terminated = compute_terminated
        self.info_keys = [unravel_key(key) for key in info_keys]
        self.achieved_reward = achieved_reward

    @classmethod
    def of(cls, env: EnvBase) -> Self:
        """Returns the reward function of an environment.

        Args:
            env: environment with a method ``compute_reward``; a method ``compute_terminated`` and attributes
                ``info_keys`` and ``achieved_reward`` are taken over if it has them.

        Raises:
            TypeError: the environment has no method ``compute_reward``.

        Example:
            >>> from torchrl_her_envs import make_env
            >>> rule = EnvReward.of(make_env("hand_v1"))
            >>> rule(torch.zeros(1, 2), torch.ones(1, 2))
            (tensor([[-1.]]), tensor([[False]]))
        """
        if not hasattr(env, "compute_reward"):
            raise TypeError(f"the environment must have a method compute_reward, got {type(env).__name__}")
        others = ("compute_terminated", "info_keys", "achieved_reward")
        return cls(env.compute_reward, **{name: getattr(env, name) for name in others if hasattr(env, name)})

    def __call__(
        self, achieved_goal: Tensor, desired_goal: Tensor, *info: TensorDictBase
    ) -> tuple[Tensor, Tensor]:
        """Returns (reward, terminated), each [..., 1], for goals [..., g], and their info if it is read."""
        reward = self.compute_reward(achieved_goal, desired_goal, *info)
        if self.compute_terminated is None:
            return reward, torch.zeros_like(reward, dtype=torch.bool)
        return reward, self.compute_terminated(achieved_goal, desired_goal, *info)


def outcomes(reward_fn: RewardFunction | None, achieved_goal: Tensor, *parts: TensorDictBase) -> Outcome:
    """Returns achieved goals [..., g], with the info that the reward function reads, if it reads any.

    Args:
        reward_fn: function whose ``info_keys`` name the entries; None for no info.
        achieved_goal: [..., g], the achieved goals.
        *parts: tensordicts [...] of the same transitions, such as ``next`` and the root. Each entry is taken
            from the first part that has it.

    Raises:
        KeyError: no part has an entry.

    Example:
        >>> rule = EnvReward(lambda a, d, info: info["cost"], info_keys=["cost"])
        >>> after = TensorDict({"cost": torch.ones(2, 1)}, [2])
        >>> outcomes(rule, torch.zeros(2, 3), after)["info", "cost"].tolist()
        [[1.0], [1.0]]
    """
    keys: Sequence[NestedKey] = getattr(reward_fn, "info_keys", ())
    if not keys:
        return achieved_goal
    out = TensorDict({"achieved_goal": achieved_goal, "info": {}}, achieved_goal.shape[:-1])
    for key in keys:
        entries = [entry for part in parts if (entry := part.get(key, None)) is not None]
        if not entries:
            raise KeyError(
                f"the reward function reads the entry {key!r}, got {list(parts[0].keys(True, True))}"
            )
        out.set(unravel_key(("info", key)), entries[0])
    return out


def call_reward(reward_fn: RewardFunction, achieved: Outcome, desired_goal: Tensor) -> tuple[Tensor, Tensor]:
    """Calls a reward function for goals [..., g]; the result is not checked."""
    return reward_fn(*_arguments(achieved, desired_goal))


def _arguments(achieved: Outcome, desired_goal: Tensor) -> Any:
    if isinstance(achieved, Tensor):
        return achieved, desired_goal
    return achieved.get("achieved_goal"), desired_goal, achieved.get("info")


def ask_reward(reward_fn: RewardFunction, achieved: Outcome, desired_goal: Tensor) -> tuple[Tensor, Tensor]:
    """Calls a reward function for goals [..., g] and checks its (reward, terminated), each [..., 1].

    Raises:
        ValueError: the function does not return one finite reward and one bool for each pair of goals.

    Example:
        >>> ask_reward(GoalReward(0.1), torch.zeros(2, 1), torch.ones(2, 1))[0].tolist()
        [[-1.0], [-1.0]]
        >>> ask_reward(lambda achieved, desired: (achieved / 0, achieved > 0), torch.ones(1), torch.ones(1))
        Traceback (most recent call last):
        ValueError: rewards of the reward function must be finite, got inf in it
    """
    reward, terminated = _call(reward_fn, achieved, desired_goal)
    shape = _pairs(achieved, desired_goal)
    if terminated.dtype != torch.bool or terminated.numel() != shape.numel():
        raise ValueError(
            f"the reward function must give one bool for each of {shape.numel()} pairs of goals, got "
            f"{terminated.dtype} of shape {list(terminated.shape)}"
        )
    return _checked(reward, shape).unsqueeze(-1), terminated.reshape(*shape, 1)


def _call(reward_fn: RewardFunction, achieved: Outcome, desired_goal: Tensor) -> tuple[Tensor, Tensor]:
    """Calls a reward function and raises a ValueError if its result is not of the required form."""
    try:
        answer = call_reward(reward_fn, achieved, desired_goal)
    except TypeError as error:
        if _takes(reward_fn, _arguments(achieved, desired_goal)):
            raise
        raise ValueError(f"{_FORM}, got {error}") from error
    several = answer if isinstance(answer, tuple | list) else [answer]
    if len(several) == 2 and all(isinstance(value, Tensor) for value in several):
        reward, terminated = several
        return reward, terminated
    kinds = " and ".join(type(value).__name__ for value in several)
    raise ValueError(
        f"{_FORM}, got {kinds}; wrap a function that returns only rewards as EnvReward(function): then no "
        "goal ends an episode"
    )


def _takes(function: Callable[..., object], arguments: Sequence[object]) -> bool:
    """Returns whether a function can be called with some arguments; True if its signature is unknown."""
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError:
        return False
    except ValueError:  # functions in C may have no signature
        return True
    return True


def _pairs(achieved: Outcome, desired_goal: Tensor) -> torch.Size:
    """Returns the shape [...] of goals [..., g] that are broadcast against each other."""
    return torch.broadcast_shapes(*(goals.shape for goals in _arguments(achieved, desired_goal)[:2]))[:-1]


def _checked(reward: Tensor, shape: torch.Size) -> Tensor:
    """Returns rewards in the shape of the pairs of goals; raises if there is not one for each pair."""
    if reward.numel() != shape.numel():
        raise ValueError(
            f"the reward function must give one reward for each of {shape.numel()} pairs of goals, got a "
            f"shape of {list(reward.shape)}"
        )
    check_finite({"rewards of the reward function": reward})
    return reward.reshape(shape)


def missed(reward_fn: RewardFunction, achieved: Outcome, desired_goal: Tensor) -> Tensor:
    """Returns a mask [...] of the pairs of goals [..., g] whose reward is below that of an achieved goal.

    ``terminated`` is not needed, so an :class:`EnvReward` computes the reward alone, in half the time.

    Args:
        reward_fn: maps (achieved, desired) goals to (reward, terminated).
        achieved: goals [..., g], with the info that the function reads (``outcomes``).
        desired_goal: [..., g], broadcast against the achieved goals.

    Raises:
        ValueError: there is not one finite reward for each pair of goals.
    """
    if isinstance(reward_fn, EnvReward):
        value = reward_fn.compute_reward(*_arguments(achieved, desired_goal))
    else:
        value = _call(reward_fn, achieved, desired_goal)[0]
    return _checked(value, _pairs(achieved, desired_goal)) < achieved_reward_of(reward_fn)


def achieved_reward_of(reward_fn: RewardFunction) -> float:
    """Returns the least reward of an achieved goal: that of the reward function, or 0 if it has none.

    Example:
        >>> achieved_reward_of(GoalReward(0.1, missed_reward=0.0, achieved_reward=1.0))
        1.0
    """
    return float(getattr(reward_fn, "achieved_reward", None) or 0.0)


def ends_at_goals(reward_fn: RewardFunction, goals: Outcome) -> bool:
    """Returns whether achieving a goal ends an episode, at least for some of the infos that are read.

    Args:
        reward_fn: maps (achieved, desired) goals to (reward, terminated).
        goals: [n, g], at least one; with the info that the function reads (``outcomes``).

    Example:
        >>> stay = EnvReward(lambda a, d: -(a - d).abs(), lambda a, d: a != a)
        >>> ends_at_goals(GoalReward(0.1), torch.zeros(1, 2)), ends_at_goals(stay, torch.zeros(1, 1))
        (True, False)
    """
    some = goals[:1] if isinstance(goals, Tensor) else goals[:: max(1, len(goals) // _LOOKED_AT)]
    return bool(call_reward(reward_fn, some, _arguments(some, torch.empty(0))[0])[1].any())


def is_achieved(after: TensorDictBase, reward_fn: RewardFunction | None = None) -> Tensor:
    """Returns whether steps achieved their goals: by the environment's own flag, else by a reward function.

    The environment's flag is the entry ``is_success``. The reward of a step is the last resort, because it
    may contain more than the goal, such as a cost of actions.

    Args:
        after: [...], the entry ``next`` of steps.
        reward_fn: maps (achieved, desired) goals to (reward, terminated); None for the reward of the step,
            which is at least 0 where the goal is achieved.

    Returns:
        Mask [...] of the steps that achieved their goals.

    Example:
        >>> from tensordict import TensorDict
        >>> goals = {"achieved_goal": torch.tensor([[0.0], [5.0]]), "desired_goal": torch.zeros(2, 1)}
        >>> after = TensorDict({**goals, "reward": torch.tensor([[-0.01], [-1.01]])}, [2])
        >>> is_achieved(after, GoalReward(0.1)).tolist(), is_achieved(after).tolist()
        ([True, False], [False, False])
    """
    word = after.get("is_success", None)
    if word is not None:
        return word.bool().view(after.shape)
    if reward_fn is None:
        return (after.get("reward") >= 0.0).view(after.shape)
    reached = outcomes(reward_fn, after.get("achieved_goal"), after)
    return ~missed(reward_fn, reached, after.get("desired_goal"))
