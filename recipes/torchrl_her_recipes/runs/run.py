"""One run from beginning to end: train, evaluate, record, checkpoint, and go on from there."""

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
from torchrl_her_recipes.components.assembly import build
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.config.loggers import check_installed
from torchrl_her_recipes.config.plain_files import naming
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.best import BestPolicy
from torchrl_her_recipes.runs.callbacks import Callback, RunView, Stopped
from torchrl_her_recipes.runs.curriculum import layer_success, move_on, play_greedily
from torchrl_her_recipes.runs.evaluation import measure, written
from torchrl_her_recipes.runs.film import film_policy
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.goal_map import GoalMap, goal_map
from torchrl_her_recipes.runs.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.runs.log_to import LogByName
from torchrl_her_recipes.runs.notices import notices
from torchrl_her_recipes.runs.plots import plot_curves, plot_goals
from torchrl_her_recipes.runs.policy_file import write_policy
from torchrl_her_recipes.runs.progress import Progress
from torchrl_her_recipes.runs.state import load_run_state, run_state, seed_epoch
from torchrl_her_recipes.runs.virtual_goals import at_virtual_goals


@dataclass(frozen=True)
class RunResult:
    """The result of a run, or of several side by side.

    Attributes:
        rows: the table of metrics, with a row for each epoch and run.
        folder: the folder with all files of the run, or None.
        interrupted: whether it was stopped by Ctrl-C or a signal.
        stopped: whether a callback stopped it before its last epoch.
    """

    rows: list[dict[str, float]]
    folder: Path | None
    interrupted: bool = False
    stopped: bool = False

    @property
    def successes(self) -> list[float]:
        """Success rate of each run in the last evaluation; empty if there was none."""
        return last_success(self.rows) if self.rows else []

    @property
    def reached(self) -> float:
        """Share of goals achieved at some step in the last evaluation, the median of the runs."""
        last = self.rows[-len(self.successes) :]
        return statistics.median(row.get("reached", row["success"]) for row in last) if last else 0.0

    @property
    def success(self) -> float:
        """Success rate in the last evaluation, the median of the runs; 0 if there was none."""
        return statistics.median(self.successes) if self.rows else 0.0


def last_success(rows: list[dict[str, float]]) -> list[float]:
    """Success of each run in the last evaluation."""
    return [row["success"] for row in rows if row["epoch"] == rows[-1]["epoch"]]


def run(
    components: Components,
    folder: str | Path | None = None,
    *,
    callbacks: Sequence[Callback] = (),
    progress: bool = True,
) -> RunResult:
    """Trains for as many epochs as the recipe says.

    Args:
        components: from :func:`~torchrl_her_recipes.build`; you may have replaced some of them.
        folder: where the run writes its files; None writes nothing.
        callbacks: called on the way; they may stop the run.
        progress: whether to show a progress bar, or a line for each epoch where there is no terminal.

    Raises:
        ValueError: the folder holds a run already, or a logger cannot begin.
        ImportError: a logger's package is not installed.

    Example:
        >>> from torchrl_her_recipes import EarlyStopping, build, make_recipe
        >>> recipe = make_recipe(task="hand_v0", epochs=3, epoch_frames=320, num_envs=8, episodes=2)
        >>> result = run(build(recipe), callbacks=[EarlyStopping("frames", at_least=640)], progress=False)
        >>> result.stopped, [row["frames"] for row in result.rows]
        (True, [320, 640])
    """
    home, trainer = None if folder is None else RunFolder(folder), components.trainer()
    if home is not None:
        check_installed(components.recipe.run.log)
    with torch.random.fork_rng(devices=[]), ExitStack() as stack:
        # Losses and policies of TorchRL draw from torch's own generator.
        torch.manual_seed(components.recipe.run.seed)
        if home is not None:
            home.create()
            stack.enter_context(home.at_work())
            # Before config.yaml: a folder that has one can be resumed.
            _save(components, trainer, home, BestPolicy())
            home.describe(components.recipe)
        return _run(components, trainer, home, [], BestPolicy(), callbacks, progress=progress)


