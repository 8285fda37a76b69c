"""The class :class:`Components`, which holds all components of a run as named attributes."""

from __future__ import annotations

import math
import warnings
from copy import deepcopy
from dataclasses import dataclass
from typing import cast

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase

from torchrl_her.behavior import BehaviorGoals
from torchrl_her.curriculum.relay import RelayPolicy
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.native.library import CannotCompile
from torchrl_her.trainers.fused import FusedLearner, MatmulDtype
from torchrl_her.trainers.fusing import is_plain_adam, why_not_fused
from torchrl_her.trainers.graphs import GraphLearner, why_not_recorded
from torchrl_her.trainers.learner import Learner, LossLearner
from torchrl_her.trainers.trainer import Trainer
from torchrl_her_recipes.components.buffers import rising_beta
from torchrl_her_recipes.components.collection.processes import ProcessCollector
from torchrl_her_recipes.components.curricula import CurriculumState
from torchrl_her_recipes.components.demonstrations import RunDemonstrations
from torchrl_her_recipes.components.devices import CPU, place_of
from torchrl_her_recipes.components.learner import Agent
from torchrl_her_recipes.config.recipe import Recipe


@dataclass(kw_only=True)
class Components(Agent):
    """All components of a run, or of R independent runs side by side.

    Any component can be replaced before the run starts. A new loss also needs a new optimizer and target
    updater; a new environment also needs a new collector.

    Attributes:
        recipe: recipe from which the components were built.
        env: batched training environments: R blocks of equal size, one for each run. If other processes
            collect, each block has one environment, whose specs are read.
        eval_env: batched environments for evaluation: R blocks of equal size.
        actor: the greedy policy. With ``normalize=true`` it is a
            :class:`~torchrl_her.modules.NormalizedPolicy`, whose ``actor`` is the module for losses.
        critic: module from which the loss makes its critics, values of (observation, goal, action); None if
            the loss needs none. TD3 and SAC train copies, see :func:`~torchrl_her.objectives.critic_value`.
        exploration: module that turns greedy actions into exploring actions.
        policy: actor, guide (if there is one) and exploration, in sequence.
        collector: runs the policy in the environments.
        buffer: replay buffer of all runs, with the writer that relabels and the sampler.
        loss: any TorchRL loss module.
        optimizer: optimizer of the loss module's parameters.
        target: updates the target networks.
        curriculum: the curriculum and the stage of each run, or None.
        goal_target: q* [cells], the target distribution of IBS over a grid of goals, to which the divergence
            of virtual goals is measured; None if goals are not counted on a grid.
        generators: random generators for exploration, relabeling and sampling, one for each run; twice as
            many if learner and buffer are on different devices.
        rewards: reward of a missed goal and of an achieved goal.
        bounds: the least and the greatest reward; infinite if rewards have no bounds.
        norm: statistics by which observations and goals are normalized for the actor and in sampled
            transitions, or None.
        average: moving average of the actor, which is evaluated, filmed and saved in its place; or None.
        guide: module that lets an earlier stage's policy act first in some episodes (``guided_share``), or
            None.
        virtual_env: environments for evaluation at virtual goals, or None.
        behavior: transform of the environment that proposes the goals of episodes, or None. Its state is
            part of the collector's state.
        demonstrations: recorded episodes, used in batches and as starts of episodes; or None.
    """

    recipe: Recipe
    env: EnvBase
    eval_env: EnvBase
    collector: BaseCollector
    buffer: TensorDictReplayBuffer
    goal_target: Tensor | None
    generators: list[torch.Generator]
    rewards: tuple[float, float] = (-1.0, 0.0)
    bounds: tuple[float, float] = (-math.inf, math.inf)
    curriculum: CurriculumState | None = None
    behavior: BehaviorGoals | None = None
    virtual_env: EnvBase | None = None
    demonstrations: RunDemonstrations | None = None

    @property
    def greedy(self) -> TensorDictModuleBase:
        """The greedy policy that is evaluated and saved: the average of the actor, or else the actor."""
        average = self.average
        return self.actor if average is None or average.policy is not self.actor else average.module

    @property
    def player(self) -> TensorDictModuleBase:
        """The greedy policy as it plays, on the environments' device.

        It is a copy if the agent learns on another device. With ``relay=true`` its stages act in turn.
        """
        policy, place = self.greedy, self.eval_env.device or CPU
        policy = policy if place_of(policy) == place else deepcopy(policy).to(place)
        if self.curriculum is None or not getattr(self.recipe.order, "relay", False):
            return policy
        return RelayPolicy(policy, self.curriculum.curriculum).to(place)

    def learner(self) -> Learner:
        """Makes the learner. It compiles gradient steps if possible, and otherwise calls the loss module.

        On the CPU, gradient steps are compiled to C++. On a GPU they are recorded as CUDA graphs; with
        ``compile=always``, they pass through ``torch.compile`` first.

        Raises:
            ValueError: ``compile=always`` is given, but the steps cannot be compiled.
        """
        choice, parts = self.recipe.learner.compile, (self.loss, self.optimizer, self.target)
        norm, runs = self.recipe.learner.max_grad_norm, self.recipe.run.num_runs
        if choice == "never":
            return LossLearner(*parts, max_grad_norm=norm, runs=runs)
        on_cpu = place_of(self.loss).type == "cpu"
        reason = self._why_not_fused() if on_cpu else why_not_recorded(self.loss, self.target)
        if reason is None and not on_cpu:
            return GraphLearner(*parts, max_grad_norm=norm, runs=runs, compile=choice == "always")
        if reason is None:
            try:
                matmul_dtype = cast(MatmulDtype, self.recipe.learner.matmul_dtype)
                return FusedLearner(*parts, max_grad_norm=norm, matmul_dtype=matmul_dtype)
            except CannotCompile as error:
                reason = str(error)
                if choice == "auto":
                    warnings.warn(
                        f"gradient steps are several times slower than they could be: {error}", stacklevel=2
                    )
        if choice == "always":
            raise ValueError(f"compile=always is not supported here: {reason}; choose compile=auto")
        return LossLearner(*parts, max_grad_norm=norm, runs=runs)

    def _why_not_fused(self) -> str | None:
        if not is_plain_adam(self.optimizer, self.loss):
            return f"an optimizer that is not a plain Adam over the loss's parameters, {self.optimizer}"
        return why_not_fused(self.loss, self.target)

    def close(self) -> None:
        """Ends the processes that collect, if there are any; collecting another batch restarts them."""
        if isinstance(self.collector, ProcessCollector):
            self.collector.shutdown()

    def trainer(self) -> Trainer:
        """Returns the training loop over these components."""
        recipe, replay, demonstrations = self.recipe, self.recipe.replay, self.demonstrations
        proposals = [] if self.behavior is None else self.behavior.proposal.weights
        weights = [*self.buffer.writer.goal_weights, *proposals]
        return Trainer(
            collector=self.collector,
            buffer=self.buffer
            if demonstrations is None
            else demonstrations.mixed_with(self.buffer, recipe.demonstrations.share, replay.batch_size),
            learner=self.learner(),
            schedules=[
                self.exploration,
                *([] if self.guide is None else [self.guide]),
                *(weight for weight in weights if isinstance(weight, InstructiveWeights)),
                *rising_beta(self.buffer.sampler, replay.priority_beta_end, recipe.run.epochs),
            ],
            runs=recipe.run.num_runs,
            epoch_frames=recipe.collection.epoch_frames,
            frames_per_update=recipe.collection.frames_per_update,
            warmup_frames=recipe.collection.warmup_frames,
            batch_size=replay.batch_size,
            batches_per_sample=min(replay.batches_per_sample, replay.buffer_size // replay.batch_size),
            average=self.average,
        )
