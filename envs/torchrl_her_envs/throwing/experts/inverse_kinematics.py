"""Inverse kinematics of a planar arm of two equal links. Pure functions for any batch shape."""

from __future__ import annotations

import torch
from torch import Tensor


def turn(start: Tensor, end: Tensor) -> Tensor:
    """Returns the shortest turn from one angle to another, in (-pi, pi].

    Example:
        >>> turn(torch.tensor(3.0), torch.tensor(-3.0))  # over the back, not around the front
        tensor(0.2832)
    """
    return torch.pi - (torch.pi - (end - start)) % (2 * torch.pi)


def two_link_angles(point: Tensor, base: Tensor, length: float) -> Tensor:
    """Computes the angles that bring the end of an arm to a point, or as near to it as the arm reaches.

    Args:
        point: [..., 2], where the arm should end.
        base: [2], position of the first joint.
        length: total length; each link has half of it.

    Returns:
        [..., 2, 2]: two solutions (the elbow on either side) of two angles as
        :func:`~torchrl_her_envs.throwing.kinematics.chain` takes them.

    Example:
        >>> from torchrl_her_envs.throwing.kinematics import chain
        >>> angles = two_link_angles(torch.tensor([0.6, 0.8]), torch.zeros(2), 2.0)
        >>> chain(angles, torch.zeros(2), 2.0)[:, -1]
        tensor([[0.6000, 0.8000],
                [0.6000, 0.8000]])
    """
    gap = point - base.to(point)
    # Links and the line to the point form a triangle with two equal angles, each half of the elbow's turn.
    half = (gap.norm(dim=-1) / length).clamp(max=1.0).acos()
    half = torch.stack((half, -half), -1)
    heading = torch.atan2(gap[..., 1], gap[..., 0]).unsqueeze(-1)
    return torch.stack((heading - half, 2.0 * half), -1)


def nearest_turn(joints: Tensor, point: Tensor, base: Tensor, length: float) -> Tensor:
    """Returns the turn [..., 2] of the joints to a point: the solution whose largest turn is smaller.

    Args:
        joints: [..., 2], the present angles.
        point: [..., 2], where the end of the arm should be.
        base: [2], position of the first joint.
        length: total length of the two links.

    Example:
        >>> up = torch.tensor([torch.pi / 2, 0.0])
        >>> nearest_turn(up, torch.tensor([2.0, 0.0]), torch.zeros(2), 2.0)  # a quarter, clockwise
        tensor([-1.5708,  0.0000])
    """
    turns = turn(joints.unsqueeze(-2), two_link_angles(point, base, length))
    best = turns.abs().amax(-1).argmin(-1)
    return turns.gather(-2, best[..., None, None].expand(*best.shape, 1, 2)).squeeze(-2)
