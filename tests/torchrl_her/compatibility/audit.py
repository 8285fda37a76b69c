"""The audit: whether each row of a buffer, or of a batch drawn from it, is what it should be."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from .tagged import REST, action_of, lengths_of, reward_fn, terminates, wanted

_BASE = torch.tensor([10_000_000, 10_000, 100, 1])  # environments, episodes and steps below 1000, 100, 100
ENDS = ("terminated", "truncated", "done")


def key_of(tag: Tensor) -> Tensor:
    """One number [...] for each tag [..., 4] of whole numbers."""
    return (tag.round().long() * _BASE).sum(-1)


class Log:
    """What was collected, independently of any buffer.

    Args:
        batches: as the collector gave them, of any shape.
    """

    def __init__(self, batches: Iterable[TensorDictBase]) -> None:
        rows = torch.cat([batch.reshape(-1).select(*_KEPT) for batch in batches])
        key = key_of(rows["observation"])
        self.keys, order = key.sort()
        self.rows = rows[order]
        assert (self.keys.diff() > 0).all(), "the collector gave the same transition twice"
        self._check_environment()

    def __len__(self) -> int:
        return len(self.keys)

    def find(self, key: Tensor) -> tuple[Tensor, Tensor]:
        """Positions [n] of keys [n] in the log, and whether they are in it."""
        place = torch.searchsorted(self.keys, key).clamp_max(len(self.keys) - 1)
        return place, self.keys[place] == key

    def _check_environment(self) -> None:
        """The harness itself: transitions are those that the tag stands for."""
        rows = self.rows
        run, env, episode, step = rows["observation"].long().unbind(-1)
        assert (rows["desired_goal"] == wanted(run, env, episode)).all()
        assert (rows["next", "observation"][:, 3] == step + 1).all()
        last = step + 1 == lengths_of(env, episode)
        ends = terminates(env, episode)
        assert (rows["next", "terminated"].squeeze(-1) == (last & ends)).all()
        # A collector may truncate more than the environment does, but not less.
        assert (rows["next", "truncated"].squeeze(-1) | ~(last & ~ends)).all()


_KEPT = (
    "observation",
    "achieved_goal",
    "desired_goal",
    "action",
    *[("next", key) for key in ("observation", "achieved_goal", "desired_goal", "reward", *ENDS)],
)


class Rows:
    """Rows [n], real and virtual, that were looked at one by one.

    Args:
        rows: of a storage, or of a sampled batch; any shape.
        log: what was collected.
        cut: [n] of bool, rows that a sampler of slices may have marked as truncated; None for no row.
        marked: whether episodes that were not collected any further must be truncated where they stop.

    Attributes:
        key: [n], of the transition.
        goal: [n], key of the virtual goal; -1 of real rows.
        virtual: [n] of bool.

    Raises:
        AssertionError: a row is wrong.
    """

    def __init__(
        self, rows: TensorDictBase, log: Log, cut: Tensor | None = None, *, marked: bool = False
    ) -> None:
        rows = rows.reshape(-1)
        self.rows, next_rows = rows, rows["next"]
        before, after, goal = rows["observation"], next_rows["observation"], rows["desired_goal"]
        self.key = key_of(before)
        place, known = log.find(self.key)
        _all(known, "a row was never collected")
        real = log.rows[place]
        # What hindsight leaves alone
        for key in ("achieved_goal", "action", ("next", "observation"), ("next", "achieved_goal")):
            _all(rows[key] == real[key], f"{key} is another row's")
        _all(rows["action"] == action_of(before), "an action is another row's")
        # Goals
        _all(goal == next_rows["desired_goal"], "root and next want different goals")
        self.virtual = (goal == goal.round()).all(-1)
        _all(rows["virtual"].view(-1) == self.virtual, "the mark of virtual rows is wrong")
        _all((goal == real["desired_goal"]).all(-1) | self.virtual, "a real row's goal is another one's")
        self.goal = key_of(goal).where(self.virtual, torch.tensor(-1))
        rests = (goal == 0).all(-1)  # a goal of no one's own, which the next state must have achieved then
        _all((goal[:, :3] == before[:, :3]).all(-1) | rests | ~self.virtual, "a goal crossed episodes")
        _all((goal[:, 3] >= after[:, 3]) | rests | ~self.virtual, "a goal was achieved in the past")
        _all((after[:, 3] < REST) | ~rests, "a goal was achieved in the past")
        last = goal - torch.tensor([0, 0, 0, 1.0])  # the state before the goal
        _all(log.find(key_of(last))[1] | rests | ~self.virtual, "a goal was never achieved")
        # What follows from goals
        reward, terminated = reward_fn(next_rows["achieved_goal"], goal)
        _all(next_rows["reward"] == reward, "a reward does not fit the goal")
        # An ensemble's sampler of slices writes ends without their last dimension.
        ends = {key: next_rows[key].view(-1, 1) for key in ENDS}
        _all(ends["terminated"] == terminated, "terminated does not fit the goal")
        truncated = real["next", "truncated"]
        if marked:
            stops = ~log.find(self.key + 1)[1].view_as(truncated) & ~terminated
            truncated = truncated | stops
        if cut is not None:  # a sampler may mark the ends of slices
            truncated = truncated | (cut.view_as(truncated) & ends["truncated"])
        _all(ends["truncated"] == truncated, "truncated is not the real row's")
        _all(ends["done"] == (terminated | truncated), "done is not terminated or truncated")

    def __len__(self) -> int:
        return len(self.key)


def check_written(stored: Rows, log: Log, *, held_back: int, k: int, per: str) -> None:
    """What a writer must have stored of a log, in a buffer that is not full.

    Raises:
        AssertionError: real rows were lost or doubled, or virtual ones are too few or too many.
    """
    real, times = stored.key[~stored.virtual].unique(return_counts=True)
    _all(times == 1, "a real row was stored twice")
    assert len(log) == len(real) + held_back, f"{len(log)} != {len(real)} + {held_back}: rows were lost"
    assert len(real) > 0, "nothing was written"
    if per == "transition":
        source, copies = stored.key[stored.virtual].unique(return_counts=True)
        assert torch.equal(source, real), "rows without virtual copies"
        _all(copies == k, "a row has more or fewer copies than k")
        return
    # An episode begins with a real row whose predecessor was not written, or was the last of another one.
    over = log.rows["next", "done"].view(-1)[log.find(real - 1)[0]]
    first = real[over | torch.cat((torch.tensor([True]), real.diff() != 1))]
    virtual = stored.key[stored.virtual]
    _all((virtual == first.unsqueeze(-1)).sum(-1) == k, "an episode has more or fewer copies than k")
    ids = stored.rows["collector", "traj_ids"].view(-1)
    assert not set(ids[stored.virtual].tolist()) & set(ids[~stored.virtual].tolist()), "ids used twice"
    own, copy = ids[stored.virtual].unique(return_inverse=True)
    assert len(own) == k * len(first), "a copy without an id of its own"
    for number in range(len(own)):
        which = copy == number
        key, goal = virtual[which], stored.goal[stored.virtual][which]
        assert (goal == goal[0]).all(), "a copy with several goals"
        assert (key.diff() == 1).all(), "a copy that is no sequence"
        over = stored.rows["next", "terminated"].view(-1)[stored.virtual][which]
        assert over.tolist() == [False] * (len(key) - 1) + [True], "a copy that does not end with its goal"
        assert (first == key[0]).any(), "a copy that does not begin with its episode"


def check_stored(stored: TensorDictBase, log: Log) -> None:
    """A plain buffer that is not full holds exactly what was collected.

    Raises:
        AssertionError: it does not.
    """
    key = key_of(stored.reshape(-1)["observation"]).sort().values
    assert torch.equal(key, log.keys), f"{len(key)} rows are stored of {len(log)}"


def check_slices(rows: Rows, length: int) -> None:
    """Each slice is a sequence of consecutive steps of one episode, with one goal.

    Raises:
        AssertionError: a slice is not.
    """
    key, goal = rows.key.view(-1, length), rows.goal.view(-1, length)
    _all(key.diff(dim=-1) == 1, "a slice is no sequence")
    # Virtual or real, all of a slice want the same.
    _all(goal == goal[:, :1], "a slice with several goals")


def _all(right: Tensor, message: str) -> None:
    wrong = (~right.reshape(len(right), -1).all(-1)).nonzero().view(-1)
    assert len(wrong) == 0, f"{message}: {len(wrong)} of {len(right)} rows"
