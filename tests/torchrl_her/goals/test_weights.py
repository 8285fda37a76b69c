"""Weights of goals: the base class, and what every weight must be."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchrl_her import GoalWeights
from torchrl_her.goals import KernelInstructiveness, NetworkNovelty, RareGoals
from torchrl_her.goals.weights import checked_weights, normalized_weights


def test_the_base_class_weighs_all_alike_and_remembers_nothing() -> None:
    weights = GoalWeights()
    goals = torch.randn(2, 3, 4)
    assert weights(goals).tolist() == [[1.0] * 3] * 2
    weights.update(goals.flatten(0, 1))
    assert weights.state_dict() == {}
    weights.load_state_dict({})
    weights.clear()
    assert weights(goals).tolist() == [[1.0] * 3] * 2


def test_weights_become_floating_numbers() -> None:
    goals = torch.zeros(2, 3)
    assert checked_weights(torch.tensor([True, False]), goals).tolist() == [1.0, 0.0]
    kept = torch.tensor([0.5, 0.0], dtype=torch.float64)
    assert checked_weights(kept, goals) is kept
    assert checked_weights(torch.empty(0), goals[:0]).shape == (0,)


@pytest.mark.parametrize("bad", [-1e-9, float("nan"), float("inf")])
def test_weights_that_are_negative_or_not_finite_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="weights of goals must be finite and at least 0, got"):
        checked_weights(torch.tensor([1.0, bad, 2.0]), torch.zeros(3, 1))


@pytest.mark.parametrize("shape", [(4,), (3, 1), ()])
def test_weights_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"weights of goals must be \[3\] for goals \[3, 2\], got"):
        checked_weights(torch.ones(shape), torch.zeros(3, 2))


def test_weights_from_logarithms_by_hand() -> None:
    logs = torch.tensor([[-1000.0, -1000.0 + float(torch.log(torch.tensor(4.0)))], [-1e5, float("nan")]])
    found = normalized_weights(logs.double(), torch.zeros(2, 2, 3))
    assert found.dtype == torch.float32
    tiny = torch.finfo(torch.float32).tiny
    torch.testing.assert_close(found, torch.tensor([[0.25, 1.0], [tiny, 0.0]]))
    assert normalized_weights(logs, torch.zeros(2, 2, 3, dtype=torch.int64)).dtype == torch.float32
    assert normalized_weights(torch.full((2,), float("nan")), torch.zeros(2, 1)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64])
@pytest.mark.parametrize(
    "make",
    [lambda real: KernelInstructiveness(real, sigma=3.0), lambda _: RareGoals(), lambda _: NetworkNovelty()],
)
def test_weights_have_the_shape_and_type_of_goals(
    make: Callable[[Tensor], GoalWeights], dtype: torch.dtype
) -> None:
    weights = make((10 * torch.rand(9, 2)).to(dtype))
    for _ in range(2):
        weights.update((10 * torch.rand(50, 2)).to(dtype))
    found = weights((10 * torch.rand(3, 4, 2)).to(dtype))
    assert found.shape == (3, 4)
    assert found.dtype == (dtype if dtype.is_floating_point else torch.float32)
    assert weights(torch.zeros(3, 0, 2)).shape == (3, 0)
