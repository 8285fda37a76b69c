"""One run from beginning to end: train, evaluate, record, checkpoint, and go on from there."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tqdm import tqdm

from torchrl_her import (
    HERWriter,
    Trainer,
    buffer_state_dict,
    discounted_return,
    evaluate,
    final_distance,
    load_buffer_state_dict,
    load_checkpoint,
    q_bias,
    save_checkpoint,
    success,
)
from torchrl_her_envs import ThrowingEnv, record_episodes, write_video
from torchrl_her_recipes.interrupt import Interrupted, soft_interrupt
from torchrl_her_recipes.parts import Parts, build_parts, eval_seed
from torchrl_her_recipes.plots import plot_curves, plot_goals
from torchrl_her_recipes.run_folder import RunFolder

logger = logging.getLogger(__name__)
_SATURATED = 0.99


@dataclass(frozen=True)
class RunResult:
    """What came of a run.

    Attributes:
        rows: the table of metrics, one row an epoch.
        folder: where all of it is, or None.
        interrupted: whether somebody stopped it.
    """

    rows: list[dict[str, float]]
    folder: Path | None
    interrupted: bool = False

    @property
    def success(self) -> float:
        """Success rate of the last evaluation; 0 if there was none."""
        return self.rows[-1]["success"] if self.rows else 0.0


def run(parts: Parts, folder: str | Path | None = None, *, progress: bool = True) -> RunResult:
    """Trains the given parts to the end of their recipe; see :meth:`Parts.run`."""
    home = None if folder is None else RunFolder(folder)
    if home is not None:
        home.describe(parts.recipe)
    return _run(parts, parts.trainer(), home, progress=progress)


def resume(folder: str | Path, *, progress: bool = True) -> RunResult:
    """Goes on with a run from its checkpoint, as if it had never stopped.

    Raises:
        ValueError: there is no run in the folder, or its checkpoint is damaged.
        OSError: there is no checkpoint yet.
    """
    home = RunFolder(folder)
    parts = build_parts(home.recipe())
    trainer = parts.trainer()
    load_run_state(parts, trainer, load_checkpoint(home.checkpoint))
    home.keep_rows(trainer.epochs)
    return _run(parts, trainer, home, progress=progress)


def run_state(parts: Parts, trainer: Trainer) -> dict[str, Any]:
    """All that a run is, as tensors and plain data."""
    return {
        "recipe": asdict(parts.recipe),
        "trainer": trainer.state_dict(),
        "loss": dict(parts.loss.state_dict()),
        "optimiser": parts.optimiser.state_dict(),
        "exploration": dict(parts.exploration.state_dict()),
        "buffer": buffer_state_dict(parts.buffer),
        "generator": parts.generator.get_state(),
        "worlds": parts.env.world_state_dict() if isinstance(parts.env, ThrowingEnv) else None,
        "trajectories": parts.collector.state_dict().get("traj_pool"),
    }


def load_run_state(parts: Parts, trainer: Trainer, state: dict[str, Any]) -> None:
    """Puts freshly built parts where :func:`run_state` was taken."""
    parts.loss.load_state_dict(state["loss"])
    parts.optimiser.load_state_dict(state["optimiser"])
    parts.exploration.load_state_dict(state["exploration"])
    load_buffer_state_dict(parts.buffer, state["buffer"])
    parts.generator.set_state(state["generator"])
    if state["worlds"] is not None and isinstance(parts.env, ThrowingEnv):
        parts.env.load_world_state_dict(state["worlds"])
    parts.collector.load_state_dict({**parts.collector.state_dict(), "traj_pool": state["trajectories"]})
    trainer.load_state_dict(state["trainer"])


def _run(parts: Parts, trainer: Trainer, home: RunFolder | None, *, progress: bool) -> RunResult:
    recipe = parts.recipe
    rows = home.rows() if home is not None else []
    threads = torch.get_num_threads()
    torch.set_num_threads(recipe.threads)
    bar = tqdm(total=recipe.total_frames, initial=trainer.frames, unit=" frames", disable=not progress)
    interrupted = False
    try:
        with soft_interrupt() as check:
            while trainer.epochs < recipe.epochs:
                rows.append(_epoch(parts, trainer, bar, check, rows[-1]["seconds"] if rows else 0.0))
                if home is not None:
                    home.log(rows[-1])
                    if trainer.epochs % recipe.checkpoint_interval == 0:
                        save_checkpoint(run_state(parts, trainer), home.checkpoint)
    except Interrupted:
        interrupted = True
    finally:
        bar.close()
        torch.set_num_threads(threads)
    if home is not None:
        _finish(parts, trainer, rows, home)
    return RunResult(rows=rows, folder=None if home is None else home.path, interrupted=interrupted)


def _epoch(
    parts: Parts, trainer: Trainer, bar: tqdm, check: Callable[[], None], seconds: float
) -> dict[str, float]:
    """One epoch and its evaluation, as a row of the table."""

    def on_batch(trainer: Trainer) -> None:
        bar.update(trainer.frames - bar.n)
        check()

    began = time.perf_counter()
    measured = trainer.epoch(on_batch)
    row = _evaluate(parts, trainer)
    row["seconds"] = seconds + time.perf_counter() - began
    bar.set_postfix(updates=trainer.updates, success=f"{row['success']:.2f}")
    return {**row, **measured}


def _evaluate(parts: Parts, trainer: Trainer) -> dict[str, float]:
    recipe = parts.recipe
    parts.eval_env.set_seed(eval_seed(recipe, trainer.epochs))
    rollout = evaluate(parts.eval_env, parts.policy, max_steps=_max_steps(parts))
    row: dict[str, float] = {
        "epoch": trainer.epochs,
        "frames": trainer.frames,
        "updates": trainer.updates,
        "success": float(success(rollout).float().mean()),
        "distance": float(final_distance(rollout).mean()),
        "saturation": float((rollout["action"].abs() > _SATURATED).float().mean()),
        "epsilon": float(parts.exploration.epsilon),
        **_values(parts, rollout),
    }
    if isinstance(parts.buffer.writer, HERWriter):
        row.update({f"rows_{name}": value for name, value in asdict(parts.buffer.writer.counts).items()})
    return row


@torch.no_grad()
def _values(parts: Parts, rollout: TensorDictBase) -> dict[str, float]:
    returns = discounted_return(rollout, parts.recipe.gamma)
    values = {"return": float(returns.mean())}
    if parts.critic is not None:
        start = rollout[:, 0].select("observation", "desired_goal")
        parts.critic.eval()
        value = parts.critic(parts.actor(start)).get(parts.critic.out_keys[0])
        parts.critic.train()
        values |= {"q": float(value.mean()), "q_bias": float(q_bias(value, returns).mean())}
    return values


def _max_steps(parts: Parts) -> int:
    return parts.eval_env.world.max_steps


def _finish(parts: Parts, trainer: Trainer, rows: list[dict[str, float]], home: RunFolder) -> None:
    """Leaves behind what people want to look at."""
    save_checkpoint(run_state(parts, trainer), home.checkpoint)
    save_checkpoint({"actor": dict(parts.actor.state_dict())}, home.policy)
    home.close()
    title = f"{parts.recipe.task}, {parts.recipe.algo}, seed {parts.recipe.seed}"
    if rows:
        plot_curves(rows, home.curves, title=title)
    goals = virtual_goals(parts)
    if len(goals):
        plot_goals(goals, parts.env, home.goals, title=f"virtual goals: {title}")
    write_video(record_episodes(parts.eval_env, parts.policy, worlds=range(min(6, parts.recipe.eval_episodes))), home.video)


def virtual_goals(parts: Parts) -> torch.Tensor:
    """The goals [n, 2] of all virtual rows in the buffer."""
    if not len(parts.buffer):
        return torch.empty(0, 2)
    rows = parts.buffer[:]
    return rows["desired_goal"][rows["virtual"].squeeze(-1)]
