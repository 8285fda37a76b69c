"""Chooses the devices on which networks learn and transitions are stored."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import nn

from torchrl_her_recipes.config.choices.learners import LearnerConfig
from torchrl_her_recipes.config.groups import ReplayConfig

CPU = torch.device("cpu")
_WORTH_IT = 1e9  # multiplications in a gradient step of all runs, above which a GPU is faster


class Devices(NamedTuple):
    """Devices of the learner and the replay buffer. Environments are always on the CPU.

    Attributes:
        learner: device of networks, losses, optimizer and the policy that acts.
        replay: device of storage, priorities and relabeling.
    """

    learner: torch.device
    replay: torch.device


ON_THE_CPU = Devices(CPU, CPU)


def devices_of(learner: LearnerConfig, replay: ReplayConfig, runs: int) -> Devices:
    """Returns the devices of learner and buffer; "auto" is a GPU only if gradient steps are large."""
    device = learner.device
    if device == "auto":
        work = 6 * learner.hidden_weights * replay.batch_size * runs
        device = "cuda" if torch.cuda.is_available() and work >= _WORTH_IT else "cpu"
    return Devices(
        _find(device, "learner.device", "auto"),
        _find(device if replay.device == "learner" else replay.device, "replay.device", "learner"),
    )


def place_of(module: nn.Module) -> torch.device:
    """Returns the device of a module's parameters; the CPU if it has none."""
    return next((parameter.device for parameter in module.parameters()), CPU)


def make_generators(seeds: Sequence[int], device: torch.device) -> list[torch.Generator]:
    """Returns random generators on a device, one for each seed."""
    return [torch.Generator(device).manual_seed(seed) for seed in seeds]


def _find(name: str, option: str, word: str) -> torch.device:
    """Returns the device with this name; raises a ValueError if it is missing or has no random generators."""
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(
            f"{option} must be {word}, cpu, or a device such as cuda or cuda:1, got {name!r}"
        ) from None
    if device.type == "cpu":
        return CPU
    if device.index is None:
        device = torch.device(device.type, 0)
    try:
        torch.empty(0, device=device)
        torch.Generator(device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = " ".join(str(error).split()).partition(". ")[0]
        raise ValueError(f"{option}={name} is not available: {reason}; cpu always is") from error
    return device
