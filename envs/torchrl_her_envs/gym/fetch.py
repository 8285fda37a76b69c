"""The Fetch tasks of gymnasium-robotics: names for entries of their states, and stages of a curriculum.

A Fetch robot has to bring its gripper, or an object that it pushes, slides or carries, to a point: Plappert
et al., Multi-goal reinforcement learning, 2018.
"""

from __future__ import annotations

import re
from typing import Any

_THRESHOLD = 0.05  # distance in meters at which the environments count a goal as achieved
_AROUND = 0.025  # meters to a block's middle at which open fingers are around it; closed ones stop at 0.038
# Entries of an observation, in order, with their widths.
_GRIPPER = {"grip": 3, "fingers": 2, "grip_speed": 3, "fingers_speed": 2}
_OBJECT = {
    "grip": 3,
    "object": 3,
    "object_from_grip": 3,
    "fingers": 2,
    "object_angles": 3,
    "object_speed": 3,
    "object_turning": 3,
    "grip_speed": 3,
    "fingers_speed": 2,
}
_TASK = re.compile(r"Fetch(Reach|Push|Slide|PickAndPlace)(Dense)?-v\d+")


def _shown(id: str) -> dict[str, int] | None:
    task = _TASK.fullmatch(id)
    if task is None:
        return None
    return _GRIPPER if task[1] == "Reach" else _OBJECT


def fetch_names(id: str) -> dict[str, list[int]]:
    """Returns names for entries of a Fetch task's state; an empty dictionary for other environments.

    Args:
        id: id of the environment in gymnasium.

    Example:
        >>> fetch_names("FetchPush-v4")["object"], fetch_names("FetchReach-v4")["place"]
        ([3, 4, 5], [10, 11, 12])
    """
    widths, names, first = _shown(id), {}, 0
    for name, width in ({} if widths is None else widths | {"place": 3}).items():
        names[name], first = list(range(first, first + width)), first + width
    return names


def fetch_stages(id: str) -> list[dict[str, Any]]:
    """Returns the stages of a Fetch task: reach the object, then move it; [] for other environments.

    The object's position, the first stage's goal, is observed in the second stage at the same network inputs.
    Tasks of reaching a point have one stage. A block to be picked up must first be between the fingers.

    Args:
        id: id of the environment in gymnasium.

    Example:
        >>> [stage["name"] for stage in fetch_stages("FetchPush-v4")]
        ['reach', 'move']
    """
    widths = _shown(id)
    if widths is None:
        return []
    gripper = list(_GRIPPER)
    reach = {"name": "reach", "observation": gripper, "achieved_goal": "grip"}
    if widths is _GRIPPER:
        return [reach | {"desired_goal": "place"}]
    rest = [name for name in widths if name not in (*gripper, "object")]
    move = {
        "name": "move",
        "observation": [*gripper, "object", *rest],
        "achieved_goal": "object",
        "desired_goal": "place",
    }
    near = _AROUND if "PickAndPlace" in id else _THRESHOLD
    return [reach | {"desired_goal": "object", "threshold": near, "instructive": False}, move]
