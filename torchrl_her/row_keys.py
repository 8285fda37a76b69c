"""Where a row of a replay buffer holds its goals, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor


@dataclass(frozen=True)
class RowKeys:
    """The entries of a row that relabelling reads and writes.

    Attributes:
        achieved, next_achieved: goals achieved before the action, and by it.
        goals: the desired goal, in the root and in ``next``.
        reward, terminated, truncated, done: in ``next``.
        trajectory: ids.
    """

    achieved: NestedKey
    next_achieved: NestedKey
    goals: tuple[NestedKey, NestedKey]
    reward: NestedKey
    terminated: NestedKey
    truncated: NestedKey
    done: NestedKey
    trajectory: NestedKey

    @classmethod
    def of(
        cls,
        *,
        achieved_goal: NestedKey,
        desired_goal: NestedKey,
        reward: NestedKey,
        terminated: NestedKey,
        truncated: NestedKey,
        done: NestedKey,
        trajectory: NestedKey,
    ) -> RowKeys:
        """From the entries' names in the root (goals, trajectories) or in ``next`` (what came of it)."""
        return cls(
            achieved=unravel_key(achieved_goal),
            next_achieved=_next(achieved_goal),
            goals=(unravel_key(desired_goal), _next(desired_goal)),
            reward=_next(reward),
            terminated=_next(terminated),
            truncated=_next(truncated),
            done=_next(done),
            trajectory=unravel_key(trajectory),
        )

    def changes(
        self, goals: Tensor, reward: Tensor, terminated: Tensor, truncated: Tensor
    ) -> dict[NestedKey, Tensor]:
        """The entries in which virtual rows differ from the rows that they are made of.

        Args:
            goals: [V, g], the virtual ones.
            reward, terminated: [V, 1], for these goals.
            truncated: [V, ...], of the rows as they were.
        """
        return {
            **dict.fromkeys(self.goals, goals),
            self.reward: reward,
            self.terminated: terminated,
            self.done: terminated | truncated.view_as(terminated),
        }


def in_root_and_next(keys: Sequence[NestedKey]) -> list[NestedKey]:
    """Each key, and its twin under ``next``.

    Raises:
        TypeError: one key in place of several.
    """
    if isinstance(keys, str):  # a sequence of letters
        raise TypeError(f"keys must be given as a list, got {keys!r}: write [{keys!r}]")
    return [twin for key in keys for twin in (unravel_key(key), _next(key))]


def entry_of(rows: TensorDictBase, key: NestedKey) -> Tensor:
    """An entry that must be there.

    Raises:
        KeyError: it is not; says which ones are.
    """
    entry = rows.get(key, None)
    if entry is None:
        raise KeyError(f"relabelling needs the entry {key!r}, got {list(rows.keys(True, True))}")
    return entry


def _next(key: NestedKey) -> NestedKey:
    return unravel_key(("next", key))
