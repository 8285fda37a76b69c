"""Showing what a run has learnt."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

from torchrl_her import evaluate, load_checkpoint, success, take_run
from torchrl_her_envs import ThrowingEnv, goal_env, record_episodes, write_video
from torchrl_her_recipes.agents import make_networks
from torchrl_her_recipes.parts import make_curriculum, make_task_env
from torchrl_her_recipes.policies import load_trained, policy_names
from torchrl_her_recipes.run_folder import RunFolder
from torchrl_her_recipes.running import FPS
from torchrl_her_recipes.worlds import make_worlds


def load_actor(folder: str | Path, *, run: int = 0) -> TensorDictModule:
    """The greedy policy that a run ended with.

    Args:
        folder: of the run.
        run: which one, if there are several side by side.

    Raises:
        ValueError: this is no folder of a run, there is no such run, or its policy is damaged.
        OSError: the run has not saved a policy yet.
    """
    home = RunFolder(folder)
    recipe = home.recipe()
    if not 0 <= run < recipe.num_runs:
        raise ValueError(f"there is no run {run} in {folder}; it has runs 0 to {recipe.num_runs - 1}")
    env = make_task_env(recipe, 1, [0])
    actor, _ = make_networks(replace(recipe, num_runs=1), env, curriculum=make_curriculum(recipe, env))
    actor.load_state_dict(take_run(load_checkpoint(home.policy)["actor"], run, recipe.num_runs))
    return actor


def play(
    source: str | Path, out: str | Path, *, run: int = 0, goals: int = 6, seed: int = 0, size: int = 240
) -> int:
    """Writes a video of a policy, for several goals side by side.

    Args:
        source: the folder of a run, or the name of a task whose policy comes with the package.
        out: a .gif or .mp4 file.
        run: which one, if there are several side by side in the folder.
        goals: how many.
        seed: of the goals and starts.
        size: pixels of one world.

    Returns:
        How many of the goals were achieved.

    Raises:
        ValueError: there is neither such a run nor such a policy, or nothing of it can be drawn.
        OSError: the run has not saved a policy yet.
    """
    env, actor = _played(source, run, goals, seed)
    if not isinstance(goal_env(env), ThrowingEnv):
        raise ValueError(f"{source} cannot be filmed: only throwing and reaching tasks can")
    write_video(record_episodes(env, actor, size=size), out, fps=FPS)
    env.set_seed(seed)
    return int(success(evaluate(env, actor, max_steps=goal_env(env).max_steps)).sum())


def _played(source: str | Path, run: int, goals: int, seed: int) -> tuple[EnvBase, TensorDictModule]:
    """Worlds, and the policy that plays in them."""
    if not Path(source).is_dir() and str(source) in policy_names():
        trained = load_trained(source)
        return make_worlds(replace(trained.recipe, task=trained.task), goals, [seed]), trained.actor
    home = RunFolder(source)
    if not home.path.is_dir():
        known = ", ".join(policy_names())
        raise ValueError(f"{source} is neither the folder of a run nor one of the trained policies: {known}")
    return make_task_env(home.recipe(), goals, [seed]), load_actor(source, run=run)
