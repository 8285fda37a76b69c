"""Actor and critic have the layers of appendix B, and stacked networks are their runs side by side."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_her import make_actor, make_critic
from torchrl_her.modules import (
    ActorNet,
    CriticNet,
    GoalNet,
    NetworkShape,
    QNet,
    StackedLayerNorm,
    StackedLinear,
    StochasticActorNet,
    stack_runs,
    take_run,
)
from torchrl_her.modules.networks import Norm, StackedBatchNorm


def layers(net: nn.Module) -> list[tuple[int, int]]:
    """(inputs, outputs) of all linear layers, in order."""
    return [tuple(m.weight.shape[1:]) for m in net.modules() if isinstance(m, StackedLinear)]


def kinds(net: nn.Module) -> list[str]:
    """What the net consists of, in order."""
    return [type(m).__name__ for m in net.modules() if not list(m.children())]


def seen(*shape: int) -> tuple[Tensor, Tensor]:
    """An observation of 9 numbers and a goal of 2."""
    return torch.randn(*shape, 9), torch.randn(*shape, 2)


def test_layers_of_the_actor() -> None:
    net = ActorNet(11, 3)
    assert layers(net) == [(11, 64), (64, 64), (64, 64), (64, 3)]
    assert kinds(net) == ["StackedLinear", "ReLU"] * 3 + ["StackedLinear", "Tanh"]


def test_layers_of_the_critic() -> None:
    net = CriticNet(11, 3)
    assert layers(net) == [(11, 64), (67, 64), (64, 64), (64, 1)]
    assert kinds(net) == ["StackedLinear", "ReLU"] * 3 + ["StackedLinear"]


def test_the_action_enters_behind_the_critics_first_layer() -> None:
    net, first = CriticNet(11, 3), []
    net.first.register_forward_hook(lambda _module, _inputs, output: first.append(output))
    action = torch.randn(4, 3, requires_grad=True)
    value = net(*seen(4), action)
    (direct,) = torch.autograd.grad(first[0].sum(), action, allow_unused=True)
    (whole,) = torch.autograd.grad(value.sum(), action)
    assert direct is None
    assert (whole != 0).any(-1).all()


def test_a_layer_by_hand() -> None:
    layer = StackedLinear(2, 1, runs=2)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[[1.0], [2.0]], [[3.0], [4.0]]]))
        layer.bias.copy_(torch.tensor([[[10.0]], [[20.0]]]))
    x = torch.tensor([[[1.0, 1.0]], [[1.0, 1.0]]])
    assert layer(x).flatten().tolist() == [13.0, 27.0]


def test_weights_start_as_torchs_own_do() -> None:
    layer = StackedLinear(100, 400)
    spread = 0.1 / math.sqrt(3)  # of a uniform distribution over [-0.1, 0.1]
    assert layer.weight.abs().max() <= 0.1
    assert layer.weight.std().item() == pytest.approx(spread, rel=0.02)
    assert layer.weight.std().item() == pytest.approx(nn.Linear(100, 400).weight.std().item(), rel=0.02)


def test_early_actions_and_values_are_small() -> None:
    observation, goal = seen(1000)
    assert ActorNet(11, 3)(observation, goal).abs().max() < 0.1
    assert CriticNet(11, 3)(observation, goal, torch.randn(1000, 3)).abs().max() < 0.1


@pytest.mark.parametrize(("normalize", "count"), [(False, 0), (True, 4)])
def test_batch_normalization_is_of_the_critics_input_and_hidden_layers(normalize: bool, count: int) -> None:
    critic = make_critic((9, 2), 3, shape=NetworkShape(norm="batch" if normalize else "none"))
    norms = [m.weight.shape[-1] for m in critic.modules() if isinstance(m, StackedBatchNorm)]
    assert norms == [11, 64, 64, 64][:count]
    assert not any(isinstance(m, StackedBatchNorm) for m in make_actor((9, 2), 3).modules())


def test_batch_normalization_is_that_of_torch() -> None:
    rows = torch.randn(16, 5) * 3.0 + 7.0
    norm, own = nn.BatchNorm1d(5), StackedBatchNorm(5)
    assert torch.allclose(own(rows.unsqueeze(0))[0], norm(rows), atol=1e-5)
    assert torch.allclose(own.running_mean, norm.running_mean, atol=1e-5)


def test_where_the_weights_do_not_learn_batch_normalization_uses_and_keeps_the_running_statistics() -> None:
    own = StackedBatchNorm(1).requires_grad_(False)
    own.running_mean.fill_(3.0)
    own.running_var.fill_(4.0)
    assert own(torch.tensor([[[3.0], [7.0]]])).flatten().tolist() == pytest.approx([0.0, 2.0], abs=1e-4)
    assert own.running_mean.tolist() == [[[3.0]]]
    assert own.running_var.tolist() == [[[4.0]]]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 3), max_size=3))
def test_any_batch_shape(shape: list[int]) -> None:
    observation, goal, action = torch.randn(*shape, 9), torch.randn(*shape, 2), torch.randn(*shape, 3)
    for net, inputs in (
        (ActorNet(11, 3), (observation, goal)),
        (CriticNet(11, 3), (observation, goal, action)),
        (CriticNet(11, 3, outputs=5), (observation, goal, action)),
    ):
        flat = net(*(x.reshape(-1, x.shape[-1]) for x in inputs))
        assert torch.allclose(net(*inputs), flat.view(*shape, -1), atol=1e-6)


def test_keys_of_ones_own() -> None:
    keys, action, value = [("agent", "seen"), "wanted"], ("agent", "action"), ("agent", "value")
    actor = make_actor((4, 2), 3, in_keys=keys, action_key=action)
    critic = make_critic((4, 2), 3, in_keys=keys, action_key=action, value_key=value)
    data = TensorDict({"agent": {"seen": torch.randn(5, 4)}, "wanted": torch.randn(5, 2)}, batch_size=[5])
    critic(actor(data))
    assert data[action].shape == (5, 3)
    assert data[value].shape == (5, 1)
    assert torch.equal(data[action], actor.module(data["agent", "seen"], data["wanted"]))


def make_nets(kind: str, runs: int) -> nn.Module:
    if kind == "actor":
        return ActorNet(11, 3, shape=NetworkShape(hidden=8), runs=runs)
    norm: Norm = "batch" if kind == "normalized critic" else "none"
    return CriticNet(11, 3, shape=NetworkShape(hidden=8, norm=norm), runs=runs)


@pytest.mark.parametrize("kind", ["actor", "critic", "normalized critic"])
def test_stacked_runs_are_the_single_ones_side_by_side(kind: str) -> None:
    singles = [make_nets(kind, 1) for _ in range(3)]
    stacked = make_nets(kind, 3)
    stacked.load_state_dict(stack_runs([net.state_dict() for net in singles]))
    inputs = [torch.randn(3, 6, 9), torch.randn(3, 6, 2)] + (
        [] if kind == "actor" else [torch.randn(3, 6, 3)]
    )
    expected = torch.stack([net(*(x[run] for x in inputs)) for run, net in enumerate(singles)])
    assert torch.allclose(stacked(*inputs), expected, atol=1e-5)
    one_after_the_other = stacked.eval()(*(x.flatten(0, 1) for x in inputs))
    assert torch.allclose(one_after_the_other.view_as(expected), stacked(*inputs), atol=1e-5)


@pytest.mark.parametrize("kind", ["actor", "normalized critic"])
def test_a_run_taken_out_is_what_was_stacked(kind: str) -> None:
    states = [make_nets(kind, 1).state_dict() for _ in range(3)]
    taken = take_run(stack_runs(states), 1, 3)
    assert taken.keys() == states[1].keys()
    assert all(torch.equal(taken[key], states[1][key]) for key in taken)
    drawn = [key for key in taken if taken[key].shape[-2] > 1]  # normalizations begin alike
    assert drawn
    assert not any(torch.equal(taken[key], states[0][key]) for key in drawn)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hidden": 0}, "hidden must be at least 1, got 0"),
        ({"depth": 1}, "depth must be at least 2, got 1"),
        ({"activation": "gelu"}, "activation must be one of relu, tanh, elu, got 'gelu'"),
        ({"norm": "group"}, "norm must be one of none, layer, batch, got 'group'"),
    ],
)
def test_shapes_that_cannot_be_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NetworkShape(**options)


def test_a_critic_may_have_several_outputs() -> None:
    critic = make_critic((4, 2), 3, outputs=5, runs=2)
    data = TensorDict(
        {"observation": torch.randn(2, 6, 4), "desired_goal": torch.randn(2, 6, 2)}
        | {"action": torch.randn(2, 6, 3)},
        [2, 6],
    )
    assert critic(data)["state_action_value"].shape == (2, 6, 5)
    assert critic(data[:, :0])["state_action_value"].shape == (2, 0, 5)
    with pytest.raises(ValueError, match="outputs must be at least 1, got 0"):
        make_critic((4, 2), 3, outputs=0)


@pytest.mark.parametrize("kind", [ActorNet, QNet, StochasticActorNet])
def test_critics_alone_have_batch_normalization(kind: type[GoalNet]) -> None:
    with pytest.raises(ValueError, match=f"norm must be none or layer in {kind.__name__}, got 'batch'"):
        kind(6, 3, shape=NetworkShape(norm="batch"))


def test_layer_normalization_is_that_of_torch() -> None:
    ours, theirs = StackedLayerNorm(5, runs=2), nn.LayerNorm(5)
    with torch.no_grad():
        ours.weight[1], ours.bias[1] = torch.arange(5.0), torch.arange(5.0) - 2
        theirs.weight.copy_(torch.arange(5.0))
        theirs.bias.copy_(torch.arange(5.0) - 2)
    x = torch.randn(2, 7, 5)
    torch.testing.assert_close(ours(x)[1], theirs(x[1]))


@pytest.mark.parametrize(("depth", "activation"), [(2, nn.ELU), (5, nn.Tanh)])
def test_depth_and_activation(depth: int, activation: type[nn.Module]) -> None:
    name = activation.__name__.lower()
    shape = NetworkShape(hidden=8, depth=depth, activation=name)  # type: ignore[arg-type]
    critic = CriticNet(6, 3, shape=shape)
    widths = [module.weight.shape[1:] for module in critic.modules() if isinstance(module, StackedLinear)]
    assert widths == [(6, 8), (11, 8), *[(8, 8)] * (depth - 2), (8, 1)]
    assert sum(isinstance(module, activation) for module in critic.modules()) == depth
