"""Runs the trials of a search as jobs in worker processes, and passes their scores to Optuna."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import optuna
from filelock import FileLock, Timeout
from optuna.exceptions import OptunaError
from optuna.storages import RDBStorage
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError
from tqdm import tqdm

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.config.imports import check_permitted
from torchrl_her_recipes.config.plain_files import dump_yaml, naming, parse_yaml, read_mapping
from torchrl_her_recipes.config.searches.search import Search, difference
from torchrl_her_recipes.runs.callbacks import Callback, RunView
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.runs.scores import score
from torchrl_her_recipes.studies.jobs import Job, Outcome
from torchrl_her_recipes.studies.schedule import outcome_of
from torchrl_her_recipes.studies.workers import LocalWorkers, Workers
from torchrl_her_recipes.tuning.results import DEFAULT, folder_of, write_pictures, write_results

_NAME, _SETTINGS, _DATABASE = "search", "search.yaml", "search.db"
_TICK = 1.0  # seconds between two checks of running trials
_ATTEMPTS = 3  # largest number of attempts at a trial whose process dies
_FAILURES = 5  # number of first trials that end a search if all fail: their options are not the cause
_ATTEMPT, _REPEATED, _PRUNED, _ERROR = "attempt", "repeated", "pruned", "error"


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """Result of a search so far.

    Attributes:
        study: Optuna's study. Trials with the attribute ``repeated`` were interrupted; another trial with the
            same values has resumed their run.
        folder: folder with the best trial as a preset, a table of trials, and figures.
        interrupted: whether the user stopped the search, which the same call resumes.
    """

    study: Study
    folder: Path
    interrupted: bool = False

    @property
    def trials(self) -> list[FrozenTrial]:
        """All trials that have begun, except those that were interrupted and repeated."""
        return _counted(self.study)

    @property
    def best(self) -> float | None:
        """The best score; None if no trial is complete."""
        done = self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        return max((trial.value or 0.0 for trial in done), default=None)

    @property
    def failed(self) -> dict[int, str]:
        """Errors of the trials that failed, by the number of the trial."""
        failed = (trial for trial in self.trials if trial.state == TrialState.FAIL)
        return {trial.number: trial.user_attrs.get(_ERROR, "") for trial in failed}


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
    """Searches for good options, or resumes the search in a folder.

    Interrupted trials are resumed from their checkpoints.

    Args:
        search: settings of the search.
        folder: folder of the search.

    Keyword Args:
        trials: total number of trials, including those of a resumed search; 50 if neither this nor
            ``minutes`` is given.
        minutes: minutes after which no further trial begins.
        workers: workers that run the trials, by default a process for each core; they are closed at the end.
        say: function that is called with a line of text for each trial that ends.
        progress: whether to show a progress bar.

    Raises:
        ValueError: the folder has a search with other settings, another process is searching in it, a limit
            is not positive, or the task names a module that must not be imported.
        ImportError: the sampler needs a package that is not installed.
        OSError: the database of trials cannot be used, for instance because the disk is full.
        KeyboardInterrupt: Ctrl-C was pressed a second time.
    """
    if trials is not None and trials < 1:
        raise ValueError(f"trials must be at least 1, got {trials}")
    if minutes is not None and not minutes > 0:
        raise ValueError(f"minutes must be above 0, got {minutes}")
    check_permitted(search.recipe.task.name)
    search, home = replace(search, recipe=resolved(search.recipe)), Path(folder)
    workers = workers or LocalWorkers()
    try:
        home.mkdir(parents=True, exist_ok=True)
        with FileLock(home / ".lock", timeout=0):
            _describe(search, home / _SETTINGS)
            study = _begin(search, home / _DATABASE)
            limit = trials or (50 if minutes is None else None)
            trial_runs = _TrialRuns(search, home, study, workers, say)
            interrupted = trial_runs.run(limit, minutes, progress=progress)
            write_pictures(study, home)
            return SearchResult(study=study, folder=home, interrupted=interrupted)
    except Timeout as error:
        raise ValueError(f"another process is searching in {home}") from error
    except (OptunaError, SQLAlchemyError) as error:
        cause = error.__cause__ or error
        why = " ".join(str(getattr(cause, "orig", cause)).split())
        raise OSError(f"{home / _DATABASE} cannot be used ({why}); to resume, repeat the command") from error
    finally:
        workers.close()


def _describe(search: Search, path: Path) -> None:
    """Writes the settings of a new search; raises a ValueError if its folder has other settings."""
    text = dump_yaml(search.to_plain())
    if not path.exists():
        write_text(path, text)
        return
    before = read_mapping(path)
    with naming(path):
        different = difference(before, parse_yaml(text))
    if different:
        raise ValueError(
            f"{path.parent} holds a search with {different}: repeat its options, or choose another folder=DIR"
        )


def _begin(search: Search, database: Path) -> Study:
    """Opens Optuna's study; plans the unchanged recipe as first trial, and repeats interrupted trials."""
    study = optuna.create_study(
        storage=_storage(database),
        study_name=_NAME,
        direction="maximize",
        load_if_exists=True,
        pruner=_make_pruner(search.pruner, search.recipe.run.epochs),
    )
    begun = study.get_trials(deepcopy=False)
    study.sampler = make_sampler(search.sampler, search.recipe.run.seed + len(begun))
    if not begun:
        values = search.space.values_of(search.recipe)
        study.enqueue_trial(search.space.inside(values), user_attrs={DEFAULT: values})
    for trial in begun:
        if trial.state == TrialState.RUNNING:
            _repeat(study, trial)
    return study


