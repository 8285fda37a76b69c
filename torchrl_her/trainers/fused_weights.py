"""The tensors that compiled gradient steps change: a loss's weights, their targets and Adam's moments."""

from __future__ import annotations

from collections.abc import Sequence
from operator import is_not
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_her.native.job import STOCHASTIC, Structures
from torchrl_her.trainers.adam import RunsAdam
from torchrl_her.trainers.fusing import FUSED

State = dict[str, Tensor]

_STATE = ("exp_avg", "exp_avg_sq", "step")  # Adam's state of a parameter


class FusedWeights:
    """The weights of a loss, network by network, as addresses that compiled steps work on.

    A stack of N critics has parameters [N, R, ...]; for the steps these are N networks. Running statistics
    have targets, but no moments.

    Args:
        loss: loss that can be fused.
        optimizer: a plain Adam over its parameters.
        kinds: the structures for the type of its weights.

    Attributes:
        parameters: parameters of the actor, the critics and SAC's temperature.
        actor_tensors, critic_tensors: number of parameters and running statistics of an actor and a critic.
        critics: N, the number of critics.
    """

    def __init__(self, loss: LossModule, optimizer: torch.optim.Optimizer, kinds: Structures) -> None:
        self._optimizer, self._kinds, fused = optimizer, kinds, FUSED[type(loss)]
        self._dtype = kinds.dtype
        is_stochastic = fused.algorithm in STOCHASTIC
        self.critics: int = 0 if fused.critic is None else getattr(loss, "num_qvalue_nets", 1)
        actor = _tensors(loss, fused.actor, delayed=not is_stochastic)  # SAC has no delayed actor
        critic = [] if fused.critic is None else _tensors(loss, fused.critic, delayed=True)
        stacked = hasattr(loss, "num_qvalue_nets")
        self.actor_tensors, self.critic_tensors = len(actor), len(critic)
        temperature = [(loss.log_alpha, None)] if is_stochastic else []
        self.parameters: list[nn.Parameter] = [
            tensor for tensor, _ in (*actor, *critic, *temperature) if isinstance(tensor, nn.Parameter)
        ]
        # Each tensor of each network: parameter, target, index of the critic, and number of critics in it.
        self._places = [
            *((tensor, delayed, 0, 1) for tensor, delayed in actor),
            *(
                (tensor, delayed, n, self.critics if stacked else 1)
                for n in range(self.critics)
                for tensor, delayed in critic
            ),
            *((tensor, delayed, 0, 1) for tensor, delayed in temperature),
        ]
        self._weights = [tensor for place in self._places for tensor in place[:2] if tensor is not None]
        # Addresses and states of Adam from which the table was made.
        self._addresses: list[int] = []
        self._moments: list[Tensor] = []
        self._table: Any = None

    def table(self) -> Any:
        """Returns the addresses of all tensors, updated if some of them were replaced, as by a checkpoint.

        Raises:
            ValueError: tensors do not fit each other, are not contiguous, not on the CPU or of another type
                than when the learner was made; or Adam's counts of steps differ.
        """
        states = [self._optimizer.state[parameter] or self._start(parameter) for parameter in self.parameters]
        addresses = [tensor.data_ptr() for tensor in self._weights]
        moments = [state[name] for state in states for name in _STATE]
        if addresses != self._addresses or any(map(is_not, moments, self._moments)):
            for state in states:
                state["step"] = state["step"].to(torch.float32)  # made as float64 if that is torch's default
            self._check(states)
            self._addresses = addresses
            self._moments = [state[name] for state in states for name in _STATE]
            rows = [self._row(*place) for place in self._places]
            kind = self._kinds.tensors
            self._table = (kind * len(rows))(*(kind(*row) for row in rows))
        return self._table

    def _check(self, states: Sequence[State]) -> None:
        """Raises a ValueError for tensors that compiled steps cannot work on."""
        for parameter, target, *_ in self._places:
            moments = (self._state(parameter).get(name) for name in _STATE[:2])
            for tensor in (parameter, target, *moments):
                if tensor is None:
                    continue
                fits = tensor.shape == parameter.shape and tensor.dtype == self._dtype
                if not (fits and tensor.device.type == "cpu" and tensor.is_contiguous()):
                    raise ValueError(
                        "a parameter and its target and moments must be contiguous tensors on the CPU, "
                        f"{self._dtype} of shape {list(parameter.shape)}; got {tensor.dtype} of shape "
                        f"{list(tensor.shape)} on {tensor.device}: make the learner after moving the loss, "
                        "and load states of the same networks"
                    )
        counts = {tuple(state["step"].flatten().tolist()) for state in states}
        if len(counts) > 1:
            raise ValueError(
                f"Adam must have made the same number of steps for each parameter, got {sorted(counts)}"
            )

    @property
    def counts(self) -> list[float]:
        """Number of steps that Adam has made: for each run, or one for all."""
        return self._optimizer.state[self.parameters[0]]["step"].flatten().tolist()

    def _state(self, tensor: Tensor) -> State:
        """Returns the moments that Adam keeps of a parameter; none for running statistics."""
        return self._optimizer.state.get(tensor, {})

    def _start(self, parameter: nn.Parameter) -> State:
        """Returns the first state of a parameter, as Adam makes it at its first step."""
        if isinstance(self._optimizer, RunsAdam):
            return self._optimizer.start(parameter)
        state: State = self._optimizer.state[parameter]
        state["step"] = torch.zeros((), dtype=torch.float32)
        state["exp_avg"], state["exp_avg_sq"] = (torch.zeros_like(parameter.data) for _ in range(2))
        return state

    def _row(self, tensor: Tensor, target: Tensor | None, critic: int, critics: int) -> Sequence[Any]:
        height, width = tensor.shape[-2:] if tensor.ndim > 1 else (1, 1)
        offset, state = critic * (tensor.numel() // critics), self._state(tensor)
        tensors = (tensor, target, state.get("exp_avg"), state.get("exp_avg_sq"))
        counter = _address(state.get("step"), 0) if critic == 0 else None  # all critics of a stack share one
        return height, width, *(_address(each, offset) for each in tensors), counter


def _tensors(loss: LossModule, network: str, *, delayed: bool) -> list[tuple[Tensor, Tensor | None]]:
    """Returns a network's parameters and running statistics with their targets, layer by layer."""
    names = getattr(loss, network).state_dict()
    online = getattr(loss, f"{network}_params").flatten_keys(".")
    if not delayed:
        return [(online[name], None) for name in names]
    targets = getattr(loss, f"target_{network}_params").flatten_keys(".")
    return [(online[name], targets[name]) for name in names]


def _address(tensor: Tensor | None, offset: int) -> int | None:
    if tensor is None:
        return None
    return tensor.data_ptr() + offset * tensor.element_size()
