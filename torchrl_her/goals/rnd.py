"""Weights that prefer goals which a network has not learned yet: random network distillation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.utils import skip_init
from torchrl.envs.transforms.rnd import RunningMeanStd
from torchrl.objectives import RNDLoss

from torchrl_her.checks import check_whole
from torchrl_her.goals.weights import GoalWeights, normalized_weights, spread_evenly

_GOAL = "goal"
_LEAST_ERROR = 1e-30
_FARTHEST = 1e15  # largest coordinate: squares of larger ones overflow in float32
_RANGE = 2.0  # most goals are within this many standard deviations of the mean


class NetworkNovelty(GoalWeights):
    """Weights goals by the error with which a network predicts the output of a random network.

    The predictor is trained on the written goals, so its error is small where many goals were written, and
    large where few were. Burda et al., Exploration by random network distillation, 2018, with
    goals in place of observations; networks and loss are TorchRL's :class:`~torchrl.objectives.RNDLoss`.
    Goals are normalized by the running mean and standard deviation of the written goals, and clipped at 5.

    Before the first goals all weights are 1, and goals that are not finite have weight 0. All random numbers
    come from ``seed``, none from torch's own generator. Emptying the buffer (``clear``) restores the initial
    networks.

    Keyword Args:
        seed: seed of both networks.
        sharpness: weights are ``error ** sharpness``, of the squared error.
        hidden: width of the hidden layers: one in the random network, two in the predictor.
        features: number of outputs of the networks.
        lr: learning rate of the predictor (Adam).
        steps: gradient steps for the goals of one ``update``, at most.
        batch_size: goals of a gradient step, at most. If there are more goals than all steps together take,
            an evenly spread part of the goals is used.

    Raises:
        ValueError: an option is out of its range, or goals have another width than earlier ones.

    Example:
        >>> weights = NetworkNovelty(seed=0)
        >>> often = torch.rand(256, 2, generator=torch.Generator().manual_seed(0))
        >>> for _ in range(50):
        ...     weights.update(often)
        >>> near, far = weights(torch.tensor([[0.5, 0.5], [3.0, 3.0]])).tolist()
        >>> near < 0.05, far
        (True, 1.0)
    """

    def __init__(
        self,
        *,
        seed: int = 0,
        sharpness: float = 1.0,
        hidden: int = 64,
        features: int = 32,
        lr: float = 1e-3,
        steps: int = 4,
        batch_size: int = 256,
    ) -> None:
        for name, value in (("sharpness", sharpness), ("lr", lr)):
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        check_whole(hidden=hidden, features=features, steps=steps, batch_size=batch_size)
        self.seed, self.sharpness, self.hidden, self.features = seed, sharpness, hidden, features
        self.lr, self.steps, self.batch_size = lr, steps, batch_size
        self._learned: _Learned | None = None

    def __call__(self, goals: Tensor) -> Tensor:
        if self._learned is None or goals.numel() == 0:
            return super().__call__(goals)
        error = self.error(goals).double().clamp_min(_LEAST_ERROR)  # NaN stays NaN
        return normalized_weights(error.log() * self.sharpness, goals)

    @torch.no_grad()
    def error(self, goals: Tensor) -> Tensor:
        """Returns the squared prediction errors [...] of goals [..., g]; NaN for goals that are not finite.

        Raises:
            RuntimeError: there were no goals to learn from yet.
        """
        learned = self._at(goals)
        if learned is None:
            raise RuntimeError("there is no prediction before the first goals: call update() first")
        error = _errors(learned.loss, _bounded(goals.nan_to_num(0.0, 0.0, 0.0)))
        return error.masked_fill(~goals.isfinite().all(-1), math.nan)

    def update(self, goals: Tensor) -> None:
        """Trains the predictor on goals."""
        goals = goals.detach().reshape(-1, goals.shape[-1])
        goals = _bounded(goals[goals.isfinite().all(-1)])
        if len(goals) == 0:
            return
        if self._learned is None:
            self._learned = self._begin(goals.shape[1], goals.device)
        learned = self._at(goals)
        assert learned is not None
        learned.loss.obs_rms.update(goals)
        chosen = goals[spread_evenly(len(goals), self.steps * self.batch_size, goals.device)]
        batches = -(-len(chosen) // self.batch_size)
        with torch.enable_grad():
            for batch in range(batches):
                _errors(learned.loss, chosen[batch::batches]).mean().backward()
                learned.optimizer.step()
                learned.optimizer.zero_grad()

    def clear(self) -> None:
        self._learned = None

    def state_dict(self) -> dict[str, Any]:
        if self._learned is None:
            return {"networks": None, "optimizer": None}
        networks = {name: value.clone() for name, value in self._learned.loss.state_dict().items()}
        return {"networks": networks, "optimizer": deepcopy(self._learned.optimizer.state_dict())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._learned = None
        if (networks := state["networks"]) is not None:
            mean = networks["obs_rms.mean"]
            self._learned = self._begin(len(mean), mean.device)
            self._learned.loss.load_state_dict(networks)
            self._learned.optimizer.load_state_dict(deepcopy(state["optimizer"]))

    def _begin(self, width: int, device: torch.device) -> _Learned:
        """Makes new networks, always the same ones for a seed and a width of goals."""
        generator = torch.Generator().manual_seed(self.seed)
        target = _network([width, self.hidden, self.features], generator)
        predictor = _network([width, self.hidden, self.hidden, self.features], generator)
        loss = RNDLoss(
            predictor, target, obs_rms=RunningMeanStd((width,)), reduction="none", update_fraction=1.0
        )
        loss.set_keys(observation=_GOAL)
        return self._with_optimizer(loss.to(device))

    def _with_optimizer(self, loss: RNDLoss) -> _Learned:
        return _Learned(loss, torch.optim.Adam(loss.predictor_network.parameters(), lr=self.lr))

    def _at(self, goals: Tensor) -> _Learned | None:
        """Returns the networks, moved to the device of the goals."""
        learned = self._learned
        if learned is None:
            return None
        mean = learned.loss.obs_rms.mean
        if len(mean) != goals.shape[-1]:
            raise ValueError(f"goals must have {len(mean)} numbers, as earlier ones, got {goals.shape[-1]}")
        if mean.device != goals.device:
            self._learned = self._with_optimizer(learned.loss.to(goals.device))
            self._learned.optimizer.load_state_dict(learned.optimizer.state_dict())
        return self._learned


class _Learned(NamedTuple):
    """Both networks, the moments of the goals, and the predictor's optimizer."""

    loss: RNDLoss
    optimizer: torch.optim.Optimizer


def _bounded(goals: Tensor) -> Tensor:
    """Returns goals in float32, clamped so that sums of their squares cannot overflow."""
    return goals.float().clamp(-_FARTHEST, _FARTHEST)


def _errors(loss: RNDLoss, goals: Tensor) -> Tensor:
    """Returns the squared prediction errors [...] of finite goals [..., g]."""
    flat = goals.reshape(-1, goals.shape[-1])
    return loss(TensorDict({_GOAL: flat}, [len(flat)]))["loss_predictor"].view(goals.shape[:-1])


def _network(widths: Sequence[int], generator: torch.Generator) -> nn.Sequential:
    """Makes linear layers with rectifiers between them, with weights from a generator.

    Biases of the first layer are spread over the range of normalized goals. Without them outputs would grow
    in proportion along each ray from the mean, and the predictor could infer outputs far from the mean from
    goals near it.
    """
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        linear = skip_init(nn.Linear, inputs, outputs)
        bound = 0.0 if layers else _RANGE
        nn.init.normal_(linear.weight, std=math.sqrt(2.0 / inputs), generator=generator)
        nn.init.uniform_(linear.bias, -bound, bound, generator=generator)
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])