def resume(
    folder: str | Path,
    *,
    components: Components | None = None,
    options: Mapping[str, Any] | None = None,
    callbacks: Sequence[Callback] = (),
    progress: bool = True,
) -> RunResult:
    """Continues a run from its newest complete checkpoint, or extends one that has ended.

    A finished run can be given more epochs only if its recipe said ``keep_buffer=True``. Otherwise its
    checkpoint has no replay buffer any more, and all that is made again are its pictures and its policy.

    With the tasks of this library the result is bit for bit that of a run that never stopped. With
    environments of gymnasium and your own it is if the run stopped between two epochs: they are seeded anew
    in each epoch. After a stop within an epoch, the rest of that epoch consists of new episodes. An
    environment must draw from the generator that it seeds alone, and begin episodes without earlier state.

    Args:
        folder: of the run.
        components: newly made ones, if those of the run were not the ones of its recipe.
        options: other values of ``epochs``, ``checkpoint_interval``, ``keep_checkpoints``, ``keep_buffer``,
            ``pictures`` or ``log``, which are written into the folder's configuration.
        callbacks: called on the way; they may stop the run. Those of its beginning are not remembered.
        progress: whether to show a progress bar, or a line for each epoch where there is no terminal.

    Raises:
        ValueError: there is no run in the folder, no checkpoint is complete, there is no replay buffer to go
            on with, an option would change what was trained, fewer epochs are asked for than were done, both
            options and components are given, or the components differ from those of the run.
    """
    home = RunFolder(folder)
    home.recipe()  # before a lock is left in a folder that is none of a run
    if options and components is not None:
        raise ValueError("give resume() options, or components that were made with them, not both")
    with home.at_work():
        return _resume(home, components, options or {}, callbacks, progress=progress)


def _resume(
    home: RunFolder,
    components: Components | None,
    options: Mapping[str, Any],
    callbacks: Sequence[Callback],
    *,
    progress: bool,
) -> RunResult:
    recipe = home.recipe()
    try:
        state = load_newest_checkpoint(home.checkpoint, keep=recipe.run.keep_checkpoints)
    except FileNotFoundError:
        raise ValueError(f"the run in {home.path} cannot go on: {home.checkpoint.name} is missing") from None
    wanted = recipe.extended(**options) if options else recipe
    check_installed(wanted.run.log)
    has_buffer = bool(state["buffer"])
    if not has_buffer:
        _check_needs_no_buffer(home, wanted if components is None else components.recipe, state)
    components = components or build(wanted)
    trainer = components.trainer()
    with torch.random.fork_rng(devices=[]):
        with naming(home.checkpoint, "is not of this run"):
            load_run_state(components, trainer, state)
        if options:
            if trainer.epochs > components.recipe.run.epochs:
                raise ValueError(
                    f"epochs must be at least {trainer.epochs}, as many as the run in {home.path} has done, "
                    f"got {components.recipe.run.epochs}"
                )
            home.describe(components.recipe)
        home.policy.unlink(missing_ok=True)  # of an earlier stop: it comes last, when the run has ended
        rows = home.rows()[
            : trainer.epochs * components.recipe.run.num_runs
        ]  # without those that are newer than the checkpoint
        best = BestPolicy(state["best"])
        if best.state is None:
            home.best.unlink(missing_ok=True)  # newer than the checkpoint
        else:
            _save_best(best, trainer, home)
        return _run(
            components, trainer, home, rows, best, callbacks, has_buffer=has_buffer, progress=progress
        )


def _check_needs_no_buffer(home: RunFolder, recipe: Recipe, state: dict[str, Any]) -> None:
    """Refuses to train on without the replay buffer, or to keep one that is lost."""
    done = state["trainer"]["epochs"]
    if recipe.run.epochs > done or recipe.run.keep_buffer:
        raise ValueError(
            f"the run in {home.path} cannot go on after its {done} epochs: its checkpoint has no replay "
            "buffer; only runs that are trained with keep_buffer=true keep it when they have finished"
        )


