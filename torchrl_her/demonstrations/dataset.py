"""Demonstrations: whole episodes played by another policy, with methods to save and load them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_her.checks import check_finite
from torchrl_her.trainers.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from torchrl_her.trainers.cut import cut_episodes

_SEEN = ("observation", "achieved_goal", "desired_goal")
_ENDS = ("terminated", "truncated", "done")
_ENTRIES: list[NestedKey] = [
    *_SEEN,
    "action",
    *(("next", name) for name in (*_SEEN, "reward", *_ENDS)),
]
_PLAYED: list[NestedKey] = ["state", "stage", ("next", "state"), ("next", "stage")]
_KIND = "demonstrations 1"


@dataclass(frozen=True)
class Demonstrations:
    """Whole recorded episodes, one after the other, with their task and their origin.

    Args:
        rows: [n], all transitions: ``observation``, ``achieved_goal``, ``desired_goal``, ``action``, and
            under ``next`` the first three with ``reward``, ``terminated``, ``truncated`` and ``done``. The
            last transition of each episode is done, and no other one. Other entries are left out, except
            for ``state`` and ``stage`` of a curriculum.
        lengths: [E] int64, transitions of each episode.

    Keyword Args:
        states: the physical state before each transition, as named tensors of n rows; None if the
            environment cannot be set to a state.
        task: name of the task.
        made_by: description of the policy or controller that played the episodes, as plain data.
        achieved_reward: the reward of an achieved goal.

    Raises:
        ValueError: an entry is missing, there is no episode, or lengths, ends or states do not match rows.

    Example:
        >>> from torchrl_her_envs import make_controller, make_env
        >>> env = make_env("hand_v0", num_envs=3, seed=0)
        >>> episodes = env.rollout(50, make_controller(env), break_when_any_done=False)
        >>> demos = Demonstrations.from_rollout(episodes, task="hand_v0", first=True)
        >>> len(demos), demos.achieved.tolist(), len(demos.rows) == int(demos.lengths.sum())
        (3, [True, True, True], True)
    """

    rows: TensorDictBase
    lengths: Tensor
    states: dict[str, Tensor] | None = field(default=None, kw_only=True)
    task: str = field(default="", kw_only=True)
    made_by: dict[str, Any] = field(default_factory=dict, kw_only=True)
    achieved_reward: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        known = set(self.rows.keys(True, True))
        if missing := [key for key in _ENTRIES if key not in known]:
            raise ValueError(f"demonstrations need the entry {missing[0]!r}, got {sorted(known, key=str)}")
        object.__setattr__(self, "rows", self.rows.select(*_ENTRIES, *_PLAYED, strict=False))
        if self.lengths.ndim != 1 or len(self.lengths) == 0 or int(self.lengths.min()) < 1:
            raise ValueError(f"demonstrations need lengths [E] of at least 1, got {self.lengths.tolist()}")
        n = int(self.lengths.sum())
        if self.rows.batch_size != (n,):
            raise ValueError(f"rows must be [{n}], the sum of all lengths, got {list(self.rows.batch_size)}")
        check_finite({f"{key!r} of demonstrations": entry for key, entry in self.rows.items(True, True)})
        ends = self.lengths.cumsum(0) - 1
        if self.rows["next", "done"].flatten().nonzero().flatten().tolist() != ends.tolist():
            raise ValueError("the last transition of each demonstration must be done, and no other one")
        for name, entry in (self.states or {}).items():
            if entry.shape[:1] != (n,):
                raise ValueError(f"states must have {n} rows, got {list(entry.shape)} of {name!r}")

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def begins(self) -> Tensor:
        """Row of each episode's first transition, [E] of int64."""
        return self.lengths.cumsum(0) - self.lengths

    @property
    def episode(self) -> Tensor:
        """Number of the episode that each transition belongs to, [n] of int64."""
        return torch.arange(len(self)).repeat_interleave(self.lengths)

    @property
    def achieved(self) -> Tensor:
        """Whether each episode achieved its goal at some step, [E] of bool."""
        steps = self.rows["next", "reward"].flatten() >= self.achieved_reward
        return torch.zeros(len(self)).index_add(0, self.episode, steps.float()) > 0

    @property
    def digest(self) -> str:
        """Short checksum of all transitions and states, which distinguishes files."""
        sha, entries = hashlib.sha256(), dict(self.rows.items(True, True))
        for name, entry in {**entries, **(self.states or {}), "lengths": self.lengths}.items():
            sha.update(str(name).encode())
            sha.update(entry.contiguous().flatten().view(torch.uint8).numpy().tobytes())
        return sha.hexdigest()[:16]

    def select(self, episodes: Tensor | Sequence[int]) -> Demonstrations:
        """Returns the episodes with the given numbers, in the given order.

        Args:
            episodes: [m] int64, numbers of the episodes; or a mask [E] of bool, such as :attr:`achieved`.
        """
        chosen = torch.as_tensor(episodes)
        index = torch.arange(len(self))[chosen if chosen.dtype == torch.bool else chosen.long()]
        lengths, begins = self.lengths[index], self.begins[index]
        offset = torch.arange(int(lengths.sum())) - (lengths.cumsum(0) - lengths).repeat_interleave(lengths)
        return self.take(begins.repeat_interleave(lengths) + offset, lengths)

    def take(self, index: Tensor, lengths: Tensor, *, rows: TensorDictBase | None = None) -> Demonstrations:
        """Returns the transitions at the given rows, which form episodes of the given lengths.

        Args:
            index: [m] int64, row of each transition.
            lengths: [e] int64, lengths of the new episodes, which sum to m.

        Keyword Args:
            rows: [n], transitions to take from; None for the demonstrations' own.
        """
        states = None if self.states is None else {name: entry[index] for name, entry in self.states.items()}
        rows_taken = (self.rows if rows is None else rows)[index]
        return replace(self, rows=rows_taken, lengths=lengths, states=states)

    def first(self, count: int) -> Demonstrations:
        """Returns the first episodes.

        Raises:
            ValueError: there are fewer episodes, or ``count`` is below 1.
        """
        if not 1 <= count <= len(self):
            raise ValueError(f"there are {len(self)} demonstrations of {self.task}, {count} were asked for")
        return self.select(range(count))

    def to(self, dtype: torch.dtype) -> Demonstrations:
        """Returns the demonstrations with floating-point entries of this type; states stay as they are."""
        return replace(self, rows=self.rows.apply(lambda x: x.to(dtype) if x.is_floating_point() else x))

    @classmethod
    def from_rollout(
        cls,
        rollout: TensorDictBase,
        *,
        first: bool = False,
        states: Mapping[str, Tensor] | None = None,
        **facts: Any,
    ) -> Demonstrations:
        """Makes demonstrations from a rollout, environment by environment; unfinished episodes are truncated.

        Args:
            rollout: [N, T], time last; or [T].

        Keyword Args:
            first: whether only the first episode of each environment counts.
            states: states of the environments before each step, [N, T, ...] each; or [T, ...].
            **facts: ``task``, ``made_by`` and ``achieved_reward``, as for the class.

        Raises:
            ValueError: an entry is missing.
        """
        rows = cut_episodes(rollout.select(*_ENTRIES, strict=False)).reshape(-1).clone()
        if ("next", "done") not in rows.keys(True, True):
            raise ValueError(
                f"demonstrations need the entry ('next', 'done'), got {list(rollout.keys(True))}"
            )
        ends = rows["next", "done"].flatten().nonzero().flatten()
        lengths = torch.diff(ends, prepend=ends.new_tensor([-1]))
        dim = rollout.ndim - 1  # of time
        flat = None if states is None else {name: entry.flatten(0, dim) for name, entry in states.items()}
        demonstrations = cls(rows, lengths, states=flat, **facts)
        if not first:
            return demonstrations
        env = demonstrations.begins // rollout.shape[-1]
        return demonstrations.select((torch.diff(env, prepend=env.new_tensor([-1])) > 0).nonzero().flatten())

    @classmethod
    def join(cls, parts: Sequence[Demonstrations]) -> Demonstrations:
        """Joins the episodes of several demonstrations, in order; task and origin are the first one's."""
        states = None
        if parts[0].states is not None:
            states = {
                name: torch.cat([(part.states or {})[name] for part in parts]) for name in parts[0].states
            }
        rows: TensorDictBase = torch.cat([part.rows for part in parts])
        return replace(
            parts[0], rows=rows, lengths=torch.cat([part.lengths for part in parts]), states=states
        )

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Writes a file of tensors and plain data, with a checksum.

        Args:
            path: the file.

        Keyword Args:
            force: whether an existing file is replaced.

        Raises:
            ValueError: the file exists, and ``force`` is False.
            OSError: the file cannot be written.
        """
        check_free(path, force=force)
        state = {
            "kind": _KIND,
            "rows": self.rows.to_dict(),
            "lengths": self.lengths,
            "states": self.states,
            "task": self.task,
            "made_by": self.made_by,
            "achieved_reward": self.achieved_reward,
        }
        save_checkpoint(state, path)

    @classmethod
    def load(cls, path: str | Path) -> Demonstrations:
        """Reads a file that :meth:`save` wrote. Nothing in it is executed.

        Raises:
            ValueError: the file is damaged, or holds no demonstrations.
            OSError: the file cannot be read.

        Example:
            >>> import tempfile
            >>> from torchrl_her import save_checkpoint
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     save_checkpoint({"kind": "something else"}, f"{folder}/demos.pt")
            ...     Demonstrations.load(f"{folder}/demos.pt")
            Traceback (most recent call last):
            ValueError: ...demos.pt holds no demonstrations: `torchrl-her record` writes some
        """
        try:
            state = load_checkpoint(path)
        except CheckpointError as error:
            raise ValueError(f"demonstrations cannot be read: {error}") from error
        if not isinstance(state, dict) or state.get("kind") != _KIND:
            raise ValueError(f"{path} holds no demonstrations: `torchrl-her record` writes some")
        try:
            lengths = state["lengths"]
            rows = TensorDict.from_dict(state["rows"], batch_size=[int(lengths.sum())])
            facts = {name: state[name] for name in ("states", "task", "made_by", "achieved_reward")}
            return cls(rows, lengths, **facts)
        except (LookupError, RuntimeError, AttributeError, TypeError, ValueError, ArithmeticError) as error:
            reason = " ".join(ascii(str(error))[1:300].split())
            raise ValueError(f"the demonstrations in {path} do not fit together: {reason}") from error


def check_free(path: str | Path, *, force: bool = False) -> None:
    """Raises a ValueError if a file exists already, unless ``force`` is True."""
    if Path(path).exists() and not force:
        raise ValueError(f"{path} exists already: choose another name, or --force (force=True) to replace it")
