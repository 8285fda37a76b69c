"""The fused gradient step is TorchRL's, number for number."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import HardUpdate, SoftUpdate

from torchrl_her import (
    FusedDDPGLearner,
    Learner,
    LossLearner,
    PenalisedDDPGLoss,
    can_fuse,
    make_actor,
    make_critic,
    make_ddpg_loss,
)


def make_loss(runs: int, *, penalty: float = 0.3, normalise: bool = False) -> PenalisedDDPGLoss:
    actor = make_actor((4, 2), 3, hidden=16, runs=runs).double()
    critic = make_critic((4, 2), 3, hidden=16, runs=runs, normalise=normalise).double()
    return make_ddpg_loss(actor, critic, gamma=0.9, action_penalty=penalty, reduction="none")


def make_rows(runs: int, seed: int, *, weighted: bool) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(runs, 8, *shape, dtype=torch.float64, generator=generator)

    terminated = normal(1) > 0.5
    rows = {
        "observation": normal(4),
        "desired_goal": normal(2),
        "action": normal(3).clamp(-1, 1),
        "next": {
            "observation": normal(4),
            "desired_goal": normal(2),
            "reward": terminated.double() - 1.0,
            "terminated": terminated,
            "done": terminated | (normal(1) > 0.5),
        },
    }
    if weighted:
        rows["priority_weight"] = normal().abs() + 0.1
    return TensorDict(rows, batch_size=[runs, 8])


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("max_grad_norm", [1e-3, 1e3])
def test_weights_targets_and_priorities_are_those_of_torchrl_s_loss(
    runs: int, weighted: bool, max_grad_norm: float
) -> None:
    first = make_loss(runs)
    second = deepcopy(first)
    learners: list[Learner] = []
    for loss, make in ((first, LossLearner), (second, FusedDDPGLearner)):
        optimiser, target = torch.optim.Adam(loss.parameters(), lr=1e-2), SoftUpdate(loss, tau=0.1)
        options = {"runs": runs} if make is LossLearner else {}
        learners.append(make(loss, optimiser, target, max_grad_norm=max_grad_norm, **options))
    for seed in range(20):
        rows = [make_rows(runs, seed, weighted=weighted) for _ in learners]
        measured = [learner.update(own) for learner, own in zip(learners, rows, strict=True)]
        torch.testing.assert_close(rows[0]["td_error"], rows[1]["td_error"])
        for name in ("loss_actor", "loss_value"):
            torch.testing.assert_close(measured[0][name], measured[1][name])
    state = second.state_dict()
    for name, value in first.state_dict().items():
        torch.testing.assert_close(value, state[name], msg=name)


def test_it_works_on_the_loss_s_own_weights() -> None:
    loss = make_loss(1)
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    learner = FusedDDPGLearner(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.1))
    learner.update(make_rows(1, 0, weighted=False))
    moved = [name for name, value in loss.state_dict().items() if not torch.equal(value, before[name])]
    for part in ("actor_network_params", "value_network_params", "target_actor", "target_value"):
        assert any(part in name for name in moved), part


def test_what_it_does_not_know_it_refuses() -> None:
    loss = make_loss(1, normalise=True)
    assert not can_fuse(loss, SoftUpdate(loss, tau=0.1))
    other_keys, other_order, other_distance = make_loss(1), make_loss(1), make_loss(1)
    other_keys.set_keys(reward="cost")
    other_order.value_network.in_keys = ["desired_goal", "observation", "action"]
    other_distance.loss_function = "smooth_l1"
    for unknown in (other_keys, other_order, other_distance):
        assert not can_fuse(unknown, SoftUpdate(unknown, tau=0.1))
    plain = make_loss(1)
    assert not can_fuse(plain, HardUpdate(plain, value_network_update_interval=5))
    assert can_fuse(plain, SoftUpdate(plain, tau=0.1))
    with pytest.raises(ValueError, match="only DDPG with the networks of make_actor"):
        FusedDDPGLearner(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.1))
