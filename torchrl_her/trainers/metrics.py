"""Metrics of greedy episodes: functions of a rollout [N, T], time last.

An environment may have begun new episodes after the first one ended; only the first one counts.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.goals.rewards import RewardFunction, distance, is_achieved


def first_episode(done: Tensor) -> Tensor:
    """Returns which steps belong to the first episode.

    Args:
        done: [..., T] of bool, whether an episode ends with each step.

    Returns:
        Mask [..., T] of these steps.

    Example:
        >>> first_episode(torch.tensor([False, True, False, True])).tolist()
        [True, True, False, False]
    """
    return done.long().cumsum(-1) - done.long() == 0


def at_the_end(rollout: TensorDictBase, values: Tensor) -> Tensor:
    """Returns the values [N, T] at the last step of the first episode, [N]."""
    last = first_episode(rollout.get(("next", "done")).squeeze(-1)).sum(-1, keepdim=True) - 1
    return values.gather(-1, last).squeeze(-1)


def success(rollout: TensorDictBase, reward_fn: RewardFunction | None = None) -> Tensor:
    """Returns whether the goal is achieved at the last step of the episode, as papers on Fetch measure it.

    Args:
        rollout: [N, T], T steps of each of N environments.
        reward_fn: decides which goals are achieved if the rollout lacks the entry ``("next", "is_success")``;
            see :func:`~torchrl_her.goals.is_achieved`.

    Returns:
        Mask [N] of the successful episodes.

    Example:
        >>> from tensordict import TensorDict
        >>> reward, done = torch.tensor([[[0.0], [-1.0]]]), torch.tensor([[[False], [True]]])
        >>> left = TensorDict({"next": {"reward": reward, "done": done}}, [1, 2])
        >>> success(left).tolist(), reached(left).tolist()
        ([False], [True])
    """
    return at_the_end(rollout, is_achieved(rollout["next"], reward_fn))


def reached(rollout: TensorDictBase, reward_fn: RewardFunction | None = None) -> Tensor:
    """Returns whether the goal is achieved at some step; arguments as for :func:`torchrl_her.success`."""
    inside = first_episode(rollout.get(("next", "done")).squeeze(-1))
    return (inside & is_achieved(rollout["next"], reward_fn)).any(-1)


def final_distance(rollout: TensorDictBase) -> Tensor:
    """Returns the distance of the achieved goal from the desired goal at the last step of the episode.

    Args:
        rollout: [N, T], T steps of each of N environments.

    Returns:
        Distances [N], in the unit of the goals.
    """
    gap = distance(rollout.get(("next", "achieved_goal")), rollout.get(("next", "desired_goal")))
    return at_the_end(rollout, gap)


def discounted_return(rollout: TensorDictBase, gamma: float, *, tail_reward: float | Tensor = -1.0) -> Tensor:
    """Computes the discounted return of the first episode, from its first state, [N].

    After a truncation, ``tail_reward`` is counted forever, because a critic bootstraps there and so
    estimates such a return as well.

    Args:
        rollout: [N, T], T steps of each of N environments.
        gamma: discount.
        tail_reward: reward of every step after a truncation, one number or one for each episode [N].

    Returns:
        Returns [N], one for each episode.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1).

    Example:
        >>> from tensordict import TensorDict
        >>> reward, done = -torch.ones(1, 2, 1), torch.tensor([[[False], [True]]])
        >>> after = {"reward": reward, "done": done, "terminated": torch.zeros_like(done)}
        >>> discounted_return(TensorDict({"next": after}, [1, 2]), 0.5).tolist()  # truncated: -1 forever
        [-2.0]
    """
    if not 0.0 <= gamma < 1.0:
        raise ValueError(f"gamma must be in [0, 1), got {gamma}")
    reward = rollout.get(("next", "reward")).squeeze(-1)
    inside = first_episode(rollout.get(("next", "done")).squeeze(-1))
    discount = gamma ** torch.arange(reward.shape[-1], dtype=reward.dtype, device=reward.device)
    total = (reward * inside * discount).sum(-1)
    ended = (inside & rollout.get(("next", "terminated")).squeeze(-1)).any(-1)
    tail = tail_reward * gamma ** inside.sum(-1).to(reward.dtype) / (1.0 - gamma)
    return torch.where(ended, total, total + tail)


def q_bias(initial_value: Tensor, returns: Tensor) -> Tensor:
    """Computes the critic's bias: estimated value of initial states minus the actual return, both [N]."""
    return initial_value.reshape(returns.shape) - returns
