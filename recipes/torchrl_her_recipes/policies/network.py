"""Makes the network of an exported policy from its :class:`PolicyInfo`, without environments of the task."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, TensorSpec

from torchrl_her.curriculum.relay import RelayPolicy
from torchrl_her.modules.normalization import RunningNorm, normalize
from torchrl_her.modules.normalized import NormalizedPolicy
from torchrl_her_recipes.components.agents import find_builder
from torchrl_her_recipes.components.learner import AgentShape, LearnerBuilder, acting
from torchrl_her_recipes.config.choices.learners import LearnerConfig
from torchrl_her_recipes.policies.info import KEYS, PolicyInfo

_CONSTANTS = ("mean", "std", "limit")  # buffers of an entry's normalization


def _action_spec(info: PolicyInfo) -> TensorSpec:
    if info.discrete:
        return Categorical(info.choices, dtype=torch.int64)
    return Bounded(-1.0, 1.0, shape=info.action_shape, dtype=torch.float32)  # the range that learners use


def load_network(
    info: PolicyInfo, options: LearnerConfig, weights: Mapping[str, Tensor]
) -> tuple[TensorDictModuleBase, TensorDictModuleBase]:
    """Makes a greedy policy, which reads ``observation`` and ``desired_goal`` and writes ``action``.

    Args:
        info: widths of inputs, and actions.
        options: options of the learner, which determine the network.
        weights: ``state_dict()`` of the actor and, if there is one, its normalization.

    Returns:
        The policy, and the actor with its normalization, which shares its weights with the policy.

    Raises:
        ValueError: the weights do not fit the network; this is checked before memory for it is allocated.
    """
    curriculum = info.curriculum
    shape = AgentShape(
        task=info.task,
        widths=info.widths if curriculum is None else {"input": curriculum.input_width},
        action_spec=_action_spec(info),
        dtype=getattr(torch, info.dtype),
    )
    builder = find_builder(options, shape)
    check_weights(builder, weights)
    actor = builder.player(1)
    player = acting(actor, builder.norm())
    player.load_state_dict(dict(weights))
    net = builder.greedy(actor)
    scaled = {*info.low} != {-1.0} or {*info.high} != {1.0}
    if not info.discrete and scaled and all(map(math.isfinite, (*info.low, *info.high))):
        net = ScaledActions(net, info.low, info.high)
    greedy = TensorDictModule(net, in_keys=list(shape.widths), out_keys=["action"])
    policy = acting(greedy, player.norm if isinstance(player, NormalizedPolicy) else None)
    if curriculum is not None:
        policy = RelayPolicy(policy, curriculum, in_keys=KEYS)
    return policy.requires_grad_(False), player


def check_weights(builder: LearnerBuilder, weights: Mapping[str, Tensor]) -> None:
    """Raises a ValueError if weights do not have the names and shapes of a builder's actor.

    No memory is allocated for the actor, since the widths come from a file and may be huge.
    """
    name = builder.options.name
    shapes = {key: tuple(value.shape) for key, value in weights.items()}
    if builder.options.depth > len(weights):
        raise ValueError(f"these are not the weights of an actor of learner={name}")
    with torch.device("meta"):  # tensors without memory, since only the shapes are needed
        actor = builder.player(1)
        expected = {
            key: tuple(value.shape) for key, value in acting(actor, builder.norm()).state_dict().items()
        }
    if shapes != expected:
        odd = next(key for key in {**expected, **shapes} if shapes.get(key) != expected.get(key))
        raise ValueError(
            f"these are not the weights of an actor of learner={name}: {odd} must be "
            f"{expected.get(odd, 'missing')}, got {shapes.get(odd, 'nothing')}"
        )
    if odd := [key for key, value in weights.items() if not value.isfinite().all()]:
        raise ValueError(f"weights must be finite, got NaN or infinity in {odd[0]}")


class ScaledActions(nn.Module):
    """Module that scales the actions of a network from [-1, 1] to a task's bounds.

    Args:
        net: network whose actions [..., actions] are from -1 to 1.
        low, high: the least and the greatest action, one number for each entry.

    Example:
        >>> ScaledActions(nn.Identity(), [0.0, -4.0], [2.0, 4.0])(torch.tensor([-1.0, 0.5]))
        tensor([0., 2.])
    """

    def __init__(self, net: nn.Module, low: Sequence[float], high: Sequence[float]) -> None:
        super().__init__()
        self.net = net
        least, greatest = torch.tensor(low), torch.tensor(high)
        self.register_buffer("middle", (greatest + least) / 2)
        self.register_buffer("reach", (greatest - least) / 2)
        self.register_buffer("low", least)
        self.register_buffer("high", greatest)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Maps inputs [..., width] to actions [..., actions]."""
        action = self.middle + self.reach * self.net(*inputs)
        return action.minimum(self.high).maximum(self.low)  # by rounding, actions may exceed the bounds


