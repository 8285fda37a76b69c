"""The schedule that all weights of IBS share. What it does to weights is tested with them."""

from __future__ import annotations

import pytest

from torchrl_her.goals import Instructiveness, InstructiveWeights, KernelInstructiveness

OPTIONS = {"sigma": 0.1, "start_factor": 2.0, "decay": 0.25, "floor": 0.0, "subtract": True}


def test_sigma_shrinks_and_starts_again() -> None:
    weights = InstructiveWeights(**OPTIONS)  # type: ignore[arg-type]
    found = [weights.sigma]
    for _ in range(3):
        weights.step()
        found.append(weights.sigma)
    assert found == pytest.approx([0.2, 0.1, 0.1, 0.1])  # the root of a quarter is a half
    weights.restart()
    assert weights.sigma == pytest.approx(0.2)


def test_sigma_is_its_state() -> None:
    first, second = InstructiveWeights(**OPTIONS), InstructiveWeights(**OPTIONS)  # type: ignore[arg-type]
    first.step()
    second.load_state_dict(first.state_dict())
    assert second.sigma == first.sigma != InstructiveWeights(**OPTIONS).sigma  # type: ignore[arg-type]


def test_both_kinds_of_ibs_have_it() -> None:
    for kind in (Instructiveness, KernelInstructiveness):
        assert issubclass(kind, InstructiveWeights)
        assert not kind.is_uniform


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("sigma", float("nan"), "sigma must be positive and finite, got nan"),
        ("start_factor", 0.5, "start_factor must be at least 1 and finite, got 0.5"),
        ("decay", 0.0, "decay must be above 0 and at most 1, got 0.0"),
        ("floor", -1.0, "floor must be at least 0 and finite, got -1.0"),
    ],
)
def test_bad_options_are_named(name: str, value: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        InstructiveWeights(**{**OPTIONS, name: value})  # type: ignore[arg-type]
