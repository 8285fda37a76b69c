"""Showing what a run has learnt."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tensordict.nn import TensorDictModule

from torchrl_her import evaluate, load_checkpoint, success, take_run
from torchrl_her_envs import base_env, record_episodes, write_video
from torchrl_her_recipes.parts import make_networks, make_task_env
from torchrl_her_recipes.run_folder import RunFolder
from torchrl_her_recipes.running import FPS


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
    actor, _ = make_networks(replace(recipe, num_runs=1), make_task_env(recipe, 1, [0]))
    actor.load_state_dict(take_run(load_checkpoint(home.policy)["actor"], run, recipe.num_runs))
    return actor


def play(
    folder: str | Path, out: str | Path, *, run: int = 0, goals: int = 6, seed: int = 0, size: int = 240
) -> int:
    """Writes a video of a run's policy, for several goals side by side.

    Args:
        folder: of the run.
        run: which one, if there are several side by side.
        out: a .gif or .mp4 file.
        goals: how many.
        seed: of the goals and starts.
        size: pixels of one world.

    Returns:
        How many of the goals were achieved.
    """
    recipe = RunFolder(folder).recipe()
    actor = load_actor(folder, run=run)
    env = make_task_env(recipe, goals, [seed])
    write_video(record_episodes(env, actor, size=size), out, fps=FPS)
    env.set_seed(seed)
    return int(success(evaluate(env, actor, max_steps=base_env(env).world.max_steps)).sum())
