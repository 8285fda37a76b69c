"""The fused gradient step is TorchRL's, number for number."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import HardUpdate, SoftUpdate, ValueEstimators

from torchrl_her import FusedDDPGLearner, LossLearner, make_actor, make_critic, make_ddpg_loss
from torchrl_her.objectives import PenalizedDDPGLoss, clamped_td0
from torchrl_her.trainers import Learner, can_fuse, is_plain_adam, why_not_fused


def make_loss(runs: int, *, penalty: float = 0.3, normalize: bool = False) -> PenalizedDDPGLoss:
    actor = make_actor((4, 2), 3, hidden=16, runs=runs).double()
    critic = make_critic((4, 2), 3, hidden=16, runs=runs, normalize=normalize).double()
    return make_ddpg_loss(actor, critic, gamma=0.9, action_penalty=penalty, reduction="none")


def make_rows(runs: int, seed: int, *, weighted: bool, spans: bool = False) -> TensorDict:
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
    if spans:
        rows["steps_to_next_obs"] = torch.randint(1, 6, (runs, 8, 1), generator=generator)
    return TensorDict(rows, batch_size=[runs, 8])


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("spans", [False, True])
@pytest.mark.parametrize("max_grad_norm", [1e-3, 1e3])
def test_weights_targets_and_priorities_are_those_of_torchrl_s_loss(
    runs: int, weighted: bool, spans: bool, max_grad_norm: float
) -> None:
    first = make_loss(runs)
    second = deepcopy(first)
    learners: list[Learner] = []
    for loss, make in ((first, LossLearner), (second, FusedDDPGLearner)):
        optimizer, target = torch.optim.Adam(loss.parameters(), lr=1e-2), SoftUpdate(loss, tau=0.1)
        options = {"runs": runs} if make is LossLearner else {}
        learners.append(make(loss, optimizer, target, max_grad_norm=max_grad_norm, **options))
    for seed in range(20):
        rows = [make_rows(runs, seed, weighted=weighted, spans=spans) for _ in learners]
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
@pytest.mark.parametrize(("runs", "spans"), [pytest.param(1, True, marks=pytest.mark.full), (2, False)])
def test_the_compiled_step_is_the_same_for_draws_of_any_length(runs: int, spans: bool) -> None:
    plain, compiling = make_pair(runs)
    for seed in range(20):
        rows = [make_rows(runs, seed, weighted=True, spans=spans) for _ in range(2)]
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
        parts = [make_rows(runs, seed, weighted=True, spans=spans) for seed in range(lengths // 2)]
        rows = torch.cat(parts, 1)
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
    for _ in range(2):  # rows that span several steps have a program of their own
        compiling.update(make_rows(2, 0, weighted=False, spans=True))
        compiling.update(make_rows(2, 0, weighted=False))
    assert told == ["told", "compiled"] * 3


@pytest.mark.full
@pytest.mark.skipif(shutil.which("c++") is None, reason="there is no C++ compiler")
def test_new_numbers_make_a_new_compiled_form() -> None:
    plain, compiling = make_pair(2)
    take_new_numbers(plain, compiling)
    assert all(form.compiled for form in compiling._compiled.values())


def test_only_a_plain_adam_is_compiled() -> None:
    loss = make_loss(1)
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


def set_keys_of_targets(loss: PenalizedDDPGLoss) -> None:
    loss.value_estimator.set_keys(reward="cost")


def set_order(loss: PenalizedDDPGLoss) -> None:
    loss.value_network.in_keys = ["desired_goal", "observation", "action"]


def set_plain_targets(loss: PenalizedDDPGLoss) -> None:
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)


def set_targets_of_another(loss: PenalizedDDPGLoss) -> None:
    loss.value_estimator.value_network = make_loss(1).actor_critic


def add_a_hook(loss: PenalizedDDPGLoss) -> None:
    loss.value_network.module.rest.register_forward_hook(lambda *_: None)


def add_a_hook_to_the_loss(loss: PenalizedDDPGLoss) -> None:
    loss.register_forward_hook(lambda *_: None)


def add_a_hook_to_a_parameter(loss: PenalizedDDPGLoss) -> None:
    next(loss.parameters()).register_hook(lambda gradient: 0.0 * gradient)


def take_away_tanh(loss: PenalizedDDPGLoss) -> None:
    loss.actor_network.module.layers[-1] = torch.nn.Identity()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda loss: loss.set_keys(reward="cost"), "reward under the key 'cost'"),
        (lambda loss: loss.set_keys(priority_weight="importance"), "priority_weight under the key"),
        (lambda loss: setattr(loss.tensor_keys, "state_action_value", "q"), "a critic that writes"),
        (set_keys_of_targets, "reward of the targets under the key 'cost'"),
        (set_order, "a critic that reads"),
        (lambda loss: setattr(loss, "loss_function", "smooth_l1"), "loss_function='smooth_l1'"),
        (lambda loss: setattr(loss, "reduction", "sum"), "reduction='sum'"),
        (set_plain_targets, "targets of a TD0Estimator"),
        (set_targets_of_another, "targets from other networks"),
        (lambda loss: setattr(loss.value_estimator, "average_rewards", True), "average_rewards=True"),
        (lambda loss: setattr(loss.value_estimator, "skip_existing", True), "skip_existing=True"),
        (add_a_hook, "hooks on the loss or its networks"),
        (add_a_hook_to_the_loss, "hooks on the loss or its networks"),
        (add_a_hook_to_a_parameter, "hooks on parameters"),
        (take_away_tanh, "other layers than those of a plain ActorNet"),
    ],
)
def test_what_it_does_not_know_it_refuses(change: Callable[[PenalizedDDPGLoss], Any], reason: str) -> None:
    loss = make_loss(1)
    target = SoftUpdate(loss, tau=0.1)
    assert can_fuse(loss, target)
    change(loss)
    assert not can_fuse(loss, target)
    with pytest.raises(ValueError, match=f"only DDPG with the networks of make_actor.*{re.escape(reason)}"):
        FusedDDPGLearner(loss, torch.optim.Adam(loss.parameters()), target)


def test_other_networks_targets_and_losses_are_refused() -> None:
    normalized = make_loss(1, normalize=True)
    assert not can_fuse(normalized, SoftUpdate(normalized, tau=0.1))
    loss = make_loss(1)
    assert not can_fuse(loss, HardUpdate(loss, value_network_update_interval=5))
    assert not can_fuse(loss, SoftUpdate(make_loss(1), tau=0.1))
    assert not can_fuse(loss, None)
    for delays in ({"delay_actor": False}, {"delay_value": False}):
        options = {"delay_actor": True, "delay_value": True, "action_penalty": 0.0} | delays
        loss = PenalizedDDPGLoss(make_actor((4, 2), 3), make_critic((4, 2), 3), **options)
        loss.make_value_estimator(clamped_td0(0.9, (-1.0, 0.0), loss.actor_critic))
        assert not can_fuse(loss, SoftUpdate(loss, tau=0.1))


def test_frozen_parameters_are_not_trained() -> None:
    actor, critic = make_actor((4, 2), 3), make_critic((4, 2), 3)
    actor.module.layers[0].requires_grad_(False)
    loss = make_ddpg_loss(actor, critic)
    target = SoftUpdate(loss, tau=0.1)
    assert why_not_fused(loss, target) == "frozen parameters"


def test_parameters_that_are_frozen_later_are_noticed() -> None:
    loss = make_loss(1)
    learner = FusedDDPGLearner(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.1))
    next(loss.parameters()).requires_grad_(False)
    with pytest.raises(ValueError, match="parameters were frozen"):
        learner.update(make_rows(1, 0, weighted=False))


def test_an_optimizer_of_some_parameters_trains_no_others() -> None:
    loss = make_loss(1)
    optimizer = torch.optim.Adam(loss.value_network_params.parameters(), lr=1e-2)
    learner = FusedDDPGLearner(loss, optimizer, SoftUpdate(loss, tau=0.1))
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    learner.update(make_rows(1, 0, weighted=False))
    for name, value in loss.state_dict().items():
        assert torch.equal(value, before[name]) == ("actor" in name or "gamma" in name), name


def both_learners(loss: PenalizedDDPGLoss) -> tuple[LossLearner, FusedDDPGLearner]:
    other = deepcopy(loss)
    return tuple(
        make(own, torch.optim.Adam(own.parameters(), lr=1e-2), SoftUpdate(own, tau=0.1))
        for make, own in ((LossLearner, loss), (FusedDDPGLearner, other))
    )


def check_equal_updates(loss: PenalizedDDPGLoss, rows: TensorDict, **kinds: Any) -> None:
    ordinary, fused = both_learners(loss)
    for _ in range(3):
        measured = [learner.update(rows.clone()) for learner in (ordinary, fused)]
        torch.testing.assert_close(*measured, **kinds)
    for ours, theirs in zip(ordinary.loss.parameters(), fused.loss.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_importance_weights_are_ignored_if_the_loss_ignores_them() -> None:
    loss = make_loss(1)
    loss.use_prioritized_weights = False
    check_equal_updates(loss, make_rows(1, 0, weighted=True))


def test_rows_without_termination_end_where_they_are_done() -> None:
    rows = make_rows(1, 0, weighted=False)
    assert not torch.equal(rows["next", "done"], rows["next", "terminated"])
    check_equal_updates(make_loss(1), rows.exclude(("next", "terminated")))


def test_numbers_of_the_loss_may_change_during_training() -> None:
    ordinary, fused = both_learners(make_loss(1))
    for learner in (ordinary, fused):
        learner.update(make_rows(1, 0, weighted=False))
        learner.loss.action_penalty = 3.0
        learner.loss.value_estimator.gamma.fill_(0.5)
        learner.loss.value_estimator.low = -2.0
        learner.target.eps = 0.5
        learner.update(make_rows(1, 1, weighted=False))
    state = fused.loss.state_dict()
    for name, value in ordinary.loss.state_dict().items():
        torch.testing.assert_close(value, state[name], msg=name)


def test_masked_rows_are_refused() -> None:
    _, fused = both_learners(make_loss(1))
    rows = make_rows(1, 0, weighted=False)
    rows["collector", "mask"] = torch.rand(1, 8, 1) > 0.5
    with pytest.raises(ValueError, match=r"learns from all rows, but \('collector', 'mask'\) masks some"):
        fused.update(rows)
    fused.loss.loss_mask_key = None
    fused.update(rows)


@pytest.mark.parametrize("kind", [torch.float64, torch.int64])
def test_rewards_of_another_type_are_cast(kind: torch.dtype) -> None:
    loss = make_ddpg_loss(make_actor((4, 2), 3), make_critic((4, 2), 3))
    rows = make_rows(1, 0, weighted=True).float()
    for key in ("terminated", "done"):
        rows["next", key] = rows["next", key].bool()
    rows["next", "reward"] = rows["next", "reward"].to(kind)
    check_equal_updates(loss, rows[0].unsqueeze(0), check_dtype=False)


def test_a_scheduler_of_the_learning_rate_sees_compiled_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "compile", lambda function, **options: function)
    _, compiling = make_pair(2)
    schedule = torch.optim.lr_scheduler.ExponentialLR(compiling.optimizer, 0.5)
    compiling.update(make_rows(2, 0, weighted=False))
    schedule.step()  # a warning, here an error, says so if the optimizer made no step
    assert compiling.optimizer.param_groups[0]["lr"] == 5e-3


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
