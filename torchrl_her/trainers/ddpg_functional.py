"""DDPG's gradients written out by hand: functions of stacked weights and transitions, without autograd.

With small networks, autograd spends most of its time on the bookkeeping around a hundred small products.
Written out, the whole gradient step is plain tensor code, which compiles into one program.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Layer(NamedTuple):
    """Weights [R, inputs, outputs] and biases [R, 1, outputs] of one layer of R networks."""

    weight: Tensor
    bias: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """[R, B, inputs] to [R, B, outputs]."""
        return torch.baddbmm(self.bias, x, self.weight)

    def back(self, slope: Tensor) -> Tensor:
        """The gradient of a loss in the inputs, from its gradient in the outputs."""
        return torch.bmm(slope, self.weight.mT)


Layers = list[Layer]


class Networks(NamedTuple):
    """The layers of DDPG's four networks."""

    actor: Layers
    critic: Layers
    target_actor: Layers
    target_critic: Layers


class Weights(NamedTuple):
    """The same as lists of tensors: weight, bias, weight, ..., first the actor's and then the critic's."""

    values: list[Tensor]
    targets: list[Tensor]

    def networks(self, actor_layers: int) -> Networks:
        """The layers that these weights belong to."""
        layers = [
            [Layer(w, b) for w, b in zip(own[::2], own[1::2], strict=True)]
            for own in (self.values, self.targets)
        ]
        return Networks(*(part for own in layers for part in (own[:actor_layers], own[actor_layers:])))


class Rows(NamedTuple):
    """The transitions that a step learns from, [R, B, width] each.

    ``seen`` and ``next_seen`` are the joined inputs of actor and critic; ``weight`` are importance weights
    with any mean, None for all alike; ``discount`` [R, B, 1] is that of the next state's value where rows
    span several steps, None for the discount of one step in all rows.
    """

    seen: Tensor
    action: Tensor
    next_seen: Tensor
    reward: Tensor
    terminated: Tensor
    weight: Tensor | None = None
    discount: Tensor | None = None


class Settings(NamedTuple):
    """Discount, least and greatest target, action L2 penalty, greatest norm of a network's gradient."""

    gamma: float
    low: float
    high: float
    action_penalty: float
    max_grad_norm: float


class Adam(NamedTuple):
    """The state of a :class:`torch.optim.Adam` without extras; lists have one entry for each parameter.

    ``size`` and ``spread`` are the bias corrections of the coming step. They are tensors [] and not computed
    in the compiled step, which would compute them again for each weight.
    """

    first_moments: list[Tensor]
    second_moments: list[Tensor]
    counts: list[Tensor]
    size: Tensor
    spread: Tensor
    betas: tuple[float, float]
    eps: float


class Step(NamedTuple):
    """What a step computes: clipped gradients of all parameters, squared TD errors [R, B, 1], losses [R]."""

    actor: list[Tensor]
    critic: list[Tensor]
    squares: Tensor
    loss_actor: Tensor
    loss_value: Tensor


def run_actor(layers: Layers, seen: Tensor) -> list[Tensor]:
    """The input and all layers' outputs of :class:`~torchrl_her.modules.ActorNet`, the action last."""
    outputs = [seen]
    for layer in layers[:-1]:
        outputs.append(layer(outputs[-1]).relu_())
    return [*outputs, layers[-1](outputs[-1]).tanh_()]


def actor_gradients(layers: Layers, outputs: list[Tensor], slope: Tensor) -> list[Tensor]:
    """Gradients of all weights and biases, from the gradient ``slope`` [R, B, a] of a loss in the action."""
    slope = slope * (1.0 - outputs[-1].square())
    gradients = _gradients(outputs[-2], slope)
    for i in range(len(layers) - 1, 0, -1):
        slope = _relu_back(layers[i].back(slope), outputs[i])
        gradients = _gradients(outputs[i - 1], slope) + gradients
    return gradients


def run_critic(layers: Layers, seen: Tensor, action: Tensor) -> list[Tensor]:
    """The input and all layers' outputs of :class:`~torchrl_her.modules.CriticNet`, the value last."""
    outputs = [seen, torch.cat((layers[0](seen).relu_(), action), -1)]
    for layer in layers[1:-1]:
        outputs.append(layer(outputs[-1]).relu_())
    return [*outputs, layers[-1](outputs[-1])]


def critic_gradients(layers: Layers, outputs: list[Tensor], slope: Tensor) -> list[Tensor]:
    """Gradients of all weights and biases, from the gradient ``slope`` [R, B, 1] of a loss in the value."""
    gradients = _gradients(outputs[-2], slope)
    for i in range(len(layers) - 1, 0, -1):
        width = layers[i - 1].bias.shape[-1]  # behind the first layer without the action
        slope = _relu_back(layers[i].back(slope)[..., :width], outputs[i][..., :width])
        gradients = _gradients(outputs[i - 1], slope) + gradients
    return gradients


