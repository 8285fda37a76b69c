"""DDPG from TorchRL's loss, with clamped targets; and the learner that applies any TorchRL loss."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import DDPGLoss, HardUpdate, LossModule, SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.objectives.value import TD0Estimator

from torchrl_her.ddpg_step import norms_of_runs

_WEIGHT = "priority_weight"  # of importance sampling, as TorchRL's samplers and losses call it


class ClampedTD0(TD0Estimator):
    """One-step targets, kept within the values that are possible.

    With rewards in [-1, 0] no value is below -1 / (1 - gamma) or above 0. Andrychowicz et al.,
    Hindsight Experience Replay, 2017, appendix A.

    Args:
        low: least target.
        high: greatest target.
        **kwargs: of :class:`torchrl.objectives.value.TD0Estimator`.
    """

    def __init__(self, *, low: float, high: float, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.low, self.high = low, high

    def value_estimate(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> Tensor:
        """The targets, clamped."""
        return super().value_estimate(tensordict, *args, **kwargs).clamp(self.low, self.high)


def clamped_td0(
    gamma: float, reward_range: tuple[float, float], value_network: TensorDictModule | None = None
) -> ClampedTD0:
    """One-step targets within what rewards of a range allow; for ``loss.make_value_estimator``.

    Args:
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward.
        value_network: gives the value of the next state; None for a loss that brings it along.

    Raises:
        ValueError: a discount outside of [0, 1).
    """
    if not 0.0 <= gamma < 1.0:
        raise ValueError(f"gamma must be in [0, 1), got {gamma}")
    least, greatest = reward_range
    return ClampedTD0(
        low=min(least, least / (1.0 - gamma)),  # paid once, if the episode ends there, or for ever
        high=max(greatest, greatest / (1.0 - gamma)),
        gamma=gamma,
        value_network=value_network,
    )


class PenalisedDDPGLoss(DDPGLoss):
    """TorchRL's DDPG loss with a price on large actions, which keeps tanh off its flat ends.

    An actor that saturates early gets no gradient any more. The price is that of OpenAI's HER:
    the mean square of the actions, times ``action_penalty``, is added to the actor's loss.

    Args:
        *args: of :class:`torchrl.objectives.DDPGLoss`.
        **kwargs: of the same.
        action_penalty: at least 0.
    """

    def __init__(self, *args: Any, action_penalty: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.action_penalty = action_penalty

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        actions: list[Tensor] = []
        hook = self.actor_network.register_forward_hook(
            lambda _module, _inputs, output: actions.append(output.get(self.actor_network.out_keys[0]))
        )
        loss, metadata = super().loss_actor(tensordict)
        hook.remove()
        price = self.action_penalty * actions[0].square().mean(-1)
        return loss + (price if loss.ndim else price.mean()), metadata


def make_ddpg_loss(
    actor: TensorDictModule,
    critic: TensorDictModule,
    *,
    gamma: float = 0.98,
    reward_range: tuple[float, float] = (-1.0, 0.0),
    action_penalty: float = 0.0,
    reduction: Literal["mean", "none"] = "mean",
) -> DDPGLoss:
    """TorchRL's DDPG loss with target networks for both and clamped targets.

    Args:
        actor: from :func:`~torchrl_her.make_actor`.
        critic: from :func:`~torchrl_her.make_critic`.
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to what these allow.
        action_penalty: see :class:`PenalisedDDPGLoss`.
        reduction: ``"none"`` keeps the losses of rows [R, B] apart, for stacked networks.

    Raises:
        ValueError: a discount outside of [0, 1).

    Example:
        >>> from torchrl_her import make_actor, make_critic
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> round(loss.value_estimator.low), round(loss.value_estimator.high)
        (-50, 0)
    """
    loss = PenalisedDDPGLoss(
        actor, critic, delay_actor=True, delay_value=True, action_penalty=action_penalty, reduction=reduction
    )
    estimator = clamped_td0(gamma, reward_range, loss.actor_critic)
    loss.set_keys(state_action_value=critic.out_keys[0])
    estimator.set_keys(value=critic.out_keys[0])
    loss.make_value_estimator(estimator)
    return loss


def make_target_updater(loss: LossModule, *, tau: float, hard_interval: int) -> TargetNetUpdater:
    """A soft update with rate ``tau`` after each step, or with ``hard_interval > 0`` a copy every so many."""
    if hard_interval > 0:
        # TorchRL counts that many steps without a copy before each step with one
        return HardUpdate(loss, value_network_update_interval=hard_interval - 1)
    return SoftUpdate(loss, tau=tau)


class Learner(Protocol):
    """What the training loop asks of an algorithm: gradient steps of each run."""

    def update(self, rows: TensorDictBase, steps: int = 1, *, idle: Sequence[int] = ()) -> dict[str, Tensor]:
        """Learns from rows and writes their priorities into them.

        Args:
            rows: [R, S * B] of R runs; step s takes the rows [:, s * B : (s + 1) * B].
            steps: S.
            idle: runs that stay as they are, whatever their rows.

        Returns:
            What it measured, [S, R] each.
        """
        ...


def check_steps(rows: TensorDictBase, steps: int) -> None:
    """Raises a ValueError if rows [R, n] are no whole number of batches."""
    if steps < 1 or rows.shape[-1] % steps:
        raise ValueError(f"{rows.shape[-1]} rows cannot be shared out among {steps} gradient steps")


class LossLearner:
    """Gradient steps on any TorchRL loss module: backward, clipping, optimiser, target update.

    Several independent runs are learnt at once if the networks are stacked and the loss keeps them
    apart (``reduction="none"``): the sum over runs of each run's mean loss gives each run the
    gradient that it would have alone.

    Args:
        loss: its outputs that begin with ``loss`` are summed; each of them must reach networks of its own.
        optimiser: over the loss module's parameters; must treat each number by itself, as Adam does.
        target: moves the target networks; None for a loss without them.
        max_grad_norm: the gradients of each network of each run are clipped to this norm, apart.
        runs: R.

    Example:
        >>> from torchrl_her import make_actor, make_critic
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> learner = LossLearner(loss, torch.optim.Adam(loss.parameters()), SoftUpdate(loss, tau=0.01))
    """

    def __init__(
        self,
        loss: LossModule,
        optimiser: torch.optim.Optimizer,
        target: TargetNetUpdater | None = None,
        *,
        max_grad_norm: float = 3.0,
        runs: int = 1,
    ) -> None:
        self.loss, self.optimiser, self.target = loss, optimiser, target
        self.max_grad_norm, self.runs = max_grad_norm, runs
        self._networks = self._find_networks()

    def update(self, rows: TensorDictBase, steps: int = 1, *, idle: Sequence[int] = ()) -> dict[str, Tensor]:
        """Gradient steps of each run; see :class:`Learner`."""
        last = rows.ndim - 1
        check_steps(rows, steps)
        parts = rows.split(rows.shape[last] // steps, last)
        with keep_runs(self.loss, self.optimiser, idle, runs=self.runs):
            measured = [self._update(part) for part in parts]
        key = getattr(self.loss.tensor_keys, "priority", None)
        priorities = [] if key is None else [part.get(key, None) for part in parts]
        if priorities and priorities[0] is not None:
            rows.set(key, torch.cat(priorities, last))
        return {key: torch.stack([step[key] for step in measured]) for key in measured[0]}

    def _update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        weight = batch.get(_WEIGHT, None)
        if weight is not None:
            # TorchRL divides by the sum of the weights if it averages, but not if it keeps rows apart.
            by_run = weight.reshape(self.runs, -1)
            batch.set(_WEIGHT, (by_run / by_run.mean(1, keepdim=True)).view_as(weight))
        output = self.loss(batch)
        losses = {
            key: value.reshape(self.runs, -1).mean(1)
            for key, value in output.items()
            if key.startswith("loss")
        }
        self.optimiser.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        for parameters in self._networks:
            self._clip(parameters)
        self.optimiser.step()
        if self.target is not None:
            self.target.step()
        return {key: value.detach() for key, value in losses.items()}

    def _clip(self, parameters: list[nn.Parameter]) -> None:
        if self.runs == 1:
            nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        else:
            clip_by_run(parameters, self.max_grad_norm, runs=self.runs)

    def _find_networks(self) -> list[list[nn.Parameter]]:
        """The parameters of each network: the loss module's children that have any."""
        groups: dict[str, list[nn.Parameter]] = {}
        for name, parameter in self.loss.named_parameters():
            groups.setdefault(name.split(".")[0], []).append(parameter)
        return list(groups.values())


