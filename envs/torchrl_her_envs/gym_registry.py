"""The names that gymnasium knows our tasks by."""

from __future__ import annotations

import warnings

import gymnasium

from torchrl_her_envs.task import TASKS, Task, WorldConfig

NAMESPACE = "torchrl_her"


def gym_id(task: Task) -> str:
    """What ``gymnasium.make`` calls a task.

    Example:
        >>> gym_id(TASKS["hand_wall_v1"]), gym_id(TASKS["robot_reach"])
        ('torchrl_her/HandWallThrow-v1', 'torchrl_her/RobotReach-v0')
    """
    words = task.name.split("_")
    *who, last = words if task.throws else [*words, "v0"]
    what = ["throw"] if task.throws else []
    return f"{NAMESPACE}/{''.join(word.capitalize() for word in who + what)}-{last}"


def register_tasks() -> None:
    """Lets ``gymnasium.make`` and ``gymnasium.make_vec`` know all tasks; importing this package does it."""
    for name, task in TASKS.items():
        if gym_id(task) not in gymnasium.registry:
            gymnasium.register(
                gym_id(task),
                entry_point="torchrl_her_envs.gym_out:GymTask",
                vector_entry_point="torchrl_her_envs.gym_vector:GymVectorTask",
                max_episode_steps=WorldConfig.max_steps,
                kwargs={"task": name},
            )
    # v0, v1 and v2 are tasks beside each other: none of them is out of date, as gymnasium would say.
    warnings.filterwarnings(
        "ignore", rf".*The environment {NAMESPACE}/\w+-v\d is out of date", DeprecationWarning
    )
