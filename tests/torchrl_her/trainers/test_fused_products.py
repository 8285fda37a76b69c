"""Products of numbers in bfloat16."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.objectives import LossModule

from tests.torchrl_her.trainers.fused_cases import ALGORITHMS, make_loss, make_rows, twin
from torchrl_her import FusedLearner, LossLearner, make_target_updater
from torchrl_her.modules.networks import StackedLinear

HIDDEN, BATCH = 40, 25  # neither of them a multiple of a vector, and an odd number of rows


def rounded(x: Tensor) -> Tensor:
    return x.bfloat16().float()


class RoundedProduct(torch.autograd.Function):
    """x @ weight with rounded factors, forward and backward; the action's gradient has exact factors."""

    generate_vmap_rule = True  # several critics are mapped over

    @staticmethod
    def forward(x: Tensor, weight: Tensor) -> Tensor:
        return rounded(x) @ rounded(weight)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        (slope,) = slopes
        before = rounded(slope) @ rounded(weight[..., :HIDDEN, :]).mT
        joined = slope @ weight[..., HIDDEN:, :].mT
        return torch.cat((before, joined), -1), rounded(x).mT @ rounded(slope)


def product_of_hidden_layers(layer: StackedLinear, x: Tensor) -> Tensor:
    if min(layer.weight.shape[-2:]) < 32:
        return torch.baddbmm(layer.bias, x, layer.weight)
    return RoundedProduct.apply(x, layer.weight) + layer.bias  # type: ignore[no-untyped-call]


def slopes_of(learner: Any, rows: Any) -> Tensor:
    """The gradients of a first step: Adam's first moments are a tenth of them."""
    learner.update(rows)
    states = (learner.optimizer.state[parameter] for parameter in learner.loss.parameters())
    moments = [state["exp_avg"].flatten() for state in states]
    return 10 * torch.cat(moments)


def make(kind: Callable[..., Any], loss: LossModule, **options: Any) -> Any:
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    target = make_target_updater(loss, tau=0.1, hard_interval=0)
    return kind(loss, optimizer, target, max_grad_norm=1e9, **options)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("norm", ["none", "layer"])
def test_factors_between_hidden_layers_are_rounded(
    algorithm: str, norm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    loss = make_loss(algorithm, dtype=torch.float32, hidden=HIDDEN, norm=norm)
    rows = make_rows(algorithm, (1, BATCH), dtype=torch.float32)
    others = [twin(loss) for _ in range(2)]
    exact = slopes_of(make(FusedLearner, loss), rows.clone())
    fused = slopes_of(make(FusedLearner, others[0], matmul_dtype="bfloat16"), rows.clone())
    monkeypatch.setattr(StackedLinear, "forward", product_of_hidden_layers)
    wanted = slopes_of(make(LossLearner, others[1]), rows.clone())
    distance = (fused - wanted).norm() / wanted.norm()
    assert distance < 0.1 * (exact - wanted).norm() / wanted.norm()  # a number may be rounded the other way
    assert (exact - wanted).norm() < 0.05 * exact.norm()


def test_numbers_without_digits_to_lose_give_the_same_results() -> None:
    learners = []
    for matmul_dtype in ("float32", "bfloat16"):
        torch.manual_seed(0)
        loss = make_loss("dqn", dtype=torch.float32, hidden=32, depth=2)
        for parameter in loss.parameters():
            parameter.data = (parameter.data * 12).round() / 4
        learners.append(make(FusedLearner, loss, matmul_dtype=matmul_dtype))
    rows = make_rows("dqn", (1, BATCH), dtype=torch.float32)
    for key in ("observation", "desired_goal"):
        for where in (rows, rows["next"]):
            where[key] = where[key].round()
    losses = [float(learner.update(rows.clone())["loss"]) for learner in learners]
    assert losses[0] == losses[1] > 0


def test_a_number_that_is_none_stays_one() -> None:
    loss = make_loss("dqn", dtype=torch.float32, hidden=32)
    rows = make_rows("dqn", (1, BATCH), dtype=torch.float32)
    rows["observation"][0, 0, 0] = torch.nan
    measured = make(FusedLearner, loss, matmul_dtype="bfloat16").update(rows)
    assert all(value.isnan().all() for value in measured.values())


def test_weights_of_another_type_are_refused() -> None:
    loss = make_loss("ddpg", dtype=torch.float64)
    with pytest.raises(
        ValueError, match=r"matmul_dtype='bfloat16' needs weights in torch.float32, got torch.f"
    ):
        make(FusedLearner, loss, matmul_dtype="bfloat16")


def test_products_that_there_are_not_are_refused() -> None:
    loss = make_loss("ddpg", dtype=torch.float32)
    with pytest.raises(ValueError, match="matmul_dtype must be one of float32, bfloat16, got 'float16'"):
        make(FusedLearner, loss, matmul_dtype="float16")
