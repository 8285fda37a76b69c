"""Adam with a count of steps for each run, beside torch's own for each of them."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from tests.torchrl_her.trainers.fused_cases import make_loss
from torchrl_her.trainers import RunsAdam


@pytest.mark.parametrize("algorithm", ["ddpg", "sac"])
def test_runs_that_learn_together_take_torch_s_steps(algorithm: str) -> None:
    ours, theirs = make_loss(algorithm, runs=2), make_loss(algorithm, runs=2)
    theirs.load_state_dict(ours.state_dict())
    options = {"lr": 0.01, "betas": (0.8, 0.95), "eps": 1e-6}
    pairs = [
        (ours, RunsAdam(ours, runs=2, **options)),
        (theirs, torch.optim.Adam(theirs.parameters(), **options)),
    ]
    for _ in range(5):
        for loss, optimizer in pairs:
            optimizer.zero_grad()
            sum(own.sin().square().sum() for own in loss.parameters()).backward()
            optimizer.step()
    for own, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(own, other, atol=1e-14, rtol=0)


def test_the_first_step_of_a_late_run_is_as_long_as_that_of_the_others() -> None:
    weight = nn.Linear(1, 2, bias=False)  # as if of two runs
    optimizer = RunsAdam(weight, lr=0.1, runs=2)
    for _ in range(10):
        weight.weight.grad = torch.ones(2, 1)
        optimizer.step()
    state = optimizer.state[weight.weight]
    for own in state.values():
        own[1] = 0  # the second run has not learned yet
    before = weight.weight.detach().clone()
    optimizer.step()
    assert (before - weight.weight)[1].item() == pytest.approx(0.1, rel=1e-5)
    assert state["step"].flatten().tolist() == [11, 1]
