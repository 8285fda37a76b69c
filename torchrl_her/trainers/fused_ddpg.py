"""DDPG's gradient step without autograd: the results of TorchRL's loss in a fraction of the time.

The learner works on the weights of the loss module, its target networks and its optimizer. So these can be
saved, loaded and used as always.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS

from torchrl_her.objectives.ddpg import PenalizedDDPGLoss
from torchrl_her.trainers.compile import CompiledOnce
from torchrl_her.trainers.ddpg_functional import (
    Adam,
    Rows,
    Settings,
    Step,
    Weights,
    bias_corrections,
    ddpg_gradients,
    ddpg_update_,
)
from torchrl_her.trainers.fusing import is_plain_adam, why_not_fused
from torchrl_her.trainers.learner import check_steps
from torchrl_her.trainers.runs import keep_runs


class FusedDDPGLearner:
    """A :class:`~torchrl_her.trainers.Learner` for :class:`~torchrl_her.objectives.PenalizedDDPGLoss`.

    Args:
        loss: with :class:`~torchrl_her.modules.ActorNet` and :class:`~torchrl_her.modules.CriticNet` without
            batch normalization, as :func:`~torchrl_her.make_ddpg_loss` makes it.
        optimizer: over the loss module's parameters; must be elementwise, as Adam is, if there are several
            runs.
        target: of the loss.
        max_grad_norm: to which the gradients of each network of each run are clipped separately.
        compile_step: whether to compile the whole step (losses, gradients, clipping, a plain Adam and the
            soft update) into one program, at the first batch of each shape; see
            :class:`~torchrl_her.trainers.CompiledOnce`.

    The learner keeps references to the weights' memory: make it after moving the loss to its device and type.
    Entries of the rows are cast to that type, so rewards may be float64 beside networks in float32. Rows that
    span several steps (``steps_to_next_obs``, see :class:`~torchrl_her.objectives.ClampedTD0`) have a program
    of their own.

    Attributes:
        before_compiling: called before a step is compiled, which takes half a minute the first time.

    Raises:
        ValueError: the loss or its targets are set to what the fused step does not do, see
            :func:`~torchrl_her.trainers.can_fuse`: use :class:`~torchrl_her.LossLearner`; or the optimizer is
            not one that can be compiled.

    Example:
        >>> from torchrl_her import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> learner = FusedDDPGLearner(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.01))
    """

    def __init__(
        self,
        loss: PenalizedDDPGLoss,
        optimizer: torch.optim.Optimizer,
        target: SoftUpdate,
        *,
        max_grad_norm: float = 3.0,
        compile_step: bool = False,
    ) -> None:
        self.loss, self.optimizer, self.compile_step = loss, optimizer, compile_step
        self.target, self.max_grad_norm = target, max_grad_norm
        reason = why_not_fused(loss, target)
        if reason is not None:
            raise ValueError(
                "only DDPG with the networks of make_actor and make_critic can be fused, and not with "
                f"{reason}: use LossLearner"
            )
        if compile_step:
            self._check_adam(loss)
        self.runs: int = loss.actor_network.module.runs
        self.before_compiling: Callable[[], None] | None = None
        self._compiled: dict[tuple, CompiledOnce] = {}  # by all that a compiled form holds fixed
        self._keys = list(loss.actor_network.in_keys)
        self._next_keys = [("next", key) for key in self._keys]
        self._action_key = loss.actor_network.out_keys[0]
        actor, critic = loss.actor_network.module, loss.value_network.module
        self._parameters = [
            *_parameters(actor, loss.actor_network_params),
            *_parameters(critic, loss.value_network_params),
        ]
        targets = [
            *_parameters(actor, loss.target_actor_network_params),
            *_parameters(critic, loss.target_value_network_params),
        ]
        self._dtype = self._parameters[0].dtype
        self._weights = Weights([p.data for p in self._parameters], [p.data for p in targets])
        self._actor_layers = len(list(actor.parameters())) // 2
        self._networks = self._weights.networks(self._actor_layers)
        self._gamma = 0.0
        self._gamma_version: object = None
        self._settings = self._read_settings()

    @property
    def tau(self) -> float:
        """The share of the online weights in a soft update."""
        return 1.0 - float(self.target.eps)

    @tau.setter
    def tau(self, tau: float) -> None:
        self.target.eps = 1.0 - tau

    @property
    def is_compiled(self) -> bool:
        """Whether a compiled form has been used."""
        return any(form.compiled for form in self._compiled.values())

    @property
    def compile_seconds(self) -> float:
        """Seconds that compiling has taken so far."""
        return sum(form.seconds for form in self._compiled.values())

    @torch.no_grad()
    def update(self, rows: TensorDictBase, steps: int = 1, *, idle: Sequence[int] = ()) -> dict[str, Tensor]:
        """Gradient steps of each run; see :class:`~torchrl_her.trainers.Learner`.

        Raises:
            ValueError: the rows carry a mask of TorchRL's losses, or the loss or its optimizer were changed
                to what this learner cannot do.
        """
        self._check(rows)
        self._settings = self._read_settings()
        with keep_runs(self.loss, self.optimizer, idle, runs=self.runs):
            done = [self._step(part) for part in self._parts(rows, steps)]
        squares = torch.cat([step.squares for step in done], 1)
        rows.set(self.loss.tensor_keys.priority, squares.view(rows.batch_size))
        return {
            "loss_actor": torch.stack([step.loss_actor for step in done]),
            "loss_value": torch.stack([step.loss_value for step in done]),
        }

    def _check(self, rows: TensorDictBase) -> None:
        """What may change after the learner was made."""
        if self.loss.reduction not in ("mean", "none"):
            raise ValueError(f"reduction={self.loss.reduction!r} cannot be fused: use LossLearner")
        if not all(parameter.requires_grad for parameter in self._parameters):
            raise ValueError("parameters were frozen, but a fused step trains all of them: use LossLearner")
        own = self.loss.loss_mask_key
        for key in AUTO_LOSS_MASK_KEYS if own == "auto" else () if own is None else (own,):
            if rows.get(key, None) is not None:
                raise ValueError(
                    f"a fused step learns from all rows, but {key!r} masks some: use LossLearner, or set "
                    "loss.loss_mask_key = None"
                )
        if self.compile_step:
            self._check_adam(None)

    def _check_adam(self, loss: PenalizedDDPGLoss | None) -> None:
        if not is_plain_adam(self.optimizer, loss):
            raise ValueError(
                "only a plain torch.optim.Adam can be compiled, with one group of exactly the loss's "
                f"parameters and without hooks, got {self.optimizer}"
            )

    def _read_settings(self) -> Settings:
        """The numbers of the loss, read anew for each update since they may be scheduled."""
        estimator = self.loss.value_estimator
        gamma = estimator.gamma
        version = (id(gamma), gamma._version) if isinstance(gamma, Tensor) else gamma
        if version != self._gamma_version:  # reading a number from a device waits for it
            self._gamma, self._gamma_version = float(gamma), version
        return Settings(
            gamma=self._gamma,
            low=estimator.low,
            high=estimator.high,
            action_penalty=self.loss.action_penalty,
            max_grad_norm=self.max_grad_norm,
        )

    def _step(self, rows: Rows) -> Step:
        if self.compile_step:
            return self._compiled_step(rows)
        step = ddpg_gradients(self._networks, rows, self._settings)
        for parameter, gradient in zip(self._parameters, step.actor + step.critic, strict=True):
            parameter.grad = gradient
        self.optimizer.step()
        torch._foreach_lerp_(self._weights.targets, self._weights.values, self.tau)
        return step

    def _compiled_step(self, rows: Rows) -> Step:
        adam = self._adam()
        action = rows.action
        form = (
            action.shape,
            action.dtype,
            action.device,
            rows.weight is None,
            rows.discount is None,
            adam.betas,
            adam.eps,
            self.tau,
            self._settings,
        )
        if form not in self._compiled:
            if self.before_compiling is not None:
                self.before_compiling()
            settings, layers, tau = self._settings, self._actor_layers, self.tau

            def ddpg_step(weights: Weights, adam: Adam, rows: Rows) -> Step:
                return ddpg_update_(weights, adam, rows, settings, actor_layers=layers, tau=tau)

            self._compiled[form] = CompiledOnce(ddpg_step)
        return self._compiled[form](self._weights, adam, rows)

    def _adam(self) -> Adam:
        """The optimizer's own state, read anew for each step since loading a checkpoint replaces it."""
        states = [self.optimizer.state[parameter] or self._start(parameter) for parameter in self._parameters]
        (group,) = self.optimizer.param_groups
        count = float(states[0]["step"]) + 1.0
        size, spread = bias_corrections(count, float(group["lr"]), group["betas"])
        # As its step() would: schedulers of learning rates ask for it.
        self.optimizer._opt_called = True  # type: ignore[attr-defined]
        number = self._weights.values[0].new_tensor
        return Adam(
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [state["step"] for state in states],
            number(size),
            number(spread),
            group["betas"],
            group["eps"],
        )

    def _start(self, parameter: nn.Parameter) -> dict[str, Tensor]:
        """Adam's first state for a parameter, which Adam itself would make at its first step."""
        state = self.optimizer.state[parameter]
        state["step"] = torch.zeros(())
        state["exp_avg"], state["exp_avg_sq"] = (torch.zeros_like(parameter.data) for _ in range(2))
        return state

    def _parts(self, rows: TensorDictBase, steps: int) -> list[Rows]:
        """The rows of each step."""
        check_steps(rows, steps)
        entries = self._rows(rows)
        size = entries.action.shape[1] // steps
        split = [[None] * steps if entry is None else entry.split(size, 1) for entry in entries]
        # A compiled form needs rows with the strides that it was compiled for.
        parts = [[entry if entry is None else entry.contiguous() for entry in own] for own in split]
        return [Rows(*own) for own in zip(*parts, strict=True)]

    def _rows(self, batch: TensorDictBase) -> Rows:
        terminated = batch.get(("next", "terminated"), None)
        if terminated is None:  # as TorchRL's targets
            terminated = batch.get(("next", "done"))
        return Rows(
            self._joined(batch, self._keys),
            self._joined(batch, [self._action_key]),
            self._joined(batch, self._next_keys),
            self._joined(batch, [("next", "reward")]),
            self._blocks(terminated),
            self._importance(batch),
            self._discount(batch),
        )

    def _importance(self, batch: TensorDictBase) -> Tensor | None:
        """Importance weights, if there are any and the loss uses them."""
        if self.loss.use_prioritized_weights not in (True, "auto"):
            return None
        weight = batch.get("priority_weight", None)
        return None if weight is None else self._blocks(weight.unsqueeze(-1)).to(self._dtype)

    def _discount(self, batch: TensorDictBase) -> Tensor | None:
        """What the next state's value is multiplied by, if rows say how many steps they span."""
        estimator = self.loss.value_estimator
        steps = batch.get(estimator.tensor_keys.steps_to_next_obs, None)
        if steps is None:
            return None
        # not in the compiled step, and with the loss's own tensor: so powers are rounded as TorchRL's are
        discount = estimator.gamma.to(steps.device) ** steps
        return discount.reshape(self.runs, -1, 1).to(self._dtype)

    def _joined(self, batch: TensorDictBase, keys: list) -> Tensor:
        """Entries, joined: [R, B, width], in the type of the weights."""
        values = [batch.get(key) for key in keys]
        joined = torch.cat(values, -1) if len(values) > 1 else values[0]
        return self._blocks(joined).to(self._dtype)

    def _blocks(self, entry: Tensor) -> Tensor:
        """[..., width] to [R, B, width]."""
        return entry.reshape(self.runs, -1, entry.shape[-1])


def _parameters(net: nn.Module, weights: TensorDictBase) -> list[nn.Parameter]:
    """A network's parameters in a loss module, in order: weight, bias, weight, ..."""
    flat = weights["module"].flatten_keys(".")
    return [flat[name] for name, _ in net.named_parameters()]
