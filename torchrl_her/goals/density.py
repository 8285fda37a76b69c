"""Logarithms of densities of goals in any number of dimensions, estimated from samples.

In 30 dimensions densities span hundreds of orders of magnitude, too many for floating-point numbers.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_her.goals.grid import Numbers

_CHUNK = 1 << 20  # number of distances that are computed at once: 8 MiB of float64
_LEAST_SCALE = 0.01  # least scale of a dimension, as a fraction of the widest one's
_FARTHEST = 1e140  # coordinates, in sigmas, beyond which squares of float64 would overflow


def goal_scale(samples: Tensor) -> Tensor:
    """Returns the standard deviations [g] of samples [n, g], to scale goals of different units.

    Deviations are at least a hundredth of the greatest one, since otherwise a coordinate that hardly varies
    would make all goals rare. All are 1 if nothing varies.

    Example:
        >>> goal_scale(torch.tensor([[0.0, 5.0], [4.0, 5.0]])).tolist()
        [2.0, 0.019999999552965164]
    """
    scale = samples.std(0, correction=0)
    widest = float(scale.max())
    return scale.clamp_min(_LEAST_SCALE * widest) if widest > 0 else torch.ones_like(scale)


def log_kernel_density(points: Tensor, samples: Tensor, sigma: Numbers) -> Tensor:
    """Returns the logarithm of a kernel density: the mean of normal densities around the samples.

    Parzen, On estimation of a probability density function and mode, 1962; here with a Gaussian product
    kernel in g dimensions, normalized.

    Args:
        points: [..., g], where to compute the density.
        samples: [n, g] goals of the distribution, n at least 1.
        sigma: standard deviation of the kernel, in the unit of the goals; one number, or one for each
            dimension.

    Returns:
        [...] of float64: finite, however far a point is away; NaN where a point has NaN or infinity.

    Raises:
        ValueError: shapes do not match, samples are not finite, or sigma is not positive and finite.

    Example:
        >>> log_kernel_density(torch.tensor([[0.0], [2.0]]), torch.tensor([[0.0]]), 2.0).exp()
        tensor([0.1995, 0.1210], dtype=torch.float64)
    """
    flat, known = _checked(points, samples)
    scale = _scale(sigma, known)
    center = known.mean(0)  # subtracted, since sums of squares lose the fewest digits near 0
    # Goals are clamped, since squares could overflow to infinity; NaN and infinity are marked below.
    flat = ((flat - center) / scale).clamp_(-_FARTHEST, _FARTHEST)
    known = ((known - center) / scale).clamp_(-_FARTHEST, _FARTHEST)
    parts = [_log_sum(part, known) for part in flat.split(max(1, _CHUNK // len(known)))]
    n, g = known.shape
    constant = math.log(n) + g * 0.5 * math.log(2 * math.pi) + float(scale.log().sum())
    return _marked(torch.cat(parts).view(points.shape[:-1]) - constant, points)


def log_neighbor_density(points: Tensor, samples: Tensor, k: int, *, least_distance: float = 1e-6) -> Tensor:
    """Returns the log of a nearest-neighbor density: k / n over the volume up to the k-th nearest sample.

    Loftsgaarden and Quesenberry, A nonparametric estimate of a multivariate density function, 1965. The ball
    grows where samples are few, so this estimate needs no width and remains of use in many dimensions.

    Args:
        points: [..., g], where to compute the density. A point that is itself a sample is its own neighbor.
        samples: [n, g] goals of the distribution.
        k: from 1 to n; the distance to the k-th nearest sample gives the density.

    Keyword Args:
        least_distance: smaller distances are raised to this, in the unit of the goals: where k samples are
            equal, the density would be infinite.

    Returns:
        [...] of float64: finite, however far a point is away; NaN where a point has NaN or infinity.

    Raises:
        ValueError: shapes do not match, samples are not finite, or an option is out of its range.

    Example:
        >>> samples = torch.tensor([[0.0], [1.0], [4.0]])  # the second nearest to 2 is at distance 2
        >>> log_neighbor_density(torch.tensor([[2.0]]), samples, 2).exp()  # 2 of 3 samples in [0, 4]
        tensor([0.1667], dtype=torch.float64)
    """
    flat, known = _checked(points, samples)
    n, g = known.shape
    if not 1 <= k <= n:
        raise ValueError(f"k must be from 1 to the number of samples, {n}, got {k}")
    if not 0 < least_distance < math.inf:
        raise ValueError(f"least_distance must be positive and finite, got {least_distance}")
    center = known.mean(0)
    flat, known = ((x - center).clamp_(-_FARTHEST, _FARTHEST) for x in (flat, known))
    parts = [_kth_distance(part, known, k) for part in flat.split(max(1, _CHUNK // max(n, k * g)))]
    distance = torch.cat(parts).view(points.shape[:-1]).clamp_min_(least_distance)
    ball = g * 0.5 * math.log(math.pi) - math.lgamma(g * 0.5 + 1.0)  # volume of the unit ball
    return _marked(math.log(k / n) - ball - g * distance.log(), points)


def _checked(points: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
    """Returns points [m, g], with 0 for NaN and infinity, and samples [n, g], both in float64."""
    if samples.ndim != 2 or len(samples) == 0 or samples.shape[1] == 0 or not samples.isfinite().all():
        raise ValueError(f"samples must be finite, [n, g] with n > 0, got a shape of {list(samples.shape)}")
    if points.ndim == 0 or points.shape[-1] != samples.shape[1]:
        raise ValueError(
            f"points must be [..., {samples.shape[1]}] as samples are, got a shape of {list(points.shape)}"
        )
    flat = points.detach().reshape(-1, samples.shape[1]).double()
    return flat.nan_to_num(0.0, 0.0, 0.0), samples.detach().double()


def _squares(points: Tensor, samples: Tensor) -> Tensor:
    """Returns squared distances [m, n], by a matrix product: differences take several times as long."""
    products = torch.addmm(samples.square().sum(1), points, samples.T, alpha=-2.0)
    return products.add_(points.square().sum(1, True)).clamp_min_(0.0)


def _log_sum(points: Tensor, samples: Tensor) -> Tensor:
    """Returns the logarithm [m] of the sum of exp(-distance^2 / 2) over samples; faster than logsumexp."""
    logs = _squares(points, samples).mul_(-0.5)
    greatest = logs.amax(1, True)
    return logs.sub_(greatest).exp_().sum(1).log_().add_(greatest.squeeze(1))


def _kth_distance(points: Tensor, samples: Tensor, k: int) -> Tensor:
    """Returns the distance [m] to the k-th nearest sample."""
    nearest = _squares(points, samples).topk(k, 1, largest=False, sorted=False).indices
    # Matrix products lose the digits of small distances, so the k nearest are computed again as differences.
    return (points.unsqueeze(1) - samples[nearest]).norm(dim=-1).amax(1)


def _scale(sigma: Numbers, samples: Tensor) -> Tensor:
    """Returns sigma [g] on the device of the samples."""
    scale = torch.as_tensor(sigma, dtype=torch.float64).to(samples.device).reshape(-1)
    g = samples.shape[1]
    if len(scale) not in (1, g) or not bool(((scale > 0) & scale.isfinite()).all()):
        raise ValueError(f"sigma must be positive and finite, a scalar or of length {g}, got {sigma}")
    return scale.expand(g)


def _marked(log_density: Tensor, points: Tensor) -> Tensor:
    """Returns values with NaN where a point is not finite."""
    return log_density.masked_fill_(~points.isfinite().all(-1), math.nan)
