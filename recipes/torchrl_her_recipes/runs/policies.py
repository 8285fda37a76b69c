"""Trained policies that come with the package, one for each throwing and reaching task."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her.modules.networks import make_actor, take_run
from torchrl_her.trainers.checkpoint import load_checkpoint, save_checkpoint
from torchrl_her.trainers.metrics import success
from torchrl_her.trainers.trainer import evaluate
from torchrl_her_envs.common.goal_env import goal_env, reward_range
from torchrl_her_recipes.components.curricula import make_curriculum
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.components.normalization import acting, make_norm
from torchrl_her_recipes.config.imports import permit_task
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.shipped import TRAINED, policy_names
from torchrl_her_recipes.runs.kept import KeptPolicy
from torchrl_her_recipes.runs.run import median_run

_KEYS = ("observation", "desired_goal")


@dataclass(frozen=True)
class TrainedPolicy:
    """A greedy policy, and what made it.

    Attributes:
        task: that it is for.
        actor: reads ``observation`` and ``desired_goal``, writes ``action``.
        recipe: of the run; its seed is that of this very policy. Its task may be a harder one.
        success: in 1,000 episodes of its task, with starts and goals that no training has seen.
        frames: environment steps that it was trained for.
    """

    task: str
    actor: TensorDictModuleBase
    recipe: Recipe
    success: float
    frames: int


def load_trained(name: str | Path, *, allow_import: bool = False) -> TrainedPolicy:
    """A policy that comes with the package, or one that was exported, with what made it.

    Nothing is imported here. A policy's task may name a module, however, and its environments can only be
    made where that module may be imported.

    Args:
        name: of a task, or the path of a .pt file.
        allow_import: whether the module that the task may name may be imported, from now on.

    Raises:
        ValueError: there is no such policy, or the file is damaged or holds something else.
    """
    path = TRAINED / f"{name}.pt" if str(name) in policy_names() else Path(name)
    if not path.is_file():
        raise ValueError(f"there is no policy {str(name)!r}; there are {', '.join(policy_names())}")
    state = load_checkpoint(path)
    if not isinstance(state, dict) or "widths" not in state:
        raise ValueError(
            f"{path} is no exported policy: `torchrl-her export RUN` writes one of a run's folder"
        )
    policy = _policy_of(state)
    if allow_import:
        permit_task(policy.task)
    return policy


def check_plays(policy: TrainedPolicy, env: EnvBase, task: str) -> None:
    """Refuses a policy for environments that show or want something else than those of its own task.

    Args:
        policy: the policy.
        env: the environments.
        task: what theirs is called.

    Raises:
        ValueError: they do.
    """
    own = make_task_envs(policy.recipe.replace(task=policy.task), 1, [0])
    if not env.action_spec.dtype.is_floating_point or _widths(own) != _widths(env):
        raise ValueError(f"a policy of {policy.task} cannot play {task}: it has other widths")


def load_policy(
    name: str | Path, *, run: int | None = None, best: bool = False, allow_import: bool = False
) -> TensorDictModuleBase:
    """The greedy policy of a task, trained: reads ``observation`` and ``desired_goal``, writes ``action``.

    Nothing is imported for a file, whatever module its task names: it is weights alone. For a run,
    environments of its task are made.

    Args:
        name: of a task, the path of a .pt file that :func:`export_policy` wrote, or the folder of a run.
        run: which one, of several side by side in a folder; the median of them if None.
        best: whether to take the best policy of the folder: that of the evaluation with the best median
            success.
        allow_import: whether the module that the task of a run may name may be imported.

    Raises:
        ValueError: there is no such policy, it is not one of ``make_actor``, the file is damaged, ``best``
            without the folder of a run, or the run's task names a module that must not be imported.
        OSError: the run has not saved a policy yet.
    """
    kept = KeptPolicy.of(name, best=best)
    if kept is None:
        return load_trained(name).actor
    return _policy_of(_state_of(kept, run, None, allow_import)).actor


def export_policy(
    folder: str | Path,
    out: str | Path,
    *,
    run: int | None = None,
    task: str | None = None,
    best: bool = False,
    allow_import: bool = False,
) -> TrainedPolicy:
    """Writes the policy of a finished run as a small file of its own.

    Args:
        folder: of the run, or ``policy.pt`` or ``best.pt`` in it.
        out: the .pt file.
        run: which one, of several side by side; the median of them if None.
        task: that the policy is for, if not the run's own: one that shows and wants the same.
        best: whether to take the policy of the evaluation with the best median success, not the last.
        allow_import: whether the module that the run's task may name may be imported.

    Returns:
        What was written.

    Raises:
        ValueError: this is no folder of a run, it has no such run, its policy is not one of ``make_actor``,
            it has no best policy, the task is one that it cannot play, or the run's names a module that must
            not be imported.
        OSError: the run has not saved a policy yet.
    """
    kept = KeptPolicy.of(folder, best=best)
    if kept is None:
        raise ValueError(f"{folder} is no folder of a run: it has no config.yaml")
    state = _state_of(kept, run, task, allow_import)
    state["success"] = measure_success(_policy_of(state))
    save_checkpoint(state, out)
    return _policy_of(state)


def _state_of(kept: KeptPolicy, run: int | None, task: str | None, allow_import: bool) -> dict[str, Any]:
    """What the file of an exported policy holds; its success is not measured yet."""
    recipe, rows = kept.home.recipe(), kept.home.rows()
    if not rows:
        raise ValueError(f"the run in {kept.home.path} has not been evaluated yet")
    weights = kept.load()
    rows = [row for row in rows if row["epoch"] <= weights.get("epoch", math.inf)]
    chosen = median_run(rows) if run is None else run
    if chosen not in range(recipe.run.num_runs):
        runs = recipe.run.num_runs
        raise ValueError(f"there is no run {chosen} in {kept.home.path}; it has runs 0 to {runs - 1}")
    for named in (task, recipe.task.name if allow_import else None):
        if named is not None:
            permit_task(named)
    played = recipe.replace(task=task or recipe.task.name)
    env = make_task_envs(recipe, 1, [0])
    widths, actions = _widths(env)
    actor = take_run(weights["actor"], chosen, recipe.run.num_runs)
    state = {
        "task": played.task.name,
        "widths": widths,
        "actions": actions,
        "actor": _as_shown(actor, _seen(recipe, env), sum(widths)),
        "recipe": recipe.replace(num_runs=1, seed=recipe.run.seed + chosen).to_dict(),
        "success": math.nan,
        "frames": int(rows[-1]["frames"]),
    }
    _check_state(recipe, state)
    if task is not None and _widths(make_task_envs(played, 1, [0])) != (widths, actions):
        raise ValueError(
            f"a policy of {recipe.task.name} cannot play {played.task.name}: it has other widths"
        )
    return state


def measure_success(policy: TrainedPolicy, *, episodes: int = 1_000, seed: int = 1 << 41) -> float:
    """The share of greedy episodes in which a policy achieves its goal."""
    env = make_task_envs(policy.recipe.replace(task=policy.task), episodes, [seed])
    rollout = evaluate(env, policy.actor, max_steps=goal_env(env).max_steps)
    achieved = success(rollout, achieved_reward=reward_range(goal_env(env))[1])
    env.close()
    return float(achieved.float().mean())


def _policy_of(state: dict[str, Any]) -> TrainedPolicy:
    recipe = Recipe.from_dict(state["recipe"])
    actor = _actor_of(state, recipe)
    actor.load_state_dict(state["actor"])
    return TrainedPolicy(
        task=state["task"],
        actor=actor.requires_grad_(False),
        recipe=recipe,
        success=state["success"],
        frames=state["frames"],
    )


def _actor_of(state: dict[str, Any], recipe: Recipe) -> TensorDictModuleBase:
    """The actor that the weights are loaded into, with its normalization if there is one."""
    widths = state["widths"]
    actor = make_actor(widths, state["actions"], in_keys=_KEYS, **recipe.learner.actor_shape)
    return acting(actor, make_norm(recipe.replace(num_runs=1), dict(zip(_KEYS, widths, strict=True))))


def _widths(env: EnvBase) -> tuple[list[int], int]:
    """How wide an environment's observation and goal are, and its actions."""
    return [goal_env(env).observation_spec[key].shape[-1] for key in _KEYS], env.action_spec.shape[-1]