def _run(
    components: Components,
    trainer: Trainer,
    home: RunFolder | None,
    rows: list[dict[str, float]],
    best: BestPolicy,
    callbacks: Sequence[Callback],
    *,
    progress: bool,
    has_buffer: bool = True,
) -> RunResult:
    recipe = components.recipe
    loggers = [] if home is None else [LogByName(name) for name in recipe.run.log]
    hooks, view = [*callbacks, *loggers], RunView(components, trainer, rows, home)
    threads = torch.get_num_threads()
    torch.set_num_threads(recipe.run.threads)
    torch.set_flush_denormal(True)  # Adam's moments of unused weights become denormal, ten times as slow
    shown = Progress(recipe, trainer, show=progress)
    interrupted = stopped = saved = False
    with soft_interrupt() as check, ExitStack() as opened:  # also while things are saved at the end
        for logger in loggers:
            opened.callback(logger.close)

        def between_batches() -> None:
            check()
            wanted = [own.on_batch(view) for own in hooks]  # of all of them, also after a True
            if any(wanted):
                raise Stopped

        try:
            for own in hooks:
                own.on_start(view)
            while trainer.epochs < recipe.run.epochs and not stopped:
                seconds = rows[-1]["seconds"] if rows else 0.0
                rows += _epoch(components, trainer, shown, between_batches, seconds, best)
                asked = [own.on_epoch(view) for own in hooks]
                stopped = any(asked)
                for line in notices(rows, recipe, components.bounds):
                    shown.say(line)
                if home is not None:
                    with _despite_a_full_disk("table", trainer):
                        home.write_table(rows)
                    _save_best(best, trainer, home)
                    saved = trainer.epochs % recipe.run.checkpoint_interval == 0 and _save_all(
                        components, trainer, home, best
                    )
        except Interrupted:
            interrupted, saved = True, False
        except Stopped:
            stopped, saved = True, False
        finally:
            shown.close()
            components.close()
            torch.set_num_threads(threads)
            torch.set_flush_denormal(False)
        if home is not None:
            if not saved:
                (_save_all if has_buffer else _save)(components, trainer, home, best)
            _finish(components, trainer, rows, home, has_buffer)
        for own in hooks:
            own.on_end(view)
    return RunResult(
        rows=rows,
        folder=None if home is None else home.path,
        interrupted=interrupted,
        stopped=stopped and trainer.epochs < recipe.run.epochs,
    )


def _epoch(
    components: Components,
    trainer: Trainer,
    shown: Progress,
    between_batches: Callable[[], None],
    seconds: float,
    best: BestPolicy,
) -> list[dict[str, float]]:
    """One epoch and its evaluation, as rows of the table: one for each run."""

    def on_batch(_trainer: Trainer) -> None:
        shown.batch()
        between_batches()

    began = time.perf_counter()
    seed_epoch(components, trainer)
    measured = trainer.epoch(on_batch)
    rollout = play_greedily(components, components.eval_env, trainer.epochs)
    measured |= measure(components, rollout) | at_virtual_goals(components, trainer.epochs)
    samples = (
        None
        if components.curriculum is None
        else layer_success(components, components.curriculum, rollout, trainer.epochs)
    )
    if samples is not None:
        measured["layer_success"] = samples.mean(1)
    seconds += time.perf_counter() - began
    rows = []
    for run, seed in enumerate(components.recipe.seeds):
        counters = {"run": run, "seed": seed, "epoch": trainer.epochs, "frames": trainer.frames}
        times = {"updates": trainer.updates, "seconds": seconds}
        values = {name: float(value[run]) for name, value in measured.items()}
        if components.curriculum is not None:
            progress = components.curriculum.progress
            values["mean_layer" if progress.by_episode else "layer"] = progress.mean_layer(run)
        rows.append({**counters, **times, **values, **written(components, run)})
    best.see(rows, components.greedy)  # before a new layer changes it
    if components.curriculum is not None and samples is not None:
        for line in move_on(components, components.curriculum, samples, trainer.frames):
            shown.say(line)
    shown.epoch(rows)
    return rows


def _save_all(components: Components, trainer: Trainer, home: RunFolder, best: BestPolicy) -> bool:
    """Writes the histogram of virtual goals and then a checkpoint; returns whether it could write the latter.

    In this order, since the last checkpoint has no buffer to make the histogram of.
    """
    with _despite_a_full_disk("map of goals", trainer):
        _save_goals(components, home)
    return _save(components, trainer, home, best)


