"""Windows of n steps, and the discounted sums of the rewards in them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

STEPS_KEY = "steps_to_next_obs"  # as TorchRL's MultiStep writes it, and as its losses read it


class NStepReturn(NamedTuple):
    """Return, end and last step of each transition that spans several steps.

    Attributes:
        reward: [..., 1], the discounted sum.
        last: [...] int64, the position in the window of the last step.
        terminated: [..., 1] of bool, whether the last step terminates.
    """

    reward: Tensor
    last: Tensor
    terminated: Tensor

    @property
    def steps(self) -> Tensor:
        """Number of steps, [..., 1] of int64."""
        return (self.last + 1).unsqueeze(-1)


def n_step_return(reward: Tensor, terminated: Tensor, inside: Tensor, gamma: float) -> NStepReturn:
    """Computes the discounted sum of rewards up to the first step that terminates, or to the window's end.

    ``G = r_0 + gamma r_1 + ... + gamma^(m-1) r_(m-1)``, with m the number of steps. Sutton and Barto,
    Reinforcement Learning, 2018, equation 7.1.

    Args:
        reward: [..., n, 1], the reward of each step of the window.
        terminated: [..., n, 1] of bool, whether each step terminates.
        inside: [..., n] of bool, which steps belong to the episode: the first ones, at least one.
        gamma: the discount of one step.

    Example:
        >>> reward = torch.tensor([[-1.0, -1.0, 0.0]]).unsqueeze(-1)
        >>> goal_reached = torch.tensor([[False, True, False]]).unsqueeze(-1)
        >>> out = n_step_return(reward, goal_reached, torch.ones(1, 3).bool(), gamma=0.5)
        >>> out.reward.item(), out.steps.item(), out.terminated.item()
        (-1.5, 2, True)
    """
    end = terminated.squeeze(-1)
    before = end.cumsum(-1) - end.to(torch.int64)  # number of terminations before this step
    used = inside & (before == 0)
    discount = gamma ** torch.arange(reward.shape[-2], device=reward.device, dtype=reward.dtype)
    total = (reward.squeeze(-1) * discount * used).sum(-1, keepdim=True)
    last = used.sum(-1) - 1
    return NStepReturn(total, last, end.gather(-1, last.unsqueeze(-1)))


def windows(start: Tensor, end: Tensor, n_steps: int) -> tuple[Tensor, Tensor]:
    """Returns the places of up to n steps from ``start`` on, all before ``end``.

    Args:
        start: [...] int64, the place of each window's first step.
        end: [...] int64, one more than the episode's last place; above ``start``.
        n_steps: n.

    Returns:
        ``(places, inside)``, [..., m] each; m is n, or the greatest number of steps before an ``end`` if that
        is smaller. Places beyond the episode repeat its last one.

    Example:
        >>> places, inside = windows(torch.tensor([4, 7]), torch.tensor([6, 10]), 100)
        >>> places.tolist(), inside.tolist()
        ([[4, 5, 5], [7, 8, 9]], [[True, True, False], [True, True, True]])
    """
    longest = int((end - start).max()) if start.numel() else 1
    places = start.unsqueeze(-1) + torch.arange(min(n_steps, longest), device=start.device)
    behind = end.unsqueeze(-1)
    return places.minimum(behind - 1), places < behind
