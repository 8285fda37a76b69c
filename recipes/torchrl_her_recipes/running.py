"""One run from beginning to end: train, evaluate, record, checkpoint, and go on from there."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from tqdm import tqdm

from torchrl_her import (
    FusedDDPGLearner,
    GoalHistogram,
    HERWriter,
    Trainer,
    buffer_state_dict,
    discounted_return,
    final_distance,
    load_buffer_state_dict,
    load_checkpoint,
    q_bias,
    save_checkpoint,
    set_layer_goals,
    success,
)
from torchrl_her_envs import ThrowingEnv, base_env, record_episodes, write_video
from torchrl_her_recipes.climbing import layer_success, move_on, play_greedily
from torchrl_her_recipes.goal_map import GoalMap, goal_map
from torchrl_her_recipes.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.parts import Parts, build_parts
from torchrl_her_recipes.plots import plot_curves, plot_goals
from torchrl_her_recipes.run_folder import RunFolder

_SATURATED = 0.99
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
    home = None if folder is None else RunFolder(folder)
    if home is not None:
        home.describe(parts.recipe)
    return _run(parts, parts.trainer(), home, [], progress=progress)


def resume(folder: str | Path, *, parts: Parts | None = None, progress: bool = True) -> RunResult:
    """Goes on with a run from its checkpoint.

    From a checkpoint between two epochs, as if it had never stopped: bit for bit. After Ctrl-C in the
    middle of an epoch the rest of it is made up with fresh episodes.

    Args:
        folder: of the run.
        parts: freshly built ones, if the run's were not those of its recipe.
        progress: whether to show a progress bar.

    Raises:
        ValueError: there is no run in the folder, its checkpoint is damaged, or the parts are others.
        OSError: there is no checkpoint yet.
    """
    home = RunFolder(folder)
    parts = parts or build_parts(home.recipe())
    trainer = parts.trainer()
    load_run_state(parts, trainer, load_checkpoint(home.checkpoint))
    rows = home.rows()[: trainer.epochs * parts.recipe.num_runs]  # not those behind the checkpoint
    return _run(parts, trainer, home, rows, progress=progress)


def run_state(parts: Parts, trainer: Trainer) -> dict[str, Any]:
    """All that a run is, as tensors and plain data."""
    return {
        "recipe": asdict(parts.recipe),
        "made_of": _made_of(parts),
        "trainer": trainer.state_dict(),
        "loss": dict(parts.loss.state_dict()),
        "optimiser": parts.optimiser.state_dict(),
        "exploration": dict(parts.exploration.state_dict()),
        "buffers": [buffer_state_dict(buffer) for buffer in parts.buffers],
        "generators": [generator.get_state() for generator in parts.generators],
        "worlds": None if (worlds := _worlds(parts)) is None else worlds.world_state_dict(),
        "progress": None if parts.climb is None else parts.climb.progress.state_dict(),
        "trajectories": parts.collector.state_dict().get("traj_pool"),
    }


def load_run_state(parts: Parts, trainer: Trainer, state: dict[str, Any]) -> None:
    """Puts freshly built parts where :func:`run_state` was taken.

    Raises:
        ValueError: the parts are of other types or have other settings than those of the run.
    """
    for name, value in _made_of(parts).items():
        if value != state["made_of"][name]:
            was = state["made_of"][name]
            raise ValueError(f"the run's {name} was {was}, not {value}: give resume() parts made as its were")
    parts.loss.load_state_dict(state["loss"])
    parts.optimiser.load_state_dict(state["optimiser"])
    parts.exploration.load_state_dict(state["exploration"])
    for buffer, own in zip(parts.buffers, state["buffers"], strict=True):
        load_buffer_state_dict(buffer, own)
    for generator, own in zip(parts.generators, state["generators"], strict=True):
        generator.set_state(own)
    if state["worlds"] is not None and (worlds := _worlds(parts)) is not None:
        worlds.load_world_state_dict(state["worlds"])
    if parts.climb is not None:
        parts.climb.progress.load_state_dict(state["progress"])
        for run, buffer in enumerate(parts.buffers):
            set_layer_goals(buffer.writer, parts.climb.progress.layer_of(run))
    parts.collector.load_state_dict({**parts.collector.state_dict(), "traj_pool": state["trajectories"]})
    trainer.load_state_dict(state["trainer"])


def _worlds(parts: Parts) -> ThrowingEnv | None:
    """The environment below all transforms, if it is one of ours."""
    try:
        return base_env(parts.env)
    except TypeError:
        return None


def _made_of(parts: Parts) -> dict[str, str]:
    """What must be the same for a run to go on."""
    writer = parts.buffer.writer
    hindsight: list[object] = []
    if isinstance(writer, HERWriter):
        hindsight = [writer.k, writer.strategy, writer.filter_achieved, type(writer.weights).__name__]
    names = {
        name: type(getattr(parts, name)).__name__
        for name in ("actor", "critic", "loss", "optimiser", "target")
    }
    return names | {
        "writer": " ".join(map(str, [type(writer).__name__, *hindsight])),
        "sampler": type(parts.buffer.sampler).__name__,
    }


def _run(
    parts: Parts, trainer: Trainer, home: RunFolder | None, rows: list[dict[str, float]], *, progress: bool
) -> RunResult:
    recipe = parts.recipe
    threads = torch.get_num_threads()
    torch.set_num_threads(recipe.threads)
    torch.set_flush_denormal(
        True
    )  # moments of unused weights fade to such numbers, which take ten times as long
    bar = tqdm(total=recipe.total_frames, initial=trainer.frames, unit="frames", disable=not progress)
    interrupted = compiled = False
    with soft_interrupt() as check:  # also while things are saved at the end
        try:
            while trainer.epochs < recipe.epochs:
                new = _epoch(parts, trainer, bar, check, rows[-1]["seconds"] if rows else 0.0)
                rows += new
                compiled = compiled or _say_compiled(trainer, bar)
                if home is not None:
                    home.log(rows, len(new))
                    if trainer.epochs % recipe.checkpoint_interval == 0:
                        save_checkpoint(run_state(parts, trainer), home.checkpoint)
                        _save_goals(parts, home)
        except Interrupted:
            interrupted = True
        finally:
            bar.close()
            torch.set_num_threads(threads)
            torch.set_flush_denormal(False)
        if home is not None:
            _finish(parts, trainer, rows, home)
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
    measured |= _measure(parts, rollout)
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
        rows.append({**counters, **times, **values, **_written(parts, run)})
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


@torch.no_grad()
def _measure(parts: Parts, rollout: TensorDictBase) -> dict[str, Tensor]:
    """What greedy episodes of each run show, [R] each."""
    recipe = parts.recipe
    returns = discounted_return(rollout, recipe.gamma)
    measured = {
        "success": success(rollout).float(),
        "distance": final_distance(rollout),
        "return": returns,
        "saturation": (rollout["action"].abs() > _SATURATED).float().mean((1, 2)),
    }
    if parts.critic is not None:
        value = _initial_value(parts.actor, parts.critic, rollout[:, 0])
        measured |= {"q": value, "q_bias": q_bias(value, returns)}
    means = {name: value.view(recipe.num_runs, -1).mean(1) for name, value in measured.items()}
    return means | {"epsilon": parts.exploration.epsilon}


def _initial_value(actor: TensorDictModule, critic: TensorDictModule, start: TensorDictBase) -> Tensor:
    """The critic's value [N] of first states [N]."""
    critic.eval()
    value = critic(actor(start.select(*actor.in_keys))).get(critic.out_keys[0])
    critic.train()
    return value.squeeze(-1)


