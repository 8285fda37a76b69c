"""The state of a sampler as tensors and plain data: priorities, permutations, counts of what was drawn."""

from __future__ import annotations

from typing import Any

import torch
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, Sampler, SamplerEnsemble

from torchrl_her.replay_buffers.runs.sampler import RunsPrioritizedSampler
from torchrl_her.torchrl_private import capacity_of, samplers_in

_REMAINING = "_remaining_batches"  # until a pass over the data is over; TorchRL's states leave it out


def sampler_state_dict(sampler: Sampler, size: int) -> dict[str, Any]:
    """Returns the state that decides, together with random numbers, which rows a sampler draws next.

    Args:
        sampler: sampler of any of TorchRL's kinds.
        size: number of filled rows in its storage; a prioritized sampler's state has only these.

    Example:
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
        >>> sampler = SamplerWithoutReplacement(shuffle=False)
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(5), sampler=sampler, batch_size=2)
        >>> _ = buffer.extend(torch.arange(5)), buffer.sample()
        >>> sampler_state_dict(sampler, 5)["own"]["_sample_list"].tolist()  # what is left of this pass
        [2, 3, 4]
    """
    if isinstance(sampler, SamplerEnsemble):
        # Whole trees of the ensemble's members: the number of filled rows of each is not known here.
        state: dict[str, Any] = {
            str(i): sampler_state_dict(part, capacity_of(part)) for i, part in enumerate(samplers_in(sampler))
        }
    elif isinstance(sampler, PrioritizedSampler) and not isinstance(sampler, RunsPrioritizedSampler):
        state = _priorities(sampler, size)
    else:
        state = {
            key: value.clone() if isinstance(value, torch.Tensor) else value
            for key, value in sampler.state_dict().items()
        }
    return {"kind": type(sampler).__name__, "own": state, "remaining": vars(sampler).get(_REMAINING)}


def load_sampler_state_dict(sampler: Sampler, state: dict[str, Any]) -> None:
    """Restores the state that :func:`sampler_state_dict` returned.

    Raises:
        ValueError: the state is of another kind of sampler.
    """
    kind = type(sampler).__name__
    if state["kind"] != kind:
        raise ValueError(f"the state is of a {state['kind']}, not of a {kind}")
    if isinstance(sampler, SamplerEnsemble):
        for i, part in enumerate(samplers_in(sampler)):
            load_sampler_state_dict(part, state["own"][str(i)])
    elif isinstance(sampler, PrioritizedSampler) and not isinstance(sampler, RunsPrioritizedSampler):
        _load_priorities(sampler, state["own"])
    else:
        sampler.load_state_dict(state["own"])
    if state["remaining"] is not None:
        setattr(sampler, _REMAINING, state["remaining"])


def _priorities(sampler: PrioritizedSampler, size: int) -> dict[str, Any]:
    """Returns the priorities of filled rows: TorchRL's state holds trees that a safe load refuses."""
    state, filled = sampler.state_dict(), torch.arange(size)
    return {
        "sum": torch.as_tensor(state["_sum_tree"][filled]) if size else None,
        "min": torch.as_tensor(state["_min_tree"][filled]) if size else None,
        "max_priority": [
            None if value is None else torch.as_tensor(value) for value in state["_max_priority"]
        ],
        "alpha": float(state["_alpha"]),
        "beta": float(state["_beta"]),
    }


def _load_priorities(sampler: PrioritizedSampler, saved: dict[str, Any]) -> None:
    state = sampler.state_dict()
    if saved["sum"] is not None:
        filled = torch.arange(len(saved["sum"]))
        state["_sum_tree"][filled] = saved["sum"]
        state["_min_tree"][filled] = saved["min"]
    state["_max_priority"] = tuple(saved["max_priority"])
    state["_alpha"], state["_beta"] = saved["alpha"], saved["beta"]
    sampler.load_state_dict(state)
