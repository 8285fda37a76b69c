"""IBS from kernel densities: by hand, beside the grid, in 15 dimensions, in the writer and in curricula."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_her import (
    CurriculumStage,
    GoalGrid,
    Instructiveness,
    box_target,
    enter_stage,
)
from torchrl_her.curriculum import set_stage_goals
from torchrl_her.goals import KernelInstructiveness
from torchrl_her.trainers import load_checkpoint, save_checkpoint

from ..her_data import make_buffer

PAIR = torch.tensor([[0.0], [2.0]])


def uniform(n: int, g: int, *, low: float = 0.0, high: float = 1.0, seed: int = 0) -> Tensor:
    return low + (high - low) * torch.rand(n, g, generator=torch.Generator().manual_seed(seed))


def bell(x: float) -> float:
    return math.exp(-x * x / 2)


def test_weights_by_hand() -> None:
    weights = KernelInstructiveness(PAIR, sigma=0.5, start_factor=2.0, floor=0.01)
    assert weights.sigma == 1.0
    asked = torch.tensor([[0.0], [1.0], [5.0], [100.0]])
    peak = (1.0 + bell(2.0)) / 2  # q* at a real goal, up to a constant
    q_star = [peak, bell(1.0), (bell(3.0) + bell(5.0)) / 2, 0.0]
    expected = [max(q / peak, 0.01) for q in q_star]
    assert weights(asked).tolist() == pytest.approx(expected)
    weights.update(torch.tensor([[0.0], [0.0], [0.0], [2.0]]))
    q = [(3 + bell(2.0)) / 4, bell(1.0), (3 * bell(5.0) + bell(3.0)) / 4, 0.0]
    expected = [max((a - b) / peak, 0.01) for a, b in zip(q_star, q, strict=True)]
    assert expected[:2] == [0.01, 0.01]
    assert weights(asked).tolist() == pytest.approx(expected, abs=1e-6)
    assert float(weights(torch.tensor([2.0]))) == pytest.approx((peak - (1 + 3 * bell(2.0)) / 4) / peak)
    weights.clear()
    assert weights.written == 0
    assert weights(asked[:1]).tolist() == [1.0]


def test_weights_follow_sigma() -> None:
    weights = KernelInstructiveness(PAIR[:1], sigma=0.5, start_factor=2.0, decay=0.25)
    asked = torch.tensor([[1.0]])
    assert weights(asked).tolist() == pytest.approx([bell(1.0)])
    weights.step()
    assert weights(asked).tolist() == pytest.approx([bell(2.0)])
    weights.restart()
    assert weights(asked).tolist() == pytest.approx([bell(1.0)])


def test_the_sequential_architecture_weighs_by_the_target_alone() -> None:
    weights = KernelInstructiveness(PAIR[:1], sigma=1.0, start_factor=1.0, subtract=False, floor=0.5)
    weights.update(torch.zeros(5, 1))
    near, far = weights(torch.tensor([[3.0], [1e6]])).tolist()
    assert near == pytest.approx(bell(3.0))
    assert 0.0 < far < 1e-30  # above 0, so that transitions that have no other goals get some


def test_numbers_of_different_units_are_scaled() -> None:
    real, asked, units = uniform(20, 2), uniform(30, 2, seed=1), torch.tensor([100.0, 0.01])
    plain = KernelInstructiveness(real, sigma=0.1)
    scaled = KernelInstructiveness(real * units, sigma=0.1, scale=units)
    for weights, factor in ((plain, torch.ones(2)), (scaled, units)):
        weights.update(asked[:10] * factor)
    torch.testing.assert_close(scaled(asked * units), plain(asked), rtol=1e-4, atol=1e-5)
    assert scaled.divergence == pytest.approx(plain.divergence, rel=1e-4)


def test_a_target_of_ones_own() -> None:
    def exponential(goals: Tensor, sigma: float) -> Tensor:
        return -goals[:, 0] / sigma

    weights = KernelInstructiveness(PAIR, sigma=1.0, start_factor=1.0, log_target=exponential)
    assert weights(torch.tensor([[[0.0], [1.0]]])).tolist() == [[1.0, pytest.approx(math.exp(-1.0))]]


def test_it_agrees_with_the_grid_where_the_kernel_is_narrow() -> None:
    """A wide kernel also smooths q, which a grid does not."""
    grid = GoalGrid((0.0, 0.0), (1.0, 1.0), (20, 20))
    target = partial(box_target, grid, (0.55, 0.2), (0.95, 0.8))
    real = torch.tensor([0.55, 0.2]) + torch.tensor([0.4, 0.6]) * uniform(1_000, 2)
    binned = Instructiveness(grid, target, sigma=0.08, start_factor=1.0)
    smooth = KernelInstructiveness(real, sigma=0.08, start_factor=1.0)
    asked, written = grid.centers.float(), uniform(20_000, 2, seed=2).square()
    for least in (0.97, 0.9):
        pair = torch.stack([binned(asked), smooth(asked)])
        assert float(torch.corrcoef(pair)[0, 1]) > least
        for weights in (binned, smooth):
            weights.update(written)


def test_what_is_kept_of_the_written_goals_is_spread_evenly_over_all() -> None:
    weights = KernelInstructiveness(PAIR, sigma=1.0, samples=1_000)
    for begin in range(0, 64_000, 320):  # a hundred steps of an episode, again and again
        number = torch.arange(begin, begin + 320)
        weights.update((number % 64).float().unsqueeze(-1))
        assert len(weights._virtual) == min(1_000, begin + 320)
    assert weights.written == 64_000
    share = weights._virtual.flatten().long().bincount(minlength=64)
    assert int(share.min()) >= 12  # of 15.6
    assert int(share.max()) <= 19
    kept = KernelInstructiveness(PAIR, sigma=1.0, samples=1_000)
    kept.update(torch.arange(64_000.0).unsqueeze(-1))
    quarters = (kept._virtual.flatten() / 16_000).long().bincount()
    assert quarters.tolist() == pytest.approx([250] * 4, abs=5)


def test_the_divergence_falls_to_0_where_virtual_goals_lie_as_the_real_ones() -> None:
    weights = KernelInstructiveness(uniform(2_000, 2), sigma=0.1, samples=2_000)
    assert math.isnan(weights.divergence)
    found = []
    for shift in (0.0, 0.2, 0.5):
        weights.clear()
        weights.update(uniform(2_000, 2, seed=1) + shift)
        found.append(weights.divergence)
        assert weights.divergence == found[-1]
    assert 0.0 <= found[0] < 0.05 < found[1] < found[2]
    weights.clear()
    weights.update(uniform(1, 2, seed=1))
    sharp = weights.divergence
    weights.step()
    assert weights.divergence == sharp  # against the final sigma


def test_the_divergence_of_two_normal_distributions_by_hand() -> None:
    """One goal each: between normal distributions that are d apart it is d^2 / 2 sigma^2."""
    weights = KernelInstructiveness(torch.zeros(1, 3), sigma=0.5)
    goals = torch.zeros(2_000, 3)
    goals[:, 1] = 1.5
    weights.samples = 2_000
    weights.update(goals)
    assert weights.divergence == pytest.approx(1.5**2 / 2 / 0.5**2, rel=0.05)


@pytest.mark.parametrize("g", [3, 15, 30])
def test_goals_near_the_real_ones_are_preferred_in_many_dimensions(g: int) -> None:
    """As fingertips of a hand: real goals in one half of the box, virtual ones anywhere."""
    real = uniform(1_000, g, low=0.5)
    weights = KernelInstructiveness(real, sigma=0.2 * math.sqrt(g / 3))
    inside, outside = uniform(200, g, low=0.5, seed=1), uniform(200, g, high=0.5, seed=2)
    for _ in range(25):
        weights.step()
    assert weights.sigma == pytest.approx(weights.final_sigma)
    before = weights(inside)
    assert float(before.median()) > 4.0 * float(weights(outside).median())
    assert float(before.median()) > 0.1
    weights.update(uniform(4_000, g, low=0.5, seed=3))  # these have their share now
    assert float(weights(inside).median()) < 0.3 * float(before.median())


NUMBERS = st.floats(width=32) | st.floats(-3.0, 3.0, width=32)


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-1e3, 1e3, width=32)] * 2), min_size=1, max_size=6),
    st.lists(st.tuples(NUMBERS, NUMBERS), max_size=12),
    st.floats(1e-6, 10.0),
    st.floats(0.0, 1.0),
    st.booleans(),
)
def test_weights_are_finite_and_only_goals_that_are_not_have_none(
    real: list[tuple[float, float]],
    asked: list[tuple[float, float]],
    sigma: float,
    floor: float,
    subtract: bool,
) -> None:
    weights = KernelInstructiveness(
        torch.tensor(real), sigma=sigma, floor=floor, subtract=subtract, samples=5
    )
    goals = torch.tensor(asked).view(-1, 2)
    finite = goals.isfinite().all(-1)
    for _ in range(2):
        weight = weights(goals)
        assert bool(weight.isfinite().all())
        assert torch.equal(weight > 0, finite)
        weights.update(goals)
        weights.step()
    assert weights.written == 2 * int(finite.sum())
    assert math.isnan(weights.divergence) != bool(finite.any())
    assert not weights.divergence < 0


def test_it_goes_on_as_it_was_saved(tmp_path: Any) -> None:
    first, second = (KernelInstructiveness(uniform(50, 3), sigma=0.2, samples=40) for _ in range(2))
    asked = uniform(30, 3, seed=9)
    for seed in range(3):
        first.update(uniform(30, 3, seed=seed))
        first.step()
    save_checkpoint({"weights": first.state_dict()}, tmp_path / "state.pt")
    second.update(asked)  # is forgotten
    second.load_state_dict(load_checkpoint(tmp_path / "state.pt")["weights"])
    for seed in range(3, 6):
        assert torch.equal(second(asked), first(asked))
        assert second.divergence == first.divergence
        for weights in (first, second):
            weights.update(uniform(30, 3, seed=seed))
            weights.step()
    with pytest.raises(ValueError, match="goals must have 2 numbers, got 3"):
        KernelInstructiveness(uniform(5, 2), sigma=0.1).load_state_dict(first.state_dict())


@pytest.mark.parametrize(
    ("goals", "options", "message"),
    [
        (uniform(0, 2), {}, r"goals must be finite, \[n, g\] with n > 0, got a shape of \[0, 2\]"),
        (torch.tensor([[math.nan]]), {}, "goals must be finite"),
        (PAIR, {"samples": 0}, "samples must be at least 1, got 0"),
        (PAIR, {"scale": 0.0}, "scale must be positive and finite, a scalar or of length 1, got 0.0"),
        (PAIR, {"scale": [1.0, 2.0]}, "a scalar or of length 1, got .1.0, 2.0."),
        (PAIR, {"sigma": 0.0}, "sigma must be positive and finite, got 0.0"),
        (PAIR, {"floor": -1.0}, "floor must be at least 0 and finite, got -1.0"),
    ],
)
def test_bad_options_are_named(goals: Tensor, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        KernelInstructiveness(goals, **{"sigma": 1.0, **options})


# In the writer


def make_stage(*, instructive: bool) -> CurriculumStage:
    return CurriculumStage(
        name="one",
        observation=[0],
        achieved_goal=[0],
        desired_goal=[1],
        threshold=0.2,
        instructive=instructive,
    )


def test_a_stage_of_a_curriculum_turns_it_off_and_starts_sigma_anew() -> None:
    weights = KernelInstructiveness(PAIR, sigma=0.5)
    buffer = make_buffer(weights)
    weights.step()
    weights.update(PAIR)
    set_stage_goals(buffer.writer, make_stage(instructive=False))
    assert weights.is_uniform
    weights.update(torch.zeros(4, 3))  # a stage's goals may have another width
    assert weights.written == 2
    enter_stage(buffer, make_stage(instructive=True))
    assert not weights.is_uniform
    assert (weights.written, weights.sigma) == (0, 1.5)
    with pytest.raises(ValueError, match="goals must have 1 numbers, got 3"):
        weights.update(torch.zeros(4, 3))
