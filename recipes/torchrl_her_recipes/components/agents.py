"""Makes the agent of a run (networks, exploration, loss, optimizer) with the builder of its learner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Literal, cast

import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.data import Categorical
from torchrl.envs import EnvBase

from torchrl_her.curriculum.guide import GuidedExploration
from torchrl_her.curriculum.stages import Curriculum, zero_unused_inputs
from torchrl_her.modules.averaging import PolicyAverage
from torchrl_her.modules.networks import StackedLinear, stack_runs
from torchrl_her.objectives.targets import make_target_updater
from torchrl_her.trainers.adam import RunsAdam
from torchrl_her_recipes.components.curricula import CurriculumState, is_guided
from torchrl_her_recipes.components.devices import CPU, place_of
from torchrl_her_recipes.components.learner import Agent, AgentShape, LearnerBuilder, Networks, acting
from torchrl_her_recipes.config.choices.learners import BY_ACTIONS, LEARNERS, Actions, LearnerConfig
from torchrl_her_recipes.config.groups import CurriculumConfig, RunConfig
from torchrl_her_recipes.config.options import AUTO
from torchrl_her_recipes.config.values import load_name


def make_agent(
    builder: LearnerBuilder,
    seeds: Sequence[int],
    *,
    curriculum: CurriculumConfig,
    state: CurriculumState | None = None,
    device: torch.device = CPU,
) -> Agent:
    """Makes the agent of one run, or of several runs side by side.

    Args:
        builder: Builder of networks, exploration and loss.
        seeds: Seed of the initial weights of each run.
        curriculum: Options of the curriculum.
        state: Curriculum and the stages of the runs; None without a curriculum.
        device: Device on which the agent learns.
    """
    # Networks are made on the CPU, so that the initial weights are the same on every device.
    actor, critics = _networks(builder, seeds, curriculum, None if state is None else state.curriculum)
    actor, critics = actor.to(device), [critic.to(device) for critic in critics]
    exploration = builder.exploration().to(device)
    options, runs = builder.options, len(seeds)
    loss = builder.loss(actor, critics)
    norm = builder.norm()
    norm = None if norm is None else norm.to(device)
    player = acting(actor, norm)
    guide = _guide_of(player, curriculum, state, builder.generators, runs)
    return Agent(
        actor=player,
        critic=critics[0],
        exploration=exploration,
        policy=TensorDictSequential(player, *([] if guide is None else [guide]), exploration),
        loss=loss,
        optimizer=(
            RunsAdam(loss, lr=options.learning_rate, runs=runs)
            if runs > 1
            else torch.optim.Adam(loss.parameters(), lr=options.learning_rate, fused=True)
        ),
        target=make_target_updater(
            loss, tau=options.tau, hard_interval=options.hard_update_interval, runs=runs
        ),
        norm=norm,
        average=(
            PolicyAverage(player, decay=options.ema_decay, runs=runs) if options.ema_decay > 0 else None
        ),
        guide=guide,
    )


def shape_of(
    task: str,
    run: RunConfig,
    env: EnvBase,
    curriculum: Curriculum | None = None,
    *,
    rewards: tuple[float, float] = (-1.0, 0.0),
) -> AgentShape:
    """Returns the shape of an environment's networks: inputs and their widths, actions, range of rewards."""
    in_keys = ("observation", "desired_goal") if curriculum is None else ("input",)
    return AgentShape(
        task=task,
        widths={key: env.observation_spec[key].shape[-1] for key in in_keys},
        action_spec=env.action_spec_unbatched,
        rewards=rewards,
        runs=run.num_runs,
        dtype=getattr(torch, run.dtype),
    )


def find_learner(options: LearnerConfig, shape: AgentShape) -> type[LearnerConfig]:
    """Returns the learner's class of options; "auto" is DDPG for continuous and DQN for discrete actions.

    Raises:
        ValueError: the learner does not support the task's kind of actions or several runs side by side, or
            an option has no effect with it.
    """
    actions: Actions = "discrete" if isinstance(shape.action_spec, Categorical) else "continuous"
    learner = LEARNERS[BY_ACTIONS[actions]] if options.name == AUTO else type(options)
    if learner.actions != actions:
        fitting = " or ".join(each.name for each in LEARNERS.values() if each.actions == actions)
        raise ValueError(
            f"learner={learner.name} must not be used on {shape.task}, which has {actions} actions: "
            f"choose {fitting}"
        )
    if not learner.stacks and shape.runs > 1:
        raise ValueError(
            f"num_runs must be 1 with learner={learner.name}, which cannot train several runs side by side, "
            f"got {shape.runs}; sweep over seeds instead"
        )
    for field in fields(options):  # "auto" accepts the options of DDPG, but may stand for DQN
        value = getattr(options, field.name)
        if not hasattr(learner, field.name) and value != field.default:
            raise ValueError(f"{field.name}={value} has no effect with learner={learner.name}: leave it out")
    return learner


def find_builder(options: LearnerConfig, shape: AgentShape, **given: Any) -> LearnerBuilder:
    """Makes the builder for the learner in ``options``, with keyword arguments of :class:`LearnerBuilder`."""
    return load_name(find_learner(options, shape).maker)(options, shape, **given)


def _guide_of(
    policy: TensorDictModuleBase,
    options: CurriculumConfig,
    state: CurriculumState | None,
    generators: Sequence[torch.Generator] | None,
    runs: int,
) -> GuidedExploration | None:
    if state is None or not is_guided(options, state.progress):
        return None
    guide = GuidedExploration(
        policy,
        state.curriculum,
        share=options.guided_share,
        decay=options.guided_decay,
        per=cast(Literal["episode", "step"], options.guided_per),
        stage_key="stage" if state.progress.by_episode else None,
        runs=runs,
        generators=generators,
    )
    return guide.to(place_of(policy))


def _networks(
    builder: LearnerBuilder, seeds: Sequence[int], options: CurriculumConfig, curriculum: Curriculum | None
) -> Networks:
    """Returns actor and critics of all runs, where the weights of a run depend only on the run's seed."""
    with torch.random.fork_rng(devices=[]):
        alone = []
        for seed in seeds:
            torch.manual_seed(seed)
            single, others = builder.networks(1)
            alone.append([single, *others])
        actor, critics = builder.networks(len(seeds))
    networks = [actor, *critics]
    for network, singles in zip(networks, zip(*alone, strict=True), strict=True):
        network.load_state_dict(stack_runs([single.state_dict() for single in singles]))
    if curriculum is not None:
        alphas = [options.alpha_actor, *[options.alpha_critic] * len(critics)]
        for network, alpha in zip(networks, alphas, strict=True):
            first = next(module for module in network.modules() if isinstance(module, StackedLinear))
            weight = first.weight.data
            weight.copy_(zero_unused_inputs(weight, curriculum.first_inputs, alpha=alpha))
    return actor, critics
