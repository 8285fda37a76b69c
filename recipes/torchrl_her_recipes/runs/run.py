"""Trains runs and resumes them: the loop of training, evaluation and saving."""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchrl_her.trainers.checkpoint import load_newest_checkpoint, save_checkpoint
from torchrl_her.trainers.trainer import Trainer
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.assembly import build, eval_seeds
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.config.groups import RunConfig
from torchrl_her_recipes.config.imports import command_line
from torchrl_her_recipes.config.loggers import check_installed
from torchrl_her_recipes.config.plain_files import naming
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.callbacks import Callback, RunView, Stopped
from torchrl_her_recipes.runs.curriculum import move_on, play_greedily, stage_success
from torchrl_her_recipes.runs.evaluation import measure, written
from torchrl_her_recipes.runs.film import film_policy
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.goal_map import GoalMap, goal_map
from torchrl_her_recipes.runs.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.runs.loggers.log_to import LogByName
from torchrl_her_recipes.runs.notices import notices
from torchrl_her_recipes.runs.plots import plot_curves, plot_goals
from torchrl_her_recipes.runs.policy_file import write_policy
from torchrl_her_recipes.runs.progress import Progress
from torchrl_her_recipes.runs.scores import BestPolicy, last_success, median_run, score
from torchrl_her_recipes.runs.state import load_run_state, parts_of, run_state, seed_epoch
from torchrl_her_recipes.runs.virtual_goals import at_virtual_goals


@dataclass(frozen=True)
class RunResult:
    """The result of a run, or of several runs side by side.

    Attributes:
        rows: the table of metrics, with a row for each epoch and run.
        folder: the folder with all files of the run, or None.
        interrupted: whether Ctrl-C or a signal stopped the run.
        stopped: whether a callback stopped the run before its last epoch.
    """

    rows: list[dict[str, float]]
    folder: Path | None
    interrupted: bool = False
    stopped: bool = False

    @property
    def successes(self) -> list[float]:
        """Success rate of each run in the last evaluation; empty if there was no evaluation."""
        return last_success(self.rows)

    @property
    def reached(self) -> float:
        """Share of the goals in the last evaluation that were achieved at some step; median of the runs."""
        last = self.rows[-len(self.successes) :]
        return statistics.median(row.get("reached", row["success"]) for row in last) if last else 0.0

    @property
    def success(self) -> float:
        """Success rate in the last evaluation, as the median of the runs; 0 if there was no evaluation."""
        return statistics.median(self.successes) if self.rows else 0.0


def run(
    components: Components,
    folder: str | Path | None = None,
    *,
    callbacks: Sequence[Callback] = (),
    progress: bool = True,
) -> RunResult:
    """Trains for the recipe's number of epochs.

    Args:
        components: components from :func:`~torchrl_her_recipes.build`, some of which may be replaced.
        folder: folder for the run's files; None writes nothing.
        callbacks: user code that is called during training and can stop the run.
        progress: whether to show a progress bar, or a line for each epoch if there is no terminal.

    Raises:
        ValueError: the folder already has a run, or a logger cannot be opened.
        ImportError: the package of a logger is not installed.

    Example:
        >>> from torchrl_her_recipes import EarlyStopping, build, make_recipe
        >>> recipe = make_recipe(task="hand_v0", epochs=3, epoch_frames=320, num_envs=8, episodes=2)
        >>> result = run(build(recipe), callbacks=[EarlyStopping("frames", at_least=640)], progress=False)
        >>> result.stopped, [row["frames"] for row in result.rows]
        (True, [320, 640])
    """
    current = _Run(components, None if folder is None else RunFolder(folder))
    with torch.random.fork_rng(devices=[]), ExitStack() as stack:
        # Losses and policies of TorchRL draw random numbers from torch's global generator.
        torch.manual_seed(components.recipe.run.seed)
        if current.home is not None:
            check_installed(components.recipe.run.log)
            current.home.create()
            stack.enter_context(current.home.at_work())
            current.save(current.home, goals=False)
        return current.train(callbacks, progress=progress)


def run_score(
    recipe: Recipe,
    folder: str | Path | None = None,
    *,
    callbacks: Sequence[Callback] = (),
    progress: bool = False,
) -> float:
    """Trains a recipe and returns a score, which any program that searches for good options can maximize.

    Args:
        recipe: recipe of the runs. The score is the median over its ``num_runs`` runs.
        folder: folder for the run's files; None writes nothing.
        callbacks: user code that is called during training and can stop the run.
        progress: whether to show a progress bar, or a line for each epoch if there is no terminal.

    Raises:
        ValueError: the folder already has a run.
        KeyboardInterrupt: Ctrl-C was pressed. If a folder was given, the unfinished run is saved in it.
    """
    result = run(build(recipe), folder, callbacks=callbacks, progress=progress)
    if result.interrupted:
        raise KeyboardInterrupt  # a search must not take the low score of an unfinished run for its result
    return score(result.rows)


