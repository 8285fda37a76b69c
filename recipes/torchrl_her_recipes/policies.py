"""Trained policies that come with the package, one for each throwing and reaching task."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModule

from torchrl_her import ActorNet, load_checkpoint, make_actor, save_checkpoint, take_run
from torchrl_her_envs import goal_env
from torchrl_her_recipes.parts import make_curriculum
from torchrl_her_recipes.recipe import Recipe
from torchrl_her_recipes.run_folder import RunFolder
from torchrl_her_recipes.running import median_run
from torchrl_her_recipes.study_results import at_the_end
from torchrl_her_recipes.worlds import make_worlds

_SHIPPED = Path(__file__).parent / "trained"
_KEYS = ("observation", "desired_goal")


@dataclass(frozen=True)
class TrainedPolicy:
    """A greedy policy, and what made it.

    Attributes:
        actor: reads ``observation`` and ``desired_goal``, writes ``action``.
        recipe: of the run; its seed is that of this very policy.
        success: of the run at its end, the mean of its last evaluations.
        frames: environment steps that it was trained for.
    """

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
    state = load_checkpoint(path)
    actor = make_actor(state["widths"], state["actions"], hidden=state["recipe"]["hidden"], in_keys=_KEYS)
    actor.load_state_dict(state["actor"])
    recipe = Recipe.from_dict(state["recipe"])
    return TrainedPolicy(actor.requires_grad_(False), recipe, state["success"], state["frames"])


def load_policy(name: str | Path) -> TensorDictModule:
    """The greedy policy of a task, trained: reads ``observation`` and ``desired_goal``, writes ``action``.

    Args:
        name: of a task, or the path of a .pt file that :func:`export_policy` wrote.

    Raises:
        ValueError: there is no such policy, or the file is damaged.
    """
    return load_trained(name).actor


def export_policy(folder: str | Path, out: str | Path, *, run: int | None = None) -> TrainedPolicy:
    """Writes the policy of a finished run as a small file of its own.

    Args:
        folder: of the run.
        out: the .pt file.
        run: which one, of several side by side; the median of them if None.

    Returns:
        What was written.

    Raises:
        ValueError: this is no folder of a run, it has no such run, or its policy needs more than the
            observation and the desired goal as they are.
        OSError: the run has not saved a policy yet.
    """
    home = RunFolder(folder)
    recipe = home.recipe()
    rows = home.rows()
    if not rows:
        raise ValueError(f"the run in {folder} has not been evaluated yet")
    scores = at_the_end(rows, "success")
    chosen = median_run(rows) if run is None else run
    if chosen not in range(len(scores)):
        raise ValueError(f"there is no run {chosen} in {folder}; it has runs 0 to {recipe.num_runs - 1}")
    actor = take_run(load_checkpoint(home.policy)["actor"], chosen, recipe.num_runs)
    state = {
        "widths": _widths(recipe),
        "actions": _actions(recipe),
        "actor": actor,
        "recipe": asdict(replace(recipe, num_runs=1, seed=recipe.seed + chosen)),
        "success": scores[chosen],
        "frames": int(rows[-1]["frames"]),
    }
    _check_state(recipe, state)
    save_checkpoint(state, out)
    return load_trained(out)


def _widths(recipe: Recipe) -> list[int]:
    """Of the observation and of the goal; a curriculum's last layer must see them as they are."""
    env = make_worlds(recipe, 1, [0])
    worlds = goal_env(env)
    widths = [worlds.observation_spec[key].shape[-1] for key in _KEYS]
    curriculum = make_curriculum(recipe, env)
    if curriculum is not None:
        last, seen = curriculum.layers[-1], sum(widths)
        if (*last.observation, *last.desired_goal) != tuple(range(seen)):
            raise ValueError(
                f"the last layer of {recipe.task}'s curriculum must see the observation "
                "and the desired goal as they are, for its policy to be exported"
            )
    return widths


def _actions(recipe: Recipe) -> int:
    return make_worlds(recipe, 1, [0]).action_spec.shape[-1]


def _check_state(recipe: Recipe, state: dict[str, Any]) -> None:
    """Raises a ValueError if these are not the weights of :func:`~torchrl_her.make_actor`."""
    wanted = ActorNet(sum(state["widths"]), state["actions"], hidden=recipe.hidden).state_dict()
    shapes = {f"module.{name}": value.shape for name, value in wanted.items()}
    if {name: value.shape for name, value in state["actor"].items()} != shapes:
        raise ValueError(f"only policies of ddpg and td3 can be exported, not of learner={recipe.learner}")
