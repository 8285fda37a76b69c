"""One run from beginning to end: train, evaluate, record, checkpoint, and go on from there."""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from tqdm import tqdm

from torchrl_her import FusedDDPGLearner, Trainer, load_newest_checkpoint, save_checkpoint
from torchrl_her_envs import ThrowingEnv, base_env, goal_env, record_episodes, write_video
from torchrl_her_recipes.climbing import layer_success, move_on, play_greedily
from torchrl_her_recipes.goal_map import GoalMap, goal_map
from torchrl_her_recipes.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.measuring import measure, written
from torchrl_her_recipes.parts import Parts, build_parts
from torchrl_her_recipes.plots import plot_curves, plot_goals
from torchrl_her_recipes.run_folder import RunFolder
from torchrl_her_recipes.run_state import load_run_state, run_state

FPS = 12  # of films: half the true speed, as a throw takes half a second
_FILMED = 6  # worlds in the GIF at the end of a run


@dataclass(frozen=True)
class RunResult:
    """What came of a run, or of several side by side.

    Attributes:
        rows: the table of metrics, one row an epoch and run.
        folder: where all of it is, or None.
        interrupted: whether somebody stopped it.
    """

    rows: list[dict[str, float]]
    folder: Path | None
    interrupted: bool = False

    @property
    def success(self) -> float:
        """Success rate in the last evaluation, the median of the runs; 0 if there was none."""
        return statistics.median(last_success(self.rows)) if self.rows else 0.0


def last_success(rows: list[dict[str, float]]) -> list[float]:
    """Success of each run in the last evaluation."""
    return [row["success"] for row in rows if row["epoch"] == rows[-1]["epoch"]]


def run(parts: Parts, folder: str | Path | None = None, *, progress: bool = True) -> RunResult:
    """Trains the given parts to the end of their recipe; see :meth:`Parts.run`."""
    home, trainer = None if folder is None else RunFolder(folder), parts.trainer()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(parts.recipe.seed)  # losses and policies of TorchRL draw from torch's own generator
        if home is not None:
            home.create()
            _save(parts, trainer, home)  # before its configuration: a folder that has one can be resumed
            home.describe(parts.recipe)
        return _run(parts, trainer, home, [], progress=progress)


def resume(folder: str | Path, *, parts: Parts | None = None, progress: bool = True) -> RunResult:
    """Goes on with a run from its newest whole checkpoint, bit for bit as if it had never stopped.

    So it is with the tasks of this library. An environment of your own must keep nothing to itself
    from epoch to epoch; after Ctrl-C in the middle of one, the rest of it is made up with fresh episodes.

    Args:
        folder: of the run.
        parts: freshly built ones, if the run's were not those of its recipe.
        progress: whether to show a progress bar.

    Raises:
        ValueError: there is no run in the folder, no checkpoint is whole, or the parts are others.
        OSError: there is no checkpoint.
    """
    home = RunFolder(folder)
    parts = parts or build_parts(home.recipe())
    trainer = parts.trainer()
    state = load_newest_checkpoint(home.checkpoint, keep=parts.recipe.keep_checkpoints)
    with torch.random.fork_rng(devices=[]):
        load_run_state(parts, trainer, state)
        home.policy.unlink(missing_ok=True)  # of an earlier stop: it comes last, when the run has ended
        rows = home.rows()[: trainer.epochs * parts.recipe.num_runs]  # not those behind the checkpoint
        return _run(parts, trainer, home, rows, progress=progress)


def _run(
    parts: Parts, trainer: Trainer, home: RunFolder | None, rows: list[dict[str, float]], *, progress: bool
) -> RunResult:
    recipe = parts.recipe
    threads = torch.get_num_threads()
    torch.set_num_threads(recipe.threads)
    torch.set_flush_denormal(True)  # moments of unused weights fade to numbers that take ten times as long
    bar = tqdm(total=recipe.total_frames, initial=trainer.frames, unit="frames", disable=not progress)
    interrupted = compiled = saved = False
    unlogged = 0  # rows that are not on the disk yet
    with soft_interrupt() as check:  # also while things are saved at the end
        try:
            while trainer.epochs < recipe.epochs:
                new = _epoch(parts, trainer, bar, check, rows[-1]["seconds"] if rows else 0.0)
                rows += new
                compiled = compiled or _say_compiled(trainer, bar)
                if home is not None:
                    unlogged += len(new)
                    with _whatever_the_disk_does("table", trainer):
                        home.log(rows, unlogged)
                        unlogged = 0
                    saved = trainer.epochs % recipe.checkpoint_interval == 0 and _save(parts, trainer, home)
                    if saved:
                        with _whatever_the_disk_does("map of goals", trainer):
                            _save_goals(parts, home)
        except Interrupted:
            interrupted, saved = True, False
        finally:
            bar.close()
            torch.set_num_threads(threads)
            torch.set_flush_denormal(False)
        if home is not None:
            if not saved:
                _save(parts, trainer, home)
            _finish(parts, rows, home)
    return RunResult(rows=rows, folder=None if home is None else home.path, interrupted=interrupted)