def _seen(recipe: Recipe, env: EnvBase) -> tuple[int, ...]:
    """Where each input of a run's policy is in the observation and the desired goal behind it."""
    curriculum = make_curriculum(recipe, env)
    if curriculum is None:
        return tuple(range(sum(_widths(env)[0])))
    last = curriculum.layers[-1]
    return (*last.observation, *last.desired_goal)


def _as_shown(actor: dict[str, Tensor], places: tuple[int, ...], width: int) -> dict[str, Tensor]:
    """The weights of an actor with its inputs in other places; it does not see the rest.

    Args:
        actor: the weights, and its normalization if there is one.
        places: of each input.
        width: how many inputs there are then.
    """
    index, moved = torch.tensor(places), dict(actor)
    for key, value in actor.items():
        if key.endswith("layers.0.0.weight"):
            moved[key] = _wider(value, -2, width).index_add(-2, index, value)
        elif key in ("norm.n", "norm.mean", "norm.var"):
            moved[key] = _wider(value, -1, width, key == "norm.var").index_copy(-1, index, value)
    return moved


def _wider(value: Tensor, dim: int, width: int, fill: float = 0.0) -> Tensor:
    shape = list(value.shape)
    shape[dim] = width
    return value.new_full(shape, fill)


def _check_state(recipe: Recipe, state: dict[str, Any]) -> None:
    """Raises a ValueError if these are not the weights of :func:`~torchrl_her.make_actor`."""
    shapes = {name: value.shape for name, value in _actor_of(state, recipe).state_dict().items()}
    if {name: value.shape for name, value in state["actor"].items()} != shapes:
        raise ValueError(
            f"a policy of learner={recipe.learner.name} cannot be exported: its network is not one of "
            "make_actor, as those of ddpg and td3 are"
        )
