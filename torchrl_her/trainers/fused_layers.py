"""Converts a network's modules to the layers that compiled gradient steps support."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn

from torchrl_her.modules.networks import (
    ActorNet,
    CriticNet,
    StackedBatchNorm,
    StackedLayerNorm,
    StackedLinear,
)
from torchrl_her.modules.q_actor import QNet
from torchrl_her.modules.stochastic_actor import StochasticActorNet
from torchrl_her.native.job import Activation, Layer, Norm

_NETWORKS = (ActorNet, CriticNet, QNet, StochasticActorNet)
_ACTIVATIONS = {nn.ReLU: Activation.RELU, nn.Tanh: Activation.TANH, nn.ELU: Activation.ELU}
_NORMS = {StackedLayerNorm: Norm.LAYERNORM, StackedBatchNorm: Norm.BATCHNORM}


def layers_of(net: nn.Module) -> list[Layer] | None:
    """Returns the layers of one of this library's networks, from its input on; None if others occur.

    The tensors of the layers, in the same order, are those of ``net.state_dict()``: weight and bias, behind
    them scale and shift of a normalization, and the running mean and variance of a batch normalization.

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
        elif type(module) is StackedBatchNorm and not layers and _is_plain(module):
            layers.append(Layer(0, module.weight.shape[-1], 0, Activation.NONE, Norm.BATCHNORM))
        elif type(module) in _NORMS and fresh and not layers[-1].norm and _is_plain(module):
            layers[-1].norm = _NORMS[type(module)]
        elif type(module) in _ACTIVATIONS and fresh and _is_plain(module):
            layers[-1].activation, fresh = _ACTIVATIONS[type(module)], False
        else:
            return None
    return layers


def tensor_shapes(layers: Sequence[Layer]) -> list[tuple[int, int]]:
    """Returns the last two dimensions of the parameters and running statistics of layers, in order.

    Example:
        >>> from torchrl_her.modules import NetworkShape
        >>> shape = NetworkShape(hidden=8, depth=2, norm="layer")
        >>> tensor_shapes(layers_of(ActorNet(4, 2, shape=shape)))[:4]
        [(4, 8), (1, 8), (1, 8), (1, 8)]
    """
    shapes = []
    for layer in layers:
        product = [(layer.inputs, layer.outputs), (1, layer.outputs)] if layer.inputs else []
        shapes += [*product, *[(1, layer.outputs)] * (2 * layer.norm)]
    return shapes


def _is_plain(module: nn.Module) -> bool:
    if isinstance(module, StackedBatchNorm):
        return module.training
    return not isinstance(module, nn.ELU) or module.alpha == 1.0
