"""Videos of what a run has learned."""

from __future__ import annotations

from pathlib import Path

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_her.modules.networks import take_run
from torchrl_her.trainers.checkpoint import load_checkpoint
from torchrl_her.trainers.metrics import success
from torchrl_her.trainers.trainer import evaluate
from torchrl_her_envs.common.goal_env import goal_env, reward_range
from torchrl_her_envs.common.rendering.recording import record_episodes
from torchrl_her_envs.common.rendering.video import write_video
from torchrl_her_recipes.components.agents import make_player
from torchrl_her_recipes.components.curricula import make_curriculum, make_played_env, played_rewards
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.config.imports import permit_task
from torchrl_her_recipes.config.shipped import policy_names
from torchrl_her_recipes.runs.film import FPS
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.policies import load_trained


def load_actor(folder: str | Path, *, run: int = 0, allow_import: bool = False) -> TensorDictModuleBase:
    """The greedy policy that a run ended with.

    Args:
        folder: of the run.
        run: which one, if there are several side by side.
        allow_import: whether the module that the run's task may name may be imported.

    Raises:
        ValueError: this is no folder of a run, there is no such run, its policy is damaged, or its task
            names a module that must not be imported.
        OSError: the run has not saved a policy yet.
    """
    home = RunFolder(folder)
    recipe = home.recipe()
    if not 0 <= run < recipe.run.num_runs:
        raise ValueError(f"there is no run {run} in {folder}; it has runs 0 to {recipe.run.num_runs - 1}")
    if allow_import:
        permit_task(recipe.task.name)
    env = make_played_env(recipe, 1, [0])
    actor = make_player(recipe.replace(num_runs=1), env, curriculum=make_curriculum(recipe, env))
    actor.load_state_dict(take_run(load_checkpoint(home.policy)["actor"], run, recipe.run.num_runs))
    return actor


def play(
    source: str | Path,
    out: str | Path,
    *,
    run: int = 0,
    goals: int = 6,
    seed: int = 0,
    size: int = 240,
    allow_import: bool = False,
) -> int:
    """Writes a video of a policy, for several goals side by side.

    Args:
        source: the folder of a run, the .pt or .onnx file of an exported policy, or the name of a task whose
            policy comes with the package.
        out: a .gif or .mp4 file.
        run: which one, if there are several side by side in the folder.
        goals: how many.
        seed: of the goals and starts.
        size: pixels of one environment.
        allow_import: whether the module that the task may name may be imported.

    Returns:
        How many of the goals were achieved.

    Raises:
        ValueError: there is neither such a run nor such a policy, nothing of it can be drawn, or its task
            names a module that must not be imported.
        OSError: the run has not saved a policy yet.
    """
    env, actor, achieved = _played(source, run, goals, seed, allow_import)
    if not goal_env(env).can_render:
        raise ValueError(f"{source} cannot be filmed: its environment gives no pictures")
    write_video(record_episodes(env, actor, size=size, achieved_reward=achieved), out, fps=FPS)
    env.set_seed(seed)
    rollout = evaluate(env, actor, max_steps=goal_env(env).max_steps)
    return int(success(rollout, achieved_reward=achieved).sum())


def _played(
    source: str | Path, run: int, goals: int, seed: int, allow_import: bool
) -> tuple[EnvBase, TensorDictModuleBase, float]:
    """Environments, the policy that plays in them, and the reward of an achieved goal."""
    if not Path(source).is_dir() and (str(source) in policy_names() or Path(source).is_file()):
        trained = load_trained(source, allow_import=allow_import)
        env = make_task_envs(trained.recipe.replace(task=trained.task), goals, [seed], pictures=True)
        trained.card.check_plays(env, trained.task)
        return env, trained.actor, reward_range(goal_env(env))[1]
    home = RunFolder(source)
    if not home.path.is_dir():
        known = ", ".join(policy_names())
        raise ValueError(
            f"{source} is neither the folder of a run, nor the file of an exported policy, nor one of the "
            f"trained policies: {known}"
        )
    recipe, actor = home.recipe(), load_actor(source, run=run, allow_import=allow_import)
    env = make_played_env(recipe, goals, [seed], pictures=True)
    return env, actor, played_rewards(recipe, env)[1]
