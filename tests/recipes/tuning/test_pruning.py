"""Which trials are ended early, and that a trial that repeats some epochs ends where it did."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from torchrl_her_recipes.tuning.pruning import PRUNED, HalvingPruner, Reporter, make_pruner

optuna = pytest.importorskip("optuna", reason="needs the extra tune")


def rows(*successes: float) -> list[dict[str, float]]:
    """A table of one run, with the success of each epoch."""
    return [{"run": 0, "epoch": number + 1, "success": own} for number, own in enumerate(successes)]


def study_of(pruner: str, epochs: int, *trials: Sequence[float]) -> optuna.Study:
    """A search with complete trials, by the success of each of their epochs, and one that begins."""
    study = optuna.create_study(direction="maximize", pruner=make_pruner(pruner, epochs))
    for successes in trials:
        number = study.ask().number
        for epoch in range(len(successes)):
            Reporter(study, number).report(rows(*successes[: epoch + 1]), ended=True)
        study.tell(number, successes[-1])
    study.ask()
    return study


def ends_after(study: optuna.Study, *successes: float) -> int | None:
    """The epoch after which the trial that begins is ended."""
    reporter = Reporter(study, len(study.trials) - 1)
    for epoch in range(1, len(successes) + 1):
        if reporter.report(rows(*successes[:epoch]), ended=epoch == len(successes)):
            return epoch
    return None


def test_median_ends_what_is_below_it_when_there_are_enough_trials() -> None:
    # Means of the last evaluations so far; from the fourth epoch of ten on (two fifths of the way).
    trials = [[success] * 10 for success in (0.1, 0.2, 0.3, 0.4, 0.5)]
    assert ends_after(study_of("median", 10, *trials), *[0.25] * 10) == 4
    assert ends_after(study_of("median", 10, *trials), *[0.35] * 10) is None
    assert ends_after(study_of("median", 10, *trials), *[0.3] * 10) is None  # as good as the median
    assert ends_after(study_of("median", 10, *trials[:4]), *[0.0] * 10) is None  # too few


def test_halving_lets_the_best_third_go_on() -> None:
    assert HalvingPruner(27).rungs == [9, 3, 1]
    trials = [[success] * 27 for success in (0.1, 0.2, 0.3, 0.4, 0.5)]
    study = study_of("halving", 27, *trials)
    assert ends_after(study, *[0.35] * 27) == 1  # two of six go on: 0.5 and 0.4
    assert ends_after(study_of("halving", 27, *trials), *[0.4] * 27) is None
    assert ends_after(study_of("halving", 27, *trials), 0.6, *[0.0] * 26) == 3  # 0.2, the mean of three
    assert ends_after(study_of("halving", 27), *[0.0] * 27) is None  # the first one


def test_none_ends_nothing() -> None:
    trials = [[1.0] * 10] * 6
    assert ends_after(study_of("none", 10, *trials), *[0.0] * 10) is None


@pytest.mark.parametrize("pruner", ["median", "halving"])
def test_a_trial_that_was_killed_ends_where_it_did(pruner: str) -> None:
    # It is good at first. That it was bad afterwards must not matter when the first epochs come again.
    trials = [[success] * 27 for success in (0.1, 0.2, 0.3, 0.4, 0.5)]
    own = [0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.0, 0.0, 0.0] + [0.0] * 18
    whole = ends_after(study_of(pruner, 27, *trials), *own)
    study = study_of(pruner, 27, *trials)
    for epoch in range(1, 9):
        Reporter(study, 5).report(rows(*own[:epoch]))
    assert ends_after(study, *own) == whole
    assert study.trials[5].user_attrs.get(PRUNED) == whole
    expected = {"median": None, "halving": 9}
    assert whole == expected[pruner]
