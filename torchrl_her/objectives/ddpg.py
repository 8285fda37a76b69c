"""DDPG from TorchRL's loss, with clamped targets and a cost of actions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import DDPGLoss

from torchrl_her.objectives.actor_terms import ActorTerms
from torchrl_her.objectives.targets import Targets


class PenalizedDDPGLoss(DDPGLoss):
    """TorchRL's DDPG loss with further terms in its actor's loss.

    Args:
        *args: arguments of :class:`torchrl.objectives.DDPGLoss`.
        **kwargs: keyword arguments of the same class.
        terms: terms that are added to the actor's loss.
    """

    def __init__(self, *args: Any, terms: ActorTerms = ActorTerms(), **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.terms = terms

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        with actions_of(self.actor_network) as actions:
            loss, metadata = super().loss_actor(tensordict)
        return self.terms.add_to(loss, self, actions[0], tensordict), metadata


@contextmanager
def actions_of(actor: TensorDictModule) -> Iterator[list[Tensor]]:
    """Collects the actions [..., a] that each call of an actor returns within the ``with`` block."""
    actions: list[Tensor] = []

    def note(_module: nn.Module, _inputs: Any, output: TensorDictBase) -> None:
        actions.append(output.get(actor.out_keys[0]))

    hook = actor.register_forward_hook(note)
    try:
        yield actions
    finally:
        hook.remove()


def make_ddpg_loss(
    actor: TensorDictModule,
    critic: TensorDictModule,
    *,
    targets: Targets = Targets(reward_range=(-1.0, 0.0)),
    terms: ActorTerms = ActorTerms(),
    reduction: Literal["mean", "none"] = "mean",
) -> DDPGLoss:
    """Makes TorchRL's DDPG loss with clamped targets, and target networks for actor and critic.

    Args:
        actor: actor from :func:`~torchrl_her.make_actor`.
        critic: critic from :func:`~torchrl_her.make_critic`.
        targets: discount, and the range of rewards; targets are clamped to the returns it allows.
        terms: further terms of the actor's loss.
        reduction: ``"none"`` gives one loss for each transition [R, B], as stacked networks need it.

    Example:
        >>> from torchrl_her import make_actor, make_critic
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> round(loss.value_estimator.low), round(loss.value_estimator.high)
        (-50, 0)
    """
    loss = PenalizedDDPGLoss(
        actor,
        critic,
        delay_actor=True,
        delay_value=True,
        terms=terms,
        reduction=reduction,
    )
    key = critic.out_keys[0]
    loss.set_keys(state_action_value=key)
    loss.make_value_estimator(targets.estimator(loss.actor_critic, value_key=key))
    return loss
