"""DDPG from TorchRL's loss, with clamped targets and an action L2 penalty."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import DDPGLoss

from torchrl_her.objectives.cloning import ClonesDemonstrations, Cloning, cloning_or
from torchrl_her.objectives.targets import clamped_td0


class PenalizedDDPGLoss(DDPGLoss):
    """TorchRL's DDPG loss with an action L2 penalty.

    The penalty keeps actions away from the flat ends of tanh: an actor that saturates early gets no
    gradient any more. As in OpenAI's HER, the mean square of the actions, times ``action_penalty``, is
    added to the actor's loss.

    Args:
        *args: of :class:`torchrl.objectives.DDPGLoss`.
        **kwargs: of the same.
        action_penalty: the weight of the penalty, at least 0.
    """

    def __init__(self, *args: Any, action_penalty: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.action_penalty = action_penalty

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        with action_penalty_of(self.actor_network, self.action_penalty) as penalties:
            loss, metadata = super().loss_actor(tensordict)
        return loss + (penalties[0] if loss.ndim else penalties[0].mean()), metadata


class CloningDDPGLoss(ClonesDemonstrations, PenalizedDDPGLoss):
    """The loss with behavior cloning.

    Args:
        *args: of :class:`~torchrl_her.objectives.PenalizedDDPGLoss`.
        **kwargs: of the same.
        cloning: its weight and filter.
    """

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        loss, metadata = super().loss_actor(tensordict)
        return self.with_cloning(loss, tensordict), metadata


@contextmanager
def action_penalty_of(actor: TensorDictModule, weight: float) -> Iterator[list[Tensor]]:
    """Collects the action L2 penalty [...] of each call of an actor in the ``with`` block.

    Args:
        actor: its first output is the action.
        weight: of the penalty.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = TensorDictModule(nn.Identity(), in_keys=["wish"], out_keys=["action"])
        >>> with action_penalty_of(actor, 0.5) as penalties:
        ...     _ = actor(TensorDict({"wish": torch.tensor([[1.0, 1.0], [0.0, 2.0]])}, [2]))
        >>> penalties[0].tolist()
        [0.5, 1.0]
    """
    penalties: list[Tensor] = []

    def note(_module: nn.Module, _inputs: Any, output: TensorDictBase) -> None:
        penalties.append(weight * output.get(actor.out_keys[0]).square().mean(-1))

    hook = actor.register_forward_hook(note)
    try:
        yield penalties
    finally:
        hook.remove()


def make_ddpg_loss(
    actor: TensorDictModule,
    critic: TensorDictModule,
    *,
    gamma: float = 0.98,
    reward_range: tuple[float, float] | None = (-1.0, 0.0),
    action_penalty: float = 0.0,
    reduction: Literal["mean", "none"] = "mean",
    cloning: Cloning | None = None,
) -> DDPGLoss:
    """TorchRL's DDPG loss with clamped targets, and target networks for actor and critic.

    Args:
        actor: from :func:`~torchrl_her.make_actor`.
        critic: from :func:`~torchrl_her.make_critic`.
        gamma: discount, in [0, 1).
        reward_range: least and greatest reward; targets are clamped to the returns that these allow. None to
            leave them as they are.
        action_penalty: weight of the action L2 penalty, see
            :class:`~torchrl_her.objectives.PenalizedDDPGLoss`.
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.
        cloning: adds behavior cloning on rows that are marked as demonstrations; None for none.

    Raises:
        ValueError: ``gamma`` is outside of [0, 1).

    Example:
        >>> from torchrl_her import make_actor, make_critic
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> round(loss.value_estimator.low), round(loss.value_estimator.high)
        (-50, 0)
    """
    kind, own = cloning_or(PenalizedDDPGLoss, CloningDDPGLoss, cloning)
    loss = kind(
        actor,
        critic,
        delay_actor=True,
        delay_value=True,
        action_penalty=action_penalty,
        reduction=reduction,
        **own,
    )
    estimator = clamped_td0(gamma, reward_range, loss.actor_critic)
    loss.set_keys(state_action_value=critic.out_keys[0])
    estimator.set_keys(value=critic.out_keys[0])
    loss.make_value_estimator(estimator)
    return loss
