"""All that a run is, as tensors and plain data, so that it can go on from there bit for bit."""

from __future__ import annotations

from typing import Any

import torch

from torchrl_her.curriculum.switch import set_layer_goals
from torchrl_her.goals.sources import sources_name
from torchrl_her.goals.strategies import strategy_name
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
from torchrl_her_recipes.components.collection_worker import derive_seed
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.components.devices import place_of


def run_state(components: Components, trainer: Trainer, *, buffer: bool = True) -> dict[str, Any]:
    """All that a run is, as tensors and plain data. Rows are the buffer's own: save it at once.

    Args:
        components: of the run.
        trainer: its training loop.

    Keyword Args:
        buffer: whether with the replay buffer and that of demonstrations, which are nearly all of it. Without
            them a run cannot go on.
    """
    shown = components.demonstrations
    return {
        "recipe": components.recipe.to_dict(),
        "made_of": _made_of(components),
        "trainer": trainer.state_dict(),
        **{name: dict(part.state_dict()) for name, part in _parts(components).items()},
        "guided": None if components.guide is None else components.guide.guided,
        "buffer": buffer_state_dict(components.buffer, copy=False) if buffer else None,
        "demonstrations": None if shown is None or not buffer else shown.state_dict(),
        "generators": [generator.get_state() for generator in components.generators],
        "torch_generator": torch.get_rng_state(),  # for losses that draw, as SAC's
        "cuda_generator": None if (gpu := _gpu_of(components)) is None else torch.cuda.get_rng_state(gpu),
        "worlds": None if (worlds := _worlds(components)) is None else worlds.world_state_dict(),
        "progress": None if components.curriculum is None else components.curriculum.progress.state_dict(),
        "collector": collector_state_dict(components.collector),
    }


def load_run_state(components: Components, trainer: Trainer, state: dict[str, Any]) -> None:
    """Puts freshly built components where :func:`run_state` was taken; their buffer stays empty without one.

    Raises:
        ValueError: the components are of other types or have other settings than those of the run.
    """
    for name, value in _made_of(components).items():
        if value != (was := state["made_of"][name]):
            raise ValueError(
                f"the run's {name} was {was}, not {value}: give resume() components made as its were"
            )
    for name, part in _parts(components).items():
        part.load_state_dict(state[name])
    if components.guide is not None:
        components.guide.guided = state["guided"]
    if state["buffer"] is not None:
        load_buffer_state_dict(components.buffer, state["buffer"])
    for generator, own in zip(components.generators, state["generators"], strict=True):
        generator.set_state(own)
    torch.set_rng_state(state["torch_generator"])
    gpu, own = _gpu_of(components), state["cuda_generator"]
    if gpu is not None and own is not None:
        torch.cuda.set_rng_state(own, gpu)
    if components.curriculum is not None:
        components.curriculum.progress.load_state_dict(state["progress"])
        progress = components.curriculum.progress
        for run in range(0 if progress.by_episode else components.recipe.run.num_runs):
            set_layer_goals(components.buffer.writer, progress.layer_of(run), run=run)
    if components.demonstrations is not None and state["demonstrations"] is not None:
        components.demonstrations.load_state_dict(state["demonstrations"])
    load_collector_state_dict(components.collector, state["collector"])
    trainer.load_state_dict(state["trainer"])
    if (worlds := _worlds(components)) is not None:
        worlds.load_world_state_dict(state["worlds"])
    elif trainer.in_epoch:  # such environments cannot go on with their episodes
        components.collector.reset()
        if isinstance(components.buffer.writer, HERWriter):
            components.buffer.writer.end_episodes()


def seed_epoch(components: Components, trainer: Trainer) -> None:
    """Seeds environments whose state no checkpoint holds, so that a resumed run plays the same epoch."""
    recipe = components.recipe
    begins = trainer.epochs > 0 and not trainer.in_epoch
    if begins and recipe.collection.processes == 0 and _worlds(components) is None:
        goal_env(components.env).set_seeds([derive_seed(seed, trainer.epochs) for seed in recipe.seeds])


def _parts(components: Components) -> dict[str, Any]:
    """The components with networks or statistics, by name, as far as there are any."""
    names = ("loss", "optimizer", "target", "exploration", "norm", "average", "guide")
    return {name: part for name in names if (part := getattr(components, name)) is not None}


def _gpu_of(components: Components) -> torch.device | None:
    """Where the networks are, if that is a GPU."""
    device = place_of(components.loss)
    return device if device.type == "cuda" and torch.cuda.is_initialized() else None


def _worlds(components: Components) -> BatchedEnv | None:
    """The environment below all transforms, if it is one of ours and collects here."""
    worlds = goal_env(components.env)
    here = components.recipe.collection.processes == 0
    return worlds if here and isinstance(worlds, BatchedEnv) else None


def _made_of(components: Components) -> dict[str, str]:
    """What must be the same for a run to go on."""
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
    guide, shown = components.guide, components.demonstrations
    return names | {
        "guide": type(guide).__name__,
        "demonstrations": "none" if shown is None else f"{len(shown.recorded)}, {shown.recorded.digest}",
        "device": str(place_of(components.loss)),
        "writer": " ".join(map(str, [type(writer).__name__, *hindsight])),
        "sampler": type(components.buffer.sampler).__name__,
    }
