"""Actor and critic: three hidden layers each; the critic takes the action in after its first layer.

A network holds the weights of one run, or of R independent runs ("stacked"): every weight then has a
leading dimension R, and one batched product serves all runs. Inputs [..., width] are R equal blocks, one for
each run in order.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

_LAST_LAYER = 3e-3  # small last layers keep early actions off the ends of tanh: Lillicrap et al., 2016


class StackedLinear(nn.Module):
    """R linear layers side by side, each initialized as ``nn.Linear`` is.

    Args:
        inputs: width of the input.
        outputs: width of the output.
        runs: R.
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
        """[R, rows, inputs] to [R, rows, outputs]."""
        return torch.baddbmm(self.bias, x, self.weight)


class StackedBatchNorm(nn.Module):
    """Batch normalization in which each run has its own statistics.

    TorchRL's DDPG loss evaluates both critics in training mode. So the online critic's running statistics
    move twice in each update, and the target critic's move without being copied.

    Args:
        width: of the input.
        runs: R.
    """

    def __init__(self, width: int, *, runs: int = 1) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(runs * width)

    def forward(self, x: Tensor) -> Tensor:
        """[R, rows, width] to the same."""
        runs, rows, width = x.shape
        flat = x.transpose(0, 1).reshape(rows, runs * width)
        return self.norm(flat).view(rows, runs, width).transpose(0, 1)


def hidden_layer(inputs: int, outputs: int, *, runs: int = 1, normalize: bool = False) -> nn.Sequential:
    """A stacked linear layer and a ReLU; ``normalize`` puts batch normalization between them."""
    norm = [StackedBatchNorm(outputs, runs=runs)] if normalize else []
    return nn.Sequential(StackedLinear(inputs, outputs, runs=runs), *norm, nn.ReLU())


class ActorNet(nn.Module):
    """(observation, goal) to an action in [-1, 1].

    Args:
        inputs: width of all inputs together.
        actions: width of the action.
        hidden: width of each of the three hidden layers.
        runs: R, how many independent actors.

    Example:
        >>> ActorNet(11, 3)(torch.zeros(2, 9), torch.zeros(2, 2)).shape
        torch.Size([2, 3])
    """

    def __init__(self, inputs: int, actions: int, *, hidden: int = 64, runs: int = 1) -> None:
        super().__init__()
        self.runs = runs
        widths = [inputs, hidden, hidden, hidden]
        layers = [hidden_layer(widths[i], widths[i + 1], runs=runs) for i in range(3)]
        self.layers = nn.Sequential(
            *layers, StackedLinear(hidden, actions, runs=runs, bound=_LAST_LAYER), nn.Tanh()
        )

    def forward(self, *inputs: Tensor) -> Tensor:
        """[..., widths] of the inputs to [..., actions]."""
        x = torch.cat(inputs, -1)
        return self.layers(by_run(x, self.runs)).view(*x.shape[:-1], -1)


class CriticNet(nn.Module):
    """(observation, goal, action) to the action's value.

    Args:
        inputs: width of all inputs together, without the action.
        actions: width of the action, the last input.
        hidden: width of each of the three hidden layers.
        normalize: batch normalization of the input and of the hidden layers.
        runs: R, how many independent critics.

    Example:
        >>> CriticNet(11, 3)(torch.zeros(2, 9), torch.zeros(2, 2), torch.zeros(2, 3)).shape
        torch.Size([2, 1])
    """

    def __init__(
        self, inputs: int, actions: int, *, hidden: int = 64, normalize: bool = False, runs: int = 1
    ) -> None:
        super().__init__()
        self.runs = runs
        norm = [StackedBatchNorm(inputs, runs=runs)] if normalize else []
        self.first = nn.Sequential(*norm, hidden_layer(inputs, hidden, runs=runs, normalize=normalize))
        self.rest = nn.Sequential(
            hidden_layer(hidden + actions, hidden, runs=runs, normalize=normalize),
            hidden_layer(hidden, hidden, runs=runs, normalize=normalize),
            StackedLinear(hidden, 1, runs=runs, bound=_LAST_LAYER),
        )

    def forward(self, *inputs: Tensor) -> Tensor:
        """[..., widths] of the inputs, the action last, to [..., 1]."""
        *seen, action = inputs
        hidden = self.first(by_run(torch.cat(seen, -1), self.runs))
        return self.rest(torch.cat((hidden, by_run(action, self.runs)), -1)).view(*action.shape[:-1], 1)