def action_slope(layers: Layers, outputs: list[Tensor], slope: Tensor) -> Tensor:
    """The gradient [R, B, a] of a loss in the action, from its gradient ``slope`` [R, B, 1] in the value."""
    for i in range(len(layers) - 1, 1, -1):
        slope = _relu_back(layers[i].back(slope), outputs[i])
    return layers[1].back(slope)[..., layers[0].bias.shape[-1] :]


def clip_each_run(gradients: Sequence[Tensor], max_norm: float) -> list[Tensor]:
    """The gradients [R, ...] of one network, clipped separately for each run."""
    runs = len(gradients[0])
    _, scale = norms_of_runs([gradient.reshape(runs, -1) for gradient in gradients], max_norm)
    return [gradient * scale.view(runs, 1, 1) for gradient in gradients]


def norms_of_runs(blocks: Sequence[Tensor], max_norm: float) -> tuple[Tensor, Tensor]:
    """Norms [R] of gradients [R, n] over all blocks, and the factors [R] that clip each run's gradients."""
    norms = torch.cat(list(blocks), 1).norm(dim=1)
    return norms, (max_norm / (norms + 1e-6)).clamp(max=1.0)  # as torch's clip_grad_norm_


def clamped_targets(networks: Networks, rows: Rows, settings: Settings) -> Tensor:
    """The targets [R, B, 1] of :class:`~torchrl_her.objectives.ClampedTD0`."""
    action = run_actor(networks.target_actor, rows.next_seen)[-1]
    value = run_critic(networks.target_critic, rows.next_seen, action)[-1]
    value = value.masked_fill(rows.terminated, 0.0)
    discount = settings.gamma if rows.discount is None else rows.discount
    return (rows.reward + discount * value).clamp(settings.low, settings.high)


def ddpg_gradients(networks: Networks, rows: Rows, settings: Settings) -> Step:
    """The gradients of one step of DDPG: those of TorchRL's loss, clipped for each network of each run.

    Lillicrap et al., Continuous control with deep reinforcement learning, 2016, algorithm 1, with the
    targets clamped and the action L2 penalty as in Andrychowicz et al., 2017, appendix A.
    """
    batch, actions = rows.action.shape[1:]
    weight = torch.ones_like(rows.reward) if rows.weight is None else rows.weight
    weight = weight / weight.mean(1, keepdim=True)
    outputs = run_critic(networks.critic, rows.seen, rows.action)
    error = outputs[-1] - clamped_targets(networks, rows, settings)
    value_gradients = critic_gradients(networks.critic, outputs, error * weight * (2.0 / batch))

    actor_outputs = run_actor(networks.actor, rows.seen)
    action = actor_outputs[-1]
    wished = run_critic(networks.critic, rows.seen, action)
    penalty = settings.action_penalty / (batch * actions)
    slope = action_slope(networks.critic, wished, weight * (-1.0 / batch)) + (2.0 * penalty) * action
    squares = error.square()
    return Step(
        clip_each_run(actor_gradients(networks.actor, actor_outputs, slope), settings.max_grad_norm),
        clip_each_run(value_gradients, settings.max_grad_norm),
        squares,
        action.square().sum((1, 2)) * penalty - (wished[-1] * weight).mean((1, 2)),
        (squares * weight).mean((1, 2)),
    )


def adam_(values: Sequence[Tensor], gradients: Sequence[Tensor], adam: Adam) -> None:
    """One step of Adam in place: Kingma and Ba, 2015, algorithm 1, with the roundings of PyTorch's Adam."""
    beta1, beta2 = adam.betas
    moments = zip(adam.first_moments, adam.second_moments, strict=True)
    for count in adam.counts:
        count.add_(1.0)
    for value, gradient, (first, second) in zip(values, gradients, moments, strict=True):
        first.lerp_(gradient, 1.0 - beta1)
        second.mul_(beta2).addcmul_(gradient, gradient, value=1.0 - beta2)
        value.sub_(adam.size * first / (second.sqrt() / adam.spread + adam.eps))


def bias_corrections(count: float, learning_rate: float, betas: tuple[float, float]) -> tuple[float, float]:
    """Adam's step size at step number ``count``, and the divisor of the root of its second moment."""
    return learning_rate / (1.0 - betas[0] ** count), math.sqrt(1.0 - betas[1] ** count)


def ddpg_update_(
    weights: Weights, adam: Adam, rows: Rows, settings: Settings, *, actor_layers: int, tau: float
) -> Step:
    """One whole update, in place: gradients, Adam, and the soft update of the targets.

    Each tensor is passed only once: a compiled function that changes a tensor of which it also gets a view
    spends as much time on telling the two apart as on its work.
    """
    step = ddpg_gradients(weights.networks(actor_layers), rows, settings)
    adam_(weights.values, step.actor + step.critic, adam)
    for target, value in zip(weights.targets, weights.values, strict=True):
        target.lerp_(value, tau)
    return step


def _relu_back(slope: Tensor, output: Tensor) -> Tensor:
    return torch.ops.aten.threshold_backward(slope, output, 0.0)


def _gradients(inputs: Tensor, slope: Tensor) -> list[Tensor]:
    """Gradients of a layer's weight and bias."""
    return [torch.bmm(inputs.mT, slope), slope.sum(1, keepdim=True)]
