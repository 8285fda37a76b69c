"""Distance from the end of a demonstration at which episodes start: a walk back from the goal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl_her.checks import check_whole


class WalkBack:
    """Moves starts of episodes back from the ends of demonstrations, independently for each of R runs.

    Salimans and Chen, Learning Montezuma's Revenge from a single demonstration, 2018 (arXiv 1812.03381);
    Florensa et al., Reverse curriculum generation for reinforcement learning, 2017 (arXiv 1707.05300).

    Args:
        longest: length of the longest demonstration of each run, in steps.

    Keyword Args:
        width: number of steps among which starts are drawn: from ``back - width + 1`` to ``back`` steps
            before the end.
        stride: number of steps by which starts move back at once.
        threshold: success rate at which starts move back.
        samples: number of latest episodes for the success rate; all must have ended since the last move.

    Attributes:
        back: for each run, the greatest number of steps before the end at which episodes start.

    Raises:
        ValueError: a number is below 1, or the threshold is not in (0, 1].

    Example:
        >>> walk = WalkBack([10], width=2, stride=3, threshold=0.5, samples=2)
        >>> walk.window(0)
        (1, 2)
        >>> walk.record(0, [True, False])
        >>> walk.window(0)
        (4, 5)
    """

    def __init__(
        self,
        longest: Sequence[int],
        *,
        width: int = 4,
        stride: int = 2,
        threshold: float = 0.5,
        samples: int = 50,
    ) -> None:
        check_whole(width=width, stride=stride, samples=samples)
        if not 0.0 < threshold <= 1.0:
            raise ValueError(f"threshold must be in (0, 1], got {threshold}")
        self.width, self.stride, self.threshold, self.samples = width, stride, threshold, samples
        self._longest = list(longest)
        self.back = [min(width, length) for length in longest]
        self._outcomes: list[list[bool]] = [[] for _ in longest]

    def window(self, run: int) -> tuple[int, int]:
        """Returns the range of steps before the end at which a run's episodes start, as (least, greatest)."""
        return max(1, self.back[run] - self.width + 1), self.back[run]

    def record(self, run: int, outcomes: Sequence[bool]) -> None:
        """Records whether episodes of a run that started at demonstrations achieved their goal."""
        for outcome in outcomes:  # one by one, since starts may move back after each outcome
            latest = [*self._outcomes[run], outcome][-self.samples :]
            if len(latest) == self.samples and sum(latest) >= self.threshold * self.samples:
                self.back[run], latest = min(self._longest[run], self.back[run] + self.stride), []
            self._outcomes[run] = latest

    def restart(self, run: int, longest: int) -> None:
        """Moves a run's starts near the end of the demonstrations again, as for a new set of them."""
        self._longest[run], self.back[run], self._outcomes[run] = longest, min(self.width, longest), []

    def state_dict(self) -> dict[str, Any]:
        """Returns distances, outcomes and lengths of all runs, as plain data."""
        outcomes = [list(run_outcomes) for run_outcomes in self._outcomes]
        return {"back": list(self.back), "outcomes": outcomes, "longest": list(self._longest)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned.

        Raises:
            ValueError: the state has another number of runs.
        """
        if len(state["back"]) != len(self.back):
            raise ValueError(f"the state must have {len(self.back)} runs, got {len(state['back'])}")
        self.back, self._longest = list(state["back"]), list(state["longest"])
        self._outcomes = [list(run_outcomes) for run_outcomes in state["outcomes"]]
