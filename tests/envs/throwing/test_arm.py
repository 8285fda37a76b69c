"""The arm: where it starts, how it moves, what is seen of it."""

import math

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
    joints = points([0.0, math.pi / 2, math.pi][:links])
    speed = points([0.1, 0.2, 0.3][:links])
    seen = arm.observe(joints, speed, points([0.4, 0.5]), points([0.6, 0.7]), points([1.0]))
    cosines, sines = [1.0, 0.0, -1.0][:links], [0.0, 1.0, 0.0][:links]
    expected = [*cosines, *sines, 0.4, 0.5, *speed[0].tolist(), 0.6, 0.7, 1.0]
    torch.testing.assert_close(seen, points(expected))
    assert (arm.num_joints, arm.observation_size, seen.shape[-1]) == (links, size, size)


def test_reach_is_a_box_around_the_circle() -> None:
    # base 0.33 and 0.5 of the screen, length a third of it
    assert Arm(WorldConfig()).reach == pytest.approx((-0.0033333, 0.1666667, 0.6633333, 0.8333333), abs=1e-6)


@pytest.mark.parametrize("links", [0, -1])
def test_an_arm_without_links_is_refused(links: int) -> None:
    with pytest.raises(ValueError, match=f"at least 1 link, got num_links={links}"):
        Arm(WorldConfig(), num_links=links)
