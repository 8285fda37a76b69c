"""Flight, bounces and friction of a free ball, against numbers worked out on paper.

A time step is four substeps of h = 0.01 s. Each moves the ball by v h, finds what it then touches, and
changes v: by gravity, and so that a bounce leaves 0.7 of the normal speed that it met the surface with. The
world is 6 m wide and high, the ball's radius 0.18 m; the wall stands from x = 2.94 to 3.06 and up to y = 3.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_her_envs import BallPhysics, WorldConfig

RADIUS = 0.18


def points(*rows: list[float]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def fly(position: Tensor, velocity: Tensor, *, steps: int, wall: bool = False) -> tuple[Tensor, Tensor]:
    physics = BallPhysics(len(position), WorldConfig(), wall=wall)
    for _ in range(steps):
        position, velocity = physics.step(position, velocity)
    return position, velocity


def thrown_balls(n: int, *, seed: int = 0, speed: float = 6.0) -> tuple[Tensor, Tensor]:
    """Balls anywhere that is free, with any velocity."""
    generator = torch.Generator().manual_seed(seed)
    position = 0.2 + 5.6 * torch.rand(n, 2, dtype=torch.float64, generator=generator)
    in_wall = ((position[:, 0] - 3.0).abs() < 0.25) & (position[:, 1] < 3.2)
    position[in_wall, 0] -= 1.0
    return position, speed * torch.randn(n, 2, dtype=torch.float64, generator=generator)


def assert_close(value: Tensor, expected: Tensor, *, atol: float = 1e-12) -> None:
    torch.testing.assert_close(value, expected, rtol=0, atol=atol)


# Flight


@pytest.mark.parametrize(
    ("velocity", "to", "then"),
    [
        ([0.0, 0.0], [2.0, 3.994], [0.0, -0.4]),  # 0 + 0.001 + 0.002 + 0.003 m down
        ([1.0, 2.0], [2.04, 4.074], [1.0, 1.6]),
        ([-3.0, -1.0], [1.88, 3.954], [-3.0, -1.4]),
    ],
)
def test_free_flight_over_one_step(velocity: list[float], to: list[float], then: list[float]) -> None:
    position, velocity_ = fly(points([2.0, 4.0]), points(velocity), steps=1)
    assert_close(position, points(to))
    assert_close(velocity_, points(then))


# Bounces. In each case the ball meets the surface in the first substep and flies freely for three more.


@pytest.mark.parametrize(
    ("where", "start", "velocity", "then"),
    [
        # 0.7 * 2 = 1.4 m/s back. Gravity then takes 0.1 m/s in each of three substeps.
        ("floor", [1.0, 0.19], [0.0, -2.0], [0.0, 1.1]),
        ("ceiling", [1.0, 5.81], [0.0, 2.0], [0.0, -1.7]),
        # Against a side friction is 0.1 * (2 + 1.4) = 0.34 m/s: it eats the first substep's gravity, 0.1 m/s,
        ("left side", [0.19, 4.0], [-2.0, 0.0], [1.4, -0.3]),
        ("right side", [5.81, 4.0], [2.0, 0.0], [-1.4, -0.3]),
        # or slows a ball that slides along: 5 - 0.1 - 0.34 - 0.3.
        ("right side, sliding", [5.81, 4.0], [2.0, 5.0], [-1.4, 4.26]),
        ("wall, from the left", [2.75, 1.0], [2.0, 0.0], [-1.4, -0.3]),
        ("wall, from the right", [3.25, 1.0], [-2.0, 0.0], [1.4, -0.3]),
        ("wall, its top", [3.0, 3.19], [0.0, -2.0], [0.0, 1.1]),
    ],
)
def test_a_bounce_keeps_70_percent(
    where: str, start: list[float], velocity: list[float], then: list[float]
) -> None:
    _, after = fly(points(start), points(velocity), steps=1, wall=where.startswith("wall"))
    assert_close(after, points(then))


def test_a_wall_is_only_there_when_asked_for() -> None:
    position, velocity = fly(points([2.75, 1.0]), points([2.0, 0.0]), steps=1)
    assert_close(position, points([2.83, 0.994]))
    assert_close(velocity, points([2.0, -0.4]))


@pytest.mark.parametrize("down", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("along", [0.01, 0.3, 2.0, -5.0])
def test_friction_of_a_bounce_is_a_tenth_of_its_push(down: float, along: float) -> None:
    # The push turns -v into 0.7 v and carries the ball's weight for a substep, 0.1 m/s.
    _, velocity = fly(points([3.0, RADIUS + 0.005 * down]), points([along, -down]), steps=1)
    lost = 0.1 * (1.7 * down + 0.1)
    sign = 1.0 if along > 0 else -1.0
    expected = sign * max(abs(along) - lost, 0.0)  # friction stops a ball and never turns it round
    assert velocity[0, 0].item() == pytest.approx(expected, abs=1e-12)


def test_bounces_die_away() -> None:
    position, velocity = fly(points([3.0, 2.0]), points([0.0, 0.0]), steps=300)
    assert_close(position, points([3.0, RADIUS]), atol=1e-3)
    assert_close(velocity, points([0.0, 0.0]), atol=1e-9)


# Sliding and resting


def test_a_sliding_ball_slows_by_one_meter_a_second_each_second_and_stops() -> None:
    start = points([1.0, RADIUS]), points([2.0, 0.0])
    for steps, speed in ((1, 1.96), (25, 1.0), (49, 0.04), (60, 0.0)):
        position, velocity = fly(*start, steps=steps)
        assert_close(velocity, points([speed, 0.0]), atol=1e-9 if speed else 1e-12)
        assert position[0, 1].item() == pytest.approx(RADIUS, abs=1e-9)
    # 200 substeps at 2.00, 1.99, ..., 0.01 m/s make 2.01 m
    assert_close(position, points([3.01, RADIUS]), atol=1e-9)


@pytest.mark.parametrize(
    ("start", "velocity", "then"),
    [
        ([1.0, RADIUS], [0.0, 0.0], [0.0, 0.0]),
        ([RADIUS, 4.0], [-1.0, 0.0], [0.7, -0.3]),
        ([2.76, 1.0], [1.0, 0.0], [-0.7, -0.3]),
        ([3.0, 3.18], [0.0, 0.0], [0.0, 0.0]),
    ],
)
def test_a_ball_put_against_a_surface_touches_it_in_every_world(
    start: list[float], velocity: list[float], then: list[float]
) -> None:
    # Worlds stand at different places, where sums are rounded differently: no contact may hang on that.
    position, after = fly(points(start).repeat(1024, 1), points(velocity).repeat(1024, 1), steps=1, wall=True)
    assert_close(after, points(then).repeat(1024, 1))
    assert_close(position, position[:1].repeat(1024, 1))


# Nothing gets out or through


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(0.2, 2.7), st.floats(0.2, 5.8), st.booleans(), st.floats(0.0, 15.0), st.floats(0.0, 6.3)
        ),
        min_size=1,
        max_size=16,
    )
)
def test_no_ball_leaves_the_screen_or_enters_the_wall(
    balls: list[tuple[float, float, bool, float, float]],
) -> None:
    position = points(*([6.0 - x if right else x, y] for x, y, right, _, _ in balls))
    velocity = torch.stack([torch.polar(torch.tensor(s), torch.tensor(a)) for *_, s, a in balls])
    velocity = torch.view_as_real(velocity).double()
    physics = BallPhysics(len(balls), WorldConfig(), wall=True)
    for _ in range(60):
        position, velocity = physics.step(position, velocity)
        # Thrown down at 15 m/s it lands at 18.4 m/s at most, so sinks in by 0.184 m: its center by 4 mm.
        assert ((position > -0.005) & (position < 6.005)).all()
        assert not (((position[:, 0] - 3.0).abs() < 0.06) & (position[:, 1] < 3.0)).any()


# Many worlds in one space


def test_position_and_velocity_are_the_whole_state() -> None:
    # A ball in the middle of a bounce is still being pushed out of the floor: that must not outlive a step.
    used, state = BallPhysics(64, WorldConfig(), wall=True), thrown_balls(64, speed=10.0)
    for _ in range(100):
        fresh = BallPhysics(64, WorldConfig(), wall=True)
        again, state = fresh.step(*state), used.step(*state)
        for one, other in zip(again, state, strict=True):
            assert torch.equal(one, other)


def test_a_step_leaves_its_arguments_and_earlier_results_alone() -> None:
    physics = BallPhysics(8, WorldConfig(), wall=False)
    start = thrown_balls(8)
    first = physics.step(*start)
    kept = [tensor.clone() for tensor in (*start, *first)]
    physics.step(*first)
    assert all(torch.equal(a, b) for a, b in zip(kept, (*start, *first), strict=True))


# Other worlds


def test_constants_are_used() -> None:
    world = WorldConfig(
        gravity=0.0, bounce=0.5, friction=0.2, size=3.0, ball_radius=0.1, time_step=0.02, substeps=1
    )
    physics = BallPhysics(1, world, wall=False)
    # the floor is met at y = 0.3: 0.5 * 2 = 1 m/s up, and 0.2 * (2 + 1) = 0.6 m/s lost along it
    _, velocity = physics.step(points([1.0, 0.33]), points([2.0, -2.0]))
    assert_close(velocity, points([1.4, 1.0]))


@pytest.mark.parametrize("size", [0.5, 1.0])
def test_a_small_world_does_not_depend_on_those_beside_it(size: int) -> None:
    # Between steps balls wait beyond the right side, which is 1 m thick whatever the size.
    world = WorldConfig(size=size, gravity=10 * size / 6, hand_speed=8 * size / 6)
    alone, together = BallPhysics(1, world, wall=False), BallPhysics(3, world, wall=False)
    position, velocity = points([0.5 * size, 0.03 * size]), points([size / 6, -size / 12])  # on the floor
    few, many = (position, velocity), (position.repeat(3, 1), velocity.repeat(3, 1))
    for _ in range(5):
        few, many = alone.step(*few), together.step(*many)
        for ours, theirs in zip(few, many, strict=True):
            assert torch.equal(theirs, ours.repeat(3, 1))
    assert few[0][0, 0] > 0.5 * size


def test_a_ball_that_has_come_to_rest_is_as_if_it_were_still_simulated() -> None:
    resting, simulated = (BallPhysics(2, WorldConfig(), wall=False) for _ in range(2))
    state = (torch.tensor([[1.0, 0.5], [2.0, 0.3]], dtype=torch.float64), torch.zeros(2, 2).double())
    other = tuple(entry.clone() for entry in state)
    skipped = 0
    for _ in range(400):
        before = state
        state = resting.step(*state)
        skipped += int(torch.equal(state[0], before[0]) and torch.equal(state[1], before[1]))
        simulated._settled[:] = np.nan  # forgets that a ball rests
        other = simulated.step(*other)
        assert torch.equal(state[0], other[0])
        assert torch.equal(state[1], other[1])
    assert skipped > 50
    pushed = resting.step(state[0], state[1] + torch.tensor([1.0, 0.0]))
    assert (pushed[0][:, 0] > state[0][:, 0]).all()


def test_balls_that_are_not_free_stay_and_the_others_do_not_care() -> None:
    position = torch.tensor([[1.0, 3.0], [2.0, 3.0]], dtype=torch.float64)
    velocity = torch.tensor([[1.0, 0.0], [0.0, 2.0]], dtype=torch.float64)
    all_moved = BallPhysics(2, WorldConfig(), wall=False).step(position, velocity)
    moved = BallPhysics(2, WorldConfig(), wall=False).step(position, velocity, torch.tensor([True, False]))
    for before, both, one in zip((position, velocity), all_moved, moved, strict=True):
        assert torch.equal(one[0], both[0])
        assert torch.equal(one[1], before[1])


# Flight without the space


def anywhere(n: int, *, seed: int, speed: float) -> np.ndarray:
    """[4, n] states of balls anywhere, most of which touch nothing within a step."""
    position, velocity = thrown_balls(n, seed=seed, speed=speed)
    return np.concatenate((position.numpy().T, velocity.numpy().T))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.0, 12.0), st.booleans(), st.sampled_from([10.0, 0.0, -3.0]))
def test_flight_in_closed_form_is_chipmunks(seed: int, speed: float, wall: bool, gravity: float) -> None:
    physics = BallPhysics(64, WorldConfig(gravity=gravity), wall=wall)
    before = anywhere(64, seed=seed, speed=speed)
    *flown, touches = physics._fly(*before)
    simulated = physics._space.simulate(before, 0.01, 4)
    clear = ~touches
    np.testing.assert_allclose(np.stack(flown)[:, clear], simulated[:, clear], rtol=0, atol=1e-12)
    assert [physics._fly(*ball)[-1] for ball in before.T.tolist()] == touches.tolist()


@pytest.mark.parametrize("wall", [False, True])
def test_whole_paths_are_those_of_balls_that_are_always_simulated(
    wall: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    flying, simulated = (BallPhysics(100, WorldConfig(), wall=wall) for _ in range(2))
    always = SimpleNamespace(reached=lambda xs, *_: np.ones_like(xs[0], bool))
    monkeypatch.setattr(simulated, "_limits", always)
    state = other = thrown_balls(100, speed=7.0)
    skipped = 0
    for _ in range(200):
        skipped += int((~flying._fly(*np.concatenate([own.numpy().T for own in state]))[-1]).sum())
        state, other = flying.step(*state), simulated.step(*other)
        for one, two in zip(state, other, strict=True):
            assert_close(one, two, atol=1e-9)
    assert 1_000 < skipped < 19_000  # both kinds of steps are many


def test_a_path_is_the_same_to_the_last_bit_whichever_worlds_are_beside_it() -> None:
    start = thrown_balls(300, speed=7.0)  # more than the space takes at once
    start[0][:, 1] *= 0.3  # and they bounce together
    together, path, state = BallPhysics(300, WorldConfig(), wall=True), [], start
    for _ in range(120):
        state = together.step(*state)
        path.append(torch.cat(state, -1))
    for k in (0, 177, 299):
        alone = BallPhysics(1, WorldConfig(), wall=True)
        ball = torch.cat(start, -1)[k].tolist()
        for seen in path:
            ball = alone.advance_one(0, ball)
            assert ball == seen[k].tolist()


def test_the_space_has_the_surfaces_of_one_world_and_a_ball_for_each_that_bounces() -> None:
    physics = BallPhysics(500, WorldConfig(), wall=True)
    space = physics._space._space
    assert len(space.static_body.shapes) == 5
    state = thrown_balls(500, speed=3.0)
    most = 0
    for _ in range(150):
        state = physics.step(*state)
        most = max(most, len(space.bodies))
    assert 10 < most <= 64
    few = torch.zeros(500, dtype=torch.bool)
    few[:3] = True
    for _ in range(300):
        state = physics.step(*state, few)
        state[1][:3] = torch.tensor([1.0, -3.0])  # they never come to rest
    assert len(space.bodies) <= 3  # what was not needed for long is gone
