"""Writes the results of a search: a table of trials, the best trial as a preset, and Optuna's figures."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from optuna.importance import get_param_importances
from optuna.study import Study, create_study
from optuna.trial import FrozenTrial, Trial, TrialState
from optuna.visualization import matplotlib as figures

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.config.plain_files import dump_yaml
from torchrl_her_recipes.config.searches.search import Search
from torchrl_her_recipes.runs.plots import save_figure

_FEWEST = 5  # least number of complete trials from which importance is estimated
_SHOWN = 5  # largest number of trials in the printed summary
# Attribute of the trial with the unchanged recipe: the recipe's values, also those outside of the space.
DEFAULT = "default"


def folder_of(trial: FrozenTrial | Trial) -> str:
    """Returns the name of a trial's folder; a trial that repeats another one uses the other's folder."""
    return str(trial.user_attrs.get("folder", f"trial_{trial.number:04}"))


def write_results(search: Search, study: Study, trials: Sequence[FrozenTrial], folder: Path) -> None:
    """Writes the table ``trials.csv``, and the options of the best trial as the preset ``best.yaml``.

    Args:
        search: settings of the search.
        study: Optuna's study.
        trials: trials for the table.
        folder: folder of the search.
    """
    names = list(search.space.ranges)
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["trial", "state", "score", "epochs", *names, "folder"])
    for trial in trials:
        value = (
            trial.value
            if trial.value is not None
            else trial.intermediate_values.get(trial.last_step or 0, "")
        )
        values = [_values(trial).get(name, "") for name in names]
        writer.writerow(
            [trial.number, trial.state.name.lower(), value, trial.last_step or 0, *values, folder_of(trial)]
        )
    write_text(folder / "trials.csv", table.getvalue())
    if any(trial.state == TrialState.COMPLETE for trial in trials):
        best = study.best_trial
        recipe = search.space.recipe(search.recipe, best.params)
        about = f"# trial {best.number} of the search in {folder.name}: score {best.value:.3f}\n"
        write_text(folder / "best.yaml", about + dump_yaml(recipe.changed()))


def importances(study: Study) -> dict[str, float]:
    """Estimates each option's share of the variation of scores (PED-ANOVA); empty for too few trials."""
    done = _in_space(study)
    if len(done.trials) < _FEWEST or len({trial.value for trial in done.trials}) < 2:
        return {}
    return dict(get_param_importances(done))


def _in_space(study: Study) -> Study:
    """Returns a study of the complete trials that have all options; the first trial may lack some."""
    done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    most = max((len(trial.params) for trial in done), default=0)
    inside = create_study(direction="maximize")
    inside.add_trials([trial for trial in done if len(trial.params) == most])
    return inside


def write_pictures(study: Study, folder: Path) -> None:
    """Draws Optuna's figures: ``history.png``, ``options.png`` and ``importance.png``."""
    if not study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
        return
    with warnings.catch_warnings(), rc_context():  # undoes the style that Optuna sets for the whole process
        warnings.simplefilter("ignore")  # warnings that figures are experimental, and of limits of axes
        drawn = {
            "history": figures.plot_optimization_history(study, target_name="score"),
            "options": figures.plot_slice(study, target_name="score"),
        }
        if importances(study):
            drawn["importance"] = figures.plot_param_importances(_in_space(study), target_name="score")
    for name, axes in drawn.items():
        save_figure(np.atleast_1d(np.asarray(axes, dtype=object)).flat[0].figure, folder / f"{name}.png")


def search_summary(study: Study) -> list[str]:
    """Returns lines of text that list the best trials and the importance of each option."""
    done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    ranked = sorted(done, key=lambda trial: (-(trial.value or 0.0), trial.number))[:_SHOWN]
    lines = [
        f"trial {trial.number}: score {trial.value:.0%}  "
        + " ".join(f"{name}={_short(value)}" for name, value in _values(trial).items())
        for trial in ranked
    ]
    if weights := importances(study):
        guess = f" (a guess, from {len(done)} trials)" if len(done) < 20 else ""
        shares = ", ".join(f"{name} {share:.0%}" for name, share in weights.items())
        lines.append(f"importance{guess}: {shares}")
    return lines


def _values(trial: FrozenTrial) -> dict[str, Any]:
    return {**trial.user_attrs.get(DEFAULT, {}), **trial.params}


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
