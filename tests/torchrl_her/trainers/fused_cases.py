"""Losses of all algorithms and rows for them, for the tests of fused gradient steps."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.objectives import LossModule

from torchrl_her import make_actor, make_critic, make_ddpg_loss
from torchrl_her.modules import NetworkShape, RunNoise, make_q_actor, make_stochastic_actor
from torchrl_her.objectives import (
    ActorTerms,
    Targets,
    make_dqn_loss,
    make_sac_loss,
    make_td3_loss,
    make_tqc_loss,
)

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
    clamped = usual if bounded is None else bounded
    shared: dict[str, Any] = {
        "targets": Targets(reward_range=(-0.02, 0.0) if clamped else None),
        "reduction": "none",
    }
    if algorithm != "dqn":
        saturation = saturation_penalty if usual else 0.0
        shared["terms"] = ActorTerms(action_penalty=penalty, saturation_penalty=saturation)
    if algorithm == "redq":
        critics, target_critics = critics + 1, 2
    low, high = (torch.tensor(own, dtype=dtype) for own in ((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0)))
    spec = Bounded(low, high, dtype=dtype)
    shape = NetworkShape(**{"hidden": 16, **network})
    options: dict[str, Any] = {"shape": shape, "runs": runs}
    if algorithm == "dqn":
        actor = make_q_actor(WIDTHS, ACTIONS, **options)[0].to(dtype)
        return make_dqn_loss(actor, **shared)
    outputs = QUANTILES if algorithm == "tqc" else 1
    of_critic = options | ({"shape": replace(shape, norm="batch")} if algorithm == "normalized" else {})
    every = [make_critic(WIDTHS, ACTIONS, outputs=outputs, **of_critic).to(dtype) for _ in range(critics)]
    if algorithm in ("ddpg", "normalized"):
        actor = make_actor(WIDTHS, ACTIONS, **options).to(dtype)
        return make_ddpg_loss(actor, every[0], **shared)
    generators = [torch.Generator().manual_seed(run) for run in range(runs)]
    if algorithm == "td3":
        actor = make_actor(WIDTHS, ACTIONS, **options).to(dtype)
        shared |= {"action_spec": spec, "generators": generators}
        return make_td3_loss(actor, every, target_critics=target_critics, **shared).to(dtype)
    actor = make_stochastic_actor(WIDTHS, spec, generators=generators, **options).to(dtype)
    if algorithm == "tqc":
        return make_tqc_loss(actor, every, dropped_quantiles=1, **shared).to(dtype)
    return make_sac_loss(actor, every, target_critics=target_critics, **shared).to(dtype)


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
