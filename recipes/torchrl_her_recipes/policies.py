"""Trained policies that come with the package, one for each throwing and reaching task."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

from torchrl_her import (
    ActorNet,
    evaluate,
    load_checkpoint,
    make_actor,
    save_checkpoint,
    success,
    take_run,
)
from torchrl_her_envs import goal_env
from torchrl_her_recipes.parts import make_curriculum
from torchrl_her_recipes.recipe import Recipe
from torchrl_her_recipes.run_folder import RunFolder
from torchrl_her_recipes.running import median_run
from torchrl_her_recipes.worlds import make_worlds

_SHIPPED = Path(__file__).parent / "trained"
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
    actor: TensorDictModule
    recipe: Recipe
    success: float
    frames: int


def policy_names() -> list[str]:
    """The tasks whose policies come with the package."""
    return sorted(path.stem for path in _SHIPPED.glob("*.pt"))


def load_trained(name: str | Path) -> TrainedPolicy:
    """A policy that comes with the package, or one that was exported, with what made it.

    Args:
        name: of a task, or the path of a .pt file.

    Raises:
        ValueError: there is no such policy, or the file is damaged.
    """
    path = _SHIPPED / f"{name}.pt" if str(name) in policy_names() else Path(name)
    if not path.is_file():
        raise ValueError(f"there is no policy {str(name)!r}; there are {', '.join(policy_names())}")
    return _policy_of(load_checkpoint(path))


def load_policy(name: str | Path) -> TensorDictModule:
    """The greedy policy of a task, trained: reads ``observation`` and ``desired_goal``, writes ``action``.

    Args:
        name: of a task, or the path of a .pt file that :func:`export_policy` wrote.

    Raises:
        ValueError: there is no such policy, or the file is damaged.
    """
    return load_trained(name).actor


def export_policy(
    folder: str | Path, out: str | Path, *, run: int | None = None, task: str | None = None
) -> TrainedPolicy:
    """Writes the policy of a finished run as a small file of its own.

    Args:
        folder: of the run.
        out: the .pt file.
        run: which one, of several side by side; the median of them if None.
        task: that the policy is for, if not the run's own: one that shows and wants the same.

    Returns:
        What was written.

    Raises:
        ValueError: this is no folder of a run, it has no such run, its policy needs more than the
            observation and the desired goal as they are, or the task is one that it cannot play.
        OSError: the run has not saved a policy yet.
    """
    home = RunFolder(folder)
    recipe, rows = home.recipe(), home.rows()
    if not rows:
        raise ValueError(f"the run in {folder} has not been evaluated yet")
    chosen = median_run(rows) if run is None else run
    if chosen not in range(recipe.num_runs):
        raise ValueError(f"there is no run {chosen} in {folder}; it has runs 0 to {recipe.num_runs - 1}")
    played = replace(recipe, task=task or recipe.task)
    env = make_worlds(recipe, 1, [0])
    _check_seen(recipe, env)
    widths, actions = _widths(env)
    state = {
        "task": played.task,
        "widths": widths,
        "actions": actions,
        "actor": take_run(load_checkpoint(home.policy)["actor"], chosen, recipe.num_runs),
        "recipe": asdict(replace(recipe, num_runs=1, seed=recipe.seed + chosen)),
        "success": math.nan,
        "frames": int(rows[-1]["frames"]),
    }
    _check_state(recipe, state)
    if task is not None and _widths(make_worlds(played, 1, [0])) != (widths, actions):
        raise ValueError(f"a policy of {recipe.task} cannot play {played.task}: it has other widths")
    state["success"] = measure_success(_policy_of(state))
    save_checkpoint(state, out)
    return _policy_of(state)


def measure_success(policy: TrainedPolicy, *, episodes: int = 1_000, seed: int = 1 << 41) -> float:
    """The share of greedy episodes in which a policy achieves its goal."""
    env = make_worlds(replace(policy.recipe, task=policy.task), episodes, [seed])
    return float(success(evaluate(env, policy.actor, max_steps=goal_env(env).max_steps)).float().mean())


def _policy_of(state: dict[str, Any]) -> TrainedPolicy:
    actor = make_actor(state["widths"], state["actions"], hidden=state["recipe"]["hidden"], in_keys=_KEYS)
    actor.load_state_dict(state["actor"])
    recipe = Recipe.from_dict(state["recipe"])
    return TrainedPolicy(
        task=state["task"],
        actor=actor.requires_grad_(False),
        recipe=recipe,
        success=state["success"],
        frames=state["frames"],
    )


def _widths(env: EnvBase) -> tuple[list[int], int]:
    """How wide an environment's observation and goal are, and its actions."""
    return [goal_env(env).observation_spec[key].shape[-1] for key in _KEYS], env.action_spec.shape[-1]


def _check_seen(recipe: Recipe, env: EnvBase) -> None:
    """Raises a ValueError if a curriculum's last layer does not see observation and goal as they are."""
    curriculum = make_curriculum(recipe, env)
    if curriculum is None:
        return
    last, (widths, _) = curriculum.layers[-1], _widths(env)
    if (*last.observation, *last.desired_goal) != tuple(range(sum(widths))):
        raise ValueError(
            f"the last layer of {recipe.task}'s curriculum must see the observation "
            "and the desired goal as they are, for its policy to be exported"
        )


def _check_state(recipe: Recipe, state: dict[str, Any]) -> None:
    """Raises a ValueError if these are not the weights of :func:`~torchrl_her.make_actor`."""
    wanted = ActorNet(sum(state["widths"]), state["actions"], hidden=recipe.hidden).state_dict()
    shapes = {f"module.{name}": value.shape for name, value in wanted.items()}
    if {name: value.shape for name, value in state["actor"].items()} != shapes:
        raise ValueError(f"only policies of ddpg and td3 can be exported, not of learner={recipe.learner}")
