"""Runs side by side learn what each would learn alone."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_her import make_actor, make_critic, make_ddpg_loss
from torchrl_her.modules import NetworkShape, stack_runs, take_run
from torchrl_her.objectives import ActorTerms
from torchrl_her.trainers import clip_by_run

from ..ddpg_data import WEIGHT, batch, networks, step

# Most of these tests ask a loss for its numbers, and have no target networks to move.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater has been associated")


def test_clipping_by_run_is_clipping_each_run() -> None:
    gradients = [torch.randn(2, 3, 4), torch.randn(2, 1, 4)]
    gradients[0][0] *= 100.0
    gradients[0][1], gradients[1][1] = gradients[0][1] * 0.01, gradients[1][1] * 0.01
    stacked = [nn.Parameter(torch.zeros_like(gradient)) for gradient in gradients]
    for parameter, gradient in zip(stacked, gradients, strict=True):
        parameter.grad = gradient.clone()
    norms = clip_by_run(stacked, 3.0, runs=2)
    for run in range(2):
        single = [nn.Parameter(torch.zeros_like(gradient[run])) for gradient in gradients]
        for parameter, gradient in zip(single, gradients, strict=True):
            parameter.grad = gradient[run].clone()
        assert norms[run].item() == pytest.approx(nn.utils.clip_grad_norm_(single, 3.0).item(), rel=1e-5)
        for parameter, one in zip(stacked, single, strict=True):
            assert torch.allclose(parameter.grad[run], one.grad, rtol=1e-5)
    assert torch.equal(stacked[0].grad[1], gradients[0][1])  # short enough: not touched


@pytest.mark.parametrize("weighted", [False, True])
def test_runs_learn_together_what_they_learn_alone(weighted: bool) -> None:
    data = [batch(16) for _ in range(2)]
    if weighted:
        for own in data:
            own[WEIGHT] = torch.rand(16) + 0.1
    nets = [networks() for _ in range(2)]
    shape = NetworkShape(hidden=16)
    pair = make_actor((4, 2), 3, shape=shape, runs=2), make_critic((4, 2), 3, shape=shape, runs=2)
    for net, states in zip(pair, zip(*nets, strict=True), strict=True):
        net.load_state_dict(stack_runs([state.state_dict() for state in states]))
    terms = ActorTerms(action_penalty=0.5)
    options = {"max_grad_norm": 0.01}  # short enough to clip all of them
    together = make_ddpg_loss(*pair, terms=terms, reduction="none")
    measured = step(together, torch.stack(data), runs=2, **options)
    for run, (own, rows_of_run) in enumerate(zip(nets, data, strict=True)):
        alone = make_ddpg_loss(*own, terms=terms)
        single = step(alone, rows_of_run, **options)
        for key, value in single.items():
            assert measured[key][0, run].item() == pytest.approx(value.item(), rel=1e-4)
        for part in ("actor_network_params", "value_network_params"):
            expected = dict(getattr(alone, part).flatten_keys("."))
            taken = take_run(dict(getattr(together, part).flatten_keys(".")), run, 2)
            assert all(torch.allclose(taken[key], expected[key], atol=1e-6) for key in expected)
