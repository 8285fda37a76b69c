"""DDPG's gradient step written out: TorchRL's numbers, in a fraction of the time.

The loss module, its optimiser and its target networks stay what they are: this learner works on
their very weights, so checkpoints, state dicts and users see no difference. What is left out is
what small networks spend most of their time on, the bookkeeping around a hundred small products.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.losses import ClampedTD0, PenalisedDDPGLoss, clip_by_run
from torchrl_her.networks import ActorNet, CriticNet


class Layer(NamedTuple):
    """Weights [R, inputs, outputs] and biases [R, 1, outputs] of one layer of R networks."""

    weight: Tensor
    bias: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """[R, B, inputs] to [R, B, outputs]."""
        return torch.baddbmm(self.bias, x, self.weight)

    def back(self, slope: Tensor) -> Tensor:
        """The slope of a loss in the inputs, from that in the outputs."""
        return torch.bmm(slope, self.weight.mT)


def _relu_back(slope: Tensor, output: Tensor) -> Tensor:
    return torch.ops.aten.threshold_backward(slope, output, 0.0)


def _gradients(inputs: Tensor, slope: Tensor) -> list[Tensor]:
    """Gradients of a layer's weight and bias."""
    return [torch.bmm(inputs.mT, slope), slope.sum(1, keepdim=True)]


def run_actor(layers: list[Layer], seen: Tensor) -> list[Tensor]:
    """Inputs and outputs of all layers of :class:`~torchrl_her.ActorNet`; the action [R, B, a] is last."""
    outputs = [seen]
    for layer in layers[:-1]:
        outputs.append(layer(outputs[-1]).relu_())
    return [*outputs, layers[-1](outputs[-1]).tanh_()]


def actor_gradients(layers: list[Layer], outputs: list[Tensor], slope: Tensor) -> list[Tensor]:
    """Gradients of all weights and biases, from the slope [R, B, a] of a loss in the action."""
    slope = slope * (1.0 - outputs[-1].square())
    gradients = _gradients(outputs[-2], slope)
    for i in range(len(layers) - 1, 0, -1):
        slope = _relu_back(layers[i].back(slope), outputs[i])
        gradients = _gradients(outputs[i - 1], slope) + gradients
    return gradients


def run_critic(layers: list[Layer], seen: Tensor, action: Tensor) -> list[Tensor]:
    """Inputs and outputs of all layers of :class:`~torchrl_her.CriticNet`; the value [R, B, 1] is last."""
    outputs = [seen, torch.cat((layers[0](seen).relu_(), action), -1)]
    for layer in layers[1:-1]:
        outputs.append(layer(outputs[-1]).relu_())
    return [*outputs, layers[-1](outputs[-1])]


def critic_gradients(layers: list[Layer], outputs: list[Tensor], slope: Tensor) -> list[Tensor]:
    """Gradients of all weights and biases, from the slope [R, B, 1] of a loss in the value."""
    gradients = _gradients(outputs[-2], slope)
    for i in range(len(layers) - 1, 0, -1):
        width = layers[i - 1].bias.shape[-1]  # behind the first layer without the action
        slope = _relu_back(layers[i].back(slope)[..., :width], outputs[i][..., :width])
        gradients = _gradients(outputs[i - 1], slope) + gradients
    return gradients


def action_slope(layers: list[Layer], outputs: list[Tensor], slope: Tensor) -> Tensor:
    """The slope of a loss in the action [R, B, a], from that in the value [R, B, 1]."""
    for i in range(len(layers) - 1, 1, -1):
        slope = _relu_back(layers[i].back(slope), outputs[i])
    return layers[1].back(slope)[..., layers[0].bias.shape[-1] :]


def can_fuse(loss: nn.Module, target: TargetNetUpdater | None) -> bool:
    """Whether :class:`FusedDDPGLearner` knows all of a loss: its type, networks, targets and keys."""
    if type(loss) is not PenalisedDDPGLoss or type(target) is not SoftUpdate:
        return False
    actor, critic = loss.actor_network, loss.value_network
    keys = loss.tensor_keys
    return (
        type(actor.module) is ActorNet
        and type(critic.module) is CriticNet
        and not any(isinstance(module, nn.BatchNorm1d) for module in critic.modules())
        and type(loss.value_estimator) is ClampedTD0
        and loss.loss_function == "l2"
        and list(critic.in_keys) == [*actor.in_keys, *actor.out_keys]
        and (keys.reward, keys.terminated, keys.priority_weight)
        == ("reward", "terminated", "priority_weight")
    )


