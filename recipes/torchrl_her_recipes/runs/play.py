"""Videos of what a run has learned."""

from __future__ import annotations

from pathlib import Path

from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

from torchrl_her.modules.networks import take_run
from torchrl_her.trainers.checkpoint import load_checkpoint
from torchrl_her.trainers.metrics import success
from torchrl_her.trainers.trainer import evaluate
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_envs.common.rendering.recording import record_episodes
from torchrl_her_envs.common.rendering.video import write_video
from torchrl_her_recipes.components.agents import make_networks
from torchrl_her_recipes.components.curricula import make_curriculum, make_played_env
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.config.shipped import policy_names
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.policies import load_trained
from torchrl_her_recipes.runs.run import FPS


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
    if not 0 <= run < recipe.run.num_runs:
        raise ValueError(f"there is no run {run} in {folder}; it has runs 0 to {recipe.run.num_runs - 1}")
    env = make_played_env(recipe, 1, [0])
    actor, _ = make_networks(recipe.replace(num_runs=1), env, curriculum=make_curriculum(recipe, env))
    actor.load_state_dict(take_run(load_checkpoint(home.policy)["actor"], run, recipe.run.num_runs))
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
        size: pixels of one environment.

    Returns:
        How many of the goals were achieved.

    Raises:
        ValueError: there is neither such a run nor such a policy, or nothing of it can be drawn.
        OSError: the run has not saved a policy yet.
    """
    env, actor = _played(source, run, goals, seed)
    if not goal_env(env).can_render:
        raise ValueError(f"{source} cannot be filmed: its environment gives no pictures")
    write_video(record_episodes(env, actor, size=size), out, fps=FPS)
    env.set_seed(seed)
    return int(success(evaluate(env, actor, max_steps=goal_env(env).max_steps)).sum())


def _played(source: str | Path, run: int, goals: int, seed: int) -> tuple[EnvBase, TensorDictModule]:
    """Environments, and the policy that plays in them."""
    if not Path(source).is_dir() and str(source) in policy_names():
        trained = load_trained(source)
        return make_task_envs(trained.recipe.replace(task=trained.task), goals, [seed]), trained.actor
    home = RunFolder(source)
    if not home.path.is_dir():
        known = ", ".join(policy_names())
        raise ValueError(f"{source} is neither the folder of a run nor one of the trained policies: {known}")
    return make_played_env(home.recipe(), goals, [seed]), load_actor(source, run=run)
