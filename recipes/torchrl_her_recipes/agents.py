"""The learners by name: DDPG, TD3, SAC and DQN, each as networks, exploration and a TorchRL loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.modules import QValueActor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her import (
    Curriculum,
    DecayingEpsilon,
    DecayingEpsilonGreedy,
    Exploration,
    StackedLinear,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_dqn_loss,
    make_q_actor,
    make_sac_loss,
    make_stochastic_actor,
    make_target_updater,
    make_td3_loss,
    stack_runs,
    zero_unused_inputs,
)
from torchrl_her_recipes.recipe import Recipe

Networks = tuple[TensorDictModule, TensorDictModule]


@dataclass(frozen=True)
class Agent:
    """What acts and learns.

    Attributes:
        actor: the greedy policy.
        critic: values of (observation, goal, action).
        exploration: turns greedy into exploring actions.
        policy: actor, then exploration.
        loss: of TorchRL.
        optimiser: over the loss module's parameters.
        target: moves the target networks.
    """

    actor: TensorDictModule
    critic: TensorDictModule
    exploration: Exploration
    policy: TensorDictModuleBase
    loss: LossModule
    optimiser: torch.optim.Optimizer
    target: TargetNetUpdater


def make_agent(
    recipe: Recipe,
    env: EnvBase,
    generators: Sequence[torch.Generator],
    *,
    rewards: tuple[float, float] = (-1.0, 0.0),
    curriculum: Curriculum | None = None,
) -> Agent:
    """The agent that a recipe asks for.

    Args:
        recipe: of the run, or of several.
        env: tells the widths of what is seen and done.
        generators: of the exploration of each run.
        rewards: of a missed goal and of an achieved one.
        curriculum: whose layers the networks see; None without one.

    Raises:
        ValueError: a learner that cannot do with the environment's actions, or not with several runs.
    """
    learner = check_learner(recipe, env)
    actor, critic = make_networks(recipe, env, curriculum=curriculum)
    exploration = _make_exploration(recipe, env, generators)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)  # second critics are drawn anew
        loss = _make_loss(learner, recipe, env, actor, critic, rewards)
    return Agent(
        actor=actor,
        critic=critic,
        exploration=exploration,
        policy=TensorDictSequential(actor, exploration),
        loss=loss,
        optimiser=torch.optim.Adam(loss.parameters(), lr=recipe.learning_rate, fused=True),
        target=make_target_updater(loss, tau=recipe.tau, hard_interval=recipe.hard_update_interval),
    )


def check_learner(recipe: Recipe, env: EnvBase) -> str:
    """The learner of a recipe; "auto" is DDPG where actions are continuous, and DQN where they are counted.

    Raises:
        ValueError: it cannot do with the environment's actions, or not with several runs.
    """
    counted = isinstance(env.action_spec, Categorical)
    fitting = ("dqn",) if counted else ("ddpg", "td3", "sac")
    learner = fitting[0] if recipe.learner == "auto" else recipe.learner
    if learner not in fitting:
        actions = "a finite number of actions" if counted else "continuous actions"
        raise ValueError(
            f"learner={learner} must not be used on {recipe.task}, which has {actions}: "
            f"choose {' or '.join(fitting)}"
        )
    if learner in ("td3", "sac") and recipe.num_runs > 1:
        raise ValueError(
            f"num_runs must be 1 with learner={learner}, whose random numbers runs would share, "
            f"got {recipe.num_runs}; sweep over seeds instead"
        )
    return learner


def make_networks(recipe: Recipe, env: EnvBase, *, curriculum: Curriculum | None = None) -> Networks:
    """The actor and the critic; the weights of each run depend on its own seed alone."""
    learner = check_learner(recipe, env)
    in_keys = ("observation", "desired_goal") if curriculum is None else ("input",)
    with torch.random.fork_rng(devices=[]):
        alone = []
        for seed in recipe.seeds:
            torch.manual_seed(seed)
            alone.append(_make_networks(learner, recipe, env, in_keys, 1))
        networks = _make_networks(learner, recipe, env, in_keys, recipe.num_runs)
    for network, own in zip(networks, zip(*alone, strict=True), strict=True):
        network.load_state_dict(stack_runs([single.state_dict() for single in own]))
    if curriculum is not None:
        for network, alpha in zip(networks, (recipe.alpha_actor, recipe.alpha_critic), strict=True):
            weight = _first_layer(network).weight.data
            weight.copy_(zero_unused_inputs(weight, curriculum.first_inputs, alpha=alpha))
    return networks


def _first_layer(network: nn.Module) -> StackedLinear:
    return next(module for module in network.modules() if isinstance(module, StackedLinear))


def _make_networks(learner: str, recipe: Recipe, env: EnvBase, in_keys: Sequence[str], runs: int) -> Networks:
    widths, spec = [env.observation_spec[key].shape[-1] for key in in_keys], env.action_spec_unbatched
    options: dict[str, Any] = {"hidden": recipe.hidden, "in_keys": in_keys}
    if learner == "dqn":
        return make_q_actor(widths, spec.n, runs=runs, **options)
    actions, dtype = spec.shape[-1], getattr(torch, recipe.dtype)
    actor = (
        make_stochastic_actor(widths, spec, **options)
        if learner == "sac"
        else make_actor(widths, actions, runs=runs, **options)
    )
    critic = make_critic(widths, actions, normalise=recipe.batch_norm, runs=runs, **options)
    return actor.to(dtype), critic.to(dtype)


def _make_exploration(recipe: Recipe, env: EnvBase, generators: Sequence[torch.Generator]) -> Exploration:
    start, end = recipe.epsilon_start, recipe.epsilon_end
    if check_learner(recipe, env) == "sac":
        start = end = 0.0  # its policy explores by itself
    options: dict[str, Any] = {"start": start, "decay": recipe.epsilon_decay, "end": end}
    options["generators"] = generators
    spec = env.action_spec_unbatched
    if isinstance(spec, Categorical):
        return DecayingEpsilonGreedy(spec.n, **options)
    return DecayingEpsilon(spec.low, spec.high, **options)


def _make_loss(
    learner: str,
    recipe: Recipe,
    env: EnvBase,
    actor: TensorDictModule,
    critic: TensorDictModule,
    rewards: tuple[float, float],
) -> LossModule:
    options: dict[str, Any] = {"gamma": recipe.gamma}
    if learner != "sac":
        options["reward_range"] = rewards
    match learner:
        case "ddpg":
            price = recipe.action_penalty
            return make_ddpg_loss(actor, critic, action_penalty=price, reduction="none", **options)
        case "dqn":
            return make_dqn_loss(cast(QValueActor, actor), reduction="none", **options)
        case "td3":
            return make_td3_loss(actor, critic, action_spec=env.action_spec_unbatched, **options)
    return make_sac_loss(actor, critic, action_spec=env.action_spec_unbatched, **options)