def _epoch(
    parts: Parts, trainer: Trainer, bar: tqdm, check: Callable[[], None], seconds: float
) -> list[dict[str, float]]:
    """One epoch and its evaluation, as rows of the table: one for each run."""

    def on_batch(trainer: Trainer) -> None:
        bar.set_description_str(f"{trainer.updates} updates", refresh=False)
        bar.update(trainer.frames - bar.n)
        check()

    began = time.perf_counter()
    measured = trainer.epoch(on_batch)
    rollout = play_greedily(parts, parts.eval_env, trainer.epochs)
    measured |= measure(parts, rollout)
    samples = None if parts.climb is None else layer_success(parts, parts.climb, rollout, trainer.epochs)
    if samples is not None:
        measured["layer_success"] = samples.mean(1)
    seconds += time.perf_counter() - began
    rows = []
    for run, seed in enumerate(parts.recipe.seeds):
        counters = {"run": run, "seed": seed, "epoch": trainer.epochs, "frames": trainer.frames}
        times = {"updates": trainer.updates, "seconds": seconds}
        values = {name: float(value[run]) for name, value in measured.items()}
        if parts.climb is not None:
            values["layer"] = parts.climb.progress.layers[run]
        rows.append({**counters, **times, **values, **written(parts, run)})
    if parts.climb is not None and samples is not None:
        for line in move_on(parts, parts.climb, samples, trainer.frames):
            _say(bar, line)
    bar.set_postfix(success=f"{statistics.median(last_success(rows)):.2f}")
    return rows


def _say(bar: tqdm, line: str) -> None:
    """A line above the progress bar, if there is one."""
    if not bar.disable:
        bar.write(line)


def _say_compiled(trainer: Trainer, bar: tqdm) -> bool:
    """A line when the gradient step has been compiled; returns whether it was."""
    learner = trainer.learner
    if not (isinstance(learner, FusedDDPGLearner) and learner.is_compiled):
        return False
    _say(bar, f"gradient step compiled in {learner.compile_seconds:.0f} s (kept for later runs)")
    return True


def _save(parts: Parts, trainer: Trainer, home: RunFolder) -> bool:
    """Writes a checkpoint; returns whether it could."""
    with _whatever_the_disk_does("checkpoint", trainer):
        save_checkpoint(run_state(parts, trainer), home.checkpoint, keep=parts.recipe.keep_checkpoints)
        return True
    return False


@contextmanager
def _whatever_the_disk_does(what: str, trainer: Trainer) -> Iterator[None]:
    """A full disk is no reason to lose the run: what could not be written is said, and comes next time."""
    try:
        yield
    except OSError as error:
        warnings.warn(f"no {what} after {trainer.frames:,} frames, the run goes on: {error}", stacklevel=4)


def _finish(parts: Parts, rows: list[dict[str, float]], home: RunFolder) -> None:
    """Leaves behind what people want to look at, and last of all the policy: then the run has ended."""
    _draw(parts, rows, home)
    save_checkpoint({"actor": dict(parts.actor.state_dict())}, home.policy)


def _draw(parts: Parts, rows: list[dict[str, float]], home: RunFolder) -> None:
    recipe = parts.recipe
    home.close()
    title = f"{recipe.task}, {recipe.algo}, " + (
        f"seed {recipe.seed}" if recipe.num_runs == 1 else f"{recipe.num_runs} runs"
    )
    if rows:
        plot_curves(rows, home.curves, title=title)
    goals = _save_goals(parts, home)
    if not isinstance(goal_env(parts.env), ThrowingEnv):
        return  # there is nothing to draw it on
    if goals is not None:
        plot_goals(goals, base_env(parts.env), home.goals, title=f"virtual goals: {title}")
    first = recipe.eval_episodes * (median_run(rows) if rows else 0)
    worlds = range(first, first + min(_FILMED, recipe.eval_episodes))
    write_video(record_episodes(parts.eval_env, parts.policy, worlds=worlds), home.video, fps=FPS)


def median_run(rows: list[dict[str, float]]) -> int:
    """The run in the middle of the last evaluation."""
    values = last_success(rows)
    return sorted(range(len(values)), key=values.__getitem__)[len(values) // 2]


def _save_goals(parts: Parts, home: RunFolder) -> GoalMap | None:
    """A snapshot of where virtual goals were written."""
    goals = goal_map(parts.buffers, parts.goal_target)
    if goals is not None:
        goals.save(home.goal_map)
    return goals
