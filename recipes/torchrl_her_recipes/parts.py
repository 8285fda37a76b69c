"""The parts of a run as named attributes, made from a recipe."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler, Sampler
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her import (
    Curriculum,
    CurriculumProgress,
    EnvReward,
    Exploration,
    FusedDDPGLearner,
    HERWriter,
    Instructiveness,
    Learner,
    LossLearner,
    Trainer,
    ZeroPad,
    can_fuse,
    is_plain_adam,
    set_layer_goals,
)
from torchrl_her_envs import goal_env, reward_range
from torchrl_her_recipes.agents import make_agent
from torchrl_her_recipes.algorithms import get_algorithm
from torchrl_her_recipes.curricula import Climb, at_the_top, get_curriculum, in_layers, read_curriculum
from torchrl_her_recipes.goal_map import histograms
from torchrl_her_recipes.goal_weights import GoalSpace, goal_space, make_goal_weights
from torchrl_her_recipes.recipe import Recipe
from torchrl_her_recipes.worlds import make_worlds

if TYPE_CHECKING:
    from torchrl_her_recipes.running import RunResult

# Entries of a collected batch that no loss reads: not stored.
_NOT_STORED = ("state", "achieved_goal", "input", "collector")
# Evaluation has seeds of its own, far from those of training.
_EVAL_SEED = 1 << 32


@dataclass
class Parts:
    """What a run, or R independent runs side by side, consist of. Swap what you like, then :meth:`run`.

    A loss of your own needs its own optimiser and target updater; an environment of your own, its
    own collector.

    Attributes:
        recipe: what the parts were made from.
        env: batched training environments: R equal blocks.
        eval_env: batched environments for evaluation, likewise.
        actor: the greedy policy.
        critic: values of (observation, goal, action); used to measure its bias, None if there is none.
        exploration: turns greedy into exploring actions.
        policy: actor, then exploration.
        collector: runs the policy in the environments.
        buffers: one of each run, with the writer that relabels and the sampler; :attr:`buffer` is
            that of a single run.
        loss: any TorchRL loss module.
        optimiser: over the loss module's parameters.
        target: moves the target networks.
        climb: the curriculum of the runs; None without one.
        goal_target: q* [cells] of the task's goals, which the divergence of virtual goals is measured to;
            None where they are not counted.
        generators: of each run's random numbers in Python's hands (exploration, relabelling, sampling).
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
    optimiser: torch.optim.Optimizer
    target: TargetNetUpdater | None
    goal_target: Tensor | None
    generators: list[torch.Generator]
    rewards: tuple[float, float] = (-1.0, 0.0)
    climb: Climb | None = None

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
        norm = self.recipe.max_grad_norm
        fuses = can_fuse(self.loss, self.target)
        compiles = fuses and is_plain_adam(self.optimiser)
        if self.recipe.compile == "always" and not compiles:
            warnings.warn(
                "compile=always has no effect: only DDPG with this library's networks, without batch "
                "normalisation, with soft target updates and a plain Adam, can be compiled",
                stacklevel=2,
            )
        if fuses:
            return FusedDDPGLearner(
                self.loss,
                self.optimiser,
                self.target,
                max_grad_norm=norm,
                compile_step=self.recipe.compiles and compiles,
            )
        return LossLearner(
            self.loss, self.optimiser, self.target, max_grad_norm=norm, runs=self.recipe.num_runs
        )

    def trainer(self) -> Trainer:
        """The training loop over these parts."""
        recipe = self.recipe
        return Trainer(
            collector=self.collector,
            buffers=self.buffers,
            learner=self.learner(),
            schedules=[self.exploration, *self._goal_weights()],
            epoch_frames=recipe.epoch_frames,
            frames_per_update=recipe.frames_per_update,
            warmup_frames=recipe.warmup_frames,
            batch_size=recipe.batch_size,
            updates_per_draw=min(recipe.updates_per_draw, recipe.buffer_size // recipe.batch_size),
        )

    def _goal_weights(self) -> list[Instructiveness]:
        """Those weights of goals that change from epoch to epoch."""
        return [own for own in histograms(self.buffers) if isinstance(own, Instructiveness)]

    def run(self, folder: str | Path | None = None, *, progress: bool = True) -> RunResult:
        """Trains to the end and returns what came of it.

        Args:
            folder: where all that the run leaves behind goes; None leaves nothing.
            progress: whether to show a progress bar.
        """
        from torchrl_her_recipes.running import run  # noqa: PLC0415  (runs need parts)

        return run(self, folder, progress=progress)


def build_parts(recipe: Recipe) -> Parts:
    """Makes the parts that a recipe asks for."""
    task = make_worlds(recipe, recipe.num_envs, recipe.seeds)
    curriculum, space = make_curriculum(recipe, task), goal_space(recipe, task)
    climb = None if curriculum is None else make_climb(recipe, curriculum)
    env = task if climb is None else in_layers(task, climb.progress)
    generators = [torch.Generator().manual_seed(seed) for seed in recipe.seeds]
    # A curriculum gives the rewards of its layers, whatever the environment's own are.
    rewards = reward_range(goal_env(task)) if curriculum is None else (-1.0, 0.0)
    agent = make_agent(recipe, env, generators, rewards=rewards, curriculum=curriculum)
    return Parts(
        recipe=recipe,
        env=env,
        eval_env=make_task_env(recipe, recipe.eval_episodes, eval_seeds(recipe, 0)),
        collector=make_collector(recipe, env, agent.policy),
        buffers=[
            make_buffer(recipe, task, generator, rewards=rewards, space=space, climb=climb, run=run)
            for run, generator in enumerate(generators)
        ],
        goal_target=None if space is None else space.target,
        generators=generators,
        rewards=rewards,
        climb=climb,
        **vars(agent),
    )


def make_task_env(recipe: Recipe, num_envs: int, seeds: Sequence[int]) -> EnvBase:
    """The same as a trained policy sees it: at the top of the curriculum, if there is one."""
    env = make_worlds(recipe, num_envs, seeds)
    curriculum = make_curriculum(recipe, env)
    return env if curriculum is None else in_layers(env, at_the_top(curriculum, len(seeds)))


def make_curriculum(recipe: Recipe, env: EnvBase) -> Curriculum | None:
    """The curriculum that the recipe asks for: its own layers, or those of its task.

    Raises:
        ValueError: the task has no curriculum of its own, or the recipe's layers cannot be.
    """
    if not get_algorithm(recipe.algo).curriculum:
        return None
    worlds = goal_env(env)
    if recipe.curriculum is not None:
        return read_curriculum(recipe.curriculum, worlds)
    return get_curriculum(worlds)


def make_climb(recipe: Recipe, curriculum: Curriculum) -> Climb:
    """The recipe's runs in a curriculum, all in its first layer."""
    progress = CurriculumProgress(
        curriculum,
        runs=recipe.num_runs,
        window=recipe.window,
        success_threshold=recipe.success_threshold,
    )
    layer_env = make_worlds(recipe, recipe.eval_episodes, eval_seeds(recipe, 0))
    return Climb(progress, in_layers(layer_env, progress))


def make_collector(recipe: Recipe, env: EnvBase, policy: TensorDictModuleBase) -> Collector:
    """Runs a policy in the training environments, a few steps of each at a time."""
    return Collector(
        env,
        policy,
        frames_per_batch=env.batch_size.numel() * recipe.steps_per_batch,
        total_frames=-1,
        device=env.device,  # all of it: where the policy's is left open, every entry is copied at every step
        auto_register_policy_transforms=False,
    )


def make_buffer(
    recipe: Recipe,
    env: EnvBase,
    generator: torch.Generator,
    *,
    rewards: tuple[float, float] = (-1.0, 0.0),
    space: GoalSpace | None = None,
    climb: Climb | None = None,
    run: int = 0,
) -> TensorDictReplayBuffer:
    """The replay buffer of one run, with its hindsight writer and its sampler."""
    algorithm, worlds = get_algorithm(recipe.algo), goal_env(env)
    weights = make_goal_weights(recipe, space) if space is not None and algorithm.hindsight else None
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(recipe.buffer_size),
        writer=HERWriter(
            EnvReward(worlds.compute_reward, worlds.compute_terminated),
            k=recipe.k if algorithm.hindsight else 0,
            strategy=recipe.strategy,  # type: ignore[arg-type]
            filter_achieved=algorithm.filter_achieved,
            achieved_reward=rewards[1],
            weights=weights,
            exclude=_NOT_STORED,
        ),
        sampler=_make_sampler(recipe),
        priority_key="td_error",
    )
    buffer.set_rng(generator)
    if climb is not None:
        set_layer_goals(buffer.writer, climb.progress.layer_of(run))
        buffer.append_transform(ZeroPad(climb.curriculum, climb.progress, run=run))
    return buffer


def eval_seeds(recipe: Recipe, epoch: int) -> list[int]:
    """The seeds of an evaluation: for each run and epoch its own, and never one of training."""
    return [_EVAL_SEED + (seed << 20) + epoch for seed in recipe.seeds]


def _make_sampler(recipe: Recipe) -> Sampler:
    if recipe.sampler == "uniform":
        return RandomSampler()
    # TorchRL's losses give the square of the TD error, so half of alpha is Schaul's alpha.
    return PrioritizedSampler(recipe.buffer_size, alpha=recipe.priority_alpha / 2, beta=recipe.priority_beta)
