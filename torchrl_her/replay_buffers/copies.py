"""The transitions that a writer stores, made of those that were collected: real ones and virtual ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_her.goals.rewards import RewardFunction, ask_reward
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.keys import TransitionKeys, entry_of, failures, stored_as
from torchrl_her.replay_buffers.n_steps import STEPS_KEY, n_step_return, windows


@dataclass(frozen=True)
class Copies:
    """Transitions [m] that are copies of collected ones, except for some entries.

    Attributes:
        root: [m] int64, positions of the collected transitions whose root they have.
        last: [m] int64, positions of those whose ``next`` they have; the same tensor as ``root`` if
            transitions are over single steps.
        changes: entries that differ, [m, ...] each.
        reward: [m], of the last step.
    """

    root: Tensor
    last: Tensor
    changes: dict[NestedKey, Tensor]
    reward: Tensor

    def entry(self, rows: TensorDictBase, key: NestedKey) -> Tensor:
        """An entry of these transitions, [m, ...]."""
        if key not in self.changes:
            order = self.last if isinstance(key, tuple) and key[0] == "next" else self.root
            return entry_of(rows, key).index_select(0, order)
        return self.changes[key]

    def like(self, rows: TensorDictBase) -> Copies:
        """The same; what differs has the types and shapes that it has in the collected transitions.

        Raises:
            ValueError: an entry cannot hold a value.
        """
        changes = dict(self.changes)
        for key, value in self.changes.items():
            if (entry := rows.get(key, None)) is not None:
                # The discounted sum of whole numbers is none.
                summed = STEPS_KEY in changes and value.is_floating_point()
                changes[key] = value.view(-1, *entry.shape[1:]) if summed else stored_as(value, entry, key)
        return replace(self, changes=changes)


def real_copies(
    rows: TensorDictBase, episodes: Episodes, keys: TransitionKeys, *, n_steps: int, gamma: float | None
) -> Copies:
    """All transitions of some episodes, for the goals that were wanted.

    Args:
        rows: [n], collected transitions.
        episodes: positions among them.
        keys: where entries are.
        n_steps: over how many steps they go, at most.
        gamma: the discount; only needed for more than one step.
    """
    real, reward = episodes.rows[episodes.inside], entry_of(rows, keys.reward)
    if n_steps == 1 or gamma is None:
        return Copies(real, real, {}, reward.index_select(0, real).flatten())
    window, inside = _windows(rows, episodes, real, n_steps)
    done = entry_of(rows, keys.done).reshape(-1, 1)
    out = n_step_return(reward.reshape(-1, 1)[window], done[window], inside, gamma)
    last = _at(window, out.last)
    return Copies(real, last, {keys.reward: out.reward, STEPS_KEY: out.steps}, reward.flatten()[last])


def virtual_copies(
    rows: TensorDictBase,
    episodes: Episodes,
    source: Tensor,
    goals: Tensor,
    reward_fn: RewardFunction,
    keys: TransitionKeys,
    *,
    achieved_reward: float,
    n_steps: int,
    gamma: float | None,
) -> Copies:
    """Some transitions for other goals, each for its own.

    Over several steps, a transition ends where it terminates: by the reward function, or because the episode
    did so although its goal was not achieved. What such a failure cost besides the goal's reward is kept.

    Args:
        rows: [n], collected transitions.
        episodes: positions among them.
        source: [V] int64, the transitions that are copied.
        goals: [V, g].
        reward_fn: maps (achieved, desired) goals to (reward, terminated).
        achieved_reward: the reward of an achieved goal.
        keys, n_steps, gamma: as for :func:`real_copies`.
    """
    achieved = keys.after(rows, reward_fn)
    failed, cost = failures(rows, keys, reward_fn, achieved_reward)
    if n_steps == 1 or gamma is None:
        reward, terminated = ask_reward(reward_fn, achieved[source], goals)
        reward, terminated = reward + cost[source], terminated | failed[source]
        truncated = entry_of(rows, keys.truncated).index_select(0, source)
        return Copies(source, source, keys.changes(goals, reward, terminated, truncated), reward.flatten())
    window, inside = _windows(rows, episodes, source, n_steps)
    reward, terminated = ask_reward(
        reward_fn, achieved[window], goals.unsqueeze(1).expand(-1, window.shape[1], -1)
    )
    reward = reward + cost[window]
    out = n_step_return(reward, terminated | failed[window], inside, gamma)
    last = _at(window, out.last)
    truncated = entry_of(rows, keys.truncated).index_select(0, last)
    changes = keys.changes(goals, out.reward, out.terminated, truncated)
    return Copies(source, last, {**changes, STEPS_KEY: out.steps}, _at(reward.squeeze(-1), out.last))


def virtual_episodes(
    rows: TensorDictBase,
    episodes: Episodes,
    source: Tensor,
    goals: Tensor,
    reward_fn: RewardFunction,
    keys: TransitionKeys,
    *,
    achieved_reward: float,
) -> tuple[Copies, Tensor]:
    """Whole episodes for other goals, one for each copy, up to where the reward function terminates.

    An episode that does not terminate for its goal is truncated at its end.

    Args:
        rows, reward_fn, keys, achieved_reward: as for :func:`virtual_copies`.
        episodes: positions of the collected episodes.
        source: [V] int64, the first transition of the episode that is copied.
        goals: [V, g], of each copy.

    Returns:
        ``(copies, numbers)``: the transitions [m], one copy after the other, and which copy each is of, [m].
    """
    number = _episode_of(rows, episodes)[source]
    table, inside = episodes.rows[number], episodes.inside[number]
    wanted = goals.unsqueeze(1).expand(-1, table.shape[1], -1)
    reward, terminated = ask_reward(reward_fn, keys.after(rows, reward_fn)[table], wanted)
    failed, cost = failures(rows, keys, reward_fn, achieved_reward)
    reward, terminated = reward + cost[table], terminated | failed[table]
    ended = terminated.squeeze(-1).cumsum(-1) - terminated.squeeze(-1).to(torch.int64)
    used = inside & (ended == 0)
    stop = used.clone()
    stop[:, :-1] &= ~used[:, 1:]
    root = table[used]
    own_terminated = terminated[used].view(-1, 1)
    truncated = entry_of(rows, keys.truncated)[root].view(-1, 1) | (stop[used].view(-1, 1) & ~own_terminated)
    changes = keys.changes(wanted[used], reward[used].view(-1, 1), own_terminated, truncated)
    copy = torch.arange(len(source), device=table.device).unsqueeze(-1).expand_as(table)
    return Copies(root, root, {**changes, keys.truncated: truncated}, reward[used].flatten()), copy[used]


def with_ends(real: Copies, rows: TensorDictBase, episodes: Episodes, keys: TransitionKeys) -> Copies:
    """The same; episodes that were ended from outside are truncated, so that samplers of slices see that.

    Args:
        real: of :func:`real_copies`, over single steps.
        rows, episodes, keys: as there.
    """
    done, truncated = (entry_of(rows, key)[real.root].view(-1, 1) for key in (keys.done, keys.truncated))
    cut = torch.zeros_like(done).index_fill_(0, episodes.lengths.cumsum(0) - 1, True) & ~done
    return replace(real, changes={**real.changes, keys.truncated: truncated | cut, keys.done: done | cut})


def episode_numbers(episodes: Episodes) -> Tensor:
    """Which episode each of the transitions ``episodes.rows[episodes.inside]`` belongs to, [n]."""
    number = torch.arange(len(episodes.lengths), device=episodes.rows.device)
    return number.repeat_interleave(episodes.lengths)


def _episode_of(rows: TensorDictBase, episodes: Episodes) -> Tensor:
    """The episode of each collected transition [n]; that of transitions of no episode means nothing."""
    out = episodes.rows.new_zeros(len(rows))
    return out.index_copy_(0, episodes.rows[episodes.inside], episode_numbers(episodes))


def _windows(rows: TensorDictBase, episodes: Episodes, source: Tensor, n_steps: int) -> tuple[Tensor, Tensor]:
    """For transitions [V], the positions [V, m] of up to n steps from them on; which are in the episode."""
    real = episodes.rows[episodes.inside]  # one episode after the other: a place is a position in here
    place = real.new_zeros(len(rows)).index_copy_(0, real, torch.arange(len(real), device=real.device))
    end = episodes.lengths.cumsum(0)[episode_numbers(episodes)]
    places, inside = windows(place[source], end[place[source]], n_steps)
    return real[places], inside


def _at(window: Tensor, index: Tensor) -> Tensor:
    return window.gather(-1, index.unsqueeze(-1)).squeeze(-1)
