"""Registers the throwing and reaching tasks with gymnasium."""

from __future__ import annotations

import warnings

import gymnasium

from torchrl_her_envs.throwing.tasks import TASKS, Task, WorldConfig

NAMESPACE = "torchrl_her"


def gym_id(task: Task) -> str:
    """Returns the id of a task for ``gymnasium.make``.

    Example:
        >>> gym_id(TASKS["hand_wall_v1"]), gym_id(TASKS["robot_reach"])
        ('torchrl_her/HandWallThrow-v1', 'torchrl_her/RobotReach-v0')
    """
    words = task.name.split("_")
    *who, last = words if task.throws else [*words, "v0"]
    what = ["throw"] if task.throws else []
    return f"{NAMESPACE}/{''.join(word.capitalize() for word in who + what)}-{last}"


def register_gym_ids() -> None:
    """Registers all tasks with gymnasium, for ``make`` and ``make_vec``; importing this package calls it."""
    for name, task in TASKS.items():
        if gym_id(task) not in gymnasium.registry:
            gymnasium.register(
                gym_id(task),
                entry_point="torchrl_her_envs.gym.to_gym:GymTask",
                vector_entry_point="torchrl_her_envs.gym.to_gym_vector:GymVectorTask",
                max_episode_steps=WorldConfig.max_steps,
                kwargs={"task": name},
            )
    # v0, v1 and v2 are different tasks: gymnasium's warning that v0 and v1 are out of date is wrong.
    warnings.filterwarnings(
        "ignore", rf".*The environment {NAMESPACE}/\w+-v\d is out of date", DeprecationWarning
    )
