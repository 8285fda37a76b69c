"""Modules are told apart layer by layer; what is not known is not guessed."""

from __future__ import annotations

import pytest
from torch import nn

from torchrl_her.modules import ActorNet, CriticNet, NetworkShape, QNet, StackedLayerNorm, StochasticActorNet
from torchrl_her.native import Activation, Norm
from torchrl_her.trainers.fused_layers import layers_of


def test_widths_activations_and_normalizations() -> None:
    layers = layers_of(ActorNet(5, 2, shape=NetworkShape(hidden=7, depth=2, activation="elu", norm="layer")))
    assert layers is not None
    assert [(own.inputs, own.outputs, own.joined) for own in layers] == [(5, 7, 0), (7, 7, 0), (7, 2, 0)]
    assert [own.activation for own in layers] == [Activation.ELU, Activation.ELU, Activation.TANH]
    assert [own.norm for own in layers] == [Norm.LAYERNORM, Norm.LAYERNORM, Norm.PLAIN]


def test_the_action_joins_behind_the_first_layer_of_a_critic() -> None:
    layers = layers_of(CriticNet(5, 2, shape=NetworkShape(hidden=7)))
    assert layers is not None
    assert [own.joined for own in layers] == [0, 2, 0, 0]


def test_the_input_of_a_critic_is_normalized_by_a_layer_without_inputs() -> None:
    layers = layers_of(CriticNet(5, 2, shape=NetworkShape(hidden=7, depth=2, norm="batch")))
    assert layers is not None
    widths = [(own.inputs, own.outputs, own.joined) for own in layers]
    assert widths == [(0, 5, 0), (5, 7, 0), (9, 7, 2), (7, 1, 0)]
    assert [own.norm for own in layers] == [*[Norm.BATCHNORM] * 3, Norm.PLAIN]


@pytest.mark.parametrize("kind", [QNet, StochasticActorNet])
def test_other_networks_of_this_library(kind: type[nn.Module]) -> None:
    layers = layers_of(kind(5, 2))
    assert layers is not None
    assert layers[-1].activation == Activation.NONE


class Own(ActorNet):
    """What a subclass computes is not known."""


@pytest.mark.parametrize("net", [Own(5, 2), nn.Linear(3, 2)], ids=["subclass", "linear"])
def test_what_is_not_known(net: nn.Module) -> None:
    assert layers_of(net) is None


def test_layers_in_another_order() -> None:
    net = ActorNet(5, 2)
    net.layers[0].append(StackedLayerNorm(64))  # behind the activation
    assert layers_of(net) is None
    other = ActorNet(5, 2, shape=NetworkShape(activation="elu"))
    other.layers[0][1] = nn.ELU(alpha=0.5)
    assert layers_of(other) is None
