"""The entries of a stored transition that relabeling reads and writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor


@dataclass(frozen=True)
class TransitionKeys:
    """Where a transition holds its goals, and what depends on them.

    Attributes:
        achieved, next_achieved: the goal achieved before the action, and the one achieved by it.
        goals: the desired goal, in the root and under ``next``.
        reward, terminated, truncated, done: under ``next``.
        trajectory, env_ids: ids.
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

    def changes(
        self, goals: Tensor, reward: Tensor, terminated: Tensor, truncated: Tensor
    ) -> dict[NestedKey, Tensor]:
        """The entries in which virtual transitions differ from the real ones they are made of.

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


def failed(transitions: TensorDictBase, keys: TransitionKeys, achieved_reward: float) -> Tensor:
    """Where an episode terminated although its goal was not achieved, as by a fall: [n, 1] of bool.

    It would have terminated there whatever the goal, so it does for virtual goals, too.

    Args:
        transitions: [n], as collected.
        keys: where entries are.
        achieved_reward: the reward of an achieved goal.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_her import HindsightOptions
        >>> after = {"terminated": torch.tensor([[True], [True]]), "reward": torch.tensor([[0.0], [-1.0]])}
        >>> failed(TensorDict({"next": after}, [2]), HindsightOptions().transition_keys(), 0.0).tolist()
        [[False], [True]]
    """
    reward, terminated = entry_of(transitions, keys.reward), entry_of(transitions, keys.terminated)
    return terminated.reshape(-1, 1) & (reward.reshape(-1, 1) < achieved_reward)


def under_next(key: NestedKey) -> NestedKey:
    """The same key under ``next``.

    Example:
        >>> under_next("reward"), under_next(("agent", "reward"))
        (('next', 'reward'), ('next', 'agent', 'reward'))
    """
    return unravel_key(("next", key))


def in_root_and_next(keys: Sequence[NestedKey]) -> list[NestedKey]:
    """Each key, and the same key under ``next``.

    Raises:
        TypeError: one key in place of several.

    Example:
        >>> in_root_and_next(["state"])
        ['state', ('next', 'state')]
    """
    if isinstance(keys, str):  # a sequence of letters
        raise TypeError(f"keys must be given as a list, got {keys!r}: write [{keys!r}]")
    return [twin for key in keys for twin in (unravel_key(key), under_next(key))]


def entry_of(transitions: TensorDictBase, key: NestedKey) -> Tensor:
    """An entry that must be there.

    Raises:
        KeyError: it is missing; the message lists the entries that are there.
    """
    entry = transitions.get(key, None)
    if entry is None:
        raise KeyError(f"relabeling needs the entry {key!r}, got {list(transitions.keys(True, True))}")
    return entry
