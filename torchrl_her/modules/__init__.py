"""Networks, exploration around a greedy policy, and normalization of inputs."""

from torchrl_her.modules.averaging import PolicyAverage
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
    GoalNet,
    NetworkShape,
    StackedLayerNorm,
    StackedLinear,
    make_actor,
    make_critic,
    stack_runs,
    take_run,
)
from torchrl_her.modules.noise import RunNoise
from torchrl_her.modules.normalization import Moments, RunningNorm
from torchrl_her.modules.normalized import NormalizeBatch, NormalizedPolicy
from torchrl_her.modules.q_actor import QNet, make_q_actor
from torchrl_her.modules.stochastic_actor import StochasticActor, StochasticActorNet, make_stochastic_actor

__all__ = [
    "ActorNet",
    "CriticNet",
    "DecayingEpsilon",
    "DecayingEpsilonGreedy",
    "Exploration",
    "GoalNet",
    "Moments",
    "NetworkShape",
    "NormalizeBatch",
    "NormalizedPolicy",
    "PolicyAverage",
    "QNet",
    "RunNoise",
    "RunningNorm",
    "StackedLayerNorm",
    "StackedLinear",
    "StochasticActor",
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
