"""Transitions of a game that nobody can win: every reward is -1."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_her import make_critic
from torchrl_her.modules import make_stochastic_actor
from torchrl_her.objectives import Targets

SPEC = Bounded(-2.0, 2.0, (3,))


def stochastic_loss(
    make: Callable[..., LossModule],
    *,
    runs: int = 1,
    critics: int = 2,
    outputs: int = 1,
    generators: list[torch.Generator] | None = None,
    gamma: float = 0.5,
    reward_range: tuple[float, float] | None = None,
    **options: Any,
) -> LossModule:
    """The loss of a stochastic actor by ``make_sac_loss`` or ``make_tqc_loss``, with its target networks."""
    actor = make_stochastic_actor((4, 2), SPEC, runs=runs, generators=generators)
    every = [make_critic((4, 2), 3, runs=runs, outputs=outputs) for _ in range(critics)]
    loss = make(actor, every, targets=Targets(gamma=gamma, reward_range=reward_range), **options)
    SoftUpdate(loss, tau=0.1)
    return loss


def rows(n: int, *, action: torch.Tensor, runs: int = 1) -> TensorDict:
    def seen() -> dict[str, torch.Tensor]:
        return {"observation": torch.randn(runs, n, 4), "desired_goal": torch.randn(runs, n, 2)}

    off = torch.zeros(runs, n, 1, dtype=torch.bool)
    after = seen() | {"reward": -torch.ones(runs, n, 1), "done": off, "terminated": off.clone()}
    return TensorDict(seen() | {"action": action, "next": after}, [runs, n])


def say(loss: LossModule, values: Sequence[object], target_values: Sequence[object]) -> None:
    """Lets the critics of a loss, and their targets, say the same values of everything.

    Of each critic a number, or a list of quantiles.
    """
    for name, bias in (("qvalue_network_params", values), ("target_qvalue_network_params", target_values)):
        params = getattr(loss, name)
        for value in params.values(True, True):
            value.data.zero_()
        params["module", "rest", "2", "bias"].data.copy_(torch.tensor(bias).view(len(bias), 1, 1, -1))


def without_entropy(loss: LossModule) -> LossModule:
    loss.log_alpha.data.fill_(-50.0)
    return loss


def check_same_loss(ours: LossModule, plain: LossModule, batch: TensorDict) -> None:
    """Two losses of stochastic actors that draw the same give the same numbers and priorities."""
    batches = [batch.clone(), batch.clone()]
    first, second = (_seeded(loss, own) for loss, own in zip((ours, plain), batches, strict=True))
    for name in ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy"):
        torch.testing.assert_close(first[name], second[name], msg=name)
    torch.testing.assert_close(batches[0]["td_error"], batches[1]["td_error"])


def check_penalty(ours: LossModule, plain: LossModule, *, penalty: float) -> None:
    """The first of two losses adds to the actor's loss a multiple of the mean square of drawn actions."""
    batch = rows(4_000, action=torch.rand(1, 4_000, 3))[0]
    with ours.actor_network_params.to_module(ours.actor_network):
        action = ours.actor_network.get_dist(batch).rsample((10,))
    added = _seeded(ours, batch.clone())["loss_actor"] - _seeded(plain, batch.clone())["loss_actor"]
    assert added.item() == pytest.approx(penalty * action.square().mean().item(), rel=0.05)


def _seeded(loss: LossModule, batch: TensorDict) -> TensorDict:
    torch.manual_seed(3)
    return loss(batch)