class TensorPolicy(nn.Module):
    """A policy as a module on plain tensors, in float32, which includes the normalization of inputs.

    Args:
        policy: policy from :func:`load_network`; it is copied.

    Attributes:
        net: the network, which reads normalized inputs.

    Example:
        >>> from torchrl_her_recipes import load_policy
        >>> TensorPolicy(load_policy("hand_v1").module)(torch.zeros(5, 9), torch.zeros(5, 2)).shape
        torch.Size([5, 3])
    """

    def __init__(self, policy: TensorDictModuleBase) -> None:
        super().__init__()
        self.relay: Any = None
        if isinstance(policy, RelayPolicy):
            self.relay, policy = copy.deepcopy(policy.relay), policy.module
        norm = policy.norm if isinstance(policy, NormalizedPolicy) else None
        actor: Any = policy.actor if isinstance(policy, NormalizedPolicy) else policy
        self.net: Any = copy.deepcopy(actor.module).float().eval()
        self.keys, self.normalizes = policy.in_keys, norm is not None
        if norm is not None:
            for key in self.keys:
                for name, value in zip(_CONSTANTS, _constants(norm, key), strict=True):
                    self.register_buffer(f"{key}_{name}", value)

    def normalized(self, *inputs: Tensor) -> list[Tensor]:
        """Returns the network's inputs for an observation and a desired goal."""
        values = inputs if self.relay is None else [self.relay(*inputs)]
        if not self.normalizes:
            return list(values)
        constants = [[getattr(self, f"{key}_{name}") for name in _CONSTANTS] for key in self.keys]
        return [normalize(value, *stats) for value, stats in zip(values, constants, strict=True)]

    def forward(self, observation: Tensor, desired_goal: Tensor) -> Tensor:
        """Maps inputs [rows, width] to actions [rows, actions], or to integers [rows]."""
        return self.net(*self.normalized(observation, desired_goal))

    @torch.no_grad()
    def deviation(self, action: Tensor, observation: Tensor, desired_goal: Tensor) -> Tensor:
        """Returns how far given actions are from the actions of this policy, [rows].

        For continuous actions, this is the greatest difference of an entry. For integers, it is the
        difference in value between the best and the given action, since several actions may be best.
        """
        inputs = self.normalized(observation, desired_goal)
        if not action.is_floating_point():
            if not hasattr(self.net, "regret"):  # networks of users' learners may not have this method
                return (action != self.net(*inputs)).float()
            return self.net.regret(action, *inputs)
        return (action - self.net(*inputs)).abs().amax(-1)


def _constants(norm: RunningNorm, key: str) -> tuple[Tensor, Tensor, Tensor]:
    """Returns an entry's mean, standard deviation and limit, by which :class:`RunningNorm` normalizes it."""
    n, mean, _ = norm.moments_of(key)
    std = norm.std[0, norm.columns_of(key)]
    limit = torch.where(n > 0, norm.clip, torch.inf)
    return mean.float(), std.float(), limit.float()