def _written(parts: Parts, run: int) -> dict[str, float]:
    """What the writer of one run has counted."""
    writer = parts.buffers[run].writer
    if not isinstance(writer, HERWriter):
        return {}
    counts = {f"rows_{name}": value for name, value in asdict(writer.totals).items()}
    if isinstance(writer.weights, GoalHistogram):
        # q* is that of the full task
        full = parts.climb is None or parts.climb.at_the_top(run)
        counts["kl"] = writer.weights.divergence_to(parts.goal_target) if full else math.nan
    return counts


def _finish(parts: Parts, trainer: Trainer, rows: list[dict[str, float]], home: RunFolder) -> None:
    """Leaves behind what people want to look at."""
    recipe = parts.recipe
    save_checkpoint(run_state(parts, trainer), home.checkpoint)
    save_checkpoint({"actor": dict(parts.actor.state_dict())}, home.policy)
    home.close()
    title = f"{recipe.task}, {recipe.algo}, " + (
        f"seed {recipe.seed}" if recipe.num_runs == 1 else f"{recipe.num_runs} runs"
    )
    if rows:
        plot_curves(rows, home.curves, title=title)
    goals = _save_goals(parts, home)
    if goals is not None:
        plot_goals(goals, base_env(parts.env), home.goals, title=f"virtual goals: {title}")
    first = recipe.eval_episodes * (_median_run(rows) if rows else 0)
    worlds = range(first, first + min(_FILMED, recipe.eval_episodes))
    write_video(record_episodes(parts.eval_env, parts.policy, worlds=worlds), home.video, fps=FPS)


def _median_run(rows: list[dict[str, float]]) -> int:
    """The run in the middle of the last evaluation."""
    values = last_success(rows)
    return sorted(range(len(values)), key=values.__getitem__)[len(values) // 2]


def _save_goals(parts: Parts, home: RunFolder) -> GoalMap | None:
    """A snapshot of where virtual goals were written."""
    goals = goal_map(parts.buffers, parts.goal_target)
    if goals is not None:
        goals.save(home.goal_map)
    return goals
