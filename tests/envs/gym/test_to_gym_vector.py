"""Many environments of a task as one of gymnasium's vectors."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from .tasks import make, make_many

MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]


def equal(ours: Any, theirs: Any) -> None:
    """Tuples and dicts of arrays, compared: places to float tolerance."""
    if isinstance(theirs, tuple):
        theirs, ours = dict(enumerate(theirs)), dict(enumerate(ours))
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs)
        for key in theirs:
            equal(ours[key], theirs[key])
    elif isinstance(theirs, np.ndarray) and theirs.dtype == object:
        assert len(ours) == len(theirs)
        for mine, other in zip(ours, theirs, strict=True):
            equal(mine, other)
    elif theirs is None:
        assert ours is None
    else:
        assert np.asarray(ours).shape == np.asarray(theirs).shape
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


@pytest.mark.parametrize("mode", MODES)
def test_a_vector_does_what_gymnasium_s_own_does(mode: AutoresetMode) -> None:
    options = {"max_episode_steps": 9, "threshold": 0.9}  # so that episodes end in both ways
    ours = make_many("hand_v2", autoreset_mode=mode, **options)
    theirs = make_many(
        "hand_v2", vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options
    )
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    equal(ours.reset(seed=11), theirs.reset(seed=11))
    ours.action_space.seed(0)
    ends = {"terminated": 0, "truncated": 0}
    for _ in range(40):
        actions = ours.action_space.sample()
        mine, other = ours.step(actions), theirs.step(actions)
        for part, (one, two) in enumerate(zip(mine, other, strict=True)):
            # They leave out what no environment tells, and we give it with a mask that says so.
            equal({key: one[key] for key in two} if part == 4 else one, two)
        over = mine[2] | mine[3]
        ends["terminated"] += int(mine[2].sum())
        ends["truncated"] += int((mine[3] & ~mine[2]).sum())
        if mode is AutoresetMode.DISABLED and over.any():
            equal(*(env.reset(options={"reset_mask": over.copy()})[0] for env in (ours, theirs)))
    assert min(ends.values()) > 0


def test_seeds_may_be_given_one_by_one() -> None:
    many = make_many(num_envs=3)
    shown = many.reset(seed=np.array([5, 9, 5]))[0]["desired_goal"]
    for world, seed in enumerate((5, 9, 5)):
        assert np.array_equal(shown[world], make().reset(seed=seed)[0]["desired_goal"])
    again = many.reset()[0]["desired_goal"]
    assert not np.array_equal(again, shown)


def test_seeds_that_are_not_given_are_drawn() -> None:
    many = make_many(num_envs=4)
    starts = [many.reset(seed=[1, None, None, 4])[0]["desired_goal"] for _ in range(2)]
    for world, seed in ((0, 1), (3, 4)):
        assert np.array_equal(starts[0][world], make().reset(seed=seed)[0]["desired_goal"])
        assert np.array_equal(starts[0][world], starts[1][world])
    drawn = [tuple(start[world]) for start in starts for world in (1, 2)]
    assert len(set(drawn)) == 4
    again = []
    for _ in range(2):  # they come from the generator that a seed sets
        many.reset(seed=7)
        again.append(many.reset(seed=[None] * 4)[0]["desired_goal"])
    assert np.array_equal(*again)
    with pytest.raises(TypeError, match="'float' object cannot be interpreted as an integer"):
        many.reset(seed=[1, 2, 3, 4.5])


def test_what_was_returned_stays_as_it_is() -> None:
    for mode in MODES:
        many = make_many("hand_v0", num_envs=4, autoreset_mode=mode, max_episode_steps=3, threshold=0.5)
        kept: list[Any] = [many.reset(seed=0)]
        copies = copy.deepcopy(kept)
        for _ in range(8):
            kept.append(many.step(many.action_space.sample()))
            copies.append(copy.deepcopy(kept[-1]))
            if mode is AutoresetMode.DISABLED and (over := kept[-1][2] | kept[-1][3]).any():
                kept.append(many.reset(options={"reset_mask": over}))
                copies.append(copy.deepcopy(kept[-1]))
        for one, other in zip(kept, copies, strict=True):
            equal(one, other)


@pytest.mark.parametrize("mode", MODES)
def test_no_two_arrays_that_are_returned_are_one(mode: AutoresetMode) -> None:
    many = make_many("hand_v0", num_envs=4, autoreset_mode=mode, max_episode_steps=1)
    many.reset(seed=0)
    _, reward, terminated, truncated, info = many.step(many.action_space.sample())
    info |= {f"final_{key}": value for key, value in info.pop("final_info", {}).items()}
    arrays = [reward, terminated, truncated, *info.values()]
    for k, one in enumerate(arrays):
        assert not any(np.shares_memory(one, other) for other in arrays[:k])
        one[:] = 0
    if mode is AutoresetMode.DISABLED:  # what became of them does not matter to the environments
        with pytest.raises(gymnasium.error.ResetNeeded):
            many.step(many.action_space.sample())


def test_a_first_reset_is_of_all_environments() -> None:
    many, mask = make_many(num_envs=2), np.array([True, False])
    with pytest.raises(
        gymnasium.error.ResetNeeded, match=r"of all environments, got reset_mask \[True, False\]"
    ):
        many.reset(options={"reset_mask": mask})
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset must be called before step"):
        many.step(many.action_space.sample())
    many.reset(options={"reset_mask": ~mask | mask})
    many.reset(options={"reset_mask": mask})
    many.step(many.action_space.sample())


def test_a_vector_must_be_reset_first() -> None:
    many = make_many(num_envs=2, autoreset_mode="Disabled", max_episode_steps=1)
    actions = many.action_space.sample()
    many.reset(seed=0)
    many.step(actions)
    with pytest.raises(gymnasium.error.ResetNeeded, match="for each environment whose episode is over"):
        many.step(actions)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"options": {"reset_mask": np.zeros(2, np.bool_)}},
            r"must choose some of 2 environments, got \[False, False\]",
        ),
        ({"options": {"reset_mask": np.ones(3, np.bool_)}}, "must choose some of 2 environments"),
        ({"seed": 1, "options": {"reset_mask": np.array([True, False])}}, "must not be given together"),
        ({"seed": [1, 2, 3]}, "3 seeds for 2 environments: give one, or one for each"),
        ({"seed": [1]}, "1 seeds for 2 environments"),
    ],
)
def test_resets_that_cannot_be(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_many(num_envs=2).reset(**arguments)


def test_a_vector_needs_steps_and_pictures_that_can_be_seen() -> None:
    with pytest.raises(ValueError, match="max_steps must be positive, got 0"):
        make_many(max_episode_steps=0)
    with pytest.raises(ValueError, match="at least 32 pixels, got 8"):
        make_many(size=8)


def test_pictures_of_a_vector() -> None:
    many = make_many(num_envs=3, render_mode="rgb_array", size=32)
    many.reset(seed=0)
    frames = many.render()
    assert len(frames) == 3
    assert {(frame.shape, frame.dtype) for frame in frames} == {((32, 32, 3), np.dtype(np.uint8))}
    assert make_many().render() is None