@contextmanager
def keep_runs(
    loss: nn.Module, optimiser: torch.optim.Optimizer, kept: Sequence[int], *, runs: int
) -> Iterator[None]:
    """Puts back what some runs of a stacked loss and its optimiser were, when the block ends.

    What numbers of all runs have in common, as Adam's count of steps, goes on.

    Args:
        loss: each of its entries is R equal blocks, run after run.
        optimiser: over its parameters.
        kept: the runs.
        runs: R.

    Example:
        >>> weight = nn.Linear(1, 2, bias=False)  # as if of two runs
        >>> with keep_runs(weight, torch.optim.Adam(weight.parameters()), [1], runs=2):
        ...     _ = nn.init.zeros_(weight.weight)
        >>> (weight.weight == 0).flatten().tolist()
        [True, False]
    """
    if not kept:
        yield
        return
    before = {block.data_ptr(): block[list(kept)].clone() for block in _blocks(loss, optimiser, runs)}
    try:
        yield
    finally:
        with torch.no_grad():
            for block in _blocks(loss, optimiser, runs):
                # an optimiser begins with zeros, which it makes at its first step
                block[list(kept)] = before.get(block.data_ptr(), 0.0)


def _blocks(loss: nn.Module, optimiser: torch.optim.Optimizer, runs: int) -> list[Tensor]:
    """All numbers that belong to one of R runs, as [R, ...] each."""
    moments = [entry for state in optimiser.state.values() for entry in state.values()]
    entries = [*loss.state_dict().values(), *moments]
    return [entry.view(runs, -1) for entry in entries if entry.ndim > 0 and entry.numel() % runs == 0]


@torch.no_grad()
def clip_by_run(parameters: Sequence[nn.Parameter], max_norm: float, *, runs: int) -> Tensor:
    """Clips the gradient of each run to a norm of its own.

    Args:
        parameters: of one stacked network; each is R equal blocks, run after run.
        max_norm: greatest norm of a run's gradient.
        runs: R.

    Returns:
        [R], the norms before.

    Example:
        >>> weight = nn.Parameter(torch.zeros(2, 1, 1))
        >>> weight.grad = torch.tensor([[[6.0]], [[2.0]]])
        >>> clip_by_run([weight], 3.0, runs=2).tolist()
        [6.0, 2.0]
        >>> weight.grad.flatten().round(decimals=4).tolist()
        [3.0, 2.0]
    """
    blocks = [parameter.grad.view(runs, -1) for parameter in parameters if parameter.grad is not None]
    norms, scale = norms_of_runs(blocks, max_norm)
    for block in blocks:
        block.mul_(scale.unsqueeze(1))
    return norms