def by_run(x: Tensor, runs: int) -> Tensor:
    """Separates the R equal blocks of a batch: [..., width] to [R, rows, width]."""
    return x.reshape(runs, -1, x.shape[-1])


def stack_runs(states: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """The state dict of a stacked network, made of those of single networks.

    Args:
        states: ``state_dict()`` of R networks of the same shape, each of a single run.

    Returns:
        What ``load_state_dict`` of the same network with ``runs=R`` takes.

    Example:
        >>> pair = ActorNet(3, 1, runs=2)
        >>> pair.load_state_dict(stack_runs([ActorNet(3, 1).state_dict() for _ in range(2)]))
        <All keys matched successfully>
    """
    first = states[0]
    return {
        key: torch.cat([state[key] for state in states]) if first[key].ndim else first[key] for key in first
    }


def take_run(state: Mapping[str, Tensor], run: int, runs: int) -> dict[str, Tensor]:
    """The state dict of one run's network, taken out of that of a stacked network.

    Args:
        state: ``state_dict()`` of the stacked network.
        run: the run's number, from 0.
        runs: R.
    """
    return {key: value.chunk(runs)[run].clone() if value.ndim else value for key, value in state.items()}


def make_actor(
    widths: Sequence[int],
    actions: int,
    *,
    hidden: int = 64,
    runs: int = 1,
    in_keys: Sequence[NestedKey] = ("observation", "desired_goal"),
    action_key: NestedKey = "action",
) -> TensorDictModule:
    """The actor as a TensorDict module.

    Args:
        widths: of the inputs, one for each of ``in_keys``.
        actions: width of the action, which is within [-1, 1].
        hidden: width of the hidden layers.
        runs: R, how many independent actors.
        in_keys: what it sees; the goal must be among them.
        action_key: where it writes the action.

    Example:
        >>> from tensordict import TensorDict
        >>> actor = make_actor((9, 2), 3)
        >>> seen = {"observation": torch.zeros(4, 9), "desired_goal": torch.zeros(4, 2)}
        >>> actor(TensorDict(seen, [4]))["action"].shape
        torch.Size([4, 3])
    """
    net = ActorNet(sum(widths), actions, hidden=hidden, runs=runs)
    return TensorDictModule(net, in_keys=list(in_keys), out_keys=[action_key])


def make_critic(
    widths: Sequence[int],
    actions: int,
    *,
    hidden: int = 64,
    normalize: bool = False,
    runs: int = 1,
    in_keys: Sequence[NestedKey] = ("observation", "desired_goal"),
    action_key: NestedKey = "action",
    value_key: NestedKey = "state_action_value",
) -> TensorDictModule:
    """The critic as a TensorDict module.

    Args:
        widths: of the inputs, one for each of ``in_keys``.
        actions: width of the action.
        hidden: width of the hidden layers.
        normalize: whether to normalize the input and the hidden layers over the batch.
        runs: R, how many independent critics.
        in_keys: what it sees besides the action; the goal must be among them.
        action_key: where it reads the action.
        value_key: where it writes the action's value.

    Example:
        >>> from tensordict import TensorDict
        >>> critic = make_critic((9, 2), 3)
        >>> seen = {"observation": torch.zeros(4, 9), "desired_goal": torch.zeros(4, 2)}
        >>> critic(TensorDict({**seen, "action": torch.zeros(4, 3)}, [4]))["state_action_value"].shape
        torch.Size([4, 1])
    """
    net = CriticNet(sum(widths), actions, hidden=hidden, normalize=normalize, runs=runs)
    return TensorDictModule(net, in_keys=[*in_keys, action_key], out_keys=[value_key])
