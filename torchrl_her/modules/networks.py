"""Actor and critic: multilayer perceptrons; the action enters the critic after its first layer.

A network holds the weights of one run, or of R independent runs ("stacked"): every weight then has a
leading dimension R, and one batched product serves all runs. Inputs [..., width] are R equal blocks, one for
each run in order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_her.checks import check_whole

ActivationName = Literal["relu", "tanh", "elu"]
Norm = Literal["none", "layer", "batch"]

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU}
_LAST_LAYER = 3e-3  # bound of weights that keeps first actions off the ends of tanh: Lillicrap et al., 2016
_LEAST_DEPTH = 2  # the action enters the critic after its first hidden layer, so another must follow


class StackedLinear(nn.Module):
    """R linear layers side by side, each initialized as ``nn.Linear`` is.

    Args:
        inputs: width of the input.
        outputs: width of the output.
        runs: R, the number of independent runs.
        bound: weights are uniform in [-bound, bound]; None for ``1 / sqrt(inputs)``.

    Example:
        >>> StackedLinear(4, 3, runs=2)(torch.zeros(2, 5, 4)).shape
        torch.Size([2, 5, 3])
    """

    def __init__(self, inputs: int, outputs: int, *, runs: int = 1, bound: float | None = None) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(inputs) if bound is None else bound
        self.weight = nn.Parameter(torch.empty(runs, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(runs, 1, outputs).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        """Maps [R, rows, inputs] to [R, rows, outputs]."""
        return torch.baddbmm(self.bias, x, self.weight)


class StackedBatchNorm(nn.Module):
    """Batch normalization in which each run has its own statistics.

    In the critic's loss, where its weights learn, a batch is normalized by its own statistics, and updates
    the running statistics. Target networks, the actor's loss and evaluation mode use the running statistics
    and do not change them. In the actor's loss, a batch's own statistics would remove the mean of the values,
    which the actor has to raise.

    Args:
        width: Width of the input.
        runs: R, the number of independent runs.

    Example:
        >>> norm, rows = StackedBatchNorm(2), torch.tensor([[[1.0, 4.0], [3.0, 8.0]]])
        >>> norm(rows).detach().round(decimals=3).tolist()
        [[[-1.0, -1.0], [1.0, 1.0]]]
        >>> norm.running_mean, norm.running_var
        (tensor([[[0.2000, 0.6000]]]), tensor([[[1.1000, 1.7000]]]))
        >>> norm.requires_grad_(False)(rows)[0, 0]  # (1 - 0.2) / sqrt(1.1), (4 - 0.6) / sqrt(1.7)
        tensor([0.7628, 2.6077])
    """

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, width: int, *, runs: int = 1) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(runs, 1, width))
        self.bias = nn.Parameter(torch.zeros(runs, 1, width))
        self.register_buffer("running_mean", torch.zeros(runs, 1, width))
        self.register_buffer("running_var", torch.ones(runs, 1, width))

    def forward(self, x: Tensor) -> Tensor:
        """Normalizes [R, rows, width] entry by entry; the shape stays."""
        runs, rows, width = x.shape
        flat = x.transpose(0, 1).reshape(rows, runs * width)
        tensors = (self.running_mean, self.running_var, self.weight, self.bias)
        mean, variance, weight, bias = (each.view(-1) for each in tensors)
        learns = self.training and self.weight.requires_grad
        flat = nn.functional.batch_norm(flat, mean, variance, weight, bias, learns)
        return flat.view(rows, runs, width).transpose(0, 1)


class StackedLayerNorm(nn.Module):
    """Layer normalization in which each run has its own scale and shift.

    Ba et al., Layer normalization, 2016.

    Args:
        width: width of the input.
        runs: R, the number of independent runs.

    Example:
        >>> StackedLayerNorm(2)(torch.tensor([[[1.0, 3.0]]])).round(decimals=3).tolist()
        [[[-1.0, 1.0]]]
    """

    def __init__(self, width: int, *, runs: int = 1) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(runs, 1, width))
        self.bias = nn.Parameter(torch.zeros(runs, 1, width))

    def forward(self, x: Tensor) -> Tensor:
        """Normalizes [R, rows, width] entry by entry; the shape stays."""
        return torch.nn.functional.layer_norm(x, x.shape[-1:]) * self.weight + self.bias


@dataclass(frozen=True, kw_only=True)
class NetworkShape:
    """Width, number, activation and normalization of a network's hidden layers.

    Args:
        hidden: width of each hidden layer.
        depth: number of hidden layers, at least 2.
        activation: function after each hidden layer: ``"relu"``, ``"tanh"`` or ``"elu"``.
        norm: ``"layer"`` for layer normalization before each activation, ``"none"`` without; ``"batch"`` for
            batch normalization of the hidden layers and, in a critic, of its input, but not in actors.

    Raises:
        ValueError: a number is too small, or a name is unknown.

    Example:
        >>> NetworkShape(hidden=256, norm="layer")
        NetworkShape(hidden=256, depth=3, activation='relu', norm='layer')
    """

    hidden: int = 64
    depth: int = 3
    activation: ActivationName = "relu"
    norm: Norm = "none"

    def __post_init__(self) -> None:
        check_whole(hidden=self.hidden)
        check_whole(depth=self.depth, least=_LEAST_DEPTH)
        for name, known in (("norm", get_args(Norm)), ("activation", tuple(ACTIVATIONS))):
            if (word := getattr(self, name)) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {word!r}")


def hidden_layers(inputs: int, shape: NetworkShape, *, joined: int = 0, runs: int = 1) -> list[nn.Module]:
    """Makes hidden layers: linear, a normalization if there is one, an activation.

    The second layer takes ``joined`` further inputs besides the outputs of the first.
    """
    norms: dict[str, Any] = {"layer": StackedLayerNorm, "batch": StackedBatchNorm}
    layers: list[nn.Module] = []
    for width in (inputs, shape.hidden + joined, *[shape.hidden] * (shape.depth - 2)):
        linear = StackedLinear(width, shape.hidden, runs=runs)
        between = [norms[shape.norm](shape.hidden, runs=runs)] if shape.norm in norms else []
        layers.append(nn.Sequential(linear, *between, ACTIVATIONS[shape.activation]()))
    return layers


class GoalNet(nn.Module):
    """Network that maps (observation, goal) to numbers: base of all networks but critics.

    Args:
        inputs: width of all inputs together.
        actions: width of the action, or number of discrete actions.
        shape: shape of the hidden layers.
        runs: R, how many independent networks.

    Raises:
        ValueError: the shape has batch normalization, which is for critics only.
    """

    def __init__(
        self, inputs: int, actions: int, *, shape: NetworkShape = NetworkShape(), runs: int = 1
    ) -> None:
        super().__init__()
        if shape.norm == "batch":
            raise ValueError(f"norm must be none or layer in {type(self).__name__}, got 'batch'")
        self.runs = runs
        self.layers = nn.Sequential(
            *hidden_layers(inputs, shape, runs=runs), *self._last_layers(shape.hidden, actions)
        )

    def _last_layers(self, hidden: int, actions: int) -> Sequence[nn.Module]:
        """Makes the layers after the hidden ones."""
        return [StackedLinear(hidden, actions, runs=self.runs)]

    def forward(self, *inputs: Tensor) -> Any:
        """Maps inputs [..., width] to numbers [..., outputs]."""
        x = torch.cat(inputs, -1)
        return self.layers(by_run(x, self.runs)).view(*x.shape[:-1], -1)


class ActorNet(GoalNet):
    """:class:`~torchrl_her.modules.GoalNet` of a policy: maps (observation, goal) to an action in [-1, 1].

    Example:
        >>> ActorNet(11, 3)(torch.zeros(2, 9), torch.zeros(2, 2)).shape
        torch.Size([2, 3])
    """

    def _last_layers(self, hidden: int, actions: int) -> Sequence[nn.Module]:
        return [StackedLinear(hidden, actions, runs=self.runs, bound=_LAST_LAYER), nn.Tanh()]


class CriticNet(nn.Module):
    """Network of a critic: maps (observation, goal, action) to a value, or to several such as quantiles.

    Args:
        inputs: width of all inputs together, without the action.
        actions: width of the action, the last input.
        shape: shape of the hidden layers.
        runs: R, how many independent critics.
        outputs: number of outputs.

    Raises:
        ValueError: ``outputs`` is not positive.

    Example:
        >>> CriticNet(11, 3)(torch.zeros(2, 9), torch.zeros(2, 2), torch.zeros(2, 3)).shape
        torch.Size([2, 1])
    """

    def __init__(
        self,
        inputs: int,
        actions: int,
        *,
        shape: NetworkShape = NetworkShape(),
        runs: int = 1,
        outputs: int = 1,
    ) -> None:
        super().__init__()
        check_whole(outputs=outputs)
        self.runs, self.outputs = runs, outputs
        first, *rest = hidden_layers(inputs, shape, joined=actions, runs=runs)
        norms = [StackedBatchNorm(inputs, runs=runs)] if shape.norm == "batch" else []
        self.first = nn.Sequential(*norms, first)
        self.rest = nn.Sequential(*rest, StackedLinear(shape.hidden, outputs, runs=runs, bound=_LAST_LAYER))

    def forward(self, *inputs: Tensor) -> Tensor:
        """Maps inputs [..., width], the action last, to [..., outputs]."""
        *seen, action = inputs
        hidden = self.first(by_run(torch.cat(seen, -1), self.runs))
        return self.rest(torch.cat((hidden, by_run(action, self.runs)), -1)).view(
            *action.shape[:-1], self.outputs
        )


def by_run(x: Tensor, runs: int) -> Tensor:
    """Separates the R equal blocks of a batch: reshapes [..., width] to [R, rows, width]."""
    return x.reshape(runs, -1, x.shape[-1])


def stacked_runs(module: nn.Module) -> int:
    """Returns the number of runs that the networks within a module are stacked for.

    Example:
        >>> stacked_runs(make_actor((9, 2), 3, runs=5)), stacked_runs(nn.Linear(2, 2))
        (5, 1)
    """
    numbers = (getattr(part, "runs", None) for part in module.modules())
    return next((number for number in numbers if isinstance(number, int)), 1)


def stack_runs(states: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Stacks state dicts of single networks into the state dict of a stacked network.

    Args:
        states: ``state_dict()`` of R networks of the same shape, each of a single run.

    Returns:
        The state dict for the same network with ``runs=R``.

    Example:
        >>> pair = ActorNet(3, 1, runs=2)
        >>> pair.load_state_dict(stack_runs([ActorNet(3, 1).state_dict() for _ in range(2)]))
        <All keys matched successfully>
    """
    return {key: torch.cat([state[key] for state in states]) for key in states[0]}


