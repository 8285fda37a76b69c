"""Networks, and exploration around a greedy policy."""

from torchrl_her.modules.exploration import (
    DecayingEpsilon,
    DecayingEpsilonGreedy,
    Exploration,
    explore,
    explore_actions,
)
from torchrl_her.modules.networks import (
    ActorNet,
    CriticNet,
    StackedLayerNorm,
    StackedLinear,
    make_actor,
    make_critic,
    stack_runs,
    take_run,
)
from torchrl_her.modules.q_actor import QNet, make_q_actor
from torchrl_her.modules.stochastic_actor import StochasticActorNet, make_stochastic_actor

__all__ = [
    "ActorNet",
    "CriticNet",
    "DecayingEpsilon",
    "DecayingEpsilonGreedy",
    "Exploration",
    "QNet",
    "StackedLayerNorm",
    "StackedLinear",
    "StochasticActorNet",
    "explore",
    "explore_actions",
    "make_actor",
    "make_critic",
    "make_q_actor",
    "make_stochastic_actor",
    "stack_runs",
    "take_run",
]
