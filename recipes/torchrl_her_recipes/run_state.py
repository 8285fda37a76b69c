"""All that a run is, as tensors and plain data, so that it can go on from there bit for bit."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch

from torchrl_her import (
    HERWriter,
    Trainer,
    buffer_state_dict,
    collector_state_dict,
    load_buffer_state_dict,
    load_collector_state_dict,
    set_layer_goals,
)
from torchrl_her_envs import SeededWorlds, goal_env
from torchrl_her_recipes.parts import Parts


def run_state(parts: Parts, trainer: Trainer) -> dict[str, Any]:
    """All that a run is, as tensors and plain data. Rows are the buffers' own: save it at once."""
    return {
        "recipe": asdict(parts.recipe),
        "made_of": _made_of(parts),
        "trainer": trainer.state_dict(),
        "loss": dict(parts.loss.state_dict()),
        "optimiser": parts.optimiser.state_dict(),
        "target": None if parts.target is None else parts.target.state_dict(),
        "exploration": dict(parts.exploration.state_dict()),
        "buffers": [buffer_state_dict(buffer, copy=False) for buffer in parts.buffers],
        "generators": [generator.get_state() for generator in parts.generators],
        "torch_generator": torch.get_rng_state(),  # for losses that draw, as SAC's
        "worlds": None if (worlds := _worlds(parts)) is None else worlds.world_state_dict(),
        "progress": None if parts.climb is None else parts.climb.progress.state_dict(),
        "collector": collector_state_dict(parts.collector),
    }


def load_run_state(parts: Parts, trainer: Trainer, state: dict[str, Any]) -> None:
    """Puts freshly built parts where :func:`run_state` was taken.

    Raises:
        ValueError: the parts are of other types or have other settings than those of the run.
    """
    for name, value in _made_of(parts).items():
        if value != state["made_of"][name]:
            was = state["made_of"][name]
            raise ValueError(f"the run's {name} was {was}, not {value}: give resume() parts made as its were")
    parts.loss.load_state_dict(state["loss"])
    parts.optimiser.load_state_dict(state["optimiser"])
    if parts.target is not None:
        parts.target.load_state_dict(state["target"])
    parts.exploration.load_state_dict(state["exploration"])
    for buffer, own in zip(parts.buffers, state["buffers"], strict=True):
        load_buffer_state_dict(buffer, own)
    for generator, own in zip(parts.generators, state["generators"], strict=True):
        generator.set_state(own)
    torch.set_rng_state(state["torch_generator"])
    if parts.climb is not None:
        parts.climb.progress.load_state_dict(state["progress"])
        for run, buffer in enumerate(parts.buffers):
            set_layer_goals(buffer.writer, parts.climb.progress.layer_of(run))
    load_collector_state_dict(parts.collector, state["collector"])
    trainer.load_state_dict(state["trainer"])
    if (worlds := _worlds(parts)) is not None:
        worlds.load_world_state_dict(state["worlds"])
    elif trainer.in_epoch:
        parts.collector.reset()  # such an environment cannot go on with its episodes


def _worlds(parts: Parts) -> SeededWorlds | None:
    """The environment below all transforms, if it is one of ours."""
    worlds = goal_env(parts.env)
    return worlds if isinstance(worlds, SeededWorlds) else None


def _made_of(parts: Parts) -> dict[str, str]:
    """What must be the same for a run to go on."""
    writer = parts.buffer.writer
    hindsight: list[object] = []
    if isinstance(writer, HERWriter):
        hindsight = [writer.k, writer.strategy, writer.filter_achieved, type(writer.weights).__name__]
    names = {
        name: type(getattr(parts, name)).__name__
        for name in ("actor", "critic", "loss", "optimiser", "target")
    }
    return names | {
        "writer": " ".join(map(str, [type(writer).__name__, *hindsight])),
        "sampler": type(parts.buffer.sampler).__name__,
    }
