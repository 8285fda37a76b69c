"""Clamped targets, and updates of target networks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.objectives.value import TD0Estimator

from torchrl_her.checks import check_whole


class ClampedTD0(TD0Estimator):
    """Targets of one or several steps, clamped to the values that are possible.

    With rewards in [-1, 0], for example, no value is below -1 / (1 - gamma) or above 0. Andrychowicz et al.,
    Hindsight Experience Replay, 2017, appendix A.

    A row may span several steps: its reward is then the discounted sum of the steps' rewards, its ``next`` is
    that of the last step, and its entry ``steps_to_next_obs`` [B, 1], int64, is the number of steps. The
    value of the next state is discounted by ``gamma ** steps_to_next_obs``. Without it, a row is one step.
    The bounds are the same in both cases, since a state's value does not depend on how it is estimated.

    Args:
        low: least target.
        high: greatest target.
        **kwargs: keyword arguments of :class:`torchrl.objectives.value.TD0Estimator`.
    """

    def __init__(self, *, low: float, high: float, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.low, self.high = low, high

    def value_estimate(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> Tensor:
        """Returns the clamped targets."""
        return super().value_estimate(tensordict, *args, **kwargs).clamp(self.low, self.high)


@dataclass(frozen=True, kw_only=True)
class Targets:
    """Targets of a loss: their discount, and the rewards that bound them.

    Args:
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to the returns that these allow. None to
            leave targets as they are.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1).

    Example:
        >>> estimator = Targets(gamma=0.98, reward_range=(-1.0, 0.0)).estimator()
        >>> round(estimator.low), round(estimator.high)
        (-50, 0)
    """

    gamma: float = 0.98
    reward_range: tuple[float, float] | None

    def __post_init__(self) -> None:
        if not 0.0 <= self.gamma < 1.0:
            raise ValueError(f"gamma must be in [0, 1), got {self.gamma}")

    def estimator(
        self, value_network: TensorDictModule | None = None, *, value_key: NestedKey = "state_action_value"
    ) -> ClampedTD0:
        """Makes an estimator of these targets for ``loss.make_value_estimator`` of any loss of TorchRL.

        Args:
            value_network: module that computes the next state's value; None if the loss passes the value.
            value_key: key of the value.
        """
        least, greatest = self.reward_range or (-math.inf, math.inf)
        estimator = ClampedTD0(
            low=min(least, least / (1.0 - self.gamma)),  # least return: of one step, or of infinitely many
            high=max(greatest, greatest / (1.0 - self.gamma)),
            gamma=self.gamma,
            value_network=value_network,
        )
        estimator.set_keys(value=value_key)
        return estimator


class _BuffersToo(TargetNetUpdater):
    """Updates the buffers of target networks, too; TorchRL's updates move only their weights."""

    @cached_property
    def _buffers(self) -> dict[str, list[Any]]:
        """Returns the keys of the buffers of each online network that has some, by its name."""
        found = {
            name: [
                key
                for key, entry in getattr(self.loss_module, name).items(True, True)
                if not entry.requires_grad and entry.is_floating_point()  # others count, as batches
            ]
            for name in self._source_names
        }
        return {name: keys for name, keys in found.items() if keys}

    def step(self) -> None:
        super().step()
        for name, buffers in self._buffers.items():
            source, target = (getattr(self.loss_module, attribute) for attribute in (name, f"target_{name}"))
            self._step(source.select(*buffers), target.select(*buffers))


class BuffersSoftUpdate(SoftUpdate, _BuffersToo):
    """A soft update of weights and buffers, which batch normalization needs.

    Args:
        loss_module: Loss with target networks.

    Keyword Args:
        tau: Share of the online networks in each step.
    """


class RunsHardUpdate(HardUpdate, _BuffersToo):
    """Copies the online weights of each of R runs to its target networks, every n steps of the run.

    Args:
        loss: loss with stacked networks.

    Keyword Args:
        interval: gradient steps between two copies.
        runs: R, the number of independent runs.

    Attributes:
        counts: gradient steps of each run.
        idle: runs that make no gradient step at present.
    """

    def __init__(self, loss: LossModule, *, interval: int, runs: int) -> None:
        super().__init__(loss, value_network_update_interval=interval - 1)
        self.interval, self.counts = interval, [0] * runs
        self.idle: Sequence[int] = ()
        self._due: list[int] = []

    def step(self) -> None:
        """Counts a gradient step of each run that is not idle, and copies the weights that are due."""
        learning = [run for run in range(len(self.counts)) if run not in self.idle]
        for run in learning:
            self.counts[run] += 1
        self._due = [run for run in learning if self.counts[run] % self.interval == 0]
        if self._due:
            _BuffersToo.step(self)

    def _step(self, p_source: TensorDictBase, p_target: TensorDictBase) -> None:
        dim, runs = p_target.ndim, len(self.counts)  # a stack of N critics is [N, R, ...]
        if runs == 1:  # numbers of a single run's networks may have no dimension
            p_target.data.copy_(p_source.data)
            return
        for key, target in p_target.items(True, True):
            source, delayed = (
                each.data.unflatten(dim, (runs, -1)).movedim(dim, 0) for each in (p_source.get(key), target)
            )
            delayed[self._due] = source[self._due]

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "counts": list(self.counts)}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self.counts = list(state_dict["counts"])


def make_target_updater(
    loss: LossModule, *, tau: float, hard_interval: int, runs: int = 1
) -> TargetNetUpdater:
    """Makes the update of a loss's target networks and of their running statistics.

    Args:
        loss: loss with target networks.

    Keyword Args:
        tau: share of the online weights in a soft update, which follows each step if ``hard_interval`` is 0.
        hard_interval: number of steps after which the online weights are copied; 0 for soft updates.
        runs: number of independent runs in the loss; each has its own count of steps.

    Raises:
        ValueError: ``hard_interval`` or ``runs`` is not whole or too small, or ``tau`` is outside of (0, 1]
            in soft updates.

    Example:
        >>> from torchrl_her import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> isinstance(make_target_updater(loss, tau=0.01, hard_interval=0), SoftUpdate)
        True
    """
    check_whole(hard_interval=hard_interval, least=0)
    check_whole(runs=runs)
    if hard_interval > 0:
        return RunsHardUpdate(loss, interval=hard_interval, runs=runs)
    if not 0.0 < tau <= 1.0:
        raise ValueError(f"tau must be in (0, 1] in soft updates, got {tau}")
    return BuffersSoftUpdate(loss, tau=tau)
