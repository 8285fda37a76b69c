"""What an exported policy expects, as plain values."""

from __future__ import annotations

from typing import Any

import pytest

from torchrl_her_envs import make_env
from torchrl_her_recipes import PolicyInfo, load_policy
from torchrl_her_recipes.policies.info import describe_env


def card(**values: Any) -> PolicyInfo:
    known: dict[str, Any] = {
        "task": "mine",
        "widths": {"observation": 3, "desired_goal": 2},
        "action_shape": (1,),
        "low": (-2.0,),
        "high": (2.0,),
        "algorithm": "her",
        "learner": "sac",
        "seed": 7,
        "frames": 100,
    }
    return PolicyInfo(**known | values)


def test_a_card_survives_plain_data() -> None:
    own = card(success=0.25, reached=0.5, versions={"torch": "2.14.1"}, normalize_clip=5.0)
    assert PolicyInfo.from_dict(own.to_dict()) == own
    discrete = card(action_shape=(), action_dtype="int64", low=(0.0,), high=(3.0,))
    assert PolicyInfo.from_dict({**discrete.to_dict(), "action_shape": [], "high": [3]}) == discrete
    assert discrete.discrete
    assert discrete.expects() == "observation [3], desired_goal [2] and action of 4 choices"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"task": 3}, "task of a policy must be a name, got '3'"),
        ({"seed": -1}, "seed of a policy must be a whole number of at least 0"),
        ({"frames": True}, "frames of a policy must be a whole number"),
        ({"widths": {"observation": 3}}, "widths of a policy must be observation and desired_goal"),
        ({"widths": {"observation": 3, "desired_goal": 1 << 17}}, "each from 1 to 65536"),
        ({"dtype": "float16"}, "dtype of a policy must be one of float32, float64, got 'float16'"),
        ({"action_dtype": "int64"}, "action_dtype of a policy must be float32 or float64, got 'int64'"),
        ({"task_dtype": "complex64"}, "task_dtype of a policy must be one of float32, .*, got 'complex64'"),
        ({"action_shape": (2, 2)}, "action_shape of a policy must have one width"),
        ({"low": ()}, r"low of a policy must have 1 numbers, got '\(\)'"),
        (
            {"action_shape": (), "action_dtype": "int64", "low": (0,), "high": (1e9,)},
            "the last of the actions",
        ),
        ({"success": "much"}, "success of a policy must be a number, got 'much'"),
        ({"normalize_clip": 0.0}, "normalize_clip of a policy must be above 0 or None, got '0.0'"),
        ({"stages": ({"name": "reach"},)}, "stages of a policy must be those of a curriculum, got"),
        ({"versions": {"torch": 2}}, "versions of a policy must name packages and their versions"),
    ],
)
def test_values_that_no_policy_has_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        card(**values)


def test_plain_data_of_something_else_is_refused() -> None:
    own = card().to_dict()
    with pytest.raises(ValueError, match=r"its info is damaged: .* unexpected keyword argument 'surprise'"):
        PolicyInfo.from_dict({**own, "surprise": 1})
    with pytest.raises(ValueError, match=r"its info is damaged: 'int' object is not iterable"):
        PolicyInfo.from_dict({**own, "low": 5})
    del own["low"]
    with pytest.raises(ValueError, match=r"its info is damaged: 'low'"):
        PolicyInfo.from_dict(own)


def test_another_task_is_refused_with_both_widths() -> None:
    robot = make_env("robot_v0")
    with pytest.raises(
        ValueError,
        match=r"a policy of hand_v0 cannot play robot_v0: the policy has observation \[9\], "
        r"desired_goal \[2\] and action \[3\], but robot_v0 has observation \[15\], desired_goal \[2\] "
        r"and action \[3\]",
    ):
        load_policy("hand_v0").info.check_plays(robot, "robot_v0")
    load_policy("robot_v1").info.check_plays(robot, "robot_v0")
    own = {**describe_env(make_env("bit_flip", bits=4)), "task": "four"}
    four = card(**own)
    four.check_plays(make_env("bit_flip", bits=4), "four")
    with pytest.raises(ValueError, match="action of 4 choices, but five has .* and action of 5 choices"):
        four.check_plays(make_env("bit_flip", bits=5), "five")
