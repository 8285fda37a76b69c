"""How a search stands: its trials, and how much each option matters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from optuna.importance import get_param_importances
from optuna.study import Study
from optuna.trial import TrialState

_FEWEST = 5  # trials that tell which options matter
_COLUMNS = 5  # trials in the table for people


@dataclass(frozen=True, kw_only=True)
class TrialRow:
    """One trial.

    Attributes:
        number: of the trial.
        state: ``complete``, ``pruned``, ``failed`` or ``running``.
        score: at its end, or when it was pruned; None if there is none.
        epochs: after which it ended.
        values: of the options that are varied.
    """

    number: int
    state: str
    score: float | None
    epochs: int
    values: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How a search stands.

    Attributes:
        trials: all that were begun, by their numbers.
        importance: of each option, as a share of 1, the largest first; empty if it is too early to tell.
    """

    trials: list[TrialRow]
    importance: dict[str, float] = field(default_factory=dict)

    @property
    def ranked(self) -> list[TrialRow]:
        """The complete trials, the best first; of two as good ones, the earlier."""
        done = [trial for trial in self.trials if trial.state == "complete"]
        return sorted(done, key=lambda trial: (-(trial.score or 0.0), trial.number))

    @property
    def best(self) -> TrialRow | None:
        """The best trial."""
        return next(iter(self.ranked), None)

    def table(self) -> list[str]:
        """The best trials for people, a column each, and how much each option matters.

        Example:
            >>> one = TrialRow(number=3, state="complete", score=0.5, epochs=2, values={"gamma": 0.95})
            >>> print("\\n".join(Standing(trials=[one], importance={"gamma": 1.0}).table()))
            trial     3  importance
            score   50%
            gamma  0.95        100%
        """
        best = self.ranked[:_COLUMNS]
        if not best:
            return []
        names = list(self.importance) or list(best[0].values)
        rows = [
            ["trial", *(str(trial.number) for trial in best), "importance" * bool(self.importance)],
            ["score", *(f"{trial.score:.0%}" for trial in best), ""],
        ]
        for name in names:
            share = f"{self.importance[name]:.0%}" if name in self.importance else ""
            rows.append([name, *(_short(trial.values.get(name)) for trial in best), share])
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return [
            "  ".join(
                [
                    row[0].ljust(widths[0]),
                    *(cell.rjust(n) for cell, n in zip(row[1:], widths[1:], strict=True)),
                ]
            ).rstrip()
            for row in rows
        ]


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def standing_of(study: Study, names: Sequence[str]) -> Standing:
    """How the search in a database stands.

    Args:
        study: in the database.
        names: of the options that are varied.
    """
    states = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}
    trials = [
        TrialRow(
            number=trial.number,
            state=states.get(trial.state, "running"),
            score=trial.value if trial.value is not None else _last(trial.intermediate_values),
            epochs=trial.last_step or 0,
            values={name: trial.params[name] for name in names if name in trial.params},
        )
        for trial in study.get_trials(deepcopy=False)
        if trial.state != TrialState.WAITING
    ]
    scores = [trial.score for trial in trials if trial.state == "complete"]
    importance: dict[str, float] = {}
    if len(scores) >= _FEWEST and len(set(scores)) > 1:
        importance = dict(get_param_importances(study))
    return Standing(trials=trials, importance=importance)


def _last(values: Mapping[int, float]) -> float | None:
    return values[max(values)] if values else None
