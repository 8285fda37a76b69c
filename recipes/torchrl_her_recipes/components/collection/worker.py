"""Code that runs in processes that collect: their environments, collectors, and seeds of new episodes."""

from __future__ import annotations

import os
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_her.curriculum.guide import GuidedExploration
from torchrl_her.curriculum.orders import EpisodeStages
from torchrl_her.curriculum.stages import CurriculumProgress
from torchrl_her.curriculum.transforms import StateToObs
from torchrl_her.modules.exploration import Exploration
from torchrl_her.modules.stochastic_actor import StochasticActor
from torchrl_her.replay_buffers.env_ids import EnvIds
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.curricula import in_stages, is_guided, make_progress
from torchrl_her_recipes.components.devices import CPU, make_generators
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.components.streams import Stream
from torchrl_her_recipes.config.choices.order import Order
from torchrl_her_recipes.config.groups import CollectionConfig
from torchrl_her_recipes.config.imports import import_modules, permit_task


def share_of_envs(options: CollectionConfig) -> int:
    """Returns the number of environments that one process has for each run."""
    return options.num_envs // options.processes


def make_worker_env(
    envs: TaskEnvs, order: Order, options: CollectionConfig, seeds: Sequence[int], modules: Sequence[str] = ()
) -> EnvBase:
    """Makes the environments of one process, with the transforms of their stages: R equal blocks for R runs.

    Args:
        envs: Maker of the environments. The module that its task names is imported without a check, since
            the main process had the permission to import it.
        order: Order of the stages, if there is a curriculum.
        options: Options of collection.
        seeds: Seeds of the runs.
        modules: Modules to import first, since they may register tasks.
    """
    permit_task(envs.task.name)
    import_modules(modules)
    env = envs.make(share_of_envs(options), seeds)
    progress = make_progress(order, envs.curriculum, env, seeds)
    env = in_stages(env, progress, begins=is_guided(envs.curriculum, progress))
    # Rows need ids if their position does not determine their environment: if batches come from any process,
    # or processes can be replaced.
    if not options.sync or options.ray is not None:
        env = env if isinstance(env, TransformedEnv) else TransformedEnv(env)
        env.append_transform(EnvIds())
    return env


def begin_process() -> None:
    """Sets signals and floating-point mode of a collecting process, before its environment is made."""
    if hasattr(os, "setpgrp"):
        # Ctrl-C and signals to a process group must reach only the main process, which ends the others.
        os.setpgrp()
    torch.set_flush_denormal(True)  # denormals are slow; also set in the main process


@dataclass(frozen=True)
class Beginning:
    """Seeds and stages with which a process begins new episodes at a reset.

    Attributes:
        env_seeds: seeds of the process's environments, one for each run.
        seeds: seeds of exploration, one for each run.
        progress: state of the curriculum's progress, or None.
    """

    env_seeds: list[int]
    seeds: list[int]
    progress: dict[str, Any] | None = None

    def again(self, life: int) -> Beginning:
        """Returns a copy with new seeds for a process that replaces a dead one, for the ``life``-th time."""
        return replace(
            self,
            env_seeds=[derive_seed(seed, life) for seed in self.env_seeds],
            seeds=[derive_seed(seed, life) for seed in self.seeds],
        )


def drawing_modules(policy: nn.Module) -> list[Any]:
    """Returns the modules of a policy that draw random numbers, each with one generator per run."""
    kinds = Exploration | GuidedExploration | StochasticActor
    return [module for module in policy.modules() if isinstance(module, kinds)]


def derive_seed(*numbers: int) -> int:
    """Derives a seed from non-negative numbers; different numbers give different seeds."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))


class WorkerCollector(Collector):
    """Collector in a process. Each reset sets all seeds, so a resumed run draws the same random numbers."""

    def begin(self, beginning: Beginning) -> None:
        """Begins new episodes in all environments, with the given seeds and stages."""
        goal_env(self.env).set_seeds(beginning.env_seeds)
        first = beginning.seeds[0]
        torch.manual_seed(first)  # users' policies may draw from torch's own generator
        np.random.seed(first % (1 << 32))
        random.seed(first)
        for module in drawing_modules(self.policy):
            module.generators = make_generators(beginning.seeds, CPU)
        if beginning.progress is not None:
            progress = _progress_of(self.env)
            progress.load_state_dict(beginning.progress)
            if isinstance(progress, EpisodeStages):  # each process draws stages of its own
                seeds = [derive_seed(seed, Stream.STAGES) for seed in beginning.seeds]
                progress.generators = make_generators(seeds, CPU)
        self.reset()


class NodeCollector(WorkerCollector):
    """Collector in a process on a node of a cluster; receives weights with each request for a batch.

    Errors are returned as a line of text: Ray would end the process if some types of errors were raised.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        torch.set_flush_denormal(True)  # denormals are slow; also set in the main process
        torch.set_num_threads(1)
        self._error = ""  # error of the constructor, if any
        try:
            super().__init__(*args, **options)
        except Exception as error:
            self._error = f"{type(error).__name__}: {error}"

    def register_scheme_receiver(self, *args: Any, **options: Any) -> None:
        """Does nothing: weights come with each call of :meth:`collect`."""

    def collect(self, weights: TensorDictBase, beginning: Beginning | None = None) -> TensorDictBase | str:
        """Returns the next batch, in new episodes if ``beginning`` is given, or the message of an error."""
        if self._error:
            return self._error
        try:
            TensorDict.from_module(self.policy).data.update_(weights)
            if beginning is not None:
                self.begin(beginning)
            return self.next()
        except Exception as error:
            return f"{type(error).__name__}: {error}"


def _progress_of(env: TransformedEnv) -> CurriculumProgress:
    """Returns the progress from which an environment's transforms read the stages of runs."""
    return next(transform.progress for transform in env.transform if isinstance(transform, StateToObs))
