"""Results of a search: a table of its trials, the best one as a preset, and Optuna's figures."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib import rc_context
from optuna.importance import get_param_importances
from optuna.study import Study, create_study
from optuna.trial import FrozenTrial, Trial, TrialState
from optuna.visualization import matplotlib as figures

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.config.searches.search import Search
from torchrl_her_recipes.runs.plots import save_figure

_FEWEST = 5  # least number of complete trials for estimates of importance
_SHOWN = 5  # number of trials in the printed table
# Attribute of the trial of the unchanged recipe: its values, some of which may be outside of the space.
DEFAULT = "default"


def folder_of(trial: FrozenTrial | Trial) -> str:
    """Returns the name of a trial's folder, or of the trial that it repeats."""
    return str(trial.user_attrs.get("folder", f"trial_{trial.number:04}"))


def write_results(search: Search, study: Study, trials: Sequence[FrozenTrial], folder: Path) -> None:
    """Writes ``trials.csv``, and the best trial as the preset ``best.yaml``.

    Args:
        search: search that the trials belong to.
        study: Optuna's study.
        trials: all trials except interrupted ones.
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
        write_text(folder / "best.yaml", about + yaml.safe_dump(recipe.changed(), sort_keys=False))


def importances(study: Study) -> dict[str, float]:
    """Computes each option's importance for the score (PED-ANOVA), as fractions; empty for too few trials."""
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
    with warnings.catch_warnings(), rc_context():  # Optuna chooses a style for the whole process
        warnings.simplefilter("ignore")  # suppresses: figures are experimental, limits of axes
        drawn = {
            "history": figures.plot_optimization_history(study, target_name="score"),
            "options": figures.plot_slice(study, target_name="score"),
        }
        if importances(study):
            drawn["importance"] = figures.plot_param_importances(_in_space(study), target_name="score")
    for name, axes in drawn.items():
        save_figure(np.atleast_1d(np.asarray(axes, dtype=object)).flat[0].figure, folder / f"{name}.png")


def search_summary(study: Study) -> list[str]:
    """Describes the best trials and the importance of each option, in lines of text."""
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
