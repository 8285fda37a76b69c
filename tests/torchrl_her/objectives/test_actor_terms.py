"""The cost of actions: the L2 penalty and the saturation penalty, by hand."""

from __future__ import annotations

import pytest
import torch

from torchrl_her.objectives import action_cost


def test_both_costs_by_hand() -> None:
    action = torch.tensor([[0.5, 1.0, -1.0], [2.5, -4.0, 1.9]], dtype=torch.float64)
    action[1] = action[1].tanh()
    l2 = action_cost(action[0], l2=2.0)
    assert l2.item() == pytest.approx(2.0 * (0.25 + 1 + 1) / 3)
    saturation = action_cost(action[1], saturation=3.0)
    assert saturation.item() == pytest.approx(3.0 * (0.5**2 + 2.0**2 + 0) / 3)


def test_free_actions_are_not_pulled_and_saturated_ones_get_a_full_gradient() -> None:
    argument = torch.tensor([0.0, 1.5, -1.99, 5.0, -6.0], dtype=torch.float64, requires_grad=True)
    action_cost(argument.tanh(), saturation=1.0).backward()
    expected = [
        0.0,
        0.0,
        0.0,
        2 * 3 / 5,
        -2 * 4 / 5,
    ]  # of the square of what is above 2, whatever tanh's slope
    assert argument.grad is not None
    assert argument.grad.tolist() == pytest.approx(expected, rel=1e-6)


def test_actions_at_their_bounds_give_finite_numbers() -> None:
    action = torch.tensor([1.0, -1.0], requires_grad=True)
    cost = action_cost(action, saturation=1.0)
    cost.backward()
    assert cost.isfinite()
    assert action.grad is not None
    assert action.grad.isfinite().all()
