"""What came of a search: a table of its trials, the best as a preset, pictures."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Sequence

import yaml
from optuna.study import Study

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.config.search import Search
from torchrl_her_recipes.tuning.folder import SearchFolder
from torchrl_her_recipes.tuning.plots import plot_history, plot_importance, plot_options
from torchrl_her_recipes.tuning.standing import Standing, TrialRow, standing_of


def write_standing(search: Search, home: SearchFolder, study: Study, *, pictures: bool = True) -> Standing:
    """Writes the table, the best trial as a preset, and the pictures.

    Args:
        search: what is searched.
        home: the folder.
        study: in its database.
        pictures: whether to draw.
    """
    standing = standing_of(study, [entry.name for entry in search.space])
    try:
        write_text(home.table, _csv(standing, [entry.name for entry in search.space]))
        if standing.best is not None:
            write_text(home.best, best_preset(search, standing.best, home))
        if pictures and any(trial.score is not None for trial in standing.trials):
            plot_history(standing.trials, home.history)
            plot_options(standing.trials, search.space, home.options)
            if standing.importance:
                plot_importance(standing.importance, home.importance, trials=len(standing.ranked))
    except OSError as error:  # a full disk: the trials are worth more
        warnings.warn(f"the results in {home.path} are not up to date: {error}", stacklevel=2)
    return standing


def _csv(standing: Standing, names: Sequence[str]) -> str:
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["trial", "state", "score", "epochs", *names])
    for trial in standing.trials:
        shown = "" if trial.score is None else trial.score
        values = [trial.values.get(name, "") for name in names]
        writer.writerow([trial.number, trial.state, shown, trial.epochs, *values])
    return table.getvalue()


def best_preset(search: Search, best: TrialRow, home: SearchFolder) -> str:
    """A trial as a preset: training with it repeats the trial, with its seeds."""
    recipe = search.space.recipe(search.recipe, best.values)
    about = f"# trial {best.number} of the search in {home.path.name}: score {best.score:.3f}\n"
    return about + yaml.safe_dump(recipe.changed(), sort_keys=False)