class FusedDDPGLearner:
    """A :class:`~torchrl_her.Learner` for :class:`~torchrl_her.PenalisedDDPGLoss`.

    Args:
        loss: with :class:`~torchrl_her.ActorNet` and :class:`~torchrl_her.CriticNet` without batch
            normalisation, as :func:`~torchrl_her.make_ddpg_loss` makes it.
        optimiser: over the loss module's parameters; must treat each number by itself, as Adam does.
        target: of the loss.
        max_grad_norm: the gradients of each network of each run are clipped to this norm, apart.

    Raises:
        ValueError: :func:`can_fuse` says no; use :class:`~torchrl_her.LossLearner`.

    Example:
        >>> from torchrl_her import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> learner = FusedDDPGLearner(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.01))
    """

    def __init__(
        self,
        loss: PenalisedDDPGLoss,
        optimiser: torch.optim.Optimizer,
        target: SoftUpdate,
        *,
        max_grad_norm: float = 3.0,
    ) -> None:
        if not can_fuse(loss, target):
            raise ValueError("only DDPG with the networks of make_actor and make_critic can be fused")
        self.loss, self.optimiser, self.max_grad_norm = loss, optimiser, max_grad_norm
        self.gamma = float(loss.value_estimator.gamma)
        self.tau = 1.0 - float(target.eps)
        self.runs: int = loss.actor_network.module.runs
        self._in_keys = list(loss.actor_network.in_keys)
        self._next_keys = [("next", key) for key in self._in_keys]
        self._action_key = loss.actor_network.out_keys[0]
        self._networks = [
            _parameters(loss.actor_network.module, loss.actor_network_params),
            _parameters(loss.value_network.module, loss.value_network_params),
        ]
        targets = [
            _parameters(loss.actor_network.module, loss.target_actor_network_params),
            _parameters(loss.value_network.module, loss.target_value_network_params),
        ]
        self._values = [p.data for network in self._networks for p in network]
        self._targets = [p.data for network in targets for p in network]
        self._actor, self._critic = (_layers(network) for network in self._networks)
        self._target_actor, self._target_critic = (_layers(network) for network in targets)

    @torch.no_grad()
    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One gradient step of each run on rows [R, B]."""
        seen = self._rows(batch, self._in_keys)
        weight = self._weight(batch)
        critic = run_critic(self._critic, seen, self._rows(batch, [self._action_key]))
        error = critic[-1] - self._target(batch)
        squares = error.square()
        value_gradients = critic_gradients(self._critic, critic, error * weight * (2.0 / seen.shape[1]))

        actor = run_actor(self._actor, seen)
        action = actor[-1]
        wished = run_critic(self._critic, seen, action)
        slope = action_slope(self._critic, wished, weight.expand_as(error) / -seen.shape[1])
        price = self.loss.action_penalty / (action.shape[1] * action.shape[2])
        slope = slope.add(action, alpha=2.0 * price)
        self._step(actor_gradients(self._actor, actor, slope), value_gradients)
        batch.set(self.loss.tensor_keys.priority, squares.view(batch.batch_size))
        return {
            "loss_actor": action.square().sum((1, 2)) * price - (wished[-1] * weight).mean((1, 2)),
            "loss_value": (squares * weight).mean((1, 2)),
        }

    def _rows(self, batch: TensorDictBase, keys: list) -> Tensor:
        """Entries beside each other, [R, B, width]."""
        values = [batch.get(key) for key in keys]
        joined = torch.cat(values, -1) if len(values) > 1 else values[0]
        return joined.reshape(self.runs, -1, joined.shape[-1])

    def _weight(self, batch: TensorDictBase) -> Tensor:
        """Importance weights [R, B, 1] of mean 1 in each run."""
        weight = batch.get("priority_weight", None)
        if weight is None:
            return self._values[0].new_ones(1, 1, 1)
        weight = weight.reshape(self.runs, -1, 1).to(self._values[0].dtype)
        return weight / weight.mean(1, keepdim=True)

    def _target(self, batch: TensorDictBase) -> Tensor:
        """The clamped one-step targets [R, B, 1]."""
        seen = self._rows(batch, self._next_keys)
        value = run_critic(self._target_critic, seen, run_actor(self._target_actor, seen)[-1])[-1]
        value.masked_fill_(self._rows(batch, [("next", "terminated")]), 0.0)
        estimator = self.loss.value_estimator
        reward = self._rows(batch, [("next", "reward")])
        return value.mul_(self.gamma).add_(reward).clamp_(estimator.low, estimator.high)

    def _step(self, *gradients: list[Tensor]) -> None:
        for network, own in zip(self._networks, gradients, strict=True):
            for parameter, gradient in zip(network, own, strict=True):
                parameter.grad = gradient
            clip_by_run(network, self.max_grad_norm, runs=self.runs)
        self.optimiser.step()
        torch._foreach_lerp_(self._targets, self._values, self.tau)


def _parameters(net: nn.Module, weights: TensorDictBase) -> list[nn.Parameter]:
    """A network's parameters in order, out of a loss module's collection: weight, bias, weight, ..."""
    flat = weights["module"].flatten_keys(".")
    return [flat[name] for name, _ in net.named_parameters()]


def _layers(parameters: list[nn.Parameter]) -> list[Layer]:
    return [Layer(w.data, b.data) for w, b in zip(parameters[::2], parameters[1::2], strict=True)]
