"""Random transitions, small networks and losses, and one gradient step with them."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import DDPGLoss, LossModule

from torchrl_her import LossLearner, NetworkShape, make_actor, make_critic, make_ddpg_loss
from torchrl_her.objectives import Targets

WEIGHT = "priority_weight"
SMALL = NetworkShape(hidden=16)


def rows(
    reward: list[float], *, terminated: list[int] | None = None, done: list[int] | None = None
) -> TensorDict:
    """Rows with random inputs; ``done`` is truncated or terminated, and what is terminated if not given."""
    n = len(reward)
    ends = torch.tensor(terminated or [0] * n).bool().unsqueeze(-1)

    def seen() -> dict[str, Tensor]:
        return {"observation": torch.randn(n, 4), "desired_goal": torch.randn(n, 2)}

    after = {
        **seen(),
        "reward": torch.tensor(reward).unsqueeze(-1),
        "terminated": ends,
        "done": ends if done is None else torch.tensor(done).bool().unsqueeze(-1),
    }
    return TensorDict({**seen(), "action": torch.rand(n, 3) * 2 - 1, "next": after}, batch_size=[n])


def batch(n: int = 32) -> TensorDict:
    return rows([-1.0] * n)


class ConstantValue(nn.Module):
    """A critic that thinks the same of everything."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.tensor(value))

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.value.expand(*inputs[0].shape[:-1], 1)


def constant_loss(value: float, **options: Any) -> DDPGLoss:
    critic = TensorDictModule(
        ConstantValue(value),
        in_keys=["observation", "desired_goal", "action"],
        out_keys=["state_action_value"],
    )
    return make_ddpg_loss(make_actor((4, 2), 3), critic, targets=targets(**options))


def make_loss(**options: Any) -> DDPGLoss:
    networks = make_actor((4, 2), 3, shape=SMALL), make_critic((4, 2), 3, shape=SMALL)
    return make_ddpg_loss(*networks, targets=targets(**options))


def targets(**options: Any) -> Targets:
    return Targets(**{"reward_range": (-1.0, 0.0), **options})


def weights(loss: LossModule, network: str = "") -> Tensor:
    """A copy of all trained numbers of a loss, or of one of its networks."""
    own = [p.detach().flatten() for name, p in loss.named_parameters() if name.startswith(network)]
    return torch.cat(own).clone()


def networks() -> tuple[TensorDictModule, TensorDictModule]:
    actor, critic = make_actor((4, 2), 3, shape=SMALL), make_critic((4, 2), 3, shape=SMALL)
    with torch.no_grad():
        actor.module.layers[3].weight.normal_()  # actions all over the range
    return actor, critic


# Gradient steps


def step(loss: LossModule, data: TensorDict, **options: Any) -> dict[str, Tensor]:
    """One step of plain gradient descent with rate 1: weights change by minus the clipped gradient."""
    return LossLearner(loss, torch.optim.SGD(loss.parameters(), lr=1.0), **options).update(data)
