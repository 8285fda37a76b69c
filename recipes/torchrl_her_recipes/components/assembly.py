"""Makes the components that a recipe asks for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from torchrl_her_envs.common.goal_env import goal_env, reward_bounds, reward_range
from torchrl_her_recipes.components.agents import make_agent
from torchrl_her_recipes.components.behavior import make_asking, make_behavior
from torchrl_her_recipes.components.buffers import make_buffer
from torchrl_her_recipes.components.collection import ProcessCollector
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.components.curricula import (
    in_stages,
    is_guided,
    make_curriculum_state,
    make_played_env,
)
from torchrl_her_recipes.components.demonstrations import load_demonstrations, rows_needed
from torchrl_her_recipes.components.devices import ON_THE_CPU, Devices, devices_of, make_generators
from torchrl_her_recipes.components.envs import evaluation_envs, make_task_envs
from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.components.goal_space import GoalSpace, goal_space
from torchrl_her_recipes.components.streams import Stream
from torchrl_her_recipes.config.recipe import Recipe


def build(recipe: Recipe) -> Components:
    """Makes the components that a recipe asks for.

    Args:
        recipe: of the run.

    Raises:
        ValueError: something in the recipe cannot work or does not fit into memory, or it names a module that
            must not be imported.
    """
    recipe = resolved(recipe)
    processes = recipe.collection.processes > 0  # then those here only tell what the others are like
    task = make_task_envs(recipe, 1 if processes else recipe.collection.num_envs, recipe.seeds)
    seeds = eval_seeds(recipe.seeds, 0)
    state, space = make_curriculum_state(recipe, task, seeds), goal_space(recipe, task, recipe.weights)
    rewards, bounds = reward_range(goal_env(task)), reward_bounds(goal_env(task))
    shown = load_demonstrations(recipe, task, state)
    played = partial(make_played_env, recipe, evaluation_envs(recipe), seeds)
    eval_env = played()
    devices = devices_of(recipe.learner, recipe.replay, recipe.run.num_runs)
    generators = make_generators(recipe.seeds, devices.replay)
    learner_generators = (
        generators if devices.learner == devices.replay else make_generators(recipe.seeds, devices.learner)
    )
    agent = make_agent(
        recipe, eval_env, learner_generators, rewards=bounds, state=state, device=devices.learner
    )
    behavior = make_behavior(recipe, task, agent, rewards=rewards, state=state)
    progress = None if state is None else state.progress
    env = in_stages(
        task,
        progress,
        begins=is_guided(recipe.curriculum, progress),
        behavior=behavior,
        starts=None if shown is None else shown.starts,
    )
    if processes:
        collector = ProcessCollector(recipe, agent.policy, progress, storing_device=devices.replay)
    else:
        collector = make_collector(env, agent.policy, recipe.collection.steps_per_batch, devices)
    replay = partial(
        make_buffer, recipe, task, generators, rewards=rewards, space=space, state=state, norm=agent.norm
    )
    if shown is not None and recipe.demonstrations.in_batches:
        shown.fill(replay(devices=devices, capacity=rows_needed(recipe, shown)), recipe.run.num_runs)
    virtual = recipe.evaluation.virtual_goals
    return Components(
        recipe=recipe,
        env=env,
        eval_env=eval_env,
        collector=collector,
        buffer=replay(devices=devices),
        goal_target=space.target if isinstance(space, GoalSpace) else None,
        generators=generators if learner_generators is generators else [*generators, *learner_generators],
        rewards=rewards,
        bounds=bounds,
        curriculum=state,
        behavior=behavior,
        virtual_env=played(behavior=make_asking(recipe, task, rewards=rewards)) if virtual else None,
        demonstrations=shown,
        **vars(agent),
    )


def make_collector(
    env: EnvBase, policy: TensorDictModuleBase, steps_per_batch: int, devices: Devices = ON_THE_CPU
) -> Collector:
    """Runs a policy in the training environments, a few steps of each at a time."""
    if devices == ON_THE_CPU:
        # All of it: where the policy's is left open, every entry is copied at every step.
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
    """The seeds of an evaluation: for each run and epoch its own, and never one of training."""
    return [Stream.EVALUATION + (seed << 20) + epoch for seed in seeds]
