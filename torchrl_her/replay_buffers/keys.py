"""The entries of a stored transition that relabeling reads and writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torchrl_her.checks import check_finite, entry_of
from torchrl_her.goals.rewards import Outcome, RewardFunction, achieved_reward_of, ask_reward, outcomes

LEAST_COST = 1e-4  # smaller differences, relative to a reward, are rounding errors and no cost


@dataclass(frozen=True)
class TransitionKeys:
    """Keys of a transition's goals, and of the entries that depend on them.

    Attributes:
        achieved, next_achieved: the goal achieved before the action, and the one achieved by it.
        goals: the desired goal, in the root and under ``next``.
        reward, terminated, truncated, done: keys under ``next``.
        trajectory, env_ids: ids of trajectories and of environments.
        real_goal: the task's own goal, where another goal was proposed in its place.
        stage: the stage of a curriculum that an episode is played in.
    """

    achieved: NestedKey
    next_achieved: NestedKey
    goals: tuple[NestedKey, NestedKey]
    reward: NestedKey
    terminated: NestedKey
    truncated: NestedKey
    done: NestedKey
    trajectory: NestedKey
    env_ids: NestedKey
    real_goal: NestedKey
    stage: NestedKey

    def asked_for(self, rows: TensorDictBase) -> Tensor:
        """Returns the goals [..., g] that the task itself has set."""
        real = rows.get(self.real_goal, None)
        return entry_of(rows, self.goals[0]) if real is None else real

    def before(self, rows: TensorDictBase, reward_fn: RewardFunction) -> Outcome:
        """Returns the goals [n, g] that were achieved before the actions, with the info that rewards read."""
        return outcomes(reward_fn, entry_of(rows, self.achieved), rows, rows.get("next"))

    def after(self, rows: TensorDictBase, reward_fn: RewardFunction) -> Outcome:
        """Returns the goals [n, g] that the actions achieved, with the info that rewards read."""
        return outcomes(reward_fn, entry_of(rows, self.next_achieved), rows.get("next"), rows)

    def check(self, rows: TensorDictBase, what: str, *, k: int) -> None:
        """Refuses transitions with goals or rewards that cannot be stored, or that cannot be relabeled.

        Args:
            rows: [...], transitions.
            what: name of the transitions in messages.
            k: number of virtual goals of a transition; if 0, goals may be of any shape, or missing.

        Raises:
            ValueError: there is NaN or infinity, or goals are no vectors of one width.
        """
        goals = (self.achieved, self.next_achieved, *self.goals, self.real_goal)
        entries = {key: entry for key in (*goals, self.reward) if (entry := rows.get(key, None)) is not None}
        check_finite({f"the {what} {key!r}": entry for key, entry in entries.items()})
        entries.pop(self.reward, None)
        shapes = {key: list(entry.shape) for key, entry in entries.items()}
        widths = {shape[-1] for shape in shapes.values() if len(shape) == rows.ndim + 1}
        if k > 0 and (len(widths) > 1 or any(len(shape) != rows.ndim + 1 for shape in shapes.values())):
            raise ValueError(
                f"goals must be vectors of one width, {[*rows.shape, 'g']}, got {shapes}: flatten images"
            )

    def rewards(self, rows: TensorDictBase, reward_fn: RewardFunction) -> tuple[Tensor, Tensor]:
        """Returns the rewards [n] of a function plus the costs of failures, and the collected rewards [n]."""
        computed, _ = ask_reward(reward_fn, self.after(rows, reward_fn), entry_of(rows, self.goals[1]))
        cost = failures(rows, self, reward_fn)[1]
        return (computed + cost).flatten(), entry_of(rows, self.reward).flatten()

    def changes(
        self, goals: Tensor, reward: Tensor, terminated: Tensor, truncated: Tensor
    ) -> dict[NestedKey, Tensor]:
        """Returns the entries in which virtual transitions differ from the real ones they are made of.

        Args:
            goals: [V, g], the virtual goals.
            reward, terminated: [V, 1], for these goals.
            truncated: [V, ...], of the real transitions.
        """
        return {
            **dict.fromkeys(self.goals, goals),
            self.reward: reward,
            self.terminated: terminated,
            self.done: terminated | truncated.view_as(terminated),
        }


def failures(
    transitions: TensorDictBase, keys: TransitionKeys, reward_fn: RewardFunction
) -> tuple[Tensor, Tensor]:
    """Returns where an episode terminated without achieving its goal, such as by a fall, and the cost.

    Such an end and its cost do not depend on the goal, so virtual transitions have both, too.

    Returns:
        ``(failed, cost)``, [n, 1] each: a mask, and the collected reward minus the reward function's, which
        is negative; 0 where nothing failed.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_her import GoalReward, HindsightOptions
        >>> goals = {"achieved_goal": torch.tensor([[0.0], [5.0]]), "desired_goal": torch.zeros(2, 1)}
        >>> after = {"terminated": torch.ones(2, 1).bool(), "reward": torch.tensor([[0.0], [-6.0]]), **goals}
        >>> keys = HindsightOptions().transition_keys()
        >>> failed, cost = failures(TensorDict({"next": after}, [2]), keys, GoalReward(0.1))
        >>> failed.tolist(), cost.tolist()
        ([[False], [True]], [[0.0], [-5.0]])
    """
    reward, terminated = (entry_of(transitions, key).reshape(-1) for key in (keys.reward, keys.terminated))
    failed, cost = terminated & (reward < achieved_reward_of(reward_fn)), torch.zeros_like(reward)
    at = failed.nonzero().squeeze(-1)
    if len(at) > 0:  # if the reward function ends the episode, it is a success, whatever its reward
        reached, desired = keys.after(transitions, reward_fn)[at], entry_of(transitions, keys.goals[1])[at]
        own_reward, own_end = (answer.flatten() for answer in ask_reward(reward_fn, reached, desired))
        failed[at] = ~own_end
        less = (reward[at] - own_reward).to(cost.dtype)
        cost[at] = less.where(
            ~own_end & (less < -LEAST_COST * (1 + own_reward.abs())), torch.zeros_like(less)
        )
    return failed.unsqueeze(-1), cost.unsqueeze(-1)


def under_next(key: NestedKey) -> NestedKey:
    """Returns the key of the same entry under ``next``.

    Example:
        >>> under_next("reward"), under_next(("agent", "reward"))
        (('next', 'reward'), ('next', 'agent', 'reward'))
    """
    return unravel_key(("next", key))


def in_root_and_next(keys: Sequence[NestedKey]) -> list[NestedKey]:
    """Returns each key, and the same key under ``next``.

    Raises:
        TypeError: ``keys`` is a single key.

    Example:
        >>> in_root_and_next(["state"])
        ['state', ('next', 'state')]
    """
    if isinstance(keys, str):  # each character would be taken for a key
        raise TypeError(f"keys must be given as a list, got {keys!r}: write [{keys!r}]")
    return [twin for key in keys for twin in (unravel_key(key), under_next(key))]


def device_of(transitions: TensorDictBase) -> torch.device:
    """Returns the device of transitions; of their first entry if the batch itself has no device."""
    if transitions.device is not None:
        return transitions.device
    return next((entry.device for entry in transitions.values(True, True)), torch.device("cpu"))


def stored_as(value: Tensor, entry: Tensor, key: NestedKey) -> Tensor:
    """Converts values [n, ...] to the type and shape of an entry [m, ...] of the collected transitions.

    Raises:
        ValueError: the entry is of whole numbers that cannot hold a value.

    Example:
        >>> import torch
        >>> stored_as(torch.tensor([4.0]), torch.zeros(3, 1, dtype=torch.int64), "desired_goal")
        tensor([[4]])
        >>> stored_as(torch.tensor([4.4]), torch.zeros(3, 1, dtype=torch.int64), "desired_goal")
        Traceback (most recent call last):
        ValueError: 'desired_goal' is of torch.int64, which cannot hold 4.4...: use torch.float32
    """
    out = value.to(entry.dtype)
    if out.dtype != value.dtype and not out.is_floating_point():
        lost = value[out.to(value.dtype) != value]
        if len(lost) > 0:
            raise ValueError(
                f"{key!r} is of {entry.dtype}, which cannot hold {lost[0].item()}: use {value.dtype}"
            )
    return out.view(-1, *entry.shape[1:])
