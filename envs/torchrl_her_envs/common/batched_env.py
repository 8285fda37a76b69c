"""Base class of environments whose state is a batch of tensors, with episodes, rewards and resuming."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from torchrl_her_envs.common.goal_env import GoalEnv
from torchrl_her_envs.common.seeding import block_keys

_ENDS = ("done", "terminated", "truncated")
_COUNTERS = ("step", "episode")  # entries of the state that are counters and not physical


class BatchedEnv(GoalEnv):
    """Base class of N environments whose state is a set of tensors, with one row for each environment.

    Subclasses define how episodes start (:meth:`_start_episodes`), what an action does (:meth:`_advance`),
    what the agent observes (:meth:`_show`) and when a goal is achieved (:meth:`compute_terminated`). All
    random numbers derive from a key for each environment (see ``common.seeding``), so environment k with a
    given seed does the same in every batch. The reward is 0 where the goal is achieved and -1 elsewhere; an
    achieved goal ends the episode.

    Subclasses set ``max_steps`` and ``worlds``, then call :meth:`_make_specs` and
    :meth:`set_seeds`.

    Attributes:
        worlds: the state of all environments, a dataclass of tensors with N rows. This class writes two of
            them, [N] of int64: ``step`` counts the steps of the episode, ``episode`` the resets.
        max_steps: steps after which an episode is truncated.
        dtype_shown: type of observations, goals and rewards.

    Args:
        num_envs: N, the number of environments.
    """

    worlds: Any
    max_steps: int
    dtype_shown: torch.dtype = torch.float32
    continues_after_termination = True
    batched = True

    def __init__(self, num_envs: int) -> None:
        super().__init__(device="cpu", batch_size=(num_envs,))
        self._packed = False  # whether TensorDict has checked the entries

    # Methods that subclasses implement

    @abstractmethod
    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Returns whether goals are achieved, which ends an episode, as bool [..., 1]."""

    @abstractmethod
    def _start_episodes(self, which: Tensor) -> None:
        """Draws the starts of new episodes in the given environments [M], whose counters are updated."""

    @abstractmethod
    def _advance(self, action: Tensor) -> Tensor | None:
        """Takes a step with checked actions; returns a mask [N] of episodes that fail in it, or None."""

    @abstractmethod
    def _show(self) -> dict[str, Tensor]:
        """Returns ``state``, ``observation``, ``achieved_goal`` and ``desired_goal`` of all environments."""

    @abstractmethod
    def _check_action(self, action: Tensor) -> None:
        """Raises a ValueError for invalid actions."""

    def _is_achieved(self, entries: dict[str, Tensor]) -> Tensor:
        """Returns whether each environment is at its goal, as bool [N, 1]."""
        return self.compute_terminated(entries["achieved_goal"], entries["desired_goal"])

    # Public methods, and their checks

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Computes the reward of having achieved one goal when another was desired.

        Args:
            achieved_goal: [..., g], as the agent sees it.
            desired_goal: [..., g], broadcast against ``achieved_goal``.

        Returns:
            Rewards [..., 1]: 0 where the goal is achieved, -1 elsewhere.

        Raises:
            ValueError: goals do not have width g, in tasks that check this.
        """
        return self.compute_terminated(achieved_goal, desired_goal).to(achieved_goal.dtype) - 1.0

    def world_state_dict(self) -> dict[str, Tensor]:
        """Returns a copy of the whole state, with a row for each environment, to resume exactly from here."""
        state: dict[str, Tensor] = {
            field.name: getattr(self.worlds, field.name).clone(memory_format=torch.contiguous_format)
            for field in fields(self.worlds)
        }
        return state | {"key": torch.from_numpy(self._keys.view(np.int64).copy())}

    def load_world_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores the environments to the state that ``world_state_dict`` returned.

        Raises:
            ValueError: the state is of another number or kind of environments; nothing has changed then.
        """
        self._check_state(state)
        entries = {field.name: state[field.name].clone() for field in fields(self.worlds)}
        self.worlds = type(self.worlds)(**entries)
        self._keys = state["key"].numpy().copy().view(np.uint64)

    def start_at(self, states: Mapping[str, Tensor], which: Tensor) -> dict[str, Tensor]:
        """Begins episodes of some environments at given states, with the goals that the states have.

        The episodes have their full number of steps. Seeds, the count of episodes and all other environments
        stay as they are, so what is drawn later is the same as without this call.

        Args:
            states: M rows of each entry of ``worlds``, as :meth:`world_state_dict` gives them; ``step``,
                ``episode`` and ``key`` are not read.
            which: [M] of int64, indices of these environments, without repetitions.

        Returns:
            The current ``state``, ``observation`` and goals of all N environments.

        Raises:
            ValueError: an entry is missing or has another shape, or an environment is named twice or does not
                exist; nothing has changed then.

        Example:
            >>> import torch
            >>> from torchrl_her_envs import make_env
            >>> env = make_env("hand_v1", num_envs=2, seed=0)
            >>> _ = env.reset()
            >>> first = {name: entry[:1] for name, entry in env.world_state_dict().items()}
            >>> shown = env.start_at(first, torch.tensor([1]))
            >>> bool((shown["state"][0] == shown["state"][1]).all())
            True
        """
        entries = [field.name for field in fields(self.worlds) if field.name not in _COUNTERS]
        self._check_starts(states, which, entries)
        for name in entries:
            getattr(self.worlds, name)[which] = states[name]  # in place: other objects may share the memory
        self.worlds.step[which] = 0
        return self._show()

    def _check_starts(self, states: Mapping[str, Tensor], which: Tensor, entries: Sequence[str]) -> None:
        """Raises a ValueError for states or environments that :meth:`start_at` cannot take."""
        chosen = which.tolist()
        if len(set(chosen)) < len(chosen) or not all(0 <= index < self.batch_size[0] for index in chosen):
            raise ValueError(
                f"'which' must hold distinct indices from 0 to {self.batch_size[0] - 1}, got {chosen}"
            )
        for name in entries:
            if name not in states:
                raise ValueError(f"the states of {self.task_name} lack {name!r}, got {', '.join(states)}")
            expected = (len(chosen), *getattr(self.worlds, name).shape[1:])
            if states[name].shape != expected:
                got = list(states[name].shape)
                raise ValueError(f"{name!r} of the states must be of shape {list(expected)}, got {got}")

    def _check_state(self, state: dict[str, Tensor]) -> None:
        """Raises a ValueError for a state whose entries are of other shapes than these environments'."""
        shapes = {field.name: getattr(self.worlds, field.name).shape for field in fields(self.worlds)}
        for name, shape in (shapes | {"key": torch.Size(self._keys.shape)}).items():
            actual = state[name].shape
            if actual[:1] != shape[:1]:
                count = actual[0] if actual else 0
                raise ValueError(f"the state must have {shape[0]} rows, got {name!r} with {count}")
            if actual != shape:
                raise ValueError(f"{name!r} of the state must be of shape {list(shape)}, got {list(actual)}")

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds R equal blocks of environments, each as if it were alone.

        Args:
            seeds: R seeds.

        Raises:
            ValueError: the environments cannot be shared out among R blocks, or a seed is out of range.
        """
        self._keys = block_keys(seeds, self.batch_size[0])
        self.worlds.episode.zero_()

    # TorchRL's hooks

    def _set_seed(self, seed: int | None) -> None:
        self.set_seeds([seed or 0])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        which = torch.arange(self.batch_size[0]) if mask is None else mask.view(-1).nonzero().squeeze(-1)
        entries = self._begin(which)
        return self._pack(
            {**entries, **{key: torch.zeros(*self.batch_size, 1, dtype=torch.bool) for key in _ENDS}}
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        self._check_action(action)
        return self._pack(self._take(action))

    def _begin(self, which: Tensor) -> dict[str, Tensor]:
        """Begins the next episodes of the given environments [M]; returns the observations of all N."""
        self.worlds.episode[which] += 1
        self.worlds.step[which] = 0
        self._start_episodes(which)
        return self._show()

    def _take(self, action: Tensor) -> dict[str, Tensor]:
        """Takes a step with checked actions; returns observations, rewards and ends."""
        self.worlds.step = self.worlds.step + 1
        cut = self._advance(action)
        entries = self._show()
        terminated = self._is_achieved(entries)
        truncated = (self.worlds.step >= self.max_steps).unsqueeze(-1)
        if cut is not None:
            truncated = truncated | cut.unsqueeze(-1)
        entries["reward"] = terminated.to(self.dtype_shown) - 1.0
        return {**entries, "terminated": terminated, "truncated": truncated, "done": terminated | truncated}

    def _pack(self, entries: dict[str, Tensor]) -> TensorDictBase:
        # The device is given although it stays the same: otherwise TorchRL copies every entry.
        options = {"batch_size": self.batch_size, "device": self.device}
        if not self._packed:
            self._packed = True
            return TensorDict(entries, **options)
        # TensorDict's checks take longer than a step does, and once is enough: shapes do not change.
        return TensorDict._new_unsafe(entries, **options)

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        """Skips TorchRL's completion of missing entries and shapes, which these steps do not need."""
        if self.run_type_checks:
            return super()._step_proc_data(next_tensordict_out)
        return next_tensordict_out

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begins new episodes where the old ones are over, as ``EnvBase.maybe_reset`` does.

        TorchRL's method takes longer than a step of a hundred environments, and with many environments an
        episode ends in nearly every step. This method writes the new rows without checks, as they are known
        to be right.
        """
        done = tensordict.get("done", None)
        if done is None or not all(type(entry) in (Tensor, TensorDict) for entry in tensordict.values()):
            return super().maybe_reset(tensordict)
        if not bool(done.any()):
            return tensordict
        entries: dict[str, Any] = self._begin(done.view(-1).nonzero().squeeze(-1))
        for key, entry in tensordict.items():
            if key in entries:
                entries[key] = torch.where(done, entries[key], entry)
            else:  # entries that a reset clears: an action, the ends, or the memory of a policy
                entries[key] = _cleared(entry, done)
        return self._pack(entries)

    def _make_specs(
        self, observed: int, goals: int, *, seen: Callable[[tuple[int, int]], TensorSpec], action: TensorSpec
    ) -> None:
        """Sets the specs of observations, actions, rewards and ends.

        Args:
            observed: number of entries of an observation.
            goals: number of coordinates of a goal.
            seen: function that makes the spec of a state, an observation or a goal from its shape.
            action: the spec of actions.
        """
        (n,) = self.batch_size

        def flag() -> Binary:
            return Binary(n=1, shape=(n, 1), dtype=torch.bool)

        self.observation_spec = Composite(
            state=seen((n, observed + goals)),
            observation=seen((n, observed)),
            achieved_goal=seen((n, goals)),
            desired_goal=seen((n, goals)),
            shape=(n,),
        )
        self.action_spec = action
        self.reward_spec = Unbounded(shape=(n, 1), dtype=self.dtype_shown)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=(n,))


def _cleared(entry: Tensor | TensorDictBase, rows: Tensor) -> Any:
    """Returns an entry [N, ...] with zeros in the rows that a mask [N, 1] selects."""
    if isinstance(entry, Tensor):
        return entry.masked_fill(rows.view(-1, *[1] * (entry.ndim - 1)), 0)
    return entry.apply(lambda part: _cleared(part, rows))