def resume(
    folder: str | Path,
    *,
    components: Components | None = None,
    options: Mapping[str, Any] | None = None,
    callbacks: Sequence[Callback] = (),
    progress: bool = True,
) -> RunResult:
    """Continues an unfinished run from its newest complete checkpoint, or adds epochs to a finished run.

    Epochs can be added to a finished run only if its recipe has ``keep_buffer=True``. Otherwise its last
    checkpoint has no replay buffer, and resuming only makes its pictures and its policy again.

    With this library's tasks, a resumed run ends bit for bit like a run that never stopped. Environments of
    gymnasium and of users are seeded again in each epoch. With these, a run that stopped between two epochs
    ends bit for bit the same, if an environment draws only from the generator that it seeds and keeps no
    state from earlier episodes. If the run stopped within an epoch, the rest of that epoch has new episodes.

    Args:
        folder: folder of the run.
        components: newly made components, if components of the run were replaced after ``build``.
        options: new values of ``epochs``, ``checkpoint_interval``, ``keep_checkpoints``, ``keep_buffer``,
            ``pictures`` or ``log``, which are written to the folder's configuration.
        callbacks: user code that is called during training; callbacks of earlier starts are not saved.
        progress: whether to show a progress bar, or a line for each epoch if there is no terminal.

    Raises:
        ValueError: there is no run in the folder, no checkpoint is complete, more epochs need a replay buffer
            that the checkpoint lacks, an option would change the training done so far, ``epochs`` is below
            the number done, both options and components are given, or the components do not fit the run.
    """
    home = RunFolder(folder)
    home.recipe()  # raises if this is not the folder of a run, before a lock file is written to it
    if options and components is not None:
        raise ValueError("give resume() either options or components that were made with them, not both")
    with home.at_work():
        recipe = home.recipe()
        state, done, has_buffer = _newest_state(home, keep=recipe.run.keep_checkpoints)
        target = recipe.extended(**options or {}) if components is None else components.recipe
        check_installed(target.run.log)
        _check_extension(home, target.run, done, has_buffer=has_buffer, asked=bool(options))
        current = _Run(components or build(target), home)
        with torch.random.fork_rng(devices=[]):
            with naming(home.checkpoint, "is not of this run"):
                load_run_state(current.parts, state)
            if options:
                home.describe(current.recipe)
            current.go_back(home, done, has_buffer=has_buffer)
            return current.train(callbacks, progress=progress)


def _newest_state(home: RunFolder, *, keep: int) -> tuple[dict[str, Any], int, bool]:
    """Reads the newest complete checkpoint; returns it, its epoch, and whether it has a replay buffer."""
    try:
        state = load_newest_checkpoint(home.checkpoint, keep=keep)
    except FileNotFoundError:
        raise ValueError(
            f"the run in {home.path} cannot be resumed: {home.checkpoint.name} is missing"
        ) from None
    with naming(home.checkpoint, "is not of this run"):
        return state, int(state["trainer"]["epochs"]), bool(state["buffer"])


def _check_extension(
    home: RunFolder, options: RunConfig, done: int, *, has_buffer: bool, asked: bool
) -> None:
    """Raises a ValueError if a run cannot continue with the given options after ``done`` epochs."""
    if not has_buffer and (options.epochs > done or options.keep_buffer):
        raise ValueError(
            f"the run in {home.path} cannot be extended beyond {done} epochs: its checkpoint has no "
            "replay buffer; only runs trained with keep_buffer=true keep it when they have finished"
        )
    if asked and options.epochs < done:
        raise ValueError(
            f"epochs must be at least {done}, the number that the run in {home.path} has done, "
            f"got {options.epochs}"
        )