def _storage(database: Path) -> RDBStorage:
    optuna.logging.set_verbosity(optuna.logging.WARNING)

    def connect() -> sqlite3.Connection:  # not by a URL, where some characters of a path are special
        return sqlite3.connect(database, timeout=60, check_same_thread=False)

    return RDBStorage("sqlite:///search.db", engine_kwargs={"creator": connect})


def make_sampler(name: str, seed: int) -> optuna.samplers.BaseSampler:
    """Makes Optuna's sampler of this name (``tpe``, ``random`` or ``cmaes``) with a seed.

    Raises:
        ImportError: the sampler needs a package that is not installed.
    """
    if name == "cmaes" and find_spec("cmaes") is None:
        raise ImportError("--sampler cmaes needs cmaes: pip install '.[tune]'")
    makers: dict[str, Callable[..., optuna.samplers.BaseSampler]] = {
        "tpe": optuna.samplers.TPESampler,
        "random": optuna.samplers.RandomSampler,
        "cmaes": partial(optuna.samplers.CmaEsSampler, warn_independent_sampling=False),
    }
    return makers[name](seed=seed)


def _make_pruner(name: str, epochs: int) -> optuna.pruners.BasePruner:
    if name == "median":  # prunes after two fifths of the epochs, since success often comes late
        return optuna.pruners.MedianPruner(n_startup_trials=5, n_warmup_steps=2 * epochs // 5)
    if name == "halving":
        return optuna.pruners.SuccessiveHalvingPruner(min_resource=max(epochs // 9, 1), reduction_factor=3)
    return optuna.pruners.NopPruner()


def _counted(study: Study) -> list[FrozenTrial]:
    """Returns the trials that have begun, except those that were interrupted and repeated."""
    trials = study.get_trials(deepcopy=False)
    return [
        trial for trial in trials if trial.state != TrialState.WAITING and _REPEATED not in trial.user_attrs
    ]


def _repeat(study: Study, trial: FrozenTrial | Trial, *, attempt: int = 0) -> None:
    """Ends an interrupted trial in Optuna's study, and plans a trial that resumes its run."""
    attributes = {name: value for name, value in trial.user_attrs.items() if name == DEFAULT}
    Trial(study, trial._trial_id).set_user_attr(_REPEATED, True)
    study.tell(trial.number, state=TrialState.FAIL)
    study.enqueue_trial(
        trial.params, user_attrs={**attributes, "folder": folder_of(trial), _ATTEMPT: attempt}
    )


class _TrialRuns:
    """Runs the trials of a search, several at once."""

    def __init__(
        self, search: Search, home: Path, study: Study, workers: Workers, say: Callable[[str], None]
    ) -> None:
        self.search, self.home, self.study, self.workers, self.say = search, home, study, workers, say
        self._running: dict[Future[Outcome], Trial] = {}

    def run(self, trials: int | None, minutes: float | None, *, progress: bool) -> bool:
        """Runs trials until a limit is reached; returns whether the user interrupted the search."""
        end = None if minutes is None else time.monotonic() + 60 * minutes
        bar = tqdm(total=trials, initial=self._done(), unit=" trials", disable=None if progress else True)
        with bar, ThreadPoolExecutor(max(self.workers.at_once, 1)) as threads, soft_interrupt() as check:
            try:
                while True:
                    while len(self._running) < self.workers.at_once and self._may_begin(trials, end):
                        self._start(threads)
                    if not self._running:
                        return False
                    self._collect()
                    bar.n = self._done()
                    bar.refresh()
                    check()
            except Interrupted:
                self.workers.stop()
                while self._running:
                    self._collect()
                return True
            finally:
                self.workers.close()

    def _done(self) -> int:
        return sum(trial.state.is_finished() for trial in _counted(self.study))

    def _may_begin(self, trials: int | None, end: float | None) -> bool:
        counted = _counted(self.study)
        failed = sum(trial.state == TrialState.FAIL for trial in counted)
        if failed >= _FAILURES and failed == self._done():
            return False
        return (trials is None or len(counted) < trials) and (end is None or time.monotonic() < end)

    def _start(self, threads: ThreadPoolExecutor) -> None:
        space, ranges = self.search.space, self.search.space.distributions()
        waiting = self.study.get_trials(deepcopy=False, states=(TrialState.WAITING,))
        if waiting and (default := waiting[0].user_attrs.get(DEFAULT)) is not None:
            # This trial has the recipe's own values; Optuna must not change those that lie outside the space.
            ranges = {name: ranges[name] for name in space.inside(default)}
        trial = self.study.ask(ranges)
        try:
            recipe = space.recipe(self.search.recipe, trial.params)
        except ValueError as error:  # the values cannot be used together
            self._tell(trial, TrialState.FAIL, error=str(error))
            return
        name = folder_of(trial)
        options = {
            "database": str(self.home / _DATABASE),
            "number": trial.number,
            "pruner": self.search.pruner,
            "epochs": recipe.run.epochs,
        }
        around = f"{reporting.__module__}:{reporting.__name__}"
        job = Job(label=name, recipe=recipe, folder=self.home / name, around=around, options=options)
        self._running[threads.submit(self.workers.run, job)] = trial

    def _collect(self) -> None:
        for future in wait(self._running, _TICK, FIRST_COMPLETED).done:
            self._end(self._running.pop(future), outcome_of(future))

    def _end(self, trial: Trial, outcome: Outcome) -> None:
        """Passes the result of a trial to Optuna, or repeats the trial if it was interrupted or died."""
        attempt = trial.user_attrs.get(_ATTEMPT, 0)
        if outcome.interrupted:
            _repeat(self.study, trial, attempt=attempt)
            return
        if outcome.died and attempt + 1 < _ATTEMPTS:
            _repeat(self.study, trial, attempt=attempt + 1)
            return
        frozen = self.study.get_trials(deepcopy=False)[trial.number]
        run = RunFolder(self.home / folder_of(trial))
        if _PRUNED in frozen.user_attrs:
            self._tell(trial, TrialState.PRUNED)
        elif outcome.error:
            self._tell(trial, TrialState.FAIL, error=outcome.error)
        else:
            self._tell(trial, TrialState.COMPLETE, value=score(run.rows()))
            return
        for path in run.checkpoints:  # large files, which a pruned or failed trial no longer needs
            path.unlink(missing_ok=True)

    def _tell(self, trial: Trial, state: TrialState, *, value: float | None = None, error: str = "") -> None:
        if error:
            trial.set_user_attr(_ERROR, error)
        self.study.tell(trial, value, state=state)
        write_results(self.search, self.study, _counted(self.study), self.home)
        done = state == TrialState.COMPLETE
        best = f" (best {self.study.best_value:.0%}, trial {self.study.best_trial.number})" if done else ""
        line = {
            TrialState.COMPLETE: f": score {value or 0.0:.0%}{best}",
            TrialState.PRUNED: f": pruned after epoch {trial.user_attrs.get(_PRUNED)}",
        }.get(state, f" failed: {error}")
        self.say(f"trial {trial.number}{line}")


class _Reporter(Callback):
    """Callback that reports a trial's score to Optuna each epoch, and stops the trial if Optuna prunes it."""

    def __init__(self, study: Study, number: int) -> None:
        self.study = study
        self.trial = Trial(study, study.get_trials(deepcopy=False)[number]._trial_id)

    def on_epoch(self, run: RunView) -> bool:
        """Returns whether to prune the trial; the unchanged recipe is never pruned, nor the last epoch."""
        epoch = run.trainer.epochs
        self.trial.report(score(run.rows), epoch)
        may_end = epoch < run.components.recipe.run.epochs and DEFAULT not in self.trial.user_attrs
        pruned = may_end and self.trial.should_prune()
        if pruned:
            self.trial.set_user_attr(_PRUNED, epoch)
        return pruned


@contextmanager
def reporting(*, database: str, number: int, pruner: str, epochs: int) -> Iterator[list[Callback]]:
    """Context manager around the run of a trial, in its worker process; yields callbacks of the run.

    Args:
        database: Path of the search's database.
        number: Number of the trial.
        pruner: Name of the search's pruner.
        epochs: Number of epochs of each trial.
    """
    storage = _storage(Path(database))
    study = optuna.load_study(study_name=_NAME, storage=storage, pruner=_make_pruner(pruner, epochs))
    try:
        yield [_Reporter(study, number)]
    finally:
        storage.remove_session()
        storage.engine.dispose()
