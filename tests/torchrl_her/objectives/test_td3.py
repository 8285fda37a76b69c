"""TD3: targets by hand, TorchRL's numbers, and options that are refused."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torchrl.objectives import LossModule, SoftUpdate, TD3Loss

from torchrl_her import make_actor, make_critic
from torchrl_her.objectives import ActorTerms, Targets, make_td3_loss

from ..lost_game import SPEC, rows, say


def make_loss(
    critic: Any = None,
    *,
    runs: int = 1,
    critics: int = 2,
    gamma: float = 0.5,
    reward_range: tuple[float, float] = (-1.0, 0.0),
    **options: Any,
) -> LossModule:
    if critic is None:
        critic = [make_critic((4, 2), 3, runs=runs) for _ in range(critics)]
    targets = Targets(gamma=gamma, reward_range=reward_range)
    actor = make_actor((4, 2), 3, runs=runs)
    loss = make_td3_loss(actor, critic, action_spec=SPEC, targets=targets, **options)
    SoftUpdate(loss, tau=0.1)
    return loss


SUBSET = r"target_critics must be from 0 \(all\) to the number of critics, 3, got "


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"critics": 3, "target_critics": -1}, f"{SUBSET}-1"),
        ({"critics": 3, "target_critics": 4}, f"{SUBSET}4"),
        ({"target_noise": -0.1}, r"target_noise must be at least 0, got -0\.1"),
    ],
)
def test_what_cannot_be_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_loss(**options)


def test_rows_of_several_steps_discount_the_next_value_by_their_number() -> None:
    """By hand: critics that say 0 of everything, with targets that say -5 and -7."""
    critic = make_critic((4, 2), 3)
    for parameter in critic.parameters():
        parameter.data.zero_()
    loss = make_loss(critic, reward_range=(-10.0, 0.0))
    say(loss, [0.0, 0.0], [-5.0, -7.0])
    batch = rows(3, action=torch.rand(1, 3, 3))[0]
    batch["steps_to_next_obs"] = torch.tensor([[1], [2], [3]])
    assert loss(batch)["target_value"].tolist() == [-4.5, -2.75, -1.875]  # -1 - 7 / 2, - 7 / 4, - 7 / 8


def own_and_torchrls(**options: Any) -> tuple[LossModule, TD3Loss]:
    """Our loss, and TorchRL's with the same weights."""
    actor, critic = make_actor((4, 2), 3), make_critic((4, 2), 3)
    ours, plain = make_loss(**options), TD3Loss(actor, critic, action_spec=SPEC, loss_function="l2")
    targets = Targets(gamma=0.5, reward_range=(-1.0, 0.0))
    plain.make_value_estimator(targets.estimator(value_key="state_action_value"))
    plain.load_state_dict(ours.state_dict())
    SoftUpdate(plain, tau=0.1)
    return ours, plain


def test_without_a_penalty_it_is_torchrls_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = torch.randn(16, 3)
    monkeypatch.setattr(torch, "randn_like", lambda like: noise)
    batch = rows(16, action=torch.rand(1, 16, 3) * 4 - 2)[0]
    ours, plain = (loss(batch.clone()) for loss in own_and_torchrls())
    for name in ("loss_actor", "loss_qvalue", "target_value"):
        assert torch.equal(ours[name], plain[name]), name


def test_the_penalty_is_the_mean_square_of_the_actions() -> None:
    ours, plain = own_and_torchrls(terms=ActorTerms(action_penalty=0.7))
    batch = rows(16, action=torch.rand(1, 16, 3) * 4 - 2)[0]
    with ours.actor_network_params.to_module(ours.actor_network):
        action = ours.actor_network(batch.clone())["action"]
    added = ours(batch.clone())["loss_actor"] - plain(batch.clone())["loss_actor"]
    assert added.item() == pytest.approx(0.7 * action.square().mean().item(), rel=1e-3)


def test_the_targets_of_a_run_have_its_own_noise() -> None:
    """Two runs of one program, and the second of them alone."""
    generators = [torch.Generator().manual_seed(seed) for seed in (1, 2)]
    loss = make_loss(runs=2, generators=generators, reduction="none")
    first = loss.noise(torch.zeros(2, 5, 3))
    alone = torch.Generator().manual_seed(2)
    assert torch.equal(first[1].flatten(), torch.empty(15).normal_(generator=alone))


def test_without_target_noise_targets_value_the_actors_own_action() -> None:
    """The target of the same row twice; noise makes them differ."""
    batch = rows(1, action=torch.rand(1, 1, 3))[0].expand(2).clone()
    for noise, same in ((0.0, True), (0.2, False)):
        first, second = make_loss(target_noise=noise)(batch)["target_value"].tolist()
        assert (first == second) is same


def test_targets_of_critics_that_are_drawn_and_the_mean_for_the_actor() -> None:
    """By hand: the least of two of three targets, which differ from step to step."""
    generators = [torch.Generator().manual_seed(0)]
    loss = make_loss(critics=3, target_critics=2, reward_range=(-10.0, 0.0), generators=generators)
    say(loss, [-1.0, -3.0, -8.0], [-2.0, -4.0, -6.0])
    batch = rows(2, action=torch.rand(1, 2, 3))[0]
    seen = set()
    for _ in range(30):
        measured = loss(batch)
        assert measured["loss_actor"].item() == pytest.approx(4.0)
        first, second = measured["target_value"].tolist()
        assert first == second
        seen.add(first)
    assert seen == {-3.0, -4.0}  # -1 + half of -4 (critics 0 and 1) or of -6


def test_without_critics_it_is_refused() -> None:
    with pytest.raises(ValueError, match="critics must be at least 1, got 0"):
        make_loss(critics=0)


def test_critics_of_a_list_are_taken_as_they_are() -> None:
    own = [make_critic((4, 2), 3) for _ in range(3)]
    loss = make_loss(own)
    weights = loss.qvalue_network_params["module", "first", "0", "0", "weight"]
    assert weights.shape[0] == 3
    assert all(
        torch.equal(w, critic.module.first[0][0].weight) for w, critic in zip(weights, own, strict=True)
    )


@pytest.mark.parametrize("key", ["move", ("agent", "move")])
def test_actions_may_have_a_key_of_their_own(key: str | tuple[str, str]) -> None:
    critics = [make_critic((4, 2), 3, action_key=key) for _ in range(2)]
    loss = make_td3_loss(make_actor((4, 2), 3, action_key=key), critics, action_spec=SPEC)
    SoftUpdate(loss, tau=0.1)
    batch = rows(2, action=torch.rand(1, 2, 3))[0]
    batch.rename_key_("action", key)
    assert loss(batch)["loss_actor"].isfinite()
