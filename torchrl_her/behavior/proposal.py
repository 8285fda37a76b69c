"""How one of several achieved goals is chosen for an episode: by weights and factors of goals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

from torch import Tensor

from torchrl_her.behavior.factors import GoalCandidates, GoalFactor
from torchrl_her.checks import check_whole
from torchrl_her.goals.factors import draw
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.goals.weights import GoalWeights, WeightsOfRuns, checked_weights, weights_by_run
from torchrl_her.randomness import Generators, RunDraws

UpdateOn = Literal["achieved", "proposed"]


class GoalProposal:
    """Chooses a goal among candidates, in proportion to ``weight(g) * factor(g) * factor(g) * ...``

    ``weight`` is how useful a goal is, as for virtual goals. The factors measure how well the goal can be
    achieved from the episode's start, and how well it leads to the task's goal.

    | method | weights | update_on | factors | greedy |
    | --- | --- | --- | --- | --- |
    | uniform | none | | none | False |
    | IBS | :class:`~torchrl_her.Instructiveness` | proposed | none | False |
    | MEGA | none | | ``InverseDensity``, ``ValueCutoff`` | True |
    | DISCOVER | none | | ``DiscoverScore``; with a single critic ``InverseDensity``, too | True |

    Keyword Args:
        weights: weights of goals; for several runs a list, one for each run. None for equal weights.
        update_on: goals that the weights are updated on: ``achieved`` or ``proposed`` ones.
        factors: the factors by which the weights are multiplied.
        greedy: whether to choose the goal with the greatest product; if not, a goal is drawn in proportion.
        candidates: number of achieved goals drawn for each episode, of which one is proposed.

    Raises:
        ValueError: ``update_on`` is unknown, or ``candidates`` is below 1.

    Example:
        >>> from torchrl_her.behavior import InverseDensity
        >>> len(GoalProposal(factors=[InverseDensity()], greedy=True).factors)
        1
    """

    def __init__(
        self,
        *,
        weights: GoalWeights | Sequence[GoalWeights] | None = None,
        update_on: UpdateOn = "achieved",
        factors: Sequence[GoalFactor] = (),
        greedy: bool = False,
        candidates: int = 100,
    ) -> None:
        check_whole(candidates=candidates)
        if update_on not in get_args(UpdateOn):
            raise ValueError(f"update_on must be one of {', '.join(get_args(UpdateOn))}, got {update_on!r}")
        self.weights, self.update_on = weights_by_run(weights), update_on
        self.factors, self.greedy, self.candidates = list(factors), greedy, candidates

    @property
    def samples(self) -> int:
        """Number of achieved goals of a run that the factors compare candidates with."""
        return max((factor.samples for factor in self.factors), default=0)

    def choose(self, candidates: GoalCandidates, generators: Generators) -> tuple[Tensor, Tensor]:
        """Returns the chosen goals [m, g] of m episodes, and whether each may be proposed, [m] of bool."""
        likelihood = candidates.goals.new_ones(candidates.goals.shape[:-1])
        if self.weights and not self.weights[0].is_uniform:
            weights = self._of_runs()(candidates.goals, range(len(generators)), candidates.counts)
            likelihood = checked_weights(weights, candidates.goals)
        for factor in self.factors:
            likelihood = likelihood * factor(candidates)
        if self.greedy:
            place, valid = likelihood.argmax(1, keepdim=True), likelihood.amax(1) > 0
        else:
            place, valid = draw(likelihood, 1, generator=RunDraws(generators, candidates.run))
        return candidates.goals.take_along_dim(place.unsqueeze(-1), 1).squeeze(1), valid

    def is_updated_on(self, on: UpdateOn) -> bool:
        """Returns whether there are weights that are updated on such goals."""
        return bool(self.weights) and self.update_on == on

    def update(self, goals: Tensor, counts: Sequence[int]) -> None:
        """Updates the weights on goals [m, g], sorted by run."""
        self._of_runs().update(goals, range(len(counts)), counts)

    def restart(self, run: int) -> None:
        """Begins anew with the weights of a run."""
        if self.weights:
            self.weights[run].clear()
            if isinstance(weights := self.weights[run], InstructiveWeights):
                weights.restart()

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of weights and factors as tensors and plain data."""
        return {name: [part.state_dict() for part in parts] for name, parts in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned.

        Raises:
            ValueError: the state is of other weights and factors.
        """
        for name, parts in self._parts().items():
            if len(parts) != len(state[name]):
                raise ValueError(f"the state must have {len(parts)} {name}, got {len(state[name])}")
            for part, was in zip(parts, state[name], strict=True):
                part.load_state_dict(was)

    def _parts(self) -> dict[str, Sequence[GoalWeights | GoalFactor]]:
        return {"weights": self.weights, "factors": self.factors}

    def _of_runs(self) -> WeightsOfRuns:
        return type(self.weights[0]).of_runs(self.weights)
