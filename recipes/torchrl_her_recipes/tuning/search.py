"""Runs a search: trials of batched runs, several at once, which go on where they were killed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from pathlib import Path

from filelock import FileLock, Timeout
from optuna.exceptions import StorageInternalError
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError
from tqdm import tqdm

from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.config.imports import check_permitted
from torchrl_her_recipes.config.search import Search
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.runs.score import score
from torchrl_her_recipes.studies.jobs import Job, Outcome, kept_progress, read_progress
from torchrl_her_recipes.studies.workers_local import LocalWorkers, Workers
from torchrl_her_recipes.tuning.database import create_database, load_study
from torchrl_her_recipes.tuning.folder import SearchFolder
from torchrl_her_recipes.tuning.pruning import PRUNED, reporting
from torchrl_her_recipes.tuning.results import write_standing
from torchrl_her_recipes.tuning.samplers import make_sampler
from torchrl_her_recipes.tuning.standing import Standing

_TICK = 1.0  # seconds
_DRAW = 60.0  # seconds between two writings of all pictures
_DEATHS = 3  # of the process of a trial, with no epoch gained in between
_FAILURES = 5  # with no success: something else than the options is wrong
_ERROR, _SECONDS = "error", "seconds"  # attributes of trials and of the study
_AROUND = f"{reporting.__module__}:{reporting.__name__}"


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """What came of a search so far.

    Attributes:
        standing: its trials, the best first.
        folder: with the best as a preset, and the pictures.
        interrupted: whether somebody stopped it. It goes on if it is run again.
        failed: why, by the number of the trial.
    """

    standing: Standing
    folder: Path
    interrupted: bool = False
    failed: dict[int, str] = field(default_factory=dict)

    @property
    def best(self) -> float | None:
        """The best score; None if no trial has come to its end."""
        first = self.standing.best
        return None if first is None else first.score


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
        ValueError: the folder holds another search, somebody is at work in it, a limit is not positive, or
            the task names a module that must not be imported.
        ImportError: Optuna is not installed, or the sampler needs a package that is not installed.
        OSError: the database cannot be used any more, for instance because the disk is full.
        KeyboardInterrupt: by a second Ctrl-C.
    """
    if trials is not None and trials < 1:
        raise ValueError(f"trials must be at least 1, got {trials}")
    if minutes is not None and not minutes > 0:
        raise ValueError(f"minutes must be above 0, got {minutes}")
    check_permitted(search.recipe.task.name)
    search = replace(search, recipe=resolved(search.recipe))
    home = SearchFolder(folder)
    home.check(search)
    sampler = make_sampler(search.sampler, search.recipe.run.seed)
    workers = workers or LocalWorkers()
    try:
        home.path.mkdir(parents=True, exist_ok=True)
        with FileLock(home.lock, timeout=0):
            home.check(search)
            home.describe(search)
            create_database(home.database, search.space.values_of(search.recipe))
            with load_study(home.database, sampler=sampler) as study:
                rounds = _Rounds(search, home, study, workers, say)
                rounds.run(trials or (50 if minutes is None else None), minutes, progress=progress)
                return SearchResult(
                    standing=rounds.write(),
                    folder=home.path,
                    interrupted=rounds.interrupted,
                    failed={
                        trial.number: trial.user_attrs.get(_ERROR, "")
                        for trial in study.get_trials(deepcopy=False, states=(TrialState.FAIL,))
                    },
                )
    except Timeout as error:
        raise ValueError(f"another process is searching in {home.path}") from error
    except (StorageInternalError, SQLAlchemyError) as error:
        cause = error.__cause__ or error
        why = " ".join(str(getattr(cause, "orig", cause)).split())
        raise OSError(f"{home.database} cannot be used ({why}); the same command goes on") from error
    finally:
        workers.close()


