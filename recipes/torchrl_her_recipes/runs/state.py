"""Collects the state of a run as tensors and plain data, and restores it, so that runs resume bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torchrl.envs import EnvBase

from torchrl_her.goals.strategies import sources_name, strategy_name
from torchrl_her.modules.noise import generator_states, set_generator_states
from torchrl_her.replay_buffers.writer import HERWriter
from torchrl_her.trainers.checkpoint import (
    buffer_state_dict,
    collector_state_dict,
    load_buffer_state_dict,
    load_collector_state_dict,
)
from torchrl_her.trainers.trainer import Trainer
from torchrl_her_envs.common.batched_env import BatchedEnv
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.collection.worker import derive_seed
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.components.devices import place_of

_NETWORKS = ("loss", "optimizer", "target", "exploration", "norm", "average", "guide")
_ROWS = ("buffer", "demonstrations")  # parts that hold transitions, which make checkpoints large


@dataclass(frozen=True)
class Part:
    """A part of a run, with functions that read and restore its state."""

    state_dict: Callable[[], Any]
    load_state_dict: Callable[[Any], object]


def parts_of(components: Components, trainer: Trainer) -> dict[str, Any]:
    """Returns the parts of a run that have a state, by name, in the order in which states are restored."""
    buffer, collector, state = components.buffer, components.collector, components.curriculum
    guide, generators, device = components.guide, components.generators, place_of(components.loss)
    worlds = _worlds(components.env, components.recipe.collection.processes)

    def check_made_of(made_of: dict[str, str]) -> None:
        for name, value in _made_of(components).items():
            if value != made_of[name]:
                raise ValueError(
                    f"the run's {name} was {made_of[name]}, not {value}: give resume() components like those "
                    "that the run began with"
                )

    def load_progress(progress: dict[str, Any]) -> None:
        assert state is not None
        state.progress.load_state_dict(progress)
        state.set_goals(buffer.writer)

    def begin_episodes(_state: dict[str, Any]) -> None:
        if trainer.in_epoch:  # new episodes begin, since the environments' states are not saved
            collector.reset()
            if isinstance(buffer.writer, HERWriter):
                buffer.writer.end_episodes()

    parts = {
        "made_of": Part(partial(_made_of, components), check_made_of),
        **{name: getattr(components, name) for name in _NETWORKS},
        "guided": None if guide is None else Part(lambda: guide.guided, partial(setattr, guide, "guided")),
        "buffer": Part(
            partial(buffer_state_dict, buffer, copy=False), partial(load_buffer_state_dict, buffer)
        ),
        "generators": Part(partial(generator_states, generators), partial(set_generator_states, generators)),
        # Some losses, such as SAC's, draw random numbers from the global generators.
        "torch_generator": Part(torch.get_rng_state, torch.set_rng_state),
        "cuda_generator": None
        if device.type != "cuda" or not torch.cuda.is_initialized()
        else Part(
            partial(torch.cuda.get_rng_state, device), partial(torch.cuda.set_rng_state, device=device)
        ),
        "progress": None if state is None else Part(state.progress.state_dict, load_progress),
        "demonstrations": components.demonstrations,  # after "progress": rewards depend on the stage
        "collector": Part(
            partial(collector_state_dict, collector), partial(load_collector_state_dict, collector)
        ),
        "trainer": trainer,
        "worlds": Part(dict, begin_episodes)
        if worlds is None
        else Part(worlds.world_state_dict, worlds.load_world_state_dict),
    }
    return {name: part for name, part in parts.items() if part is not None}


def run_state(parts: dict[str, Any], *, buffer: bool = True) -> dict[str, Any]:
    """Returns the state of each part as tensors and plain data.

    Args:
        parts: parts from :func:`parts_of`.

    Keyword Args:
        buffer: whether to include all transitions, without which training cannot continue. Their tensors
            share memory with the replay buffers: save them before the buffers change.
    """
    return {name: part.state_dict() if buffer or name not in _ROWS else None for name, part in parts.items()}


def load_run_state(parts: dict[str, Any], state: dict[str, Any]) -> None:
    """Restores a state from :func:`run_state` in newly built parts; without transitions, buffers stay empty.

    Raises:
        ValueError: the state is of other parts, or of parts with other types or settings.
    """
    if others := sorted(parts.keys() ^ state.keys()):
        raise ValueError(
            f"it has other parts ({', '.join(others)}): resume it with the version of torchrl-her and the "
            "components that it was written with"
        )
    for name, part in parts.items():
        if state[name] is not None:
            part.load_state_dict(state[name])


def seed_epoch(env: EnvBase, seeds: Sequence[int], processes: int, trainer: Trainer) -> None:
    """Seeds environments whose state checkpoints cannot hold, so that resumed runs have the same episodes."""
    begins = trainer.epochs > 0 and not trainer.in_epoch
    if begins and processes == 0 and _worlds(env, processes) is None:
        goal_env(env).set_seeds([derive_seed(seed, trainer.epochs) for seed in seeds])


def _worlds(env: EnvBase, processes: int) -> BatchedEnv | None:
    """Returns the environment without its transforms, if its state is saved in checkpoints; else None."""
    worlds = goal_env(env)
    return worlds if processes == 0 and isinstance(worlds, BatchedEnv) else None


def _made_of(components: Components) -> dict[str, str]:
    """Returns a description of components, which must be the same when a run is resumed."""
    writer = components.buffer.writer
    hindsight: list[object] = []
    if isinstance(writer, HERWriter):
        sources = writer.goal_sources
        hindsight = [
            writer.k,
            strategy_name(writer.strategy) if sources is None else sources_name(sources),
            writer.filter_achieved,
            type(writer.goal_weights[0] if writer.goal_weights else None).__name__,
        ]
    names = {
        name: type(getattr(components, name)).__name__
        for name in ("actor", "critic", "loss", "optimizer", "target")
    }
    guide, demonstrations = components.guide, components.demonstrations
    return names | {
        "guide": type(guide).__name__,
        "demonstrations": "none"
        if demonstrations is None
        else f"{len(demonstrations.recorded)}, {demonstrations.recorded.digest}",
        "device": str(place_of(components.loss)),
        "writer": " ".join(map(str, [type(writer).__name__, *hindsight])),
        "sampler": type(components.buffer.sampler).__name__,
    }
