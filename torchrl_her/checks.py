"""Functions that check options, tensors and batches, and raise errors that name what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral

from tensordict import NestedKey, TensorDictBase
from torch import Size, Tensor


def check_whole(*, least: int = 1, **options: object) -> None:
    """Raises an error for options that are not whole numbers, or too small.

    Keyword Args:
        least: the smallest number that is allowed.
        **options: numbers by name.

    Raises:
        ValueError: an option is not a whole number or too small; the message names it.

    Example:
        >>> check_whole(runs=2, least=1)
        >>> check_whole(k=2.5, least=0)
        Traceback (most recent call last):
        ValueError: k must be a whole number, got 2.5
    """
    for name, value in options.items():
        if not isinstance(value, Integral) or isinstance(value, bool):
            raise ValueError(f"{name} must be a whole number, got {value!r}")
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")


def check_finite(tensors: Mapping[str, Tensor]) -> None:
    """Raises an error for tensors that hold NaN or infinity.

    A sum reveals NaN and infinity in a twentieth of the time of ``isfinite``. Since a sum of finite numbers
    may overflow, ``isfinite`` decides if the sum is not finite.

    Args:
        tensors: tensors of any shapes and dtypes on one device, by the name that a message should use.

    Raises:
        ValueError: one of them is not finite; the message names it.

    Example:
        >>> import torch
        >>> check_finite({"goals": torch.tensor([3e38, 3e38])})
        >>> check_finite({"goals": torch.tensor([1.0, torch.nan])})
        Traceback (most recent call last):
        ValueError: goals must be finite, got nan in it
    """
    floats = {name: tensor for name, tensor in tensors.items() if tensor.is_floating_point()}
    if not floats or bool(sum(tensor.sum() for tensor in floats.values()).isfinite()):  # type: ignore[union-attr]
        return
    for name, tensor in floats.items():
        wrong = tensor[~tensor.isfinite()]
        if len(wrong) > 0:
            raise ValueError(f"{name} must be finite, got {wrong[0].item()} in it")


def check_blocks(shape: Size, runs: int) -> None:
    """Raises a ValueError if a batch of this shape is not one equal block for each run."""
    if runs > 1 and (len(shape) == 0 or shape[0] % runs):
        raise ValueError(
            f"the first dimension of a batch must be {runs} equal blocks, one for each run, got a batch of "
            f"{list(shape)}"
        )


def entry_of(rows: TensorDictBase, key: NestedKey, *, by: str = "relabeling") -> Tensor:
    """Returns an entry; raises if it is missing.

    Args:
        rows: rows of any shape.
        key: key of the entry.

    Keyword Args:
        by: name of the part that needs the entry, for the message.

    Raises:
        KeyError: the entry is missing; the message lists the entries that are there.
    """
    entry = rows.get(key, None)
    if entry is None:
        raise KeyError(f"{by} needs the entry {key!r}, got {list(rows.keys(True, True))}")
    return entry
