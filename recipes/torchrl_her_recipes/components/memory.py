"""Refuses replay buffers that do not fit into a machine's memory, with the name of their option."""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch
from torchrl.envs import EnvBase

from torchrl_her.replay_buffers.keys import in_root_and_next


def check_buffer_size(
    size: int, runs: int, env: EnvBase, device: torch.device, *, not_stored: Sequence[str] = ()
) -> None:
    """Refuses a replay buffer that is larger than the memory of its device."""
    step = env.fake_tensordict().exclude(*in_root_and_next(not_stored))
    row = sum(entry.numel() * entry.element_size() for entry in step.values(True, True)) // env.numel()
    capacity = memory_of(device)
    if size * runs * row > capacity:
        raise ValueError(
            f"buffer_size={size} needs {size * runs * row / 1e9:.0f} GB for num_runs={runs}, {row} bytes for "
            f"each transition, but {device} has {capacity / 1e9:.0f} GB"
        )


def memory_of(device: torch.device) -> float:
    """Returns the bytes of memory of a device; infinity if the number is unknown."""
    if device.type == "cuda" and torch.cuda.device_count():
        return float(torch.cuda.get_device_properties(device).total_memory)
    if device.type != "cpu" or not hasattr(os, "sysconf"):
        return torch.inf
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
