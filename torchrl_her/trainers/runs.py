"""Functions for independent runs in stacked networks: clip each run's gradients, keep some runs unchanged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn


def run_dims(loss: nn.Module) -> dict[str, int]:
    """Returns the dimension of the runs in each entry of a stacked loss's state, by name.

    It is the first one; in the parameters of a stack of N critics [N, R, ...] it is the second.
    """
    stacked = {
        name: len(getattr(child, "batch_size", ()))
        for name, child in loss.named_children()
        if name.endswith("_params")
    }
    return {name: stacked.get(name.split(".")[0], 0) for name in loss.state_dict()}


@contextmanager
def keep_runs(
    loss: nn.Module, optimizer: torch.optim.Optimizer, kept: Sequence[int], *, runs: int
) -> Iterator[None]:
    """Protects some runs of a stacked loss and its optimizer from all changes in the ``with`` block.

    Args:
        loss: loss whose tensors have a dimension of R equal blocks, in the order of the runs (``run_dims``).
        optimizer: optimizer of the loss's parameters.
        kept: the runs that stay unchanged.
        runs: R, the number of independent runs.

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
    before = {
        key: _of_runs(entry, dim, kept, runs).clone() for key, entry, dim in _entries(loss, optimizer, runs)
    }
    try:
        yield
    finally:
        with torch.no_grad():
            for key, entry, dim in _entries(loss, optimizer, runs):
                values = _of_runs(entry, dim, kept, runs)
                # the state of an optimizer is made at its first step, and begins with zeros
                values = before.get(key, torch.zeros_like(values))
                blocks = entry.unflatten(dim, (runs, -1))
                blocks.index_copy_(dim, torch.tensor(list(kept), device=entry.device), values)


def _entries(loss: nn.Module, optimizer: torch.optim.Optimizer, runs: int) -> list[tuple[int, Tensor, int]]:
    """Returns all tensors that are divided among R runs: a key, the tensor, and the dimension of the runs."""
    dims = run_dims(loss)
    entries = [(entry, dims[name]) for name, entry in loss.state_dict().items()]
    dim_of = {id(parameter): dims.get(name, 0) for name, parameter in loss.named_parameters()}
    for parameter, state in optimizer.state.items():
        entries += [(entry, dim_of.get(id(parameter), 0)) for entry in state.values()]
    return [
        (entry.data_ptr(), entry.data, dim)
        for entry, dim in entries
        if isinstance(entry, Tensor) and entry.ndim > dim and entry.shape[dim] % runs == 0
    ]


def _of_runs(entry: Tensor, dim: int, which: Sequence[int], runs: int) -> Tensor:
    return entry.unflatten(dim, (runs, -1)).index_select(dim, torch.tensor(list(which), device=entry.device))


@torch.no_grad()
def clip_by_run(parameters: Sequence[nn.Parameter], max_norm: float, *, runs: int, dim: int = 0) -> Tensor:
    """Clips the gradient of each run separately.

    Args:
        parameters: parameters of one stacked network; each has R equal blocks, in the order of the runs.
        max_norm: greatest norm of a run's gradient, over all parameters together.
        runs: R, the number of independent runs.
        dim: the dimension of the runs.

    Returns:
        Norms [R] before clipping.

    Example:
        >>> weight = nn.Parameter(torch.zeros(2, 1, 1))
        >>> weight.grad = torch.tensor([[[6.0]], [[2.0]]])
        >>> clip_by_run([weight], 3.0, runs=2).tolist()
        [6.0, 2.0]
        >>> weight.grad.flatten().round(decimals=4).tolist()
        [3.0, 2.0]
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    blocks = [gradient.unflatten(dim, (runs, -1)).movedim(dim, 0) for gradient in gradients]
    norms = torch.cat([block.reshape(runs, -1) for block in blocks], 1).norm(dim=1)
    scale = (max_norm / (norms + 1e-6)).clamp(max=1.0)  # as in torch's clip_grad_norm_
    for block in blocks:
        block.mul_(scale.view(-1, *[1] * (block.ndim - 1)))
    return norms
