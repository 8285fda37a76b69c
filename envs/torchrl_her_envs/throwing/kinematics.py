"""Forward kinematics of a planar chain of equal links. Pure functions, any batch shape."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from torchrl_her_envs.throwing.arrays import Array, functions_of


def walk(angles: Sequence[Any], base: Sequence[Any], link: float) -> Iterator[tuple[Any, Any]]:
    """Yields the end of each link in turn.

    Args:
        angles: n numbers, arrays or tensors in radians, each relative to the link before,
            counter-clockwise, the first counted from the x axis.
        base: x and y of the first joint.
        link: length of a link.

    Yields:
        x and y of the end of each of the n links.

    Example:
        >>> import math
        >>> [(round(x, 4), round(y, 4)) for x, y in walk([0.0, math.pi / 2], (0.0, 0.0), 1.0)]
        [(1.0, 0.0), (1.0, 1.0)]
    """
    x, y = base
    heading: Any = 0.0
    xp = functions_of(angles[0])
    for angle in angles:
        heading = heading + angle
        x, y = x + xp.cos(heading) * link, y + xp.sin(heading) * link
        yield x, y


def chain(angles: Array, base: Array, length: float) -> Array:
    """Computes the positions of all joints and of the end of a chain.

    Args:
        angles: [..., n] in radians, see :func:`walk`.
        base: [2], position of the first joint.
        length: total length; each link has ``length / n``.

    Returns:
        [..., n + 1, 2]: the base, the joints, the end effector last.

    Example:
        >>> import math
        >>> import torch
        >>> angles = torch.tensor([0.0, math.pi / 2])  # right, then up
        >>> chain(angles, torch.zeros(2), 2.0).round(decimals=4).tolist()
        [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]
    """
    xp, parts = functions_of(angles), _parts(angles)
    ends: list[Array] = [xp.stack(end, -1) for end in walk(parts, _parts(base), length / len(parts))]
    return xp.stack([xp.broadcast_to(base, ends[0].shape), *ends], -2)


def chain_end(angles: Array, base: Array, length: float) -> Array:
    """Computes the position [..., 2] of the end of a chain alone; see :func:`chain`.

    Example:
        >>> import math
        >>> import torch
        >>> chain_end(torch.tensor([0.0, math.pi / 2]), torch.zeros(2), 2.0).round(decimals=4).tolist()
        [1.0, 1.0]
    """
    parts = _parts(angles)
    *_, end = walk(parts, _parts(base), length / len(parts))
    return functions_of(angles).stack(end, -1)


def _parts(values: Array) -> list[Array]:
    """Returns the entries [...] of values [..., n], one by one."""
    return [values[..., k] for k in range(values.shape[-1])]
