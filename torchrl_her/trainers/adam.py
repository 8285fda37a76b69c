"""Adam for the stacked weights of several runs, each with its own count of steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_her.trainers.runs import run_dims


class RunsAdam(torch.optim.Adam):
    """Adam for the stacked networks of R independent runs, each of which counts its own steps.

    Adam's bias corrections depend on the number of steps. A run that was idle while others learned has made
    fewer steps, so with one count for all runs it would not learn as it does alone. Each parameter's
    ``step`` is therefore a tensor [1, R, 1, ...] that is broadcast against it; a learner leaves the states
    of idle runs as they were (see :func:`~torchrl_her.trainers.keep_runs`).

    Kingma and Ba, Adam: A method for stochastic optimization, 2015.

    Args:
        loss: a loss module with stacked networks; all of its parameters are trained.
        lr: learning rate.
        betas, eps: parameters of Adam.

    Keyword Args:
        runs: R, the number of independent runs.

    Example:
        >>> loss = nn.Linear(1, 2, bias=False)  # as if of two runs
        >>> optimizer = RunsAdam(loss, lr=0.1, runs=2)
        >>> loss(torch.ones(1, 1)).sum().backward()
        >>> optimizer.step()
        >>> optimizer.state[loss.weight]["step"].flatten().tolist()
        [1.0, 1.0]
    """

    def __init__(
        self,
        loss: nn.Module,
        lr: float = 1e-3,
        *,
        runs: int,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        dims = run_dims(loss)
        self._dims = {id(parameter): dims.get(name, 0) for name, parameter in loss.named_parameters()}
        self.runs = runs
        super().__init__(loss.parameters(), lr=lr, betas=betas, eps=eps)

    def start(self, parameter: nn.Parameter) -> dict[str, Tensor]:
        """Initializes the state of a parameter before its first step."""
        dim = self._dims[id(parameter)]
        shape = [size if i == dim else 1 for i, size in enumerate(parameter.shape)]
        state: dict[str, Tensor] = self.state[parameter]
        state["step"] = torch.zeros(shape, dtype=torch.float32, device=parameter.device)
        state["exp_avg"], state["exp_avg_sq"] = (torch.zeros_like(parameter.data) for _ in range(2))
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state that ``state_dict`` returned; unlike torch's, also moves counts of steps."""
        super().load_state_dict(state_dict)
        for parameter, state in self.state.items():
            state["step"] = state["step"].to(parameter.device)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """Makes one step for each run, with its own bias corrections."""
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            states = [self.state[parameter] or self.start(parameter) for parameter in parameters]
            gradients = [parameter.grad for parameter in parameters]
            first, second = ([entries[name] for entries in states] for name in ("exp_avg", "exp_avg_sq"))
            beta1, beta2 = group["betas"]
            torch._foreach_lerp_(first, gradients, 1 - beta1)
            torch._foreach_mul_(second, beta2)
            torch._foreach_addcmul_(second, gradients, gradients, 1 - beta2)
            for parameter, state, m, v in zip(parameters, states, first, second, strict=True):
                state["step"] += 1
                count = state["step"].double()
                size = (group["lr"] / (1 - beta1**count)).to(parameter.dtype)
                spread = (1 - beta2**count).sqrt().to(parameter.dtype)
                parameter.sub_(size * m / (v.sqrt() / spread + group["eps"]))
