"""SAC: targets by hand, TorchRL's numbers, and options that are refused."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from torchrl.objectives import LossModule, SACLoss, SoftUpdate

from torchrl_her import LossLearner, make_critic
from torchrl_her.modules import make_stochastic_actor
from torchrl_her.objectives import ActorTerms, make_sac_loss
from torchrl_her.trainers import RunsAdam

from ..lost_game import SPEC, check_penalty, check_same_loss, rows, say, stochastic_loss, without_entropy

make_loss = partial(stochastic_loss, make_sac_loss)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"temperature": 0.0}, "temperature must be positive, got 0"),
        ({"terms": ActorTerms(saturation_penalty=0.1)}, "saturation_penalty is for deterministic actors"),
    ],
)
def test_what_cannot_be_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_loss(**options)


def test_rows_of_several_steps_discount_the_next_value_by_their_number() -> None:
    """By hand: critics that say 0, with targets of -5 and -7, and a temperature so low that it is nothing."""
    loss = without_entropy(make_loss())
    say(loss, [0.0, 0.0], [-5.0, -7.0])
    batch = rows(3, action=torch.rand(1, 3, 3))[0]
    batch["steps_to_next_obs"] = torch.tensor([[1], [2], [3]])
    loss(batch)
    # -1 - 7 / 2, -1 - 7 / 4, -1 - 7 / 8, as distances from 0
    assert batch["td_error"].tolist() == pytest.approx([4.5, 2.75, 1.875])


def test_targets_of_critics_that_are_drawn_and_the_mean_for_the_actor() -> None:
    """By hand: the least of two of three targets, which differ from run to run and from step to step."""
    generators = [torch.Generator().manual_seed(run) for run in range(2)]
    loss = without_entropy(
        make_loss(runs=2, critics=3, target_critics=2, generators=generators, reduction="none")
    )
    say(loss, [0.0, 0.0, 3.0], [-2.0, -4.0, -6.0])
    batch = rows(2, action=torch.rand(2, 2, 3), runs=2)
    seen = set()
    for _ in range(30):
        measured = loss(batch)
        assert measured["loss_actor"].flatten().tolist() == pytest.approx([-1.0] * 4)
        first, second = (batch["td_error"] - 3.0).tolist()  # of the critic that says 3
        assert first[0] == first[1]
        assert second[0] == second[1]
        seen.add((first[0], second[0]))
    assert seen == {(a, b) for a in (3.0, 4.0) for b in (3.0, 4.0)}  # 1 + half of 4 or of 6


def test_targets_may_be_clamped_to_possible_returns() -> None:
    batch, errors = rows(1, action=torch.rand(1, 1, 3))[0], []
    for bounds in (None, (-1.0, 0.0)):
        loss = without_entropy(make_loss(reward_range=bounds))
        say(loss, [0.0, 0.0], [-9.0, 9.0])
        loss(batch)
        errors += batch["td_error"].tolist()
    assert errors == pytest.approx([5.5, 2.0])  # -1 - 9 / 2, and the least return -1 / (1 - 1 / 2)


def own_and_torchrls(**options: Any) -> tuple[LossModule, SACLoss]:
    """Our loss, and TorchRL's with the same weights."""
    actor, critic = make_stochastic_actor((4, 2), SPEC), make_critic((4, 2), 3)
    ours, plain = make_loss(**options), SACLoss(actor, critic, action_spec=SPEC, loss_function="l2")
    plain.make_value_estimator(gamma=0.5)
    plain.load_state_dict(ours.state_dict())
    SoftUpdate(plain, tau=0.1)
    return ours, plain


def test_without_a_penalty_it_is_torchrls_loss() -> None:
    check_same_loss(*own_and_torchrls(), rows(16, action=torch.rand(1, 16, 3))[0])


def test_the_penalty_is_the_mean_square_of_the_drawn_actions() -> None:
    check_penalty(*own_and_torchrls(terms=ActorTerms(action_penalty=0.7)), penalty=0.7)


def test_each_run_has_a_temperature_of_its_own() -> None:
    loss = make_loss(runs=3, temperature=0.2, reduction="none")
    learner = LossLearner(loss, RunsAdam(loss, lr=0.1, runs=3), SoftUpdate(loss, tau=0.1), runs=3)
    assert loss.log_alpha.exp().tolist() == pytest.approx([0.2] * 3)
    learner.update(rows(8, action=torch.rand(1, 8, 3)).expand(3, 8).clone(), idle=[1])
    changed = (loss.log_alpha.exp() - 0.2).abs() > 1e-3
    assert changed.tolist() == [True, False, True]
