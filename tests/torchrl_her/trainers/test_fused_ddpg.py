"""The fused gradient step is TorchRL's, number for number."""

from __future__ import annotations

import shutil
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import HardUpdate, SoftUpdate

from torchrl_her import FusedDDPGLearner, LossLearner, make_actor, make_critic, make_ddpg_loss
from torchrl_her.objectives import PenalizedDDPGLoss
from torchrl_her.trainers import Learner, can_fuse, is_plain_adam


def make_loss(runs: int, *, penalty: float = 0.3, normalize: bool = False) -> PenalizedDDPGLoss:
    actor = make_actor((4, 2), 3, hidden=16, runs=runs).double()
    critic = make_critic((4, 2), 3, hidden=16, runs=runs, normalize=normalize).double()
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
        optimizer, target = torch.optim.Adam(loss.parameters(), lr=1e-2), SoftUpdate(loss, tau=0.1)
        options = {"runs": runs} if make is LossLearner else {}
        learners.append(make(loss, optimizer, target, max_grad_norm=max_grad_norm, **options))
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


def make_pair(runs: int) -> tuple[FusedDDPGLearner, FusedDDPGLearner]:
    """Two learners of the same networks: a plain one and one that compiles."""
    first = make_loss(runs)
    plain, compiling = (
        FusedDDPGLearner(
            loss,
            torch.optim.Adam(loss.parameters(), lr=1e-2),
            SoftUpdate(loss, tau=0.1),
            max_grad_norm=0.1,
            compile_step=choice,
        )
        for loss, choice in ((first, False), (deepcopy(first), True))
    )
    return plain, compiling


def check_same_weights(plain: FusedDDPGLearner, compiling: FusedDDPGLearner) -> None:
    state = compiling.loss.state_dict()
    for name, value in plain.loss.state_dict().items():
        torch.testing.assert_close(value, state[name], msg=name)


@pytest.mark.long
# Compiling takes up to half a minute, so that one form is compiled for all; others with the full tests.
@pytest.mark.skipif(shutil.which("c++") is None, reason="there is no C++ compiler")
@pytest.mark.parametrize("runs", [pytest.param(1, marks=pytest.mark.full), 2])
def test_the_compiled_step_is_the_same_for_draws_of_any_length(runs: int) -> None:
    plain, compiling = make_pair(runs)
    for seed in range(20):
        rows = [make_rows(runs, seed, weighted=True) for _ in range(2)]
        measured = [learner.update(own, 2) for learner, own in zip((plain, compiling), rows, strict=True)]
        torch.testing.assert_close(rows[0]["td_error"], rows[1]["td_error"])
        torch.testing.assert_close(measured[0], measured[1])
        if seed == 10:  # as after a checkpoint: the optimizer has new tensors
            for learner in (plain, compiling):
                learner.optimizer.load_state_dict(deepcopy(learner.optimizer.state_dict()))
    check_same_weights(plain, compiling)
    steps = [learner.optimizer.state_dict()["state"][0]["step"] for learner in (plain, compiling)]
    assert steps[0] == steps[1] == 40
    for lengths in (4, 12):  # parts of a longer draw lie further apart in memory
        rows = torch.cat([make_rows(runs, seed, weighted=True) for seed in range(lengths // 2)], 1)
        for learner in (plain, compiling):
            learner.update(rows.clone(), lengths)
    check_same_weights(plain, compiling)
    assert compiling.is_compiled
    assert len(compiling._compiled) == 1


def take_new_numbers(plain: FusedDDPGLearner, compiling: FusedDDPGLearner) -> None:
    """Steps before and after numbers were changed that a compiled form holds."""
    for learner in (plain, compiling):
        learner.update(make_rows(2, 8, weighted=True))
        learner.optimizer.param_groups[0].update(betas=(0.5, 0.9), eps=1e-3, lr=5e-2)
        learner.tau = 0.7
        learner.update(make_rows(2, 9, weighted=True))
    check_same_weights(plain, compiling)
    assert len(compiling._compiled) == 2


def test_new_numbers_make_a_new_form(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "compile", lambda function, **options: function)
    take_new_numbers(*make_pair(2))


def test_whoever_waits_is_told_before_each_form_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(torch, "compile", lambda function, **options: told.append("compiled") or function)
    _, compiling = make_pair(2)
    compiling.before_compiling = lambda: told.append("told")
    for steps in (1, 2):
        compiling.update(torch.cat([make_rows(2, 0, weighted=True)] * steps, 1), steps)
    assert told == ["told", "compiled"]
    compiling.update(make_rows(2, 0, weighted=False))
    assert told == ["told", "compiled"] * 2


@pytest.mark.full
@pytest.mark.skipif(shutil.which("c++") is None, reason="there is no C++ compiler")
def test_new_numbers_make_a_new_compiled_form() -> None:
    plain, compiling = make_pair(2)
    take_new_numbers(plain, compiling)
    assert all(form.compiled for form in compiling._compiled.values())


def test_only_a_plain_adam_is_compiled() -> None:
    loss = make_loss(1)
    target = SoftUpdate(loss, tau=0.1)
    for optimizer in (
        torch.optim.SGD(loss.parameters()),
        torch.optim.Adam(loss.parameters(), weight_decay=1.0),
    ):
        assert not is_plain_adam(optimizer)
        with pytest.raises(ValueError, match="only a plain torch.optim.Adam can be compiled"):
            FusedDDPGLearner(loss, optimizer, target, compile_step=True)


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


def test_it_works_on_the_loss_s_own_weights() -> None:
    loss = make_loss(1)
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    learner = FusedDDPGLearner(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.1))
    learner.update(make_rows(1, 0, weighted=False))
    moved = [name for name, value in loss.state_dict().items() if not torch.equal(value, before[name])]
    for part in ("actor_network_params", "value_network_params", "target_actor", "target_value"):
        assert any(part in name for name in moved), part


def test_what_it_does_not_know_it_refuses() -> None:
    loss = make_loss(1, normalize=True)
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


def test_idle_runs_stay_as_they_are_from_the_first_step_on() -> None:
    loss = make_loss(3)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    learner = FusedDDPGLearner(loss, optimizer, SoftUpdate(loss, tau=0.1))
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    learner.update(make_rows(3, 0, weighted=False), idle=[1])
    for name, value in loss.state_dict().items():
        if value.ndim > 0:
            assert torch.equal(value[1], before[name][1]), name
            assert not torch.equal(value[0], before[name][0]) or "target" in name, name
    for state in optimizer.state.values():
        assert (state["exp_avg"][1] == 0).all()
        assert (state["exp_avg_sq"][1] == 0).all()


def test_runs_keep_their_statistics_of_batch_normalization() -> None:
    loss = make_loss(2, normalize=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    learner = LossLearner(loss, optimizer, SoftUpdate(loss, tau=0.1), runs=2)
    learner.update(make_rows(2, 0, weighted=False))
    blocks = [value.view(2, -1) for value in loss.state_dict().values() if value.ndim > 0]
    before = [block.clone() for block in blocks]
    learner.update(make_rows(2, 1, weighted=False), idle=[0])
    assert all(torch.equal(block[0], old[0]) for block, old in zip(blocks, before, strict=True))
    assert any(not torch.equal(block[1], old[1]) for block, old in zip(blocks, before, strict=True))
