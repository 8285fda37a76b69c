"""DDPG's gradient step without TensorDicts in between: TorchRL's numbers, in a third of the time.

The loss module, its optimiser and its target networks stay what they are: this learner works on
their very weights, so checkpoints, state dicts and users see no difference.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.losses import ClampedTD0, PenalisedDDPGLoss, clip_by_run
from torchrl_her.networks import ActorNet, CriticNet


def can_fuse(loss: nn.Module, target: TargetNetUpdater | None) -> bool:
    """Whether :class:`FusedDDPGLearner` knows all of a loss: its type, networks, targets and keys."""
    if type(loss) is not PenalisedDDPGLoss or type(target) is not SoftUpdate:
        return False
    actor, critic = loss.actor_network.module, loss.value_network.module
    known = type(actor) is ActorNet and type(critic) is CriticNet and type(loss.value_estimator) is ClampedTD0
    return known and not any(isinstance(module, nn.BatchNorm1d) for module in critic.modules())


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
        online = loss.actor_network_params, loss.value_network_params
        targets = loss.target_actor_network_params, loss.target_value_network_params
        nets = loss.actor_network.module, loss.value_network.module
        self._actor, self._critic = (
            _bind(net, own, grad=True) for net, own in zip(nets, online, strict=True)
        )
        self._fixed_critic = _bind(nets[1], online[1], grad=False)
        self._target_actor, self._target_critic = (
            _bind(net, own, grad=False) for net, own in zip(nets, targets, strict=True)
        )
        self._groups = [list(self._actor.parameters()), list(self._critic.parameters())]
        self._parameters = [parameter for group in self._groups for parameter in group]
        self._targets: list[Tensor] = [*self._target_actor.parameters(), *self._target_critic.parameters()]

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One gradient step of each run on rows [R, B]."""
        seen = torch.cat([batch.get(key) for key in self._in_keys], -1)
        weight = batch.get("priority_weight", None)
        if weight is not None:
            weight = weight.reshape(self.runs, -1)
            weight = weight / weight.mean(1, keepdim=True)
        error = (self._critic(seen, batch.get(self._action_key)) - self._target(batch)).reshape(self.runs, -1)
        action = self._actor(seen)
        value = self._fixed_critic(seen, action).reshape(self.runs, -1)
        squares = error.square()
        loss_value = (squares if weight is None else squares * weight).mean(1)
        loss_actor = -(value if weight is None else value * weight).mean(1)
        if self.loss.action_penalty:
            loss_actor = loss_actor + self.loss.action_penalty * action.reshape(self.runs, -1).square().mean(
                1
            )
        self._step(loss_value, loss_actor)
        batch.set(self.loss.tensor_keys.priority, squares.detach().view(batch.batch_size))
        return {"loss_actor": loss_actor.detach(), "loss_value": loss_value.detach()}

    @torch.no_grad()
    def _target(self, batch: TensorDictBase) -> Tensor:
        """The clamped one-step targets [..., 1]."""
        seen = torch.cat([batch.get(key) for key in self._next_keys], -1)
        value = self._target_critic(seen, self._target_actor(seen))
        value.masked_fill_(batch.get(("next", "terminated")), 0.0)
        target = torch.add(batch.get(("next", "reward")), value, alpha=self.gamma)
        estimator = self.loss.value_estimator
        return target.clamp_(estimator.low, estimator.high)

    def _step(self, loss_value: Tensor, loss_actor: Tensor) -> None:
        gradients = torch.autograd.grad((loss_value + loss_actor).sum(), self._parameters)
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        for group in self._groups:
            clip_by_run(group, self.max_grad_norm, runs=self.runs)
        self.optimiser.step()
        torch._foreach_lerp_(self._targets, [p.data for p in self._parameters], self.tau)


def _bind(net: nn.Module, parameters: TensorDictBase, *, grad: bool) -> nn.Module:
    """A copy of a network that works on given weights: the very parameters, or their values alone."""
    bound = deepcopy(net)
    weights = parameters["module"].flatten_keys(".")
    for name, module, key in _slots(bound):
        tensor = weights[name]
        module._parameters[key] = tensor if grad else nn.Parameter(tensor.data, requires_grad=False)
    return bound


def _slots(net: nn.Module) -> Iterable[tuple[str, nn.Module, str]]:
    """(name, module, key) of all parameters of a network."""
    for path, module in net.named_modules():
        for key in module._parameters:
            yield f"{path}.{key}", module, key
