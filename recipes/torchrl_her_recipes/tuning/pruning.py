"""Ends trials early that fall behind, by the success of their evaluations."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from optuna.exceptions import OptunaError
from optuna.pruners import BasePruner, MedianPruner, NopPruner
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial
from sqlalchemy.exc import SQLAlchemyError

from torchrl_her_recipes.runs.callbacks import Callback, RunView
from torchrl_her_recipes.runs.score import score
from torchrl_her_recipes.tuning.database import load_study

PRUNED = "pruned"  # attribute of a trial: after which epoch


class HalvingPruner(BasePruner):
    """Asynchronous successive halving (Li et al., 2020) that decides from what was reported alone.

    At each rung a trial goes on if it is among the best of those that have come so far. Optuna's own pruner
    remembers in the database which rungs a trial has passed, so a trial that was killed and repeats some
    epochs would count itself twice.

    Args:
        epochs: of a trial.

    Keyword Args:
        factor: one of so many goes on, and rungs lie so many times farther apart each.

    Example:
        >>> HalvingPruner(30).rungs, HalvingPruner(2).rungs
        ([10, 3, 1], [])
    """

    def __init__(self, epochs: int, *, factor: int = 3) -> None:
        self.factor = factor
        self.rungs = []
        while epochs // factor > 0:
            epochs //= factor
            self.rungs.append(epochs)

    def prune(self, study: Study, trial: FrozenTrial) -> bool:
        """Whether a trial ends after the last of its evaluations."""
        epoch = trial.last_step
        if epoch is None or epoch not in self.rungs:
            return False
        others = [each for each in study.get_trials(deepcopy=False) if each.number != trial.number]
        values = [each.intermediate_values[epoch] for each in others if epoch in each.intermediate_values]
        own = trial.intermediate_values[epoch]
        best = sorted([*values, own], reverse=True)[: max((len(values) + 1) // self.factor, 1)]
        return own < best[-1]


def make_pruner(name: str, epochs: int) -> BasePruner:
    """A pruner by its name.

    Args:
        name: of the pruner.
        epochs: of a trial.
    """
    if name == "median":  # no earlier than two fifths of the way: success comes late
        return MedianPruner(n_startup_trials=5, n_warmup_steps=2 * epochs // 5)
    return HalvingPruner(epochs) if name == "halving" else NopPruner()


class Reporter(Callback):
    """Tells a search how a trial does, and stops it when the search has no more use for it.

    It decides from the table of the run, so a trial that was killed and goes on from an older checkpoint
    does what it did before.

    Args:
        study: of the search.
        number: of the trial.
    """

    def __init__(self, study: Study, number: int) -> None:
        self.study, self.number = study, number

    def on_epoch(self, run: RunView) -> bool:
        """Reports the score so far; whether the trial falls behind."""
        try:
            return self.report(run.rows, ended=run.trainer.epochs >= run.components.recipe.run.epochs)
        except (OptunaError, SQLAlchemyError) as error:  # a full disk: the run itself goes on, too
            why = " ".join(str(error.__cause__ or error).split())
            warnings.warn(f"trial {self.number} goes on without being reported: {why}", stacklevel=2)
            return False

    def report(self, rows: Sequence[dict[str, float]], *, ended: bool = False) -> bool:
        """Notes down the score after the last evaluation; whether the trial falls behind the others.

        Args:
            rows: the table so far.
            ended: whether the trial has come to its end: then it cannot fall behind.
        """
        epochs = sorted({int(row["epoch"]) for row in rows})
        scores = {epoch: score([row for row in rows if row["epoch"] <= epoch]) for epoch in epochs}
        frozen = self.study.get_trials(deepcopy=False)[self.number]
        trial = Trial(self.study, frozen._trial_id)
        if epochs[-1] not in frozen.intermediate_values:  # it is, if the trial was killed after it
            trial.report(scores[epochs[-1]], epochs[-1])
        now = copy.copy(frozen)
        now.intermediate_values = scores  # without those of epochs that are to come again
        behind = not ended and self.study.pruner.prune(self.study, now)
        if behind:
            trial.set_user_attr(PRUNED, epochs[-1])
        return behind


@contextmanager
def reporting(*, database: str, pruner: str, epochs: int, number: int) -> Iterator[list[Callback]]:
    """What surrounds the run of a trial where it is done; gives the run's callbacks.

    Args:
        database: of the search.
        pruner: by its name.
        epochs: of a trial.
        number: of the trial.
    """
    with load_study(Path(database), pruner=make_pruner(pruner, epochs)) as study:
        yield [Reporter(study, number)]
