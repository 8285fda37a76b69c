"""Checks which losses, networks, target updates and optimizers fused gradient steps can reproduce."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import torch
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import QValueActor, TanhNormal
from torchrl.objectives import DQNLoss, HardUpdate, LossModule, SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.objectives.value import TD0Estimator

from torchrl_her.modules.networks import (
    ActorNet,
    CriticNet,
    StackedBatchNorm,
    StackedLayerNorm,
    StackedLinear,
)
from torchrl_her.modules.q_actor import QNet
from torchrl_her.modules.stochastic_actor import StochasticActorNet
from torchrl_her.native.job import STOCHASTIC, Activation, Algorithm, Layer, Norm
from torchrl_her.objectives.critics import action_key
from torchrl_her.objectives.ddpg import PenalizedDDPGLoss
from torchrl_her.objectives.sac import PenalizedSACLoss
from torchrl_her.objectives.targets import BuffersSoftUpdate, ClampedTD0, RunsHardUpdate
from torchrl_her.objectives.td3 import PenalizedTD3Loss
from torchrl_her.objectives.tqc import PenalizedTQCLoss
from torchrl_her.torchrl_private import has_keyword_arguments
from torchrl_her.trainers.adam import RunsAdam


@dataclass(frozen=True)
class FusedLoss:
    """Description of a type of loss that can be fused: its networks, and the options that it must have.

    Attributes:
        algorithm: algorithm of the compiled steps.
        actor_net: type of the actor's network.
        losses: the names of the losses that are reported.
        fixed: attributes of the loss and the values that they must have, besides those of all losses.
        actor: the attribute of the actor, or of the values of discrete actions.
        critic: the attribute of the critic or critics, None if there is none.
    """

    algorithm: Algorithm
    actor_net: type[nn.Module]
    losses: tuple[str, ...]
    fixed: dict[str, Any]
    actor: str = "actor_network"
    critic: str | None = "qvalue_network"


_KEYS = ("reward", "terminated", "done")
_FIXED: dict[str, Any] = {  # attributes of each loss and the values that they must have
    **{f"tensor_keys.{key}": key for key in (*_KEYS, "priority_weight")},
    **{f"value_estimator.tensor_keys.{key}": key for key in _KEYS},
    "value_estimator.average_rewards": False,
    "value_estimator.shifted": False,
    "value_estimator.skip_existing": None,
    "value_estimator.group_key": None,
}
# SAC and TQC compute their targets without gradients, even with TorchRL's default of differentiable targets.
_HARD = {"value_estimator.differentiable": False, "loss_function": "l2"}
_SOFT = {
    "delay_actor": False,
    "delay_qvalue": True,
    "skip_done_states": False,
    "fixed_alpha": False,
    "min_log_alpha": None,
    "max_log_alpha": None,
    "_version": 2,
}
_SOFT_LOSSES = ("loss_actor", "loss_qvalue", "loss_alpha")

FUSED: dict[type[LossModule], FusedLoss] = {
    PenalizedDDPGLoss: FusedLoss(
        Algorithm.DDPG,
        ActorNet,
        ("loss_actor", "loss_value"),
        {**_HARD, "delay_actor": True, "delay_value": True},
        critic="value_network",
    ),
    PenalizedTD3Loss: FusedLoss(
        Algorithm.TD3,
        ActorNet,
        ("loss_actor", "loss_qvalue"),
        {**_HARD, "delay_actor": True, "delay_qvalue": True},
    ),
    PenalizedSACLoss: FusedLoss(
        Algorithm.SAC, StochasticActorNet, _SOFT_LOSSES, {**_SOFT, "loss_function": "l2"}
    ),
    PenalizedTQCLoss: FusedLoss(
        Algorithm.TQC, StochasticActorNet, _SOFT_LOSSES, {**_SOFT, "loss_function": "smooth_l1"}
    ),
    DQNLoss: FusedLoss(
        Algorithm.DQN,
        QNet,
        ("loss",),
        {**_HARD, "delay_value": True, "double_dqn": True, "action_space": "categorical"},
        actor="value_network",
        critic=None,
    ),
}

_NETWORKS = (ActorNet, CriticNet, QNet, StochasticActorNet)
_ACTIVATIONS = {nn.ReLU: Activation.RELU, nn.Tanh: Activation.TANH, nn.ELU: Activation.ELU}
_NORMS = {StackedLayerNorm: Norm.LAYERNORM, StackedBatchNorm: Norm.BATCHNORM}


def why_not_fused(loss: nn.Module, target: TargetNetUpdater | None) -> str | None:
    """Returns the reason why :class:`~torchrl_her.FusedLearner` cannot train a loss; None if it can.

    Args:
        loss: any loss module.
        target: update of its target networks.

    Example:
        >>> from torchrl_her import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> loss.reduction = "sum"
        >>> why_not_fused(loss, SoftUpdate(loss, tau=0.01))
        "reduction='sum'"
    """
    if getattr(getattr(loss, "terms", None), "cloning", None) is not None:
        return "behavior cloning of demonstrations, which the C++ steps do not have"
    if type(loss) not in FUSED:
        return f"a {type(loss).__name__}, which is not a loss that this library makes"
    if (
        type(target) not in (SoftUpdate, BuffersSoftUpdate, HardUpdate, RunsHardUpdate)
        or target is None
        or target.loss_module is not loss
    ):
        return "targets that do not follow this loss by a SoftUpdate or HardUpdate"
    fused = FUSED[type(loss)]
    has_statistics = any(isinstance(module, StackedBatchNorm) for module in _modules(loss, fused))
    if has_statistics and type(target) is SoftUpdate:
        return "running statistics that this SoftUpdate does not move, but that of make_target_updater does"
    return next(_obstacles(loss, fused), None)


def is_plain_adam(optimizer: torch.optim.Optimizer, loss: LossModule | None = None) -> bool:
    """Returns whether fused steps can replace an optimizer: Adam with one group and without extras.

    Args:
        optimizer: any optimizer.
        loss: the optimizer must hold exactly its parameters; None if that does not matter.
    """
    if type(optimizer) not in (torch.optim.Adam, RunsAdam) or len(optimizer.param_groups) != 1:
        return False
    (group,) = optimizer.param_groups
    extras = ("weight_decay", "amsgrad", "maximize", "differentiable")
    if any(group[name] for name in extras) or any(isinstance(beta, torch.Tensor) for beta in group["betas"]):
        return False
    if optimizer._optimizer_step_pre_hooks or optimizer._optimizer_step_post_hooks:
        return False
    return loss is None or set(map(id, group["params"])) == set(map(id, loss.parameters()))


def network_of(module: nn.Module) -> nn.Module:
    """Returns the network within the TensorDict module that a loss keeps."""
    if isinstance(module, TensorDictSequential):
        module = module[0]
    return module.module  # type: ignore[return-value]


def layers_of(net: nn.Module) -> list[Layer] | None:
    """Returns the layers of one of this library's networks, from its input on; None if it has other ones.

    The tensors of the layers, in the same order, are those of ``net.state_dict()``: weight and bias, then
    scale and shift of a normalization, and the running mean and variance of a batch normalization.

    Args:
        net: exactly one of this library's types, since a subclass may compute something else.

    Example:
        >>> [(layer.inputs, layer.outputs, layer.joined) for layer in layers_of(CriticNet(4, 2))]
        [(4, 64, 0), (66, 64, 2), (64, 64, 0), (64, 1, 0)]
    """
    if type(net) not in _NETWORKS:
        return None
    layers: list[Layer] = []
    fresh = False  # whether the last layer may still get a normalization, or an activation
    for module in net.modules():
        if module is net or type(module) is nn.Sequential:
            continue
        if type(module) is StackedLinear:
            inputs, outputs = module.weight.shape[-2:]
            joined = inputs - layers[-1].outputs if layers else 0
            layers.append(Layer(inputs, outputs, joined, Activation.NONE, Norm.PLAIN))
            fresh = True
        elif type(module) is StackedBatchNorm and not layers and _is_plain_layer(module):
            layers.append(Layer(0, module.weight.shape[-1], 0, Activation.NONE, Norm.BATCHNORM))
        elif type(module) in _NORMS and fresh and not layers[-1].norm and _is_plain_layer(module):
            layers[-1].norm = _NORMS[type(module)]
        elif type(module) in _ACTIVATIONS and fresh and _is_plain_layer(module):
            layers[-1].activation, fresh = _ACTIVATIONS[type(module)], False
        else:
            return None
    return layers


def tensor_shapes(layers: Sequence[Layer]) -> list[tuple[int, int]]:
    """Returns the last two dimensions of the parameters and running statistics of layers, in order."""
    shapes = []
    for layer in layers:
        product = [(layer.inputs, layer.outputs), (1, layer.outputs)] if layer.inputs else []
        shapes += [*product, *[(1, layer.outputs)] * (2 * layer.norm)]
    return shapes


def _obstacles(loss: LossModule, fused: FusedLoss) -> Iterator[str]:
    """Yields a description of each option that fused steps do not support."""
    estimator: Any = loss.value_estimator
    is_plain = type(estimator) is TD0Estimator and fused.algorithm in STOCHASTIC
    if type(estimator) is not ClampedTD0 and not is_plain:
        yield f"targets of a {type(estimator).__name__}"
        return
    for name, value in (_FIXED | fused.fixed).items():
        if (found := attrgetter(name)(loss)) != value:
            yield f"{name}={found!r}"
    if loss.reduction not in ("mean", "none"):
        yield f"reduction={loss.reduction!r}"
    yield from _strange_networks(loss, fused)
    yield from _strange_keys(loss, fused)
    if estimator.gamma.numel() != 1:
        yield f"a discount of shape {list(estimator.gamma.shape)}"
    # TorchRL puts one hook on each loss, which warns if nothing updates its targets.
    modules = [estimator, *_modules(loss, fused)]
    if _has_hooks(loss, expected=1) or any(_has_hooks(module) for module in modules):
        yield "hooks on the loss, its networks or its targets"
    parameters = list(loss.parameters())
    if not all(p.requires_grad for p in parameters):
        yield "frozen parameters"
    if any(p._backward_hooks or p._post_accumulate_grad_hooks for p in parameters):
        yield "hooks on parameters"
    kinds = {(p.device.type, p.dtype) for p in parameters}
    if len(kinds) > 1 or not kinds <= {("cpu", torch.float32), ("cpu", torch.float64)}:
        yield f"parameters that are {', '.join(f'{dtype} on {device}' for device, dtype in kinds)}"


def _strange_networks(loss: LossModule, fused: FusedLoss) -> Iterator[str]:
    actor = getattr(loss, fused.actor)
    # Exact types: subclasses may compute something else.
    if not _is_plain_module(actor, fused):
        yield f"a {type(actor).__name__} as {fused.actor}"
        return
    nets = {fused.actor: (actor, fused.actor_net)}
    if fused.critic is not None:
        critic = getattr(loss, fused.critic)
        if type(critic) is not TensorDictModule:
            yield f"a {type(critic).__name__} as {fused.critic}"
            return
        nets[fused.critic] = (critic, CriticNet)
    for name, (module, kind) in nets.items():
        net = network_of(module)
        if type(net) is not kind:
            yield f"a {type(net).__name__} as network of {name}"
        elif (layers := layers_of(net)) is None:
            yield f"other layers than those of a plain {kind.__name__} in training mode"
        elif [tuple(tensor.shape[-2:]) for tensor in net.state_dict().values()] != tensor_shapes(layers):
            yield f"parameters beside those of the layers in {name}"
        elif fused.algorithm is not Algorithm.DDPG and any(layer.norm == Norm.BATCHNORM for layer in layers):
            yield f"batch normalization in {name} of a {type(loss).__name__}"
        elif kind is CriticNet and fused.algorithm is not Algorithm.TQC and layers[-1].outputs != 1:
            yield f"critics with {layers[-1].outputs} outputs"
        inner = module[0] if isinstance(module, TensorDictSequential) else module
        if has_keyword_arguments(inner) or inner.method is not None or inner.method_kwargs:
            yield "options of a network's TensorDictModule"
    if len({network_of(module).runs for module, _ in nets.values()}) > 1:
        yield "networks of different numbers of runs"
    shared = [id(p) for name in nets for p in getattr(loss, f"{name}_params").values(True, True)]
    if len(shared) != len(set(shared)):
        yield "networks that share parameters"


def _is_plain_module(actor: nn.Module, fused: FusedLoss) -> bool:
    """Returns whether an actor is a network alone or, in SAC, TQC and DQN, with the usual last module."""
    if fused.algorithm not in (*STOCHASTIC, Algorithm.DQN):
        return type(actor) is TensorDictModule
    if (
        not isinstance(actor, TensorDictSequential)
        or len(actor) != 2
        or type(actor[0]) is not TensorDictModule
    ):
        return False
    head = actor[1]
    if fused.algorithm is Algorithm.DQN:
        return type(actor) is QValueActor and head.action_mask_key is None
    is_squashed = isinstance(head, ProbabilisticTensorDictModule) and head.distribution_class is TanhNormal
    return is_squashed and set(head.distribution_kwargs) <= {"low", "high"}


def _strange_keys(loss: LossModule, fused: FusedLoss) -> Iterator[str]:
    if fused.critic is None:
        return
    actor, critic = getattr(loss, fused.actor), getattr(loss, fused.critic)
    estimator, value_key = loss.value_estimator, loss.tensor_keys.state_action_value
    if list(critic.in_keys) != [*actor.in_keys, action_key(loss)]:
        yield f"a critic that reads {critic.in_keys}, not what the actor reads and writes, in that order"
    if critic.out_keys != [value_key]:
        yield f"a critic that writes {critic.out_keys}, not {value_key!r}"
    is_ddpg = fused.algorithm is Algorithm.DDPG
    if estimator.value_network is not (loss.actor_critic if is_ddpg else None) or (
        is_ddpg and estimator.tensor_keys.value != value_key
    ):
        yield "targets from other networks than the loss's"


def _is_plain_layer(module: nn.Module) -> bool:
    if isinstance(module, StackedBatchNorm):
        return module.training
    return not isinstance(module, nn.ELU) or module.alpha == 1.0


def _has_hooks(module: nn.Module, expected: int = 0) -> bool:
    pre = len(module._forward_pre_hooks) + len(module._backward_pre_hooks)
    return pre > expected or bool(module._forward_hooks or module._backward_hooks)


def _modules(loss: LossModule, fused: FusedLoss) -> list[nn.Module]:
    names = [name for name in (fused.actor, fused.critic) if name is not None]
    return [module for name in names for module in getattr(loss, name).modules()]
