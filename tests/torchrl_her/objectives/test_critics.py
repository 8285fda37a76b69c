"""The values of a loss's own critics, after these were set to known numbers."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import ClipPPOLoss, LossModule, SoftUpdate

from torchrl_her import make_actor, make_critic, make_ddpg_loss
from torchrl_her.modules import NetworkShape, RunNoise, make_q_actor, make_stochastic_actor
from torchrl_her.objectives import critic_value, make_dqn_loss, make_sac_loss, make_td3_loss
from torchrl_her.objectives.critics import least_of_some

from ..lost_game import SPEC, rows, say


def make_loss(kind: str, *, normalize: bool = False) -> LossModule:
    critic = make_critic((4, 2), 3, shape=NetworkShape(norm="batch" if normalize else "none"))
    if kind == "ddpg":
        return make_ddpg_loss(make_actor((4, 2), 3), critic)
    if kind == "td3":
        return make_td3_loss(make_actor((4, 2), 3), critic, action_spec=SPEC)
    if kind == "sac":
        return make_sac_loss(make_stochastic_actor((4, 2), SPEC), critic)
    return make_dqn_loss(make_q_actor((4, 2), 3)[0])


def make_rows(kind: str) -> TensorDict:
    return rows(5, action=torch.randint(3, (1, 5)) if kind == "dqn" else torch.rand(1, 5, 3))[0]


@pytest.mark.parametrize(
    ("kind", "biases", "value"),
    [
        ("ddpg", [-3.0], -3.0),
        ("td3", [-3.0, -5.0], -5.0),
        ("sac", [-4.0, -2.0], -4.0),
        ("dqn", [-3.0, -1.0, -2.0], -1.0),  # of the best of three actions
    ],
)
def test_it_is_the_least_of_the_critics_that_are_trained(
    kind: str, biases: list[float], value: float
) -> None:
    loss = make_loss(kind)
    params = loss.value_network_params if kind in ("ddpg", "dqn") else loss.qvalue_network_params
    for parameter in params.values(True, True):
        parameter.data.zero_()
    last = max(
        (key for key in params.keys(True, True) if key[-1] == "bias"), key=lambda key: [str(k) for k in key]
    )
    params[last].data.copy_(torch.tensor(biases).view_as(params[last]))
    assert critic_value(loss, make_rows(kind)).tolist() == [[value]] * 5


@pytest.mark.parametrize("kind", ["td3", "sac"])
def test_it_is_the_mean_of_critics_of_which_targets_take_some(kind: str) -> None:
    critics = [make_critic((4, 2), 3) for _ in range(3)]
    if kind == "td3":
        actor = make_actor((4, 2), 3)
        loss = make_td3_loss(actor, critics, action_spec=SPEC, target_critics=2)
    else:
        drawing = make_stochastic_actor((4, 2), SPEC)
        loss = make_sac_loss(drawing, critics, target_critics=2)
    SoftUpdate(loss, tau=0.1)
    say(loss, [-1.0, -2.0, -6.0], [0.0, 0.0, 0.0])
    assert critic_value(loss, make_rows(kind)).tolist() == [[-3.0]] * 5


def test_the_least_of_critics_that_are_drawn_for_each_run() -> None:
    """Two runs of two rows, and three critics: by hand for the subsets that the generators give."""
    values = torch.tensor(
        [[[1.0, 9.0], [4.0, 4.0]], [[2.0, 8.0], [3.0, 5.0]], [[0.0, 7.0], [6.0, 2.0]]]
    )  # [critics, runs, rows]
    seen = set()
    for seed in range(20):
        noise = RunNoise([torch.Generator().manual_seed(seed + run) for run in (0, 100)])
        again = RunNoise([torch.Generator().manual_seed(seed + run) for run in (0, 100)])
        first, second = again.subsets(2, 3).tolist()
        assert least_of_some(values.unsqueeze(-1), 2, noise).squeeze(-1).tolist() == [
            [min(values[n, run, row].item() for n in own) for row in range(2)]
            for run, own in enumerate((first, second))
        ]
        seen |= {tuple(first), tuple(second)}
    assert seen == {(0, 1), (0, 2), (1, 2)}


@pytest.mark.parametrize("kind", ["td3", "sac"])
def test_batch_normalization_is_refused_where_critics_are_stacked(kind: str) -> None:
    with pytest.raises(ValueError, match="norm must be none or layer .* got 'batch'"):
        make_loss(kind, normalize=True)


def test_statistics_of_batches_are_neither_used_nor_changed() -> None:
    loss, data = make_loss("ddpg", normalize=True), make_rows("ddpg")
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    together = critic_value(loss, data)
    alone = torch.cat([critic_value(loss, data[i : i + 1]) for i in range(5)])
    torch.testing.assert_close(together, alone)
    assert all(torch.equal(value, before[name]) for name, value in loss.state_dict().items())
    assert not together.requires_grad


def test_a_loss_without_critics_of_actions_has_none() -> None:
    actor, critic = make_stochastic_actor((4, 2), SPEC), make_critic((4, 2), 3)
    assert critic_value(ClipPPOLoss(actor, critic), make_rows("sac")) is None