class _Run:
    """A run in progress (or several runs side by side): components, table of metrics and folder."""

    def __init__(self, components: Components, home: RunFolder | None) -> None:
        self.components, self.recipe, self.home = components, components.recipe, home
        self.trainer, self.best = components.trainer(), BestPolicy()
        self.rows: list[dict[str, float]] = []
        self.parts = parts_of(components, self.trainer) | {"best": self.best}
        self.has_buffer = True

    def go_back(self, home: RunFolder, epochs: int, *, has_buffer: bool) -> None:
        """Restores table and best policy as they were after ``epochs`` epochs, and removes newer files."""
        home.policy.unlink(missing_ok=True)  # written when the run stopped, but marks a finished run
        if self.best.state is None:
            # Best policy and table are written each epoch, so their files may be newer than the checkpoint.
            home.best.unlink(missing_ok=True)
        self.save_best(home)
        self.rows, self.has_buffer = home.rows()[: epochs * self.recipe.run.num_runs], has_buffer

    @property
    def has_ended(self) -> bool:
        """Whether the run has finished its last epoch."""
        return self.trainer.epochs >= self.recipe.run.epochs

    def train(self, callbacks: Sequence[Callback], *, progress: bool) -> RunResult:
        """Trains, evaluates and saves up to the last epoch, or until a callback or a signal stops the run."""
        recipe, trainer, rows, home = self.recipe, self.trainer, self.rows, self.home
        loggers = [] if home is None else [LogByName(name) for name in recipe.run.log]
        hooks, view = [*callbacks, *loggers], RunView(self.components, trainer, rows, home)
        threads = torch.get_num_threads()
        torch.set_num_threads(recipe.run.threads)
        torch.set_flush_denormal(True)  # unused weights have denormal moments in Adam, ten times slower
        display = Progress(trainer, epochs=recipe.run.epochs, frames=recipe.total_frames, show=progress)
        interrupted = stopped = saved = False
        with soft_interrupt() as check, ExitStack() as opened:  # also defers Ctrl-C while files are saved
            for logger in loggers:
                opened.callback(logger.close)

            def on_batch(_trainer: Trainer) -> None:
                display.batch()
                check()
                stops = [hook.on_batch(view) for hook in hooks]  # every hook is called, even if one is True
                if any(stops):
                    raise Stopped

            try:
                for hook in hooks:
                    hook.on_start(view)
                while not self.has_ended and not stopped:
                    self.epoch(on_batch, display)
                    answers = [hook.on_epoch(view) for hook in hooks]
                    stopped = any(answers)
                    for line in notices(rows, recipe, self.components.bounds):
                        display.say(line)
                    if home is not None:
                        with self._despite_a_full_disk("table"):
                            home.write_table(rows)
                        due = trainer.epochs % recipe.run.checkpoint_interval == 0
                        saved = (due or not home.config.exists()) and self.save(home)
                        self.save_best(home)
            except Interrupted:
                interrupted, saved = True, False
            except Stopped:
                stopped, saved = True, False
            finally:
                display.close()
                self.components.close()
                torch.set_num_threads(threads)
                torch.set_flush_denormal(False)
            if home is not None:
                if not saved:
                    self.save(home)
                    self.save_best(home)
                if interrupted and recipe.run.pictures:
                    display.say("the run is saved; its pictures are drawn, unless Ctrl-C is pressed again")
                self.finish(home)
            for hook in hooks:
                hook.on_end(view)
        return RunResult(
            rows=rows,
            folder=None if home is None else home.path,
            interrupted=interrupted,
            stopped=stopped and not self.has_ended,
        )

    def epoch(self, on_batch: Callable[[Trainer], None], display: Progress) -> None:
        """Trains for an epoch, evaluates, and adds a row for each run to the table of metrics."""
        components, trainer, state = self.components, self.trainer, self.components.curriculum
        began = time.perf_counter()
        seed_epoch(components.env, self.recipe.seeds, self.recipe.collection.processes, trainer)
        measured = trainer.epoch(on_batch)
        rollout = play_greedily(components, components.eval_env, trainer.epochs)
        measured |= measure(components, rollout)
        if components.behavior is not None:
            measured["proposed_success"] = components.behavior.success()
        measured |= {"epsilon": components.exploration.epsilon} | at_virtual_goals(components, trainer.epochs)
        if state is not None:
            samples = stage_success(components, state, rollout, trainer.epochs)
            measured["stage_success"] = samples.mean(1)
            stages = [state.progress.mean_stage(run) for run in range(self.recipe.run.num_runs)]
            name = "mean_stage" if state.progress.by_episode else "stage"
            measured[name] = torch.tensor(stages, dtype=torch.float64)
        seconds = (self.rows[-1]["seconds"] if self.rows else 0.0) + time.perf_counter() - began
        rows = []
        for run, seed in enumerate(self.recipe.seeds):
            counters = {"run": run, "seed": seed, "epoch": trainer.epochs, "frames": trainer.frames}
            times = {"updates": trainer.updates, "seconds": seconds}
            values = {name: float(value[run]) for name, value in measured.items()}
            rows.append({**counters, **times, **values, **written(components, run)})
        self.best.see(rows, components.greedy)  # before runs move to new stages
        if state is not None:
            for line in move_on(components, state, samples, trainer.frames):
                display.say(line)
        display.epoch(rows)
        self.rows += rows

    def save(self, home: RunFolder, *, goals: bool = True) -> bool:
        """Writes a checkpoint, at the end without replay buffer; returns whether this succeeded.

        Unless ``goals`` is False, writes the histogram of virtual goals first, since it needs the buffer.
        """
        if goals:
            with self._despite_a_full_disk("map of goals"):
                self.save_goals(home)
        state = run_state(self.parts, buffer=self.recipe.run.keep_buffer or not self.has_ended)
        with self._despite_a_full_disk("checkpoint"):
            save_checkpoint(state, home.checkpoint, keep=self.recipe.run.keep_checkpoints)
            if not home.config.exists():  # written last, so that a folder with config.yaml can be resumed
                if self.rows:
                    home.write_table(self.rows)
                home.describe(self.recipe)
                self.best.is_new = self.best.state is not None
            return True
        return False

    def save_best(self, home: RunFolder) -> None:
        """Writes the best policy if it has changed since the last call."""
        if self.best.state is not None and self.best.is_new:
            with self._despite_a_full_disk("best policy"):
                described = {name: self.best.state[name] for name in ("epoch", "success")}
                write_policy(home.best, self.best.state["actor"], described)
                home.describe_best(**described)
                self.best.is_new = False

    def save_goals(self, home: RunFolder) -> GoalMap | None:
        """Writes and returns the histogram of virtual goals; without a buffer, reads the earlier file."""
        if not self.has_buffer:
            return GoalMap.load(home.goal_map) if home.goal_map.is_file() else None
        goals = goal_map(self.components.buffer, self.components.goal_target)
        if goals is not None:
            goals.save(home.goal_map)
        return goals

    @contextmanager
    def _despite_a_full_disk(self, what: str) -> Iterator[None]:
        """Makes the folder if it is missing; turns a failure to write into a warning, as epochs try again."""
        try:
            if self.home is not None:
                self.home.path.mkdir(parents=True, exist_ok=True)  # it may have been deleted meanwhile
            yield
        except OSError as error:
            message = f"no {what} after {self.trainer.frames:,} frames, the run continues: {error}"
            warnings.warn(message, stacklevel=4)

    def finish(self, home: RunFolder) -> None:
        """Draws the pictures and then writes the policy, whose file marks the run as finished.

        Raises:
            OSError: a file cannot be written; the message lists the missing files.
        """
        try:
            goals = self.save_goals(home)
            if self.recipe.run.pictures:
                self._draw(goals, home)
            write_policy(home.policy, self.components.greedy.state_dict(), {})
            if self.has_ended:
                for path in home.older_checkpoints:
                    path.unlink(missing_ok=True)
        except OSError as error:
            expected = [home.curves, home.video] if self.recipe.run.pictures else []
            missing = [path.name for path in (*expected, home.policy) if not path.is_file()]
            why = (error.strerror or str(error)).lower()
            resuming = command_line("train", "--resume", home.path, task=self.recipe.task.name)
            raise OSError(
                f"cannot write {error.filename or ' or '.join(missing)}: {why}; "
                f"{', '.join(missing)} will be written by: {resuming}"
            ) from error

    def _draw(self, goals: GoalMap | None, home: RunFolder) -> None:
        recipe, rows, task = self.recipe, self.rows, goal_env(self.components.env)
        title = f"{recipe.task.name}, {recipe.hindsight.algo}, " + (
            f"seed {recipe.run.seed}" if recipe.run.num_runs == 1 else f"{recipe.run.num_runs} runs"
        )
        if rows:
            plot_curves(rows, home.curves, title=title)
        if goals is not None and goals.target.ndim == 2 and task.goal_box() is not None:
            plot_goals(goals, task, home.goals, title=f"virtual goals: {title}")
        run, epoch = (median_run(rows), int(rows[-1]["epoch"])) if rows else (0, 0)
        env, player, seeds = self.components.eval_env, self.components.player, eval_seeds(recipe.seeds, epoch)
        film_policy(TaskEnvs.of(recipe), env, player, home.video, seeds=seeds, run=run)
