"""Losses of all algorithms and rows for them, for the tests of fused gradient steps."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.objectives import LossModule

from torchrl_her import make_actor, make_critic, make_ddpg_loss
from torchrl_her.modules import RunNoise, make_q_actor, make_stochastic_actor
from torchrl_her.objectives import make_dqn_loss, make_sac_loss, make_td3_loss, make_tqc_loss

WIDTHS, ACTIONS = (4, 2), 3
ALGORITHMS = ("ddpg", "normalized", "td3", "sac", "redq", "tqc", "dqn")
QUANTILES = 5


def make_loss(
    algorithm: str,
    *,
    runs: int = 1,
    critics: int = 2,
    target_critics: int = 0,
    penalty: float = 0.3,
    saturation_penalty: float = 0.0,
    bounded: bool | None = None,
    dtype: torch.dtype = torch.float64,
    **network: Any,
) -> LossModule:
    """A loss with small networks and random numbers of its own; actions have three different ranges.

    ``bounded`` says whether targets are clamped, in place of what is usual for the algorithm; ``redq`` is SAC
    with targets of two critics at random, ``normalized`` DDPG with batch normalization in the critic.
    """
    usual = algorithm in ("ddpg", "normalized", "td3", "dqn")
    clamped: dict[str, Any] = {
        "reward_range": (-0.02, 0.0) if (usual if bounded is None else bounded) else None
    }
    if algorithm == "redq":
        critics, target_critics = critics + 1, 2
    low, high = (torch.tensor(own, dtype=dtype) for own in ((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0)))
    spec = Bounded(low, high, dtype=dtype)
    options: dict[str, Any] = {"hidden": 16, "runs": runs, **network}
    if algorithm == "dqn":
        actor = make_q_actor(WIDTHS, ACTIONS, **options)[0].to(dtype)
        return make_dqn_loss(actor, reduction="none", **clamped)
    outputs = QUANTILES if algorithm == "tqc" else 1
    of_critic = options | ({"norm": "batch"} if algorithm == "normalized" else {})
    critic = make_critic(WIDTHS, ACTIONS, outputs=outputs, **of_critic).to(dtype)
    if algorithm in ("ddpg", "normalized"):
        actor = make_actor(WIDTHS, ACTIONS, **options).to(dtype)
        costs = {"action_penalty": penalty, "saturation_penalty": saturation_penalty}
        return make_ddpg_loss(actor, critic, reduction="none", **costs, **clamped)
    generators = [torch.Generator().manual_seed(run) for run in range(runs)]
    shared: dict[str, Any] = {
        "critics": critics,
        "action_penalty": penalty,
        "generators": generators,
        "reduction": "none",
        **clamped,
    }
    if algorithm == "td3":
        actor = make_actor(WIDTHS, ACTIONS, **options).to(dtype)
        shared |= {"action_spec": spec, "saturation_penalty": saturation_penalty}
        return make_td3_loss(actor, critic, target_critics=target_critics, **shared).to(dtype)
    actor = make_stochastic_actor(WIDTHS, spec, **options).to(dtype)
    shared |= {"action_spec": spec, "runs": runs}
    if algorithm == "tqc":
        return make_tqc_loss(actor, critic, dropped_quantiles=1, **shared).to(dtype)
    return make_sac_loss(actor, critic, target_critics=target_critics, **shared).to(dtype)


def twin(loss: LossModule) -> LossModule:
    """The same loss once more, with random numbers that begin alike."""
    noise, other = getattr(loss, "noise", None), copy.deepcopy(loss)
    if noise is not None:
        other.noise = RunNoise([generator.clone_state() for generator in noise.generators])
    return other


def make_rows(
    algorithm: str,
    shape: tuple[int, ...],
    seed: int = 0,
    *,
    dtype: torch.dtype = torch.float64,
    **extras: bool,
) -> TensorDict:
    """Transitions; ``weights`` and ``spans`` add importance weights and several steps in a row."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*width: int) -> torch.Tensor:
        return torch.randn(*shape, *width, generator=draw, dtype=torch.float64).to(dtype)

    def flags() -> torch.Tensor:
        return torch.rand(*shape, 1, generator=draw) < 0.3

    action: Callable[[], torch.Tensor] = lambda: normal(ACTIONS).clamp(-1, 1)  # noqa: E731
    if algorithm == "dqn":
        action = lambda: torch.randint(ACTIONS, shape, generator=draw)  # noqa: E731
    ends = flags()
    rows = TensorDict(
        {
            "observation": normal(WIDTHS[0]),
            "desired_goal": normal(WIDTHS[1]),
            "action": action(),
            "next": {
                "observation": normal(WIDTHS[0]),
                "desired_goal": normal(WIDTHS[1]),
                "reward": -flags().to(dtype),
                "terminated": ends,
                "done": ends | flags(),
            },
        },
        shape,
    )
    if extras.get("weights"):
        rows["priority_weight"] = torch.rand(*shape, generator=draw).to(dtype) + 0.1
    if extras.get("spans"):
        rows["steps_to_next_obs"] = torch.randint(1, 4, (*shape, 1), generator=draw)
    return rows