def _save(components: Components, trainer: Trainer, home: RunFolder, best: BestPolicy) -> bool:
    """Writes a checkpoint; returns whether it could. That of the last epoch is without the replay buffer."""
    buffer = components.recipe.run.keep_buffer or not _has_ended(components, trainer)
    state = run_state(components, trainer, buffer=buffer) | {"best": best.state}
    with _despite_a_full_disk("checkpoint", trainer):
        save_checkpoint(state, home.checkpoint, keep=components.recipe.run.keep_checkpoints)
        return True
    return False


def _has_ended(components: Components, trainer: Trainer) -> bool:
    """Whether the last epoch is done."""
    return trainer.epochs >= components.recipe.run.epochs


def _save_best(best: BestPolicy, trainer: Trainer, home: RunFolder) -> None:
    """Writes the best policy if there is a new one."""
    if best.state is not None and best.is_new:
        with _despite_a_full_disk("best policy", trainer):
            described = {name: best.state[name] for name in ("epoch", "success")}
            write_policy(home.best, best.state["actor"], described)
            home.describe_best(best.state["epoch"], best.state["success"])
            best.is_new = False


@contextmanager
def _despite_a_full_disk(what: str, trainer: Trainer) -> Iterator[None]:
    """Turns a failure to write a file into a warning: the run goes on, and the next epoch tries again."""
    try:
        yield
    except OSError as error:
        warnings.warn(f"no {what} after {trainer.frames:,} frames, the run goes on: {error}", stacklevel=4)


def _finish(
    components: Components, trainer: Trainer, rows: list[dict[str, float]], home: RunFolder, has_buffer: bool
) -> None:
    """Draws the pictures and then writes the policy, whose file tells that the run has ended.

    Raises:
        OSError: a file cannot be written; the message says which are missing.
    """
    try:
        goals = None
        if has_buffer:
            goals = _save_goals(components, home)
        elif home.goal_map.is_file():  # written when the run still had its buffer
            goals = GoalMap.load(home.goal_map)
        if components.recipe.run.pictures:
            _draw(components, rows, goals, home)
        write_policy(home.policy, components.greedy.state_dict(), {})
        if _has_ended(components, trainer):
            for path in home.older_checkpoints:
                path.unlink(missing_ok=True)
    except OSError as error:
        expected = [home.curves, home.video] if components.recipe.run.pictures else []
        missing = [path.name for path in (*expected, home.policy) if not path.is_file()]
        why = (error.strerror or str(error)).lower()
        raise OSError(
            f"cannot write {error.filename or ' or '.join(missing)}: {why}; "
            f"{', '.join(missing)} will be written by: torchrl-her train --resume {home.path}"
        ) from error


def _draw(
    components: Components, rows: list[dict[str, float]], goals: GoalMap | None, home: RunFolder
) -> None:
    recipe = components.recipe
    title = f"{recipe.task.name}, {recipe.hindsight.algo}, " + (
        f"seed {recipe.run.seed}" if recipe.run.num_runs == 1 else f"{recipe.run.num_runs} runs"
    )
    if rows:
        plot_curves(rows, home.curves, title=title)
    task = goal_env(components.env)
    if goals is not None and goals.target.ndim == 2 and task.goal_box() is not None:
        plot_goals(goals, task, home.goals, title=f"virtual goals: {title}")
    run, epoch = (median_run(rows), int(rows[-1]["epoch"])) if rows else (0, 0)
    film_policy(components, home.video, run=run, epoch=epoch)


def median_run(rows: list[dict[str, float]]) -> int:
    """The index of the run with the median success in the last evaluation."""
    values = last_success(rows)
    return sorted(range(len(values)), key=values.__getitem__)[len(values) // 2]


def _save_goals(components: Components, home: RunFolder) -> GoalMap | None:
    """Writes the histogram of virtual goals, if there is one."""
    goals = goal_map(components.buffer, components.goal_target)
    if goals is not None:
        goals.save(home.goal_map)
    return goals
