"""The fused gradient step is TorchRL's, number for number."""

from __future__ import annotations

import shutil
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import HardUpdate, SoftUpdate

from torchrl_her import (
    CompiledOnce,
    FusedDDPGLearner,
    Learner,
    LossLearner,
    PenalisedDDPGLoss,
    can_fuse,
    is_plain_adam,
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


def test_several_steps_of_one_call_are_those_of_several_calls() -> None:
    first = make_loss(2)
    second = deepcopy(first)
    together, apart = (
        FusedDDPGLearner(loss, torch.optim.Adam(loss.parameters(), lr=1e-2), SoftUpdate(loss, tau=0.1))
        for loss in (first, second)
    )
    parts = [make_rows(2, seed, weighted=True) for seed in range(3)]
    rows = torch.cat(parts, 1)
    measured = together.update(rows, 3)
    losses = [apart.update(part)["loss_value"] for part in parts]
    assert measured["loss_value"].tolist() == torch.cat(losses).tolist()
    torch.testing.assert_close(rows["td_error"], torch.cat([part["td_error"] for part in parts], 1))
    for ours, theirs in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("runs", [1, 2])
def test_the_compiled_step_is_the_same(runs: int) -> None:
    if shutil.which("c++") is None:
        pytest.skip("there is no C++ compiler")
    first = make_loss(runs)
    second = deepcopy(first)
    plain, compiled = (
        FusedDDPGLearner(
            loss,
            torch.optim.Adam(loss.parameters(), lr=1e-2),
            SoftUpdate(loss, tau=0.1),
            max_grad_norm=0.1,
            compile_step=choice,
        )
        for loss, choice in ((first, False), (second, True))
    )
    for seed in range(20):
        rows = [make_rows(runs, seed, weighted=True) for _ in range(2)]
        measured = [learner.update(own, 2) for learner, own in zip((plain, compiled), rows, strict=True)]
        torch.testing.assert_close(rows[0]["td_error"], rows[1]["td_error"])
        torch.testing.assert_close(measured[0], measured[1])
        if seed == 10:  # as after a checkpoint: the optimiser has new tensors
            for learner in (plain, compiled):
                learner.optimiser.load_state_dict(deepcopy(learner.optimiser.state_dict()))
    state = second.state_dict()
    for name, value in first.state_dict().items():
        torch.testing.assert_close(value, state[name], msg=name)
    steps = [learner.optimiser.state_dict()["state"][0]["step"] for learner in (plain, compiled)]
    assert steps[0] == steps[1] == 40
    assert compiled.is_compiled


def test_only_a_plain_adam_is_compiled() -> None:
    loss = make_loss(1)
    target = SoftUpdate(loss, tau=0.1)
    for optimiser in (
        torch.optim.SGD(loss.parameters()),
        torch.optim.Adam(loss.parameters(), weight_decay=1.0),
    ):
        assert not is_plain_adam(optimiser)
        with pytest.raises(ValueError, match="only a plain torch.optim.Adam can be compiled"):
            FusedDDPGLearner(loss, optimiser, target, compile_step=True)


def test_without_a_compiler_it_warns_once_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_compiler(*_args: object, **_options: object) -> object:
        def fail(*_args: object) -> None:
            raise RuntimeError("no working C++ compiler found\nand a long story")

        return fail

    monkeypatch.setattr(torch, "compile", no_compiler)
    loss = make_loss(1)
    options = {"compile_step": True}
    learner = FusedDDPGLearner(
        loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.1), **options
    )
    with pytest.warns(UserWarning, match="ddpg_step is not compiled: no working C\\+\\+ compiler found$"):
        learner.update(make_rows(1, 0, weighted=True))
    measured = learner.update(make_rows(1, 1, weighted=True))  # a second warning would be an error
    assert measured["loss_value"].isfinite().all()
    assert not learner.is_compiled


def test_what_raises_uncompiled_raises() -> None:
    def broken(x: torch.Tensor) -> torch.Tensor:
        return x + torch.zeros(7)

    with pytest.raises(RuntimeError, match="must match the size"):
        CompiledOnce(broken)(torch.zeros(3))


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


def test_a_compiled_step_takes_draws_of_any_length_and_new_numbers() -> None:
    if shutil.which("c++") is None:
        pytest.skip("there is no C++ compiler")
    first = make_loss(2)
    second = deepcopy(first)
    plain, compiled = (
        FusedDDPGLearner(
            loss,
            torch.optim.Adam(loss.parameters(), lr=1e-2),
            SoftUpdate(loss, tau=0.1),
            compile_step=choice,
        )
        for loss, choice in ((first, False), (second, True))
    )
    for steps in (2, 3, 1):  # parts of a longer draw lie further apart in memory
        rows = torch.cat([make_rows(2, seed, weighted=True) for seed in range(steps)], 1)
        for learner in (plain, compiled):
            learner.update(rows.clone(), steps)
    for learner in (plain, compiled):
        learner.optimiser.param_groups[0].update(betas=(0.5, 0.9), eps=1e-3, lr=5e-2)
        learner.tau = 0.7
        learner.update(make_rows(2, 9, weighted=True))
    state = second.state_dict()
    for name, value in first.state_dict().items():
        torch.testing.assert_close(value, state[name], msg=name)


def test_idle_runs_stay_as_they_are_from_the_first_step_on() -> None:
    loss = make_loss(3)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-2)
    learner = FusedDDPGLearner(loss, optimiser, SoftUpdate(loss, tau=0.1))
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    learner.update(make_rows(3, 0, weighted=False), idle=[1])
    for name, value in loss.state_dict().items():
        if value.ndim > 0:
            assert torch.equal(value[1], before[name][1]), name
            assert not torch.equal(value[0], before[name][0]) or "target" in name, name
    for state in optimiser.state.values():
        assert (state["exp_avg"][1] == 0).all()
        assert (state["exp_avg_sq"][1] == 0).all()


def test_runs_keep_their_statistics_of_batch_normalisation() -> None:
    loss = make_loss(2, normalise=True)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-2)
    learner = LossLearner(loss, optimiser, SoftUpdate(loss, tau=0.1), runs=2)
    learner.update(make_rows(2, 0, weighted=False))
    blocks = [value.view(2, -1) for value in loss.state_dict().values() if value.ndim > 0]
    before = [block.clone() for block in blocks]
    learner.update(make_rows(2, 1, weighted=False), idle=[0])
    assert all(torch.equal(block[0], old[0]) for block, old in zip(blocks, before, strict=True))
    assert any(not torch.equal(block[1], old[1]) for block, old in zip(blocks, before, strict=True))