def take_run(state: Mapping[str, Tensor], run: int, runs: int) -> dict[str, Tensor]:
    """Extracts the state dict of one run's network from the state dict of a stacked network.

    Args:
        state: ``state_dict()`` of the stacked network.
        run: the run's number, from 0.
        runs: R, the number of independent runs.
    """
    return {key: value.chunk(runs)[run].clone() for key, value in state.items()}


def make_actor(
    widths: Sequence[int],
    actions: int,
    *,
    shape: NetworkShape = NetworkShape(),
    runs: int = 1,
    in_keys: Sequence[NestedKey] = ("observation", "desired_goal"),
    action_key: NestedKey = "action",
) -> TensorDictModule:
    """Makes an actor as a TensorDict module.

    Args:
        widths: widths of the inputs, one for each of ``in_keys``.
        actions: width of the action, which is within [-1, 1].
        shape: shape of the hidden layers.
        runs: R, how many independent actors.
        in_keys: keys of the inputs; the goal must be among them.
        action_key: key under which the action is written.

    Example:
        >>> from tensordict import TensorDict
        >>> actor = make_actor((9, 2), 3)
        >>> seen = {"observation": torch.zeros(4, 9), "desired_goal": torch.zeros(4, 2)}
        >>> actor(TensorDict(seen, [4]))["action"].shape
        torch.Size([4, 3])
    """
    net = ActorNet(sum(widths), actions, shape=shape, runs=runs)
    return TensorDictModule(net, in_keys=list(in_keys), out_keys=[action_key])


