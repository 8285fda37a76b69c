"""What the fused steps would get wrong is named, and refused."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn
from torchrl.data import Bounded
from torchrl.objectives import DDPGLoss, LossModule, SoftUpdate, ValueEstimators

from tests.torchrl_her.trainers.fused_cases import ALGORITHMS, make_loss
from torchrl_her import FusedLearner, make_actor, make_critic, make_target_updater
from torchrl_her.modules import (
    ActorNet,
    CriticNet,
    NetworkShape,
    QNet,
    StackedLayerNorm,
    StochasticActorNet,
    make_stochastic_actor,
)
from torchrl_her.native import Activation, Norm
from torchrl_her.objectives import PenalizedDDPGLoss, PenalizedTD3Loss, Targets, make_sac_loss, make_tqc_loss
from torchrl_her.trainers import is_plain_adam, why_not_fused
from torchrl_her.trainers.fusing import layers_of


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("hard", [0, 2])
def test_all_losses_of_this_library_can_be_fused(algorithm: str, hard: int) -> None:
    loss = make_loss(algorithm, norm="layer", activation="elu", depth=2)
    assert why_not_fused(loss, make_target_updater(loss, tau=0.1, hard_interval=hard)) is None


def test_only_a_plain_adam_is_fused() -> None:
    loss = make_loss("ddpg")
    target = SoftUpdate(loss, tau=0.1)
    with_a_hook = torch.optim.Adam(loss.parameters())
    with_a_hook.register_step_post_hook(lambda *_: None)
    for optimizer in (
        torch.optim.SGD(loss.parameters()),
        torch.optim.Adam(loss.parameters(), weight_decay=1.0),
        torch.optim.Adam(loss.parameters(), amsgrad=True),
        torch.optim.Adam(loss.parameters(), maximize=True),
        torch.optim.Adam(loss.parameters(), differentiable=True),
        torch.optim.AdamW(loss.parameters()),
        torch.optim.Adam([{"params": [p], "lr": 0.1 / (i + 1)} for i, p in enumerate(loss.parameters())]),
        torch.optim.Adam(list(loss.parameters())[1:]),
        with_a_hook,
    ):
        assert not is_plain_adam(optimizer, loss)
        with pytest.raises(ValueError, match="only a plain torch.optim.Adam can be fused"):
            FusedLearner(loss, optimizer, target)


def set_keys_of_targets(loss: LossModule) -> None:
    loss.value_estimator.set_keys(reward="cost")


def set_order(loss: LossModule) -> None:
    loss.value_network.in_keys = ["desired_goal", "observation", "action"]


def set_plain_targets(loss: LossModule) -> None:
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)


def set_targets_of_another(loss: LossModule) -> None:
    loss.value_estimator.value_network = make_loss("ddpg").actor_critic


def add_a_hook(loss: LossModule) -> None:
    loss.value_network.module.rest.register_forward_hook(lambda *_: None)


def add_a_hook_to_the_loss(loss: LossModule) -> None:
    loss.register_forward_hook(lambda *_: None)


def add_a_hook_to_the_targets(loss: LossModule) -> None:
    loss.value_estimator.register_forward_hook(lambda *_: None)


def add_a_hook_to_a_parameter(loss: LossModule) -> None:
    next(loss.parameters()).register_hook(lambda gradient: 0.0 * gradient)


def use_another_activation(loss: LossModule) -> None:
    loss.actor_network.module.layers[-1] = torch.nn.Hardtanh()


def mask_actions(loss: LossModule) -> None:
    loss.value_network[1].action_mask_key = "mask"


def set_a_value_network(loss: LossModule) -> None:
    loss.value_estimator.value_network = loss.qvalue_network


def add_a_parameter(loss: LossModule) -> None:
    loss.actor_network.module.extra = torch.nn.Parameter(torch.zeros(1))


def freeze(loss: LossModule) -> None:
    next(loss.parameters()).requires_grad_(False)


@pytest.mark.parametrize(
    ("algorithm", "change", "reason"),
    [
        ("ddpg", lambda loss: loss.set_keys(reward="cost"), "tensor_keys.reward='cost'"),
        (
            "ddpg",
            lambda loss: loss.set_keys(priority_weight="importance"),
            "tensor_keys.priority_weight='importance'",
        ),
        ("ddpg", lambda loss: setattr(loss.tensor_keys, "state_action_value", "q"), "a critic that writes"),
        ("ddpg", set_keys_of_targets, "value_estimator.tensor_keys.reward='cost'"),
        ("ddpg", set_order, "a critic that reads"),
        ("ddpg", lambda loss: setattr(loss, "loss_function", "smooth_l1"), "loss_function='smooth_l1'"),
        ("ddpg", lambda loss: setattr(loss, "reduction", "sum"), "reduction='sum'"),
        ("ddpg", set_plain_targets, "targets of a TD0Estimator"),
        ("ddpg", set_targets_of_another, "targets from other networks"),
        ("ddpg", lambda loss: setattr(loss.value_estimator, "average_rewards", True), "average_rewards=True"),
        ("ddpg", lambda loss: setattr(loss.value_estimator, "skip_existing", True), "skip_existing=True"),
        ("ddpg", add_a_hook, "hooks on the loss, its networks or its targets"),
        ("ddpg", add_a_hook_to_the_loss, "hooks on the loss, its networks or its targets"),
        ("ddpg", add_a_hook_to_the_targets, "hooks on the loss, its networks or its targets"),
        ("ddpg", add_a_hook_to_a_parameter, "hooks on parameters"),
        ("ddpg", use_another_activation, "other layers than those of a plain ActorNet"),
        ("ddpg", freeze, "frozen parameters"),
        ("ddpg", lambda loss: loss.bfloat16(), "parameters that are torch.bfloat16 on cpu"),
        ("td3", lambda loss: setattr(loss, "delay_actor", False), "delay_actor=False"),
        ("sac", lambda loss: setattr(loss, "fixed_alpha", True), "fixed_alpha=True"),
        ("sac", lambda loss: setattr(loss, "skip_done_states", True), "skip_done_states=True"),
        ("tqc", lambda loss: setattr(loss, "fixed_alpha", True), "fixed_alpha=True"),
        ("tqc", lambda loss: setattr(loss, "loss_function", "l2"), "loss_function='l2'"),
        ("tqc", set_a_value_network, "targets from other networks than the loss's"),
        ("dqn", lambda loss: setattr(loss, "double_dqn", False), "double_dqn=False"),
        ("dqn", mask_actions, "a QValueActor as value_network"),
        ("td3", set_a_value_network, "targets from other networks than the loss's"),
        ("sac", set_a_value_network, "targets from other networks than the loss's"),
        ("ddpg", add_a_parameter, "parameters beside those of the layers in actor_network"),
        ("dqn", lambda loss: setattr(loss, "loss_function", "l1"), "loss_function='l1'"),
    ],
)
def test_what_they_do_not_know_they_refuse(
    algorithm: str, change: Callable[[LossModule], Any], reason: str
) -> None:
    loss = make_loss(algorithm)
    target = SoftUpdate(loss, tau=0.1)
    assert why_not_fused(loss, target) is None
    change(loss)
    assert why_not_fused(loss, target) is not None
    with pytest.raises(ValueError, match=f"cannot be fused: .*{re.escape(reason)}"):
        FusedLearner(loss, torch.optim.Adam(loss.parameters()), target)


def test_critics_of_quantiles_are_those_of_tqc_alone() -> None:
    spec = Bounded(-1.0, 1.0, (3,))
    critic = make_critic((4, 2), 3, outputs=5)
    loss = make_sac_loss(make_stochastic_actor((4, 2), spec), critic)
    assert why_not_fused(loss, SoftUpdate(loss, tau=0.1)) == "critics with 5 outputs"
    loss = make_tqc_loss(make_stochastic_actor((4, 2), spec), critic)
    assert why_not_fused(loss, SoftUpdate(loss, tau=0.1)) is None


def test_batch_normalization_must_learn_and_its_targets_must_follow() -> None:
    loss = make_loss("normalized")
    assert "running statistics that this SoftUpdate" in str(why_not_fused(loss, SoftUpdate(loss, tau=0.1)))
    loss.value_network.eval()
    target = make_target_updater(loss, tau=0.1, hard_interval=0)
    assert "a plain CriticNet in training mode" in str(why_not_fused(loss, target))
    actor, critic = make_actor((4, 2), 3), make_critic((4, 2), 3, shape=NetworkShape(norm="batch"))
    spec = Bounded(-1.0, 1.0, (3,))
    values = PenalizedTD3Loss(actor, critic, action_spec=spec, delay_actor=True, loss_function="l2")
    values.make_value_estimator(Targets(reward_range=None).estimator())
    target = make_target_updater(values, tau=0.1, hard_interval=0)
    assert why_not_fused(values, target) == "batch normalization in qvalue_network of a PenalizedTD3Loss"


def test_other_networks_targets_and_losses_are_refused() -> None:
    loss = make_loss("ddpg")
    assert why_not_fused(loss, SoftUpdate(make_loss("ddpg"), tau=0.1)) is not None
    assert why_not_fused(loss, None) is not None
    plain = DDPGLoss(make_actor((4, 2), 3), make_critic((4, 2), 3), delay_actor=True, delay_value=True)
    assert "a DDPGLoss" in str(why_not_fused(plain, SoftUpdate(plain, tau=0.1)))
    for delays in ({"delay_actor": False}, {"delay_value": False}):
        options = {"delay_actor": True, "delay_value": True} | delays
        loss = PenalizedDDPGLoss(make_actor((4, 2), 3), make_critic((4, 2), 3), **options)
        loss.make_value_estimator(Targets(reward_range=(-1.0, 0.0)).estimator(loss.actor_critic))
        assert why_not_fused(loss, SoftUpdate(loss, tau=0.1)) is not None


def test_widths_activations_and_normalizations() -> None:
    layers = layers_of(ActorNet(5, 2, shape=NetworkShape(hidden=7, depth=2, activation="elu", norm="layer")))
    assert layers is not None
    assert [(own.inputs, own.outputs, own.joined) for own in layers] == [(5, 7, 0), (7, 7, 0), (7, 2, 0)]
    assert [own.activation for own in layers] == [Activation.ELU, Activation.ELU, Activation.TANH]
    assert [own.norm for own in layers] == [Norm.LAYERNORM, Norm.LAYERNORM, Norm.PLAIN]


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
