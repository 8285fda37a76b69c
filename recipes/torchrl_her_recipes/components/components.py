"""The components of a run as named attributes, made from a recipe."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.goals.ibs import Instructiveness
from torchrl_her.modules.exploration import Exploration
from torchrl_her.trainers.fused_ddpg import FusedDDPGLearner
from torchrl_her.trainers.fusing import can_fuse, is_plain_adam
from torchrl_her.trainers.learner import Learner, LossLearner
from torchrl_her.trainers.trainer import Trainer
from torchrl_her_recipes.components.curricula import CurriculumState
from torchrl_her_recipes.components.goal_space import histograms
from torchrl_her_recipes.config.recipe import Recipe


@dataclass
class Components:
    """What a run, or R independent runs side by side, consist of. Swap what you like, then run it.

    A loss of your own needs its own optimizer and target updater; an environment of your own, its
    own collector.

    Attributes:
        recipe: what the components were made from.
        env: batched training environments: R equal blocks.
        eval_env: batched environments for evaluation, likewise.
        actor: the greedy policy.
        critic: values of (observation, goal, action); what the loss's critics were made from, None if there
            is none. TD3 and SAC train others like it, see :func:`~torchrl_her.objectives.critic_value`.
        exploration: turns greedy into exploring actions.
        policy: actor, then exploration.
        collector: runs the policy in the environments.
        buffers: one of each run, with the writer that relabels and the sampler; :attr:`buffer` is
            that of a single run.
        loss: any TorchRL loss module.
        optimizer: over the loss module's parameters.
        target: moves the target networks.
        curriculum: the curriculum and the layer of each run, or None.
        goal_target: q* [cells] of the task's goals, to which the divergence of virtual goals is
            measured; None if they are not counted.
        generators: sources of the random numbers of each run (exploration, relabeling, sampling).
        rewards: of a missed goal and of an achieved one.
    """

    recipe: Recipe
    env: EnvBase
    eval_env: EnvBase
    actor: TensorDictModule
    critic: TensorDictModule | None
    exploration: Exploration
    policy: TensorDictModuleBase
    collector: BaseCollector
    buffers: list[TensorDictReplayBuffer]
    loss: LossModule
    optimizer: torch.optim.Optimizer
    target: TargetNetUpdater | None
    goal_target: Tensor | None
    generators: list[torch.Generator]
    rewards: tuple[float, float] = (-1.0, 0.0)
    curriculum: CurriculumState | None = None

    @property
    def buffer(self) -> TensorDictReplayBuffer:
        """The buffer of a single run (of the first one if there are more)."""
        return self.buffers[0]

    @buffer.setter
    def buffer(self, buffer: TensorDictReplayBuffer) -> None:
        if len(self.buffers) > 1:
            raise ValueError(f"there are {len(self.buffers)} runs: set `buffers`, one for each")
        self.buffers = [buffer]

    def learner(self) -> Learner:
        """Gradient steps on the loss: fused where that is possible, through the loss module elsewhere."""
        norm = self.recipe.learner.max_grad_norm
        fuses = can_fuse(self.loss, self.target)
        compiles = fuses and is_plain_adam(self.optimizer, self.loss)
        if getattr(self.recipe.learner, "compile", "auto") == "always" and not compiles:
            warnings.warn(
                "compile=always has no effect: only DDPG with this library's networks, without batch "
                "normalization, with soft target updates and a plain Adam, can be compiled",
                stacklevel=2,
            )
        if fuses:
            return FusedDDPGLearner(
                self.loss,
                self.optimizer,
                self.target,
                max_grad_norm=norm,
                compile_step=self.recipe.compiles and compiles,
            )
        return LossLearner(
            self.loss, self.optimizer, self.target, max_grad_norm=norm, runs=self.recipe.run.num_runs
        )

    def trainer(self) -> Trainer:
        """The training loop over these components."""
        recipe, replay = self.recipe, self.recipe.replay
        return Trainer(
            collector=self.collector,
            buffers=self.buffers,
            learner=self.learner(),
            schedules=[self.exploration, *self._goal_weights()],
            epoch_frames=recipe.collection.epoch_frames,
            frames_per_update=recipe.collection.frames_per_update,
            warmup_frames=recipe.collection.warmup_frames,
            batch_size=recipe.replay.batch_size,
            batches_per_sample=min(replay.batches_per_sample, replay.buffer_size // replay.batch_size),
        )

    def _goal_weights(self) -> list[Instructiveness]:
        """The weights of goals that change from epoch to epoch."""
        return [own for own in histograms(self.buffers) if isinstance(own, Instructiveness)]
