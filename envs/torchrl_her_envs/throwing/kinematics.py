"""Forward kinematics of a planar chain of equal links. Pure functions, any batch shape."""

from __future__ import annotations

import torch
from torch import Tensor


def chain(angles: Tensor, base: Tensor, length: float) -> Tensor:
    """Positions of all joints and of the end of a chain.

    Args:
        angles: [..., n] in radians, each relative to the link before, counter-clockwise, the first
            counted from the x axis.
        base: [2], position of the first joint.
        length: total length; each link has ``length / n``.

    Returns:
        [..., n + 1, 2]: the base, the joints, the end effector last.

    Example:
        >>> import math
        >>> angles = torch.tensor([0.0, math.pi / 2])  # right, then up
        >>> chain(angles, torch.zeros(2), 2.0).round(decimals=4).tolist()
        [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]
    """
    heading = angles.cumsum(-1)
    links = torch.stack((heading.cos(), heading.sin()), -1) * (length / angles.shape[-1])
    return torch.cat((base.expand(*angles.shape[:-1], 1, 2), base + links.cumsum(-2)), -2)