class _Rounds:
    """The trials of a search, from the one that begins next to those that are under way."""

    def __init__(
        self, search: Search, home: SearchFolder, study: Study, workers: Workers, say: Callable[[str], None]
    ) -> None:
        self.search, self.home, self.study, self.workers, self.say = search, home, study, workers, say
        self.interrupted = False
        self._began = time.monotonic()
        self._before: float = study.user_attrs.get(_SECONDS, 0.0)
        self._deaths: dict[int, list[int]] = {}  # the epochs that a trial had kept each time
        self._failures = 0  # since this command began
        self._drawn = time.monotonic()
        self._left_over = [trial.number for trial in self._trials(TrialState.RUNNING)]
        for trial in self._trials(TrialState.PRUNED, TrialState.FAIL):
            self._drop_checkpoints(trial.number)  # if a search was killed before it did

    @property
    def seconds(self) -> float:
        """How long all commands together have searched."""
        return self._before + time.monotonic() - self._began

    def run(self, trials: int | None, minutes: float | None, *, progress: bool) -> None:
        """Does trials up to a limit.

        Args:
            trials: how many there are to be in all.
            minutes: after which none begins.
            progress: whether to show a bar.
        """
        waiting: dict[Future[Outcome], int] = {}

        def fill() -> None:
            while len(waiting) < self.workers.at_once:
                number = self._next(trials, minutes)
                if number is None:
                    return
                job = self._job(number)
                if job is not None:
                    waiting[threads.submit(self.workers.run, job)] = number

        def collect() -> None:
            for future in wait(waiting, _TICK, FIRST_COMPLETED).done:
                self._end(waiting.pop(future), _outcome(future))
            bar.n = self._done
            bar.set_postfix_str(self._running(waiting.values()))

        # No bar in a file: there, lines say when a trial ends.
        bar = tqdm(total=trials, initial=self._done, unit=" trials", disable=None if progress else True)
        with bar, ThreadPoolExecutor(max(self.workers.at_once, 1)) as threads, soft_interrupt() as check:
            try:
                fill()
                while waiting:
                    collect()
                    fill()
                    check()
            except Interrupted:
                self.interrupted = True
                self.workers.stop()
                while waiting:
                    collect()
            finally:
                self.workers.close()
        self.study.set_user_attr(_SECONDS, self.seconds)

    def write(self) -> Standing:
        """Writes what came of the search so far."""
        self._drawn = time.monotonic()
        return write_standing(self.search, self.home, self.study)

    def _running(self, numbers: Iterable[int]) -> str:
        """How far the trials are that are under way: their numbers, with epochs."""
        epochs = self.search.recipe.run.epochs
        return ", ".join(
            f"trial {number}: {read_progress(self.home.trial(number)).epochs}/{epochs} epochs"
            for number in sorted(numbers)
        )

    @property
    def _done(self) -> int:
        return sum(trial.state.is_finished() for trial in self.study.get_trials(deepcopy=False))

    def _trials(self, *states: TrialState) -> list[FrozenTrial]:
        return self.study.get_trials(deepcopy=False, states=states)

    def _trial(self, number: int) -> FrozenTrial:
        return self.study.get_trials(deepcopy=False)[number]

    def _next(self, trials: int | None, minutes: float | None) -> int | None:
        """The number of the trial that is to be done next; None if there is none."""
        if self._left_over:
            return self._left_over.pop(0)
        begun = sum(trial.state != TrialState.WAITING for trial in self.study.get_trials(deepcopy=False))
        if self._failures >= _FAILURES and not self._trials(TrialState.COMPLETE, TrialState.PRUNED):
            return None
        if (trials is not None and begun >= trials) or (minutes is not None and self.seconds >= 60 * minutes):
            return None
        return self.study.ask().number

    def _job(self, number: int) -> Job | None:
        """What a trial runs; None if it has ended already, or cannot be."""
        frozen = self._trial(number)
        if PRUNED in frozen.user_attrs:  # the search was killed before it could note it down
            self._end(number, Outcome())
            return None
        try:
            # Values that the trial lacks, as its beginning was cut short, are what they would have been.
            values = self.search.space.suggest(Trial(self.study, frozen._trial_id))
            recipe = self.search.space.recipe(self.search.recipe, values)
        except ValueError as error:
            self._end(number, Outcome(error=str(error)))
            return None
        folder = self.home.trial(number)
        around = {
            "database": str(self.home.database),
            "pruner": self.search.pruner,
            "epochs": recipe.run.epochs,
            "number": number,
        }
        return Job(label=folder.name, recipe=recipe, folder=folder, around=_AROUND, options=around)

    def _end(self, number: int, outcome: Outcome) -> None:
        """Notes down what came of a trial."""
        if outcome.interrupted:
            return
        if outcome.died and self._goes_on(number):
            self._left_over.append(number)
            return
        home, state, value, error = (
            RunFolder(self.home.trial(number)),
            TrialState.COMPLETE,
            None,
            outcome.error,
        )
        if PRUNED in self._trial(number).user_attrs:
            state, error = TrialState.PRUNED, ""
        elif not error:
            try:
                value = score(home.rows())
            except ValueError as broken:
                error = str(broken)
        if error:
            state = TrialState.FAIL
            self._failures += 1
            Trial(self.study, self._trial(number)._trial_id).set_user_attr(_ERROR, error)
        self.study.tell(number, value, state=state)
        self.study.set_user_attr(_SECONDS, self.seconds)
        if state != TrialState.COMPLETE:
            self._drop_checkpoints(number)
        self.say(self._line(number, error))
        if time.monotonic() - self._drawn > _DRAW:
            self.write()
        else:
            write_standing(self.search, self.home, self.study, pictures=False)

    def _goes_on(self, number: int) -> bool:
        """Whether a trial whose process died is taken up again: not if it never gets any further."""
        folder = self.home.trial(number)
        kept = kept_progress(Job(label="", recipe=self.search.recipe, folder=folder)).epochs
        deaths = self._deaths.setdefault(number, [])
        deaths.append(kept)
        return deaths.count(kept) < _DEATHS

    def _drop_checkpoints(self, number: int) -> None:
        """Removes what a trial could go on from, which is large, and of no use to one that never does."""
        for path in RunFolder(self.home.trial(number)).checkpoints:
            path.unlink(missing_ok=True)

    def _line(self, number: int, error: str) -> str:
        trial = self._trial(number)
        if error:
            return f"trial {number} failed: {error}"
        best = max(self._trials(TrialState.COMPLETE), key=lambda own: own.value or 0.0, default=None)
        record = "" if best is None else f" (best {best.value:.0%}, trial {best.number})"
        if trial.state == TrialState.PRUNED:
            return f"trial {number}: pruned after epoch {trial.user_attrs[PRUNED]}{record}"
        return f"trial {number}: score {trial.value:.0%}{record}"


def _outcome(future: Future[Outcome]) -> Outcome:
    error = future.exception()
    return future.result() if error is None else Outcome(error=" ".join(f"{error!r}".split()))
