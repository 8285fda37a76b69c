"""Builds the components of a run (environments, agent, replay buffer, collector) from a recipe."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from torchrl_her_envs.common.goal_env import goal_env, reward_bounds, reward_range
from torchrl_her_recipes.components.agents import find_builder, make_agent, shape_of
from torchrl_her_recipes.components.buffers import make_buffer
from torchrl_her_recipes.components.collection.processes import ProcessCollector
from torchrl_her_recipes.components.collection.worker import make_worker_env
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.components.curricula import (
    check_order,
    in_stages,
    is_guided,
    make_curriculum_state,
    make_played_env,
    make_progress,
)
from torchrl_her_recipes.components.demonstrations import load_demonstrations, make_cloning, rows_needed
from torchrl_her_recipes.components.devices import ON_THE_CPU, Devices, devices_of, make_generators
from torchrl_her_recipes.components.envs import TaskEnvs, evaluation_envs
from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.components.goals.behavior import make_asking, make_behavior
from torchrl_her_recipes.components.goals.space import GoalSpace, goal_space
from torchrl_her_recipes.components.streams import Stream
from torchrl_her_recipes.config.recipe import Recipe


def build(recipe: Recipe) -> Components:
    """Builds the components that a recipe describes.

    Args:
        recipe: recipe of the run.

    Raises:
        ValueError: the recipe cannot be used with the task, its replay buffer does not fit into memory, or it
            names a module that must not be imported.
    """
    recipe = resolved(recipe)
    envs, seeds, collection = TaskEnvs.of(recipe), recipe.seeds, recipe.collection
    processes = collection.processes
    # If other processes collect, this environment plays no episodes: only its specs are read.
    task = envs.make(1 if processes else collection.num_envs, seeds)
    progress = make_progress(recipe.order, envs.curriculum, task, seeds)
    check_order(recipe.order, progress, recipe.weights, processes)
    tests, test_seeds = evaluation_envs(recipe.task.name, recipe.evaluation.episodes), eval_seeds(seeds, 0)
    state = make_curriculum_state(recipe.order, progress, envs, tests, test_seeds)
    space = goal_space(recipe.weights, envs, task, collection.num_envs)
    demonstrations = load_demonstrations(recipe.demonstrations, envs, task, seeds, state)
    played = partial(make_played_env, envs, tests, test_seeds)
    eval_env = played()

    devices = devices_of(recipe.learner, recipe.replay, len(seeds))
    generators = make_generators(seeds, devices.replay)
    same_device = devices.learner == devices.replay
    learner_generators = generators if same_device else make_generators(seeds, devices.learner)
    curriculum, bounds = None if state is None else state.curriculum, reward_bounds(goal_env(task))
    shape = shape_of(recipe.task.name, recipe.run, eval_env, curriculum, rewards=bounds)
    cloning = make_cloning(recipe.demonstrations)
    builder = find_builder(recipe.learner, shape, generators=learner_generators, cloning=cloning)
    agent = make_agent(builder, seeds, curriculum=recipe.curriculum, state=state, device=devices.learner)

    goals = goal_space(recipe.behavior, envs, task, collection.num_envs)
    behavior = make_behavior(
        recipe.behavior, recipe.learner, task, agent, seeds=seeds, space=goals, state=state
    )
    begins = is_guided(recipe.curriculum, progress)
    starts = None if demonstrations is None else demonstrations.starts
    env = in_stages(task, progress, begins=begins, behavior=behavior, starts=starts)
    if processes:
        make_env = partial(make_worker_env, envs, recipe.order, collection, seeds)
        collector = ProcessCollector(
            collection, make_env, agent.policy, seeds=seeds, progress=progress, storing_device=devices.replay
        )
    else:
        collector = make_collector(env, agent.policy, collection.steps_per_batch, devices)
    replay = partial(
        make_buffer, recipe, task, generators, space=space, state=state, norm=agent.norm, devices=devices
    )
    if demonstrations is not None and recipe.demonstrations.in_batches:
        capacity = rows_needed(recipe.hindsight, demonstrations)
        demonstrations.fill(replay(capacity=capacity), len(seeds))
    virtual = recipe.evaluation.virtual_goals
    return Components(
        recipe=recipe,
        env=env,
        eval_env=eval_env,
        collector=collector,
        buffer=replay(),
        goal_target=space.target if isinstance(space, GoalSpace) else None,
        generators=generators if same_device else [*generators, *learner_generators],
        rewards=reward_range(goal_env(task)),
        bounds=bounds,
        curriculum=state,
        behavior=behavior,
        virtual_env=played(behavior=make_asking(seeds, task, memory=tests)) if virtual else None,
        demonstrations=demonstrations,
        **vars(agent),
    )


def make_collector(
    env: EnvBase, policy: TensorDictModuleBase, steps_per_batch: int, devices: Devices = ON_THE_CPU
) -> Collector:
    """Makes a collector whose batches have ``steps_per_batch`` steps of each training environment."""
    if devices == ON_THE_CPU:
        # One device for environment, policy and storage: else TorchRL copies every entry in every step.
        places = {"device": env.device}
    else:
        learner, replay = devices
        places = {"env_device": env.device, "policy_device": learner, "storing_device": replay}
    return Collector(
        env,
        policy,
        frames_per_batch=env.batch_size.numel() * steps_per_batch,
        total_frames=-1,
        **places,
        auto_register_policy_transforms=False,
    )


def eval_seeds(seeds: Sequence[int], epoch: int) -> list[int]:
    """Returns each run's seed for the evaluation after an epoch, which no training or other epoch uses."""
    return [Stream.EVALUATION + (seed << 20) + epoch for seed in seeds]
