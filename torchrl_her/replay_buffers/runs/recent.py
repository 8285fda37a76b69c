"""Goals of recent episodes, which transitions of other episodes may take, too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.checks import entry_of
from torchrl_her.goals.strategies import RECENT
from torchrl_her.goals.weights import spread_evenly
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.keys import TransitionKeys, stored_as

Goals = tuple[Tensor | None, ...]


@dataclass(frozen=True)
class RecentGoals:
    """Memory of the goals that were desired and achieved in recent episodes of each of R runs.

    Attributes:
        goals: goals of each run, [m, g] with the newest last, under ``"actual"`` and ``"achieved"``; None for
            a run without goals.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_her import HindsightOptions
        >>> wanted, got = torch.tensor([[9.0], [9.0], [8.0]]), torch.tensor([[1.0], [2.0], [3.0]])
        >>> rows = TensorDict({"desired_goal": wanted, "next": {"achieved_goal": got}}, [3])
        >>> episodes = Episodes(torch.tensor([[0, 1], [2, 2]]), torch.tensor([2, 1]))
        >>> keys = HindsightOptions().transition_keys()
        >>> recent = RecentGoals.none(1).after(rows, episodes, None, keys, sizes={"actual": 9, "achieved": 2})
        >>> [recent.goals[name][0].flatten().tolist() for name in ("actual", "achieved")]
        [[9.0, 8.0], [1.0, 3.0]]
    """

    goals: Mapping[str, Goals]

    @classmethod
    def none(cls, runs: int) -> RecentGoals:
        """Returns an empty memory of R runs."""
        return cls(dict.fromkeys(RECENT, (None,) * runs))

    def after(
        self,
        rows: TensorDictBase,
        episodes: Episodes,
        run: Tensor | None,
        keys: TransitionKeys,
        *,
        sizes: Mapping[str, int],
    ) -> RecentGoals:
        """Returns the memory with the goals of some episodes added.

        Args:
            rows: [n], transitions.
            episodes: positions of the episodes in ``rows``, run after run.
            run: [E] int64, the run of each episode; None if there is only one.
            keys: keys of the goals.

        Keyword Args:
            sizes: number of goals that a run keeps, for each kind that is remembered. If the episodes have
                more, those that are kept are spread over all of them.
        """
        if len(episodes.lengths) == 0 or not sizes:
            return self
        out, lengths, achieved = dict(self.goals), episodes.lengths, entry_of(rows, keys.next_achieved)
        for name, size in sizes.items():
            if name == "actual":  # the desired goal of each episode
                number, goals, row = torch.ones_like(lengths), keys.asked_for(rows), episodes.rows[:, 0]
            else:
                number, goals, row = lengths, achieved, episodes.rows[episodes.inside]
            # Goals are kept in the dtype of achieved goals, which all virtual goals have.
            new = stored_as(goals.index_select(0, row), achieved, keys.next_achieved)
            counts = [len(new)]
            if run is not None:
                counts = number.new_zeros(len(out[name])).index_add_(0, run, number).tolist()
            parts = zip(out[name], new.split(counts), strict=True)
            out[name] = tuple(_last(before, part, size) for before, part in parts)
        return RecentGoals(out)

    def without_run(self, run: int) -> RecentGoals:
        """Returns the memory without one run's goals."""
        return RecentGoals(
            {name: (*goals[:run], None, *goals[run + 1 :]) for name, goals in self.goals.items()}
        )

    def lines(self, name: str, runs: Sequence[int]) -> tuple[Tensor, Episodes]:
        """Joins the goals of one kind that some runs remember; each of these runs must have goals.

        Returns:
            ``(goals, lines)``: goals [p, g], and the positions of each run's goals, one line for each run.
        """
        parts = [goals for run in runs if (goals := self.goals[name][run]) is not None]
        goals = parts[0] if len(parts) == 1 else torch.cat([part.to(parts[-1]) for part in parts])
        lengths = torch.tensor([len(part) for part in parts], device=goals.device)
        return goals, Episodes.consecutive(lengths.cumsum(0) - lengths, lengths)

    def state_dict(self) -> dict[str, Any]:
        """Returns the goals of all runs, for each kind."""
        return {name: list(goals) for name, goals in self.goals.items()}

    @classmethod
    def from_state(cls, state: Mapping[str, Sequence[Tensor | None]]) -> RecentGoals:
        """Restores the memory from a :meth:`state_dict`."""
        return cls({name: tuple(state[name]) for name in RECENT})


def _last(before: Tensor | None, new: Tensor, size: int) -> Tensor | None:
    """Returns the newest ``size`` goals [m, g]; if even the new ones are more, an evenly spread part."""
    if len(new) == 0:
        return before
    if len(new) > size:
        # New goals are ordered by environment, so the last ones would come from few environments.
        return new[spread_evenly(len(new), size, new.device)]
    if before is None:
        return new.clone()  # a view would keep the whole batch in memory
    return torch.cat((before[max(0, len(before) + len(new) - size) :].to(new), new))
