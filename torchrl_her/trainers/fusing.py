"""Which losses, target updates and optimizers the fused gradient step does justice to."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import LossModule, SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.objectives.value import TD0Estimator

from torchrl_her.modules.networks import ActorNet, CriticNet
from torchrl_her.objectives.ddpg import PenalizedDDPGLoss
from torchrl_her.objectives.targets import ClampedTD0

_PLAIN = {ActorNet: ActorNet(1, 1, hidden=1), CriticNet: CriticNet(1, 1, hidden=1)}


def can_fuse(loss: nn.Module, target: TargetNetUpdater | None) -> bool:
    """Whether :class:`~torchrl_her.FusedDDPGLearner` does what a loss and its target update are set to do.

    Args:
        loss: any loss module.
        target: what moves its target networks.
    """
    return why_not_fused(loss, target) is None


def why_not_fused(loss: nn.Module, target: TargetNetUpdater | None) -> str | None:
    """What :class:`~torchrl_her.FusedDDPGLearner` would get wrong, for messages; None if nothing.

    Args:
        loss: any loss module.
        target: what moves its target networks.

    Example:
        >>> from torchrl_her import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> loss.reduction = "sum"
        >>> why_not_fused(loss, SoftUpdate(loss, tau=0.01))
        "reduction='sum'"
    """
    if type(loss) is not PenalizedDDPGLoss:
        return f"a {type(loss).__name__}, not the loss of make_ddpg_loss"
    if target is None or type(target) is not SoftUpdate or target.loss_module is not loss:
        return "the targets do not follow this loss by a SoftUpdate"
    return next(_obstacles(loss), None)


def is_plain_adam(optimizer: torch.optim.Optimizer, loss: LossModule | None = None) -> bool:
    """Whether a compiled step can do the work of an optimizer: Adam with one group and without extras.

    Args:
        optimizer: any optimizer.
        loss: the optimizer must hold exactly its parameters; None if that does not matter.
    """
    if type(optimizer) is not torch.optim.Adam or len(optimizer.param_groups) != 1:
        return False
    (group,) = optimizer.param_groups
    extras = ("weight_decay", "amsgrad", "maximize", "differentiable")
    if any(group[name] for name in extras) or any(isinstance(beta, torch.Tensor) for beta in group["betas"]):
        return False
    if optimizer._optimizer_step_pre_hooks or optimizer._optimizer_step_post_hooks:
        return False
    return loss is None or _ids(group["params"]) == _ids(loss.parameters())


def _ids(parameters: Iterator[nn.Parameter] | list[nn.Parameter]) -> set[int]:
    return {id(parameter) for parameter in parameters}


def _obstacles(loss: PenalizedDDPGLoss) -> Iterator[str]:
    """All options that the fused step does not know."""
    if not (loss.delay_actor and loss.delay_value):
        yield f"delay_actor={loss.delay_actor}, delay_value={loss.delay_value}"
    if loss.loss_function != "l2":
        yield f"loss_function={loss.loss_function!r}"
    if loss.reduction not in ("mean", "none"):
        yield f"reduction={loss.reduction!r}"
    yield from _strange_networks(loss)
    yield from _strange_keys(loss)
    yield from _strange_targets(loss)
    # TorchRL puts one hook on each loss, which warns if nothing updates its targets.
    if _has_hooks(loss, own=1) or any(_has_hooks(module) for module in _modules(loss)):
        yield "hooks on the loss or its networks"
    if not all(p.requires_grad for p in _parameters(loss)):
        yield "frozen parameters"
    if len(_ids(_parameters(loss))) != len(_parameters(loss)):
        yield "actor and critic share parameters"
    if any(p._backward_hooks or p._post_accumulate_grad_hooks for p in _parameters(loss)):
        yield "hooks on parameters"


def _strange_networks(loss: PenalizedDDPGLoss) -> Iterator[str]:
    actor, critic = loss.actor_network, loss.value_network
    # Exact types: subclasses may compute something else.
    if any(type(module) is not TensorDictModule for module in (actor, critic)):
        yield f"a {type(actor).__name__} and a {type(critic).__name__}, not plain TensorDictModules"
    elif type(actor.module) is not ActorNet or type(critic.module) is not CriticNet:
        yield f"{type(actor.module).__name__} and {type(critic.module).__name__} as networks"
    elif actor.module.runs != critic.module.runs:
        yield f"{actor.module.runs} actors and {critic.module.runs} critics"
    else:
        for own in (actor, critic):
            if _types(own.module) != _types(_PLAIN[type(own.module)]):
                yield f"other layers than those of a plain {type(own.module).__name__}"
            if own._kwargs or own._get_kwargs or own.method is not None or own.method_kwargs:
                yield "options of a network's TensorDictModule"


def _strange_keys(loss: PenalizedDDPGLoss) -> Iterator[str]:
    actor, critic, keys = loss.actor_network, loss.value_network, loss.tensor_keys
    if list(critic.in_keys) != [*actor.in_keys, *actor.out_keys]:
        yield f"a critic that reads {critic.in_keys}, not what the actor reads and writes, in that order"
    if critic.out_keys != [keys.state_action_value]:
        yield f"a critic that writes {critic.out_keys}, not {keys.state_action_value!r}"
    for name in ("reward", "terminated", "done", "priority_weight"):
        if getattr(keys, name) != name:
            yield f"{name} under the key {getattr(keys, name)!r}"


def _strange_targets(loss: PenalizedDDPGLoss) -> Iterator[str]:
    estimator = loss.value_estimator
    if type(estimator) is not ClampedTD0:
        yield f"targets of a {type(estimator).__name__}"
        return
    if estimator.value_network is not loss.actor_critic or estimator.tensor_keys.value != (
        loss.tensor_keys.state_action_value
    ):
        yield "targets from other networks than the loss's"
    for name in ("reward", "terminated", "done"):
        if getattr(estimator.tensor_keys, name) != name:
            yield f"{name} of the targets under the key {getattr(estimator.tensor_keys, name)!r}"
    plain = TD0Estimator(gamma=0.0, value_network=None)
    for name in ("average_rewards", "shifted", "differentiable", "skip_existing", "group_key"):
        if getattr(estimator, name) != getattr(plain, name):
            yield f"targets with {name}={getattr(estimator, name)!r}"
    if estimator.gamma.numel() != 1:
        yield f"a discount of shape {list(estimator.gamma.shape)}"
    if estimator._forward_hooks or estimator._forward_pre_hooks:
        yield "hooks on the value estimator"


def _types(net: nn.Module) -> list[type]:
    return [type(module) for module in net.modules()]


def _has_hooks(module: nn.Module, own: int = 0) -> bool:
    pre = len(module._forward_pre_hooks) + len(module._backward_pre_hooks)
    return pre > own or bool(module._forward_hooks or module._backward_hooks)


def _modules(loss: PenalizedDDPGLoss) -> list[nn.Module]:
    return [module for net in (loss.actor_network, loss.value_network) for module in net.modules()]


def _parameters(loss: PenalizedDDPGLoss) -> list[nn.Parameter]:
    both = (loss.actor_network_params, loss.value_network_params)
    return [value for params in both for value in params.values(True, True)]
