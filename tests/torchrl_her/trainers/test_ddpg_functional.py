"""Gradients written out against autograd, and Adam's step against PyTorch's."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_her.trainers.ddpg_functional import (
    Adam,
    Layer,
    Layers,
    action_slope,
    actor_gradients,
    adam_,
    bias_corrections,
    clip_each_run,
    critic_gradients,
    run_actor,
    run_critic,
)

RUNS, ROWS, SEEN, ACTIONS, HIDDEN = 2, 5, 4, 3, 6


def make_layers(*widths: tuple[int, int]) -> Layers:
    def numbers(*shape: int) -> Tensor:
        return torch.randn(RUNS, *shape, dtype=torch.float64).requires_grad_()

    return [Layer(numbers(inputs, outputs), numbers(1, outputs)) for inputs, outputs in widths]


def make_actor_layers() -> Layers:
    return make_layers((SEEN, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, ACTIONS))


def make_critic_layers() -> Layers:
    return make_layers((SEEN, HIDDEN), (HIDDEN + ACTIONS, HIDDEN), (HIDDEN, 1))


def seen() -> Tensor:
    return torch.randn(RUNS, ROWS, SEEN, dtype=torch.float64)


def detached(layers: Layers) -> Layers:
    return [Layer(layer.weight.detach(), layer.bias.detach()) for layer in layers]


def plain_actor(layers: Layers, x: Tensor) -> Tensor:
    for layer in layers[:-1]:
        x = (x @ layer.weight + layer.bias).relu()
    return (x @ layers[-1].weight + layers[-1].bias).tanh()


def plain_critic(layers: Layers, x: Tensor, action: Tensor) -> Tensor:
    x = torch.cat(((x @ layers[0].weight + layers[0].bias).relu(), action), -1)
    x = (x @ layers[1].weight + layers[1].bias).relu()
    return x @ layers[2].weight + layers[2].bias


def test_the_actor_s_gradients_are_autograd_s() -> None:
    layers, x, slope = make_actor_layers(), seen(), torch.randn(RUNS, ROWS, ACTIONS, dtype=torch.float64)
    action = plain_actor(layers, x)
    expected = torch.autograd.grad((action * slope).sum(), [entry for layer in layers for entry in layer])
    outputs = run_actor(detached(layers), x)
    torch.testing.assert_close(outputs[-1], action.detach())
    torch.testing.assert_close(actor_gradients(detached(layers), outputs, slope), list(expected))


def test_the_critic_s_gradients_and_slopes_are_autograd_s() -> None:
    layers, x, slope = make_critic_layers(), seen(), torch.randn(RUNS, ROWS, 1, dtype=torch.float64)
    action = torch.rand(RUNS, ROWS, ACTIONS, dtype=torch.float64).requires_grad_()
    value = plain_critic(layers, x, action)
    wanted = [*(entry for layer in layers for entry in layer), action]
    *expected, by_action = torch.autograd.grad((value * slope).sum(), wanted)
    outputs = run_critic(detached(layers), x, action.detach())
    torch.testing.assert_close(outputs[-1], value.detach())
    torch.testing.assert_close(critic_gradients(detached(layers), outputs, slope), expected)
    torch.testing.assert_close(action_slope(detached(layers), outputs, slope), by_action)


def test_each_run_is_clipped_by_itself() -> None:
    gradients = [torch.tensor([[[3.0]], [[0.3]]]), torch.tensor([[[4.0]], [[0.4]]])]
    first, second = clip_each_run(gradients, 1.0)
    torch.testing.assert_close(first.flatten(), torch.tensor([0.6, 0.3]))
    torch.testing.assert_close(second.flatten(), torch.tensor([0.8, 0.4]))


def test_steps_of_adam_are_pytorch_s() -> None:
    value = torch.randn(RUNS, 4, 3, dtype=torch.float64)
    parameter = torch.nn.Parameter(value.clone())
    optimizer = torch.optim.Adam([parameter], lr=0.03, betas=(0.8, 0.95), eps=1e-6)
    moments, count = (torch.zeros_like(value), torch.zeros_like(value)), torch.zeros(())
    for step in range(1, 6):
        gradient = torch.randn_like(value)
        parameter.grad = gradient.clone()
        optimizer.step()
        size, spread = (value.new_tensor(number) for number in bias_corrections(step, 0.03, (0.8, 0.95)))
        adam_([value], [gradient], Adam([moments[0]], [moments[1]], [count], size, spread, (0.8, 0.95), 1e-6))
        torch.testing.assert_close(value, parameter.detach())
    assert float(count) == 5.0
