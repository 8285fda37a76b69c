"""Videos of what a run has learned."""

from __future__ import annotations

from pathlib import Path

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_her.modules.networks import take_run
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
from torchrl_her_recipes.runs.kept import KeptPolicy
from torchrl_her_recipes.runs.policies import load_trained


def load_actor(
    folder: str | Path, *, run: int = 0, best: bool = False, allow_import: bool = False
) -> TensorDictModuleBase:
    """The greedy policy that a run ended with, or its best one.

    Args:
        folder: of the run, or ``policy.pt`` or ``best.pt`` in it.
        run: which one, if there are several side by side.
        best: whether to take the policy of the evaluation with the best median success.
        allow_import: whether the module that the run's task may name may be imported.

    Raises:
        ValueError: this is no folder of a run, there is no such run, its policy is damaged, it has no best
            policy, or its task names a module that must not be imported.
        OSError: the run has not saved a policy yet.
    """
    kept = KeptPolicy.of(folder, best=best)
    if kept is None:
        home = RunFolder(folder)
        kept = KeptPolicy(home, home.policy)  # whose recipe says what is missing
    return _actor_of(kept, run, allow_import)


def _actor_of(kept: KeptPolicy, run: int, allow_import: bool) -> TensorDictModuleBase:
    recipe = kept.home.recipe()
    if not 0 <= run < recipe.run.num_runs:
        runs = recipe.run.num_runs
        raise ValueError(f"there is no run {run} in {kept.home.path}; it has runs 0 to {runs - 1}")
    if allow_import:
        permit_task(recipe.task.name)
    env = make_played_env(recipe, 1, [0])
    actor = make_player(recipe.replace(num_runs=1), env, curriculum=make_curriculum(recipe, env))
    actor.load_state_dict(take_run(kept.load()["actor"], run, recipe.run.num_runs))
    return actor


def play(
    source: str | Path,
    out: str | Path,
    *,
    run: int = 0,
    best: bool = False,
    goals: int = 6,
    seed: int = 0,
    size: int = 240,
    allow_import: bool = False,
) -> int:
    """Writes a video of a policy, for several goals side by side.

    Args:
        source: the folder of a run, ``policy.pt`` or ``best.pt`` in it, the .pt or .onnx file of an exported
            policy, or the name of a task whose policy comes with the package.
        out: a .gif or .mp4 file.
        run: which one, if there are several side by side in the folder.
        best: whether to take the best policy of the folder: that of the evaluation with the best median
            success.
        goals: how many.
        seed: of the goals and starts.
        size: pixels of one environment.
        allow_import: whether the module that the task may name may be imported.

    Returns:
        How many of the goals were achieved.

    Raises:
        ValueError: there is neither such a run nor such a policy, ``best`` without the folder of a run,
            nothing of it can be drawn, or its task names a module that must not be imported.
        OSError: the run has not saved a policy yet.
    """
    env, actor, achieved = _played(source, run, best, goals, seed, allow_import)
    if not goal_env(env).can_render:
        raise ValueError(f"{source} cannot be filmed: its environment gives no pictures")
    write_video(record_episodes(env, actor, size=size, achieved_reward=achieved), out, fps=FPS)
    env.set_seed(seed)
    rollout = evaluate(env, actor, max_steps=goal_env(env).max_steps)
    return int(success(rollout, achieved_reward=achieved).sum())


def _played(
    source: str | Path, run: int, best: bool, goals: int, seed: int, allow_import: bool
) -> tuple[EnvBase, TensorDictModuleBase, float]:
    """Environments, the policy that plays in them, and the reward of an achieved goal."""
    kept = KeptPolicy.of(source, best=best)
    if kept is None and (str(source) in policy_names() or Path(source).is_file()):
        trained = load_trained(source, allow_import=allow_import)
        env = make_task_envs(trained.recipe.replace(task=trained.task), goals, [seed], pictures=True)
        trained.card.check_plays(env, trained.task)
        return env, trained.actor, reward_range(goal_env(env))[1]
    if kept is None:
        known = ", ".join(policy_names())
        raise ValueError(
            f"{source} is neither the folder of a run, nor the file of an exported policy, nor one of the "
            f"trained policies: {known}"
        )
    recipe, actor = kept.home.recipe(), _actor_of(kept, run, allow_import)
    env = make_played_env(recipe, goals, [seed], pictures=True)
    return env, actor, played_rewards(recipe, env)[1]
