"""The stochastic actor of SAC: a normal distribution squashed into the range of actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_her.modules.networks import GoalNet, NetworkShape
from torchrl_her.modules.noise import RunNoise

_LEAST_SCALE, _GREATEST_SCALE = -10.0, 2.0  # bounds of the scale's logarithm: Haarnoja et al., 2018


class StochasticActorNet(GoalNet):
    """:class:`~torchrl_her.modules.GoalNet` that gives location and scale of a normal distribution.

    Example:
        >>> location, scale = StochasticActorNet(11, 3)(torch.zeros(2, 9), torch.zeros(2, 2))
        >>> location.shape, bool((scale > 0).all())
        (torch.Size([2, 3]), True)
    """

    def _last_layers(self, hidden: int, actions: int) -> Sequence[nn.Module]:
        return super()._last_layers(hidden, 2 * actions)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Maps inputs [..., width] to location and scale, [..., actions] each."""
        location, scale = super().forward(*inputs).chunk(2, -1)
        return location, scale.clamp(_LEAST_SCALE, _GREATEST_SCALE).exp()


class StochasticActor(ProbabilisticActor):
    """TorchRL's actor of SAC, whose draws come from a generator for each of R runs.

    What a run draws then does not depend on which other runs are trained beside it. Copies of the actor share
    its generators, since they act for the same runs.

    Args:
        *args: arguments of :class:`torchrl.modules.ProbabilisticActor`.
        generators: R generators; None for torch's own, which all runs share.
        **kwargs: keyword arguments of the same class.
    """

    def __init__(
        self, *args: Any, generators: Sequence[torch.Generator | None] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.noise = RunNoise(generators)

    @property
    def generators(self) -> list[torch.Generator | None] | None:
        """Generators of each run's random numbers."""
        return self.noise.generators

    @generators.setter
    def generators(self, generators: Sequence[torch.Generator | None] | None) -> None:
        self.noise = RunNoise(generators)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> StochasticActor:
        """Moves the bounds of actions, too: TorchRL would copy them in each step, which no CUDA graph can."""
        bounds = self[-1].distribution_kwargs
        self[-1].distribution_kwargs = {
            name: fn(value) if isinstance(value, Tensor) else value for name, value in bounds.items()
        }
        return super()._apply(fn, recurse)

    def forward(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> TensorDictBase:
        """Writes the action of each row [R * E, ...]: drawn, or greedy if exploration is switched off."""
        if self.noise.generators is None or exploration_type() is not ExplorationType.RANDOM:
            return super().forward(tensordict, *args, **kwargs)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            tensordict = super().forward(tensordict, *args, **kwargs)
        dist = self.build_dist_from_params(tensordict)
        drawn = dist.transforms[0](dist.loc + dist.scale * self.noise(dist.loc))
        return tensordict.set(self.out_keys[-1], drawn)


class SquashedLocation(nn.Module):
    """The greedy action of a stochastic actor: the location of its normal distribution, squashed and scaled.

    Args:
        net: network of the actor, which may share it.
        low: the least actions [width].
        high: the greatest actions [width].

    Example:
        >>> greedy = SquashedLocation(StochasticActorNet(3, 1), torch.tensor([0.0]), torch.tensor([10.0]))
        >>> greedy(torch.zeros(2, 2), torch.zeros(2, 1)).shape
        torch.Size([2, 1])
    """

    low: Tensor
    high: Tensor

    def __init__(self, net: StochasticActorNet, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.net = net
        self.register_buffer("low", low.clone(), persistent=False)
        self.register_buffer("high", high.clone(), persistent=False)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Maps inputs [..., width] to actions [..., actions]."""
        location, _ = self.net(*inputs)
        return (self.high + self.low) / 2 + (self.high - self.low) / 2 * location.tanh()


def make_stochastic_actor(
    widths: Sequence[int],
    action_spec: Bounded,
    *,
    shape: NetworkShape = NetworkShape(),
    runs: int = 1,
    in_keys: Sequence[NestedKey] = ("observation", "desired_goal"),
    generators: Sequence[torch.Generator] | None = None,
) -> ProbabilisticActor:
    """Makes SAC's actor: a squashed normal distribution, whose squashed location is the greedy action.

    Args:
        widths: widths of the inputs, one for each of ``in_keys``.
        action_spec: spec of one environment's action, with its bounds.
        shape: shape of the hidden layers.
        runs: R, how many independent actors.
        in_keys: keys of the inputs; the goal must be among them.
        generators: generators from which the runs draw their actions; None for torch's own.

    Example:
        >>> from tensordict import TensorDict
        >>> actor = make_stochastic_actor((9, 2), Bounded(-1.0, 1.0, (3,)))
        >>> seen = TensorDict({"observation": torch.zeros(4, 9), "desired_goal": torch.zeros(4, 2)}, [4])
        >>> actor(seen)["action"].shape
        torch.Size([4, 3])
    """
    net = StochasticActorNet(sum(widths), action_spec.shape[-1], shape=shape, runs=runs)
    return StochasticActor(
        TensorDictModule(net, in_keys=list(in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": action_spec.space.low, "high": action_spec.space.high},
        spec=action_spec,
        generators=generators,
    )
