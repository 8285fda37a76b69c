"""The fused gradient steps are TorchRL's, number for number."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.objectives import HardUpdate, LossModule

from tests.torchrl_her.trainers.fused_cases import ALGORITHMS, make_loss, make_rows, twin
from torchrl_her import (
    FusedLearner,
    LossLearner,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_target_updater,
)
from torchrl_her.objectives import ActorTerms
from torchrl_her.trainers import Learner, RunsAdam
from torchrl_her.trainers.runs import run_dims


def make_learner(kind: type, loss: LossModule, *, runs: int = 1, hard: int = 0, norm: float = 0.5) -> Any:
    target: Any = HardUpdate(loss, value_network_update_interval=hard - 1)
    if not hard:
        target = make_target_updater(loss, tau=0.1, hard_interval=0)
    options = {"runs": runs} if kind is LossLearner else {}
    # A bias before a batch normalization has no gradient but rounding errors, which a tiny eps would magnify.
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, eps=1e-4)
    return kind(loss, optimizer, target, max_grad_norm=norm, **options)


def both(loss: LossModule, **options: Any) -> tuple[LossLearner, FusedLearner]:
    """TorchRL's loss with autograd, and the fused steps, of the same weights and random numbers."""
    other = twin(loss)
    runs = options.pop("runs", 1)
    return (
        make_learner(LossLearner, loss, runs=runs, **options),
        make_learner(FusedLearner, other, runs=runs, **options),
    )


def check_equal(
    first: Learner, second: Learner, rows: Callable[[int], TensorDict], steps: int, **kinds: Any
) -> None:
    """Some updates of both; what is measured, the priorities, weights, targets and moments."""
    close: dict[str, Any] = {"rtol": 0.0, "atol": 1e-12, "check_dtype": False} | kinds
    key = first.loss.tensor_keys.priority
    for seed in range(3):
        own = [rows(seed), rows(seed)]
        measured = [learner.update(each, steps) for learner, each in zip((first, second), own, strict=True)]
        torch.testing.assert_close(measured[0], measured[1], **close)
        torch.testing.assert_close(own[0][key].reshape(-1), own[1][key].reshape(-1), **close)
    state = second.loss.state_dict()
    for name, value in first.loss.state_dict().items():
        torch.testing.assert_close(value, state[name], msg=name, **close)
    pairs = zip(first.loss.parameters(), second.loss.parameters(), strict=True)
    for one, other in pairs:
        torch.testing.assert_close(
            dict(first.optimizer.state[one]), dict(second.optimizer.state[other]), **close
        )


EXTRAS = {"weights": True, "spans": True}
# Runs, extras and norm: pairs of opposites, one for each algorithm in turn. So every two values of algorithm,
# runs, extras and norm occur together.
OPPOSITES: list[list[tuple[int, dict[str, bool], float]]] = [
    [(1, {}, 1e-2), (3, EXTRAS, 1e3)],
    [(1, EXTRAS, 1e-2), (3, {}, 1e3)],
    [(1, EXTRAS, 1e3), (3, {}, 1e-2)],
    [(1, {}, 1e3), (3, EXTRAS, 1e-2)],
]


@pytest.mark.parametrize(
    ("algorithm", "runs", "extras", "norm"),
    [(algorithm, *case) for i, algorithm in enumerate(ALGORITHMS) for case in OPPOSITES[i % 4]],
)
def test_everything_is_as_with_torchrl_s_loss(
    algorithm: str, runs: int, extras: dict[str, bool], norm: float
) -> None:
    first, second = both(make_loss(algorithm, runs=runs), runs=runs, norm=norm)
    check_equal(first, second, lambda seed: make_rows(algorithm, (runs, 24), seed, **extras), 3)


@pytest.mark.parametrize("algorithm", ["ddpg", "td3"])
def test_penalty_on_saturated_actions(algorithm: str) -> None:
    loss = make_loss(algorithm, runs=2, saturation_penalty=0.5)
    last = loss.actor_network_params["module", "layers", "3", "weight"]
    last.data *= 2_000  # actions from one end of tanh to the other
    rows = make_rows(algorithm, (2, 24))
    argument = loss.actor_network(rows.flatten())["action"].atanh().abs()
    assert argument.min() < 2 < argument.max() < 6
    first, second = both(loss, runs=2, norm=1e3)
    check_equal(first, second, lambda seed: make_rows(algorithm, (2, 24), seed), 3, atol=1e-9)