def make_critic(
    widths: Sequence[int],
    actions: int,
    *,
    shape: NetworkShape = NetworkShape(),
    runs: int = 1,
    outputs: int = 1,
    in_keys: Sequence[NestedKey] = ("observation", "desired_goal"),
    action_key: NestedKey = "action",
    value_key: NestedKey = "state_action_value",
) -> TensorDictModule:
    """Makes a critic as a TensorDict module.

    Args:
        widths: widths of the inputs, one for each of ``in_keys``.
        actions: width of the action.
        shape: shape of the hidden layers.
        runs: R, how many independent critics.
        outputs: number of outputs, for example quantiles of the return.
        in_keys: keys of the inputs besides the action; the goal must be among them.
        action_key: key from which the action is read.
        value_key: key under which the action's value is written.

    Example:
        >>> from tensordict import TensorDict
        >>> critic = make_critic((9, 2), 3)
        >>> seen = {"observation": torch.zeros(4, 9), "desired_goal": torch.zeros(4, 2)}
        >>> critic(TensorDict({**seen, "action": torch.zeros(4, 3)}, [4]))["state_action_value"].shape
        torch.Size([4, 1])
    """
    net = CriticNet(sum(widths), actions, shape=shape, runs=runs, outputs=outputs)
    return TensorDictModule(net, in_keys=[*in_keys, action_key], out_keys=[value_key])
