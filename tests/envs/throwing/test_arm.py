"""The arm: where it starts, how it moves, what is seen of it."""

import math

import numpy as np
import pytest
import torch

from torchrl_her_envs import Arm, WorldConfig


def points(*rows: list[float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


# The base is at 33 % and 50 % of 6 m, the length 2 m.
@pytest.mark.parametrize(
    ("angles", "grip"),
    [
        ([0.0], [3.98, 3.0]),
        ([math.pi / 2], [1.98, 5.0]),
        ([0.0, 0.0], [3.98, 3.0]),
        ([math.pi / 2, -math.pi / 2], [2.98, 4.0]),
        ([math.pi, math.pi], [1.98, 3.0]),
        ([0.0, math.pi / 2, math.pi / 2], [1.98, 3.0 + 2 / 3]),
    ],
)
def test_grip(angles: list[float], grip: list[float]) -> None:
    arm = Arm(WorldConfig(), num_links=len(angles))
    torch.testing.assert_close(arm.grip(points(angles)), points(grip))


def test_skeleton_runs_from_base_to_grip() -> None:
    skeleton = Arm(WorldConfig()).skeleton(points([0.0, math.pi / 2]))
    torch.testing.assert_close(skeleton[0], points([1.98, 3.0], [2.98, 3.0], [2.98, 4.0]))


@pytest.mark.parametrize("links", [1, 2, 3])
def test_starts_between_180_and_360_degrees(links: int) -> None:
    arm = Arm(WorldConfig(), num_links=links)
    starts = arm.sample(points([0.0] * links, [0.5] * links, [1.0] * links))
    torch.testing.assert_close(
        starts, points([math.pi] * links, [1.5 * math.pi] * links, [2 * math.pi] * links)
    )


def test_joints_turn_without_limit() -> None:
    arm = Arm(WorldConfig())
    torch.testing.assert_close(arm.move(points([6.0, -6.0]), points([1.0, -1.0])), points([7.0, -7.0]))


@pytest.mark.parametrize(("links", "size"), [(1, 8), (2, 11), (3, 14)])
def test_shows_cosines_then_sines_then_grip_and_velocities(links: int, size: int) -> None:
    arm = Arm(WorldConfig(), num_links=links)
    widths = {"cosines": links, "sines": links, "grip": 2, "joint_velocity": links, "grip_velocity": 2}
    assert arm.shown == (*widths, "closed")
    assert sum(widths.values()) + 1 == size
    assert (arm.num_joints, arm.observation_size) == (links, size)
    assert arm.grip_index == (2 * links, 2 * links + 1)


@pytest.mark.parametrize("links", [1, 2, 5])
def test_arrays_and_numbers_move_as_tensors_do(links: int) -> None:
    arm, rng = Arm(WorldConfig(), num_links=links), np.random.default_rng(0)
    joints, change = 6.0 * rng.random((2, 4, links))
    moved = arm.move(torch.from_numpy(joints), torch.from_numpy(change))
    assert np.array_equal(arm.move(joints, change), moved.numpy())
    assert arm.move_one(joints[0].tolist(), change[0].tolist()) == moved[0].tolist()
    grip = arm.grip(moved)
    assert arm.grip(moved.numpy()) == pytest.approx(grip.numpy(), abs=1e-14)
    assert arm.grip_one(moved[0].tolist()) == pytest.approx(grip[0].tolist(), abs=1e-14)
    assert arm.skeleton(moved.numpy()) == pytest.approx(arm.skeleton(moved).numpy(), abs=1e-14)


def test_reach_is_a_box_around_the_circle() -> None:
    # base 0.33 and 0.5 of the screen, length a third of it
    assert Arm(WorldConfig()).reach == pytest.approx((-0.0033333, 0.1666667, 0.6633333, 0.8333333), abs=1e-6)


@pytest.mark.parametrize("links", [0, -1])
def test_an_arm_without_links_is_refused(links: int) -> None:
    with pytest.raises(ValueError, match=f"at least 1 link, got num_links={links}"):
        Arm(WorldConfig(), num_links=links)
