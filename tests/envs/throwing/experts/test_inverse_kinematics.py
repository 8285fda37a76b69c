"""Angles that bring the end of an arm to a point."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_her_envs.throwing.experts.inverse_kinematics import nearest_turn, turn, two_link_angles
from torchrl_her_envs.throwing.kinematics import chain

BASE = torch.tensor([1.0, 2.0], dtype=torch.float64)
angle = st.floats(-10.0, 10.0)


@given(angle, angle)
def test_a_turn_is_the_shortest_one(start: float, end: float) -> None:
    way = turn(torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64)).item()
    assert -math.pi - 1e-9 < way <= math.pi + 1e-9
    assert math.isclose(math.cos(start + way), math.cos(end), abs_tol=1e-9)
    assert math.isclose(math.sin(start + way), math.sin(end), abs_tol=1e-9)


@settings(max_examples=50)
@given(st.floats(0.01, 0.99), st.floats(-math.pi, math.pi))
def test_both_solutions_reach_a_point_within_reach(share: float, heading: float) -> None:
    point = BASE + 2.0 * share * torch.tensor([math.cos(heading), math.sin(heading)], dtype=torch.float64)
    angles = two_link_angles(point, BASE, 2.0)
    ends = chain(angles, BASE, 2.0)[:, -1]
    torch.testing.assert_close(ends, point.expand(2, 2), atol=1e-6, rtol=0)
    assert not torch.allclose(angles[0], angles[1])


def test_a_point_out_of_reach_is_pointed_at() -> None:
    angles = two_link_angles(BASE + torch.tensor([0.0, 5.0], dtype=torch.float64), BASE, 2.0)
    ends = chain(angles, BASE, 2.0)[:, -1]
    torch.testing.assert_close(ends, (BASE + torch.tensor([0.0, 2.0], dtype=torch.float64)).expand(2, 2))


@settings(max_examples=50)
@given(angle, angle, st.floats(0.1, 0.9), st.floats(-math.pi, math.pi))
def test_the_nearest_turn_arrives_and_is_the_shorter_one(
    shoulder: float, elbow: float, share: float, heading: float
) -> None:
    joints = torch.tensor([shoulder, elbow], dtype=torch.float64)
    point = BASE + 2.0 * share * torch.tensor([math.cos(heading), math.sin(heading)], dtype=torch.float64)
    way = nearest_turn(joints, point, BASE, 2.0)
    torch.testing.assert_close(chain(joints + way, BASE, 2.0)[-1], point, atol=1e-6, rtol=0)
    both = turn(joints, two_link_angles(point, BASE, 2.0))
    assert way.abs().max() <= both.abs().amax(-1).min() + 1e-9