@pytest.mark.parametrize(
    ("algorithm", "target_critics", "runs"),
    [("td3", 1, 3), ("td3", 2, 1), ("td3", 5, 3), ("sac", 1, 1), ("sac", 2, 3), ("sac", 5, 1)],
)
def test_targets_of_critics_that_are_drawn(algorithm: str, target_critics: int, runs: int) -> None:
    loss = make_loss(algorithm, runs=runs, critics=5, target_critics=target_critics)
    first, second = both(loss, runs=runs)
    check_equal(first, second, lambda seed: make_rows(algorithm, (runs, 24), seed, weights=True), 3)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_targets_with_and_without_bounds(algorithm: str) -> None:
    bounded, free = (both(make_loss(algorithm, bounded=own)) for own in (True, False))
    for first, second in (bounded, free):
        check_equal(first, second, lambda seed: make_rows(algorithm, (1, 24), seed), 3)
    free[0].loss.load_state_dict(bounded[0].loss.state_dict())
    losses = [first.update(make_rows(algorithm, (1, 24))) for first, _ in (bounded, free)]
    names = [name for name in losses[0].keys() if name in ("loss", "loss_value", "loss_qvalue")]
    assert names
    assert not any(torch.equal(losses[0][name], losses[1][name]) for name in names)


@given(
    algorithm=st.sampled_from(ALGORITHMS),
    hidden=st.integers(1, 70),
    depth=st.integers(2, 4),
    activation=st.sampled_from(["relu", "tanh", "elu"]),
    norm=st.sampled_from(["none", "layer"]),
    critics=st.integers(1, 4),
    runs=st.integers(1, 2),
    batch=st.integers(1, 40),
    seed=st.integers(0, 1000),
)
@settings(max_examples=25, deadline=None)
def test_networks_of_any_shape(
    algorithm: str,
    hidden: int,
    depth: int,
    activation: str,
    norm: str,
    critics: int,
    runs: int,
    batch: int,
    seed: int,
) -> None:
    torch.manual_seed(seed)
    shape: dict[str, Any] = {"hidden": hidden, "depth": depth, "activation": activation, "norm": norm}
    if algorithm == "normalized":
        batch = max(batch, 4)  # two rows are normalized to 1 and -1: what is left is rounding
    first, second = both(make_loss(algorithm, runs=runs, critics=critics, **shape), runs=runs)
    # A layer normalization of a single unit, or of units that are nearly alike, magnifies rounding errors.
    check_equal(first, second, lambda own: make_rows(algorithm, (runs, 2 * batch), seed + own), 2, atol=1e-9)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_gradients_in_float32(algorithm: str) -> None:
    first, second = both(make_loss(algorithm, dtype=torch.float32), norm=1e3)
    rows = [make_rows(algorithm, (1, 16), dtype=torch.float32, weights=True) for _ in range(2)]
    measured = [learner.update(own) for learner, own in zip((first, second), rows, strict=True)]
    torch.testing.assert_close(*measured, rtol=1e-6, atol=1e-6)
    for one, other in zip(first.loss.parameters(), second.loss.parameters(), strict=True):
        # Weights would not do: Adam's first step is nearly the sign of a gradient, however small that is.
        pair = [own.optimizer.state[p] for own, p in ((first, one), (second, other))]
        moments = [state["exp_avg"] for state in pair]
        torch.testing.assert_close(*moments, rtol=1e-6, atol=1e-7)  # a tenth of the gradient
        squares = [state["exp_avg_sq"] for state in pair]
        torch.testing.assert_close(*squares, rtol=3e-6, atol=1e-10)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_targets_that_are_copied(algorithm: str) -> None:
    first, second = both(make_loss(algorithm), hard=2)
    check_equal(first, second, lambda seed: make_rows(algorithm, (1, 24), seed), 3)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_several_steps_of_one_call_are_those_of_several_calls(algorithm: str) -> None:
    loss = make_loss(algorithm, runs=2)
    together, apart = (make_learner(FusedLearner, own) for own in (loss, twin(loss)))
    parts = [make_rows(algorithm, (2, 8), seed, weights=True) for seed in range(3)]
    rows, key = torch.cat(parts, 1), loss.tensor_keys.priority
    measured = together.update(rows, 3)
    for name, values in zip(
        measured, zip(*(apart.update(part).values() for part in parts), strict=True), strict=True
    ):
        assert torch.equal(measured[name], torch.cat(values))
    assert torch.equal(rows[key].view(2, -1), torch.cat([part[key].view(2, -1) for part in parts], 1))
    for ours, theirs in zip(together.loss.parameters(), apart.loss.parameters(), strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_run_is_the_same_beside_others(algorithm: str) -> None:
    loss = make_loss(algorithm, runs=3)
    rows = make_rows(algorithm, (3, 16))
    all_three = make_learner(FusedLearner, loss)
    alone = make_loss(algorithm, runs=1)
    own_state = alone.state_dict()
    for name, value in loss.state_dict().items():
        dim = run_dims(loss)[name]
        if value.ndim > dim and not name.endswith("_action"):  # the range of actions is the same for all
            own_state[name] = value.narrow(dim, 2, 1).reshape(own_state[name].shape)
    alone.load_state_dict(own_state)
    if getattr(loss, "noise", None) is not None:
        alone.noise.generators = [loss.noise.generators[2].clone_state()]
    single = make_learner(FusedLearner, alone)
    third = rows[2:].clone()
    measured, own = all_three.update(rows, 2), single.update(third, 2)
    for name, value in own.items():
        assert torch.equal(value[:, 0], measured[name][:, 2])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_idle_runs_stay_as_they_are_from_the_first_step_on(algorithm: str) -> None:
    loss = make_loss(algorithm, runs=3)
    optimizer = RunsAdam(loss, lr=1e-2, runs=3)
    learner = FusedLearner(loss, optimizer, make_target_updater(loss, tau=0.1, hard_interval=0))
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    learner.update(make_rows(algorithm, (3, 8)), idle=[1])
    for name, value in loss.state_dict().items():
        dim = 1 if "qvalue" in name else 0
        if value.ndim > dim and value.shape[dim] == 3:
            assert torch.equal(value.select(dim, 1), before[name].select(dim, 1)), name
            moved = not torch.equal(value.select(dim, 0), before[name].select(dim, 0))
            assert moved or "target" in name or "_action" in name, name
    for parameter, state in learner.optimizer.state.items():
        dim = 1 if parameter.ndim == 4 else 0
        assert (state["exp_avg"].select(dim, 1) == 0).all()
        assert state["step"].flatten().tolist() == [1, 0, 1]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("hard", [0, 2])
def test_a_run_that_was_idle_learns_as_with_torchrl_s_loss(algorithm: str, hard: int) -> None:
    losses = [loss := make_loss(algorithm, runs=3), twin(loss)]
    measured = []
    for kind, own in zip((LossLearner, FusedLearner), losses, strict=True):
        target = make_target_updater(own, tau=0.1, hard_interval=hard, runs=3)
        options = {"runs": 3} if kind is LossLearner else {}
        learner = kind(own, RunsAdam(own, lr=1e-2, runs=3), target, max_grad_norm=0.5, **options)
        for number, idle in enumerate([[1], [], [0, 2], []]):
            rows = make_rows(algorithm, (3, 24), number)
            learning = [run for run in range(3) if run not in idle]
            measured.append([values[:, learning] for values in learner.update(rows, 3, idle=idle).values()])
    close = {"atol": 1e-9 if algorithm == "normalized" else 1e-12, "rtol": 0.0}
    torch.testing.assert_close(measured[:4], measured[4:], **close)
    for name, value in losses[0].state_dict().items():
        torch.testing.assert_close(value, losses[1].state_dict()[name], **close)


def test_idle_runs_need_counts_of_their_own() -> None:
    rows = make_rows("ddpg", (2, 8))
    learner = make_learner(FusedLearner, make_loss("ddpg", runs=2))
    with pytest.raises(ValueError, match=r"runs \[1\] are idle, but Adam counts .* use .*RunsAdam"):
        learner.update(rows, idle=[1])
    loss = make_loss("ddpg", runs=2)
    target = HardUpdate(loss, value_network_update_interval=3)
    learner = LossLearner(loss, RunsAdam(loss, runs=2), target, runs=2)
    with pytest.raises(ValueError, match=r"HardUpdate counts .* use .*make_target_updater"):
        learner.update(rows, idle=[1])


@pytest.mark.parametrize("algorithm", ["td3", "normalized"])
def test_a_checkpoint_in_between_changes_nothing(algorithm: str) -> None:
    first, second = both(make_loss(algorithm))
    for learner in (first, second):
        learner.update(make_rows(algorithm, (1, 8)))
        learner.optimizer.load_state_dict(deepcopy(learner.optimizer.state_dict()))  # has new tensors now
        learner.loss.load_state_dict(deepcopy(learner.loss.state_dict()))
    check_equal(first, second, lambda seed: make_rows(algorithm, (1, 8), seed), 1)
    assert second.optimizer.state_dict()["state"][0]["step"] == 4


@pytest.mark.parametrize("algorithm", ["td3", "normalized"])
def test_targets_may_be_replaced(algorithm: str) -> None:
    first, second = both(make_loss(algorithm))
    for learner in (first, second):
        learner.update(make_rows(algorithm, (1, 8)))
        for tensor in learner.loss.target_actor_network_params.values(True, True):
            tensor.data = 0.9 * tensor
    check_equal(first, second, lambda seed: make_rows(algorithm, (1, 8), seed), 1)


def test_numbers_may_change_during_training() -> None:
    first, second = both(make_loss("ddpg"))
    for learner in (first, second):
        learner.update(make_rows("ddpg", (1, 8)))
        learner.loss.terms = ActorTerms(action_penalty=3.0)
        learner.loss.value_estimator.gamma.fill_(0.5)
        learner.loss.value_estimator.low = -2.0
        learner.target.eps = 0.5
        learner.optimizer.param_groups[0].update(betas=(0.5, 0.9), eps=1e-3, lr=5e-2)
    assert second.tau == 0.5
    check_equal(first, second, lambda seed: make_rows("ddpg", (1, 8), seed), 1)


def test_the_number_of_dropped_quantiles_may_change_within_its_range() -> None:
    first, second = both(make_loss("tqc"))
    for learner in (first, second):
        learner.loss.top_quantiles_to_drop_per_net = 3
    check_equal(first, second, lambda seed: make_rows("tqc", (1, 8), seed), 1)
    for wrong in (-1, 5):
        second.loss.top_quantiles_to_drop_per_net = wrong
        with pytest.raises(ValueError, match=f"per_net must be from 0 to 4, got {wrong}"):
            second.update(make_rows("tqc", (1, 8)))


def test_importance_weights_are_ignored_if_the_loss_ignores_them() -> None:
    loss = make_loss("ddpg")
    loss.use_prioritized_weights = False
    check_equal(*both(loss), lambda seed: make_rows("ddpg", (1, 8), seed, weights=True), 1)


def test_rows_without_termination_end_where_they_are_done() -> None:
    rows = make_rows("ddpg", (1, 8))
    assert not torch.equal(rows["next", "done"], rows["next", "terminated"])
    check_equal(*both(make_loss("ddpg")), lambda seed: rows.exclude(("next", "terminated")), 1)


@pytest.mark.parametrize("kind", [torch.float64, torch.int64])
def test_rewards_of_another_type_are_cast(kind: torch.dtype) -> None:
    loss = make_ddpg_loss(make_actor((4, 2), 3), make_critic((4, 2), 3))

    def rows(seed: int) -> TensorDict:
        own = make_rows("ddpg", (1, 8), seed, dtype=torch.float32)
        own["next", "reward"] = own["next", "reward"].to(kind)
        return own

    check_equal(*both(loss), rows, 1, atol=1e-5, rtol=1e-4)


def test_a_scheduler_of_the_learning_rate_sees_the_steps() -> None:
    learner = make_learner(FusedLearner, make_loss("ddpg"))
    schedule = torch.optim.lr_scheduler.ExponentialLR(learner.optimizer, 0.5)
    learner.update(make_rows("ddpg", (1, 8)))
    schedule.step()  # a warning, here an error, says so if the optimizer made no step
    assert learner.optimizer.param_groups[0]["lr"] == 5e-3


def test_parameters_that_are_frozen_later_are_noticed() -> None:
    learner = make_learner(FusedLearner, make_loss("ddpg"))
    next(learner.loss.parameters()).requires_grad_(False)
    with pytest.raises(ValueError, match="parameters were frozen"):
        learner.update(make_rows("ddpg", (1, 8)))


def test_masked_rows_are_refused() -> None:
    learner = make_learner(FusedLearner, make_loss("ddpg"))
    rows = make_rows("ddpg", (1, 8))
    rows["collector", "mask"] = torch.rand(1, 8, 1) > 0.5
    with pytest.raises(ValueError, match=r"learns from all rows, but \('collector', 'mask'\) masks some"):
        learner.update(rows)
    learner.loss.loss_mask_key = None
    learner.update(rows)


@pytest.mark.parametrize(
    ("algorithm", "key", "value", "message"),
    [
        ("ddpg", "action", torch.zeros(1, 8, 2), "'action' must have 3 columns"),
        (
            "ddpg",
            "observation",
            torch.zeros(1, 8, 5),
            r"\['observation', 'desired_goal'\] must have 6 columns together, got 7",
        ),
        ("ddpg", ("next", "reward"), torch.zeros(1, 8, 2), r"\('next', 'reward'\) must have 1 columns"),
        (
            "ddpg",
            "action",
            torch.zeros(1, 8, 3, device="meta"),
            "'action' must be on the CPU to be fused, got it on meta",
        ),
        ("dqn", "action", torch.tensor([[0, 1, 2, 3, 0, 1, 2, 0]]), r"actions must be from 0 to 2, got \["),
        (
            "dqn",
            "action",
            torch.eye(8, 3).long()[None],
            "'action' must be the number of an action in each row",
        ),
    ],
)
def test_rows_of_another_kind_are_refused(
    algorithm: str, key: Any, value: torch.Tensor, message: str
) -> None:
    rows = make_rows(algorithm, (1, 8)).set(key, value)
    with pytest.raises(ValueError, match=message):
        make_learner(FusedLearner, make_loss(algorithm)).update(rows)


def test_a_batch_of_one_row_has_no_statistics() -> None:
    with pytest.raises(ValueError, match="at least 2 rows for batch normalization, got 1"):
        make_learner(FusedLearner, make_loss("normalized", runs=2)).update(make_rows("ddpg", (2, 3)), 3)


def test_a_hard_update_has_no_tau() -> None:
    learner = make_learner(FusedLearner, make_loss("ddpg"), hard=5)
    assert learner.tau == 0.0
    with pytest.raises(ValueError, match=r"tau must not be set .* got 0.5"):
        learner.tau = 0.5


def test_actors_of_sac_that_saturate_get_the_gradient_of_torchrl() -> None:
    def last_bias(loss: LossModule) -> torch.Tensor:
        return dict(loss.named_parameters())["actor_network_params.module.0.module.layers.3.bias"]

    loss = make_loss("sac", dtype=torch.float32)
    last_bias(loss).data[..., :3] = 40.0
    learners = both(loss, norm=1e9)
    for learner in learners:
        learner.update(make_rows("sac", (1, 8), dtype=torch.float32))
    moments = [learner.optimizer.state[last_bias(learner.loss)]["exp_avg"] for learner in learners]
    torch.testing.assert_close(*moments, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("kind", [LossLearner, FusedLearner])
@pytest.mark.parametrize("shape", [(12,), (4, 3), (1, 12), (2, 3, 2)])
def test_rows_that_are_not_those_of_the_runs_are_refused(kind: type, shape: tuple[int, ...]) -> None:
    learner = make_learner(kind, make_loss("ddpg", runs=2), runs=2)
    with pytest.raises(ValueError, match=r"rows of 2 runs must be of shape \[2, n\], got \["):
        learner.update(make_rows("ddpg", shape), 1)


def test_states_of_other_networks_are_refused() -> None:
    small, large = (make_learner(FusedLearner, make_loss("ddpg", hidden=hidden)) for hidden in (2, 64))
    small.update(make_rows("ddpg", (1, 8)))
    large.optimizer.load_state_dict(small.optimizer.state_dict())
    with pytest.raises(ValueError, match=r"target and moments must be contiguous tensors on the CPU"):
        large.update(make_rows("ddpg", (1, 8)))


def test_a_loss_that_was_cast_is_refused() -> None:
    learner = make_learner(FusedLearner, make_loss("ddpg"))
    learner.update(make_rows("ddpg", (1, 8)))
    learner.loss.float()
    with pytest.raises(ValueError, match="make the learner after moving the loss"):
        learner.update(make_rows("ddpg", (1, 8)))


def test_counts_of_steps_that_differ_are_refused() -> None:
    learner = make_learner(FusedLearner, make_loss("ddpg"))
    learner.update(make_rows("ddpg", (1, 8)))
    list(learner.optimizer.state.values())[-1]["step"] = torch.tensor(1000.0)
    with pytest.raises(
        ValueError, match=r"same number of steps for each parameter, got \[\(1.0,\), \(1000.0,\)\]"
    ):
        learner.update(make_rows("ddpg", (1, 8)))


def test_a_reward_that_is_not_a_number_is_not_hidden() -> None:
    rows = make_rows("ddpg", (1, 8))
    rows["next", "reward"][0, 3] = torch.nan
    learner = make_learner(FusedLearner, make_loss("ddpg"))
    learner.update(rows)
    weights = learner.loss.value_network_params
    assert all(bool(value.isnan().all()) for value in weights.values(True, True))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_process_that_was_forked_goes_on() -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        learner = make_learner(FusedLearner, make_loss("ddpg", runs=2), runs=2)
        learner.update(make_rows("ddpg", (2, 8)))
        child = os.fork()
        if child == 0:
            signal.alarm(20)  # it would hang
            learner.update(make_rows("ddpg", (2, 8)))
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
    finally:
        torch.set_num_threads(threads)
