"""Searches, for those who have Optuna."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_her_recipes.config.search import Search
from torchrl_her_recipes.studies.workers_local import Workers

if TYPE_CHECKING:
    from torchrl_her_recipes.tuning.search import SearchResult


def tune(
    search: Search,
    folder: str | Path,
    *,
    trials: int | None = None,
    minutes: float | None = None,
    workers: Workers | None = None,
    say: Callable[[str], None] = lambda _line: None,
    progress: bool = True,
) -> SearchResult:
    """Searches for good options, or goes on with it: each trial is a batched run in a worker process.

    Trials that were under way when a search was stopped or killed go on first. With one worker the result is
    the same, bit for bit, as that of a search that was never stopped.

    Args:
        search: what to do.
        folder: where its database, its trials and its results go.
        trials: how many there are to be in the folder; 50 by default if there is no limit of time.
        minutes: no trial begins when all commands together have searched for so long.
        workers: who does the trials; by default a process for each core. They are closed in the end.
        say: called with a line when a trial ends.
        progress: whether to show a progress bar.

    Returns:
        The trials, the best first, and the folder with the best as a preset.

    Raises:
        ImportError: Optuna is not installed.
        ValueError: the folder holds another search, somebody is at work in it, a limit is not positive, or
            the task names a module that must not be imported.
        KeyboardInterrupt: by a second Ctrl-C.
    """
    try:
        module = import_module("torchrl_her_recipes.tuning.search")  # needs an extra
    except ModuleNotFoundError as error:
        raise ImportError("a search needs Optuna: pip install '.[tune]'") from error
    return module.run_search(
        search, folder, trials=trials, minutes=minutes, workers=workers, say=say, progress=progress
    )
