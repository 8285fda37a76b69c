"""The agent of a recipe, made by the builder of its learner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Literal, cast

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from torchrl_her.curriculum.guide import GuidedExploration
from torchrl_her.curriculum.layers import Curriculum, zero_unused_inputs
from torchrl_her.modules.averaging import PolicyAverage
from torchrl_her.modules.networks import StackedLinear, stack_runs
from torchrl_her.modules.normalization import RunningNorm
from torchrl_her.objectives.targets import make_target_updater
from torchrl_her.trainers.adam import RunsAdam
from torchrl_her_recipes.components.curricula import is_guided
from torchrl_her_recipes.components.devices import CPU, place_of
from torchrl_her_recipes.components.learner import Agent, LearnerBuilder, Networks
from torchrl_her_recipes.components.normalization import acting, make_norm
from torchrl_her_recipes.config.learners import BY_ACTIONS, LEARNERS, Actions, LearnerSpec
from torchrl_her_recipes.config.options import default_of
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.values import load_name


def make_agent(
    recipe: Recipe,
    env: EnvBase,
    generators: Sequence[torch.Generator],
    *,
    rewards: tuple[float, float] = (-1.0, 0.0),
    curriculum: Curriculum | None = None,
    device: torch.device = CPU,
) -> Agent:
    """The agent that a recipe asks for.

    Args:
        recipe: of the run, or of several.
        env: tells the widths of observations and actions.
        generators: of the exploration of each run, on the device.
        rewards: the least and the greatest that there can be.
        curriculum: whose layers the networks see, or None.
        device: where it learns.

    Raises:
        ValueError: the learner cannot choose such actions, or cannot train several runs.
    """
    builder = _builder(recipe, env, curriculum)
    builder.generators = generators
    actor, critics = _networks(builder, recipe, curriculum)  # the same on all devices
    builder.device, actor = device, actor.to(device)
    critics = [critic.to(device) for critic in critics]
    exploration, options = builder.exploration(generators).to(device), recipe.learner
    loss = builder.loss(actor, critics, rewards, generators)
    norm = _norm_for(builder)
    norm = None if norm is None else norm.to(device)
    player = acting(actor, norm)
    guide = _guide_of(player, recipe, curriculum, generators)
    return Agent(
        actor=player,
        critic=critics[0],
        exploration=exploration,
        policy=TensorDictSequential(player, *([] if guide is None else [guide]), exploration),
        loss=loss,
        optimizer=_make_adam(loss, options.learning_rate, recipe.run.num_runs),
        target=make_target_updater(
            loss, tau=options.tau, hard_interval=options.hard_update_interval, runs=recipe.run.num_runs
        ),
        norm=norm,
        average=_average_of(player, recipe),
        guide=guide,
    )


def _make_adam(loss: LossModule, learning_rate: float, runs: int) -> torch.optim.Adam:
    if runs > 1:
        return RunsAdam(loss, lr=learning_rate, runs=runs)
    return torch.optim.Adam(loss.parameters(), lr=learning_rate, fused=True)


def find_learner(recipe: Recipe, env: EnvBase) -> LearnerSpec:
    """The learner of a recipe; "auto" is DDPG where actions are continuous, and DQN where they are discrete.

    Raises:
        ValueError: it cannot choose such actions, cannot train several runs, or an option has no effect
            with it.
    """
    actions: Actions = "discrete" if isinstance(env.action_spec, Categorical) else "continuous"
    name = BY_ACTIONS[actions] if recipe.learner.name == "auto" else recipe.learner.name
    spec = LEARNERS[name]
    if spec.actions != actions:
        fitting = " or ".join(each.name for each in LEARNERS.values() if each.actions == actions)
        raise ValueError(
            f"learner={name} must not be used on {recipe.task.name}, which has {actions} actions: "
            f"choose {fitting}"
        )
    if not spec.stacks and recipe.run.num_runs > 1:
        raise ValueError(
            f"num_runs must be 1 with learner={name}, which cannot train several runs side by side, "
            f"got {recipe.run.num_runs}; sweep over seeds instead"
        )
    known = {own.name for own in fields(spec.options)}
    for own in fields(recipe.learner):  # "auto" has the options of DDPG
        value = getattr(recipe.learner, own.name)
        if own.name not in known and value != default_of(own):
            raise ValueError(f"{own.name}={value} has no effect with learner={name}: leave it out")
    return spec


def make_player(
    recipe: Recipe, env: EnvBase, *, curriculum: Curriculum | None = None
) -> TensorDictModuleBase:
    """The greedy policy with its normalization, whose weights and statistics can be loaded."""
    builder = _builder(recipe, env, curriculum)
    actor, _ = _networks(builder, recipe, curriculum)
    return acting(actor, _norm_for(builder))


def _norm_for(builder: LearnerBuilder) -> RunningNorm | None:
    return make_norm(builder.recipe, dict(zip(builder.in_keys, builder.widths, strict=True)))


def _average_of(policy: TensorDictModuleBase, recipe: Recipe) -> PolicyAverage | None:
    decay = recipe.learner.average_decay
    return PolicyAverage(policy, decay=decay, runs=recipe.run.num_runs) if decay > 0 else None


def _guide_of(
    policy: TensorDictModuleBase,
    recipe: Recipe,
    curriculum: Curriculum | None,
    generators: Sequence[torch.Generator],
) -> GuidedExploration | None:
    if curriculum is None or not is_guided(recipe, curriculum):
        return None
    guide = GuidedExploration(
        policy,
        curriculum,
        share=recipe.curriculum.guided_share,
        per=cast(Literal["episode", "step"], recipe.curriculum.guided_per),
        layer_key=None if recipe.curriculum.order == "threshold" else "layer",
        runs=recipe.run.num_runs,
        generators=generators,
    )
    return guide.to(place_of(policy))


def _networks(builder: LearnerBuilder, recipe: Recipe, curriculum: Curriculum | None) -> Networks:
    """The actor and the critics; the weights of each run depend on its own seed alone."""
    with torch.random.fork_rng(devices=[]):
        alone = []
        for seed in recipe.seeds:
            torch.manual_seed(seed)
            alone.append(_in_one_list(builder.networks(1)))
        actor, critics = builder.networks(recipe.run.num_runs)
    networks = [actor, *critics]
    for network, own in zip(networks, zip(*alone, strict=True), strict=True):
        network.load_state_dict(stack_runs([single.state_dict() for single in own]))
    if curriculum is not None:
        alphas = [recipe.curriculum.alpha_actor, *[recipe.curriculum.alpha_critic] * len(critics)]
        for network, alpha in zip(networks, alphas, strict=True):
            weight = _first_layer(network).weight.data
            weight.copy_(zero_unused_inputs(weight, curriculum.first_inputs, alpha=alpha))
    return actor, critics


def _in_one_list(networks: Networks) -> list[TensorDictModule]:
    return [networks[0], *networks[1]]


def _builder(recipe: Recipe, env: EnvBase, curriculum: Curriculum | None) -> LearnerBuilder:
    in_keys = ("observation", "desired_goal") if curriculum is None else ("input",)
    return load_name(find_learner(recipe, env).builder)(recipe, env, in_keys)


def _first_layer(network: nn.Module) -> StackedLinear:
    return next(module for module in network.modules() if isinstance(module, StackedLinear))
