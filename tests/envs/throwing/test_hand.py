"""The hand: where it starts, how it moves, what is seen of it."""

import numpy as np
import pytest
import torch

from torchrl_her_envs import Hand, WorldConfig


def points(*rows: list[float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


# The screen is 6 m, the ball's radius 0.18 m; half of the wall's thickness is 0.06 m.
@pytest.mark.parametrize(("wall", "right"), [(False, 2.82), (True, 2.76)])
def test_starts_anywhere_in_its_half(wall: bool, right: float) -> None:
    hand = Hand(WorldConfig(), wall=wall)
    starts = hand.sample(points([0.0, 0.0], [1.0, 1.0], [0.5, 0.25]))
    torch.testing.assert_close(starts, points([0.18, 0.18], [right, 5.82], [0.09 + right / 2, 1.59]))
    assert hand.reach == pytest.approx((0.03, 0.03, right / 6, 0.97))


@pytest.mark.parametrize(
    ("change", "to"),
    [
        ([0.1, -0.2], [1.1, 2.8]),
        ([9.0, 0.0], [2.82, 3.0]),
        ([-9.0, 0.0], [0.18, 3.0]),
        ([0.0, 9.0], [1.0, 5.82]),
        ([0.3, -9.0], [1.3, 0.18]),  # along a side it goes on
    ],
)
def test_moves_within_its_half(change: list[float], to: list[float]) -> None:
    hand = Hand(WorldConfig(), wall=False)
    torch.testing.assert_close(hand.move(points([1.0, 3.0]), points(change)), points(to))


def test_is_its_own_grip() -> None:
    hand = Hand(WorldConfig(), wall=False)
    assert torch.equal(hand.grip(points([1.0, 2.0])), points([1.0, 2.0]))
    assert torch.equal(hand.skeleton(points([1.0, 2.0])), points([1.0, 2.0]).unsqueeze(1))


def test_shows_position_velocity_and_grip() -> None:
    hand = Hand(WorldConfig(), wall=False)
    assert hand.shown == ("grip", "grip_velocity", "closed")  # its joints are its position: not shown twice
    assert (hand.num_joints, hand.observation_size, hand.action_speed) == (2, 5, 8.0)
    assert hand.grip_index == (0, 1)


@pytest.mark.parametrize("change", [[0.1, -0.2], [9.0, 0.0], [-9.0, 9.0], [0.3, -9.0]])
def test_arrays_and_numbers_move_as_tensors_do(change: list[float]) -> None:
    hand, at = Hand(WorldConfig(), wall=True), [1.0, 3.0]
    expected = hand.move(points(at), points(change))
    assert np.array_equal(hand.move(np.array([at]), np.array([change])), expected.numpy())
    assert [hand.move_one(at, change)] == expected.tolist()
    assert hand.grip_one(at) == at
