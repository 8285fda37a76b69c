"""Checkpoints of a whole run: atomic, checksummed, tensors and plain data only."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler

_MAGIC = b"torchrl-her checkpoint 1\n"


class CheckpointError(ValueError):
    """A file that is no whole checkpoint."""


def save_checkpoint(state: dict[str, Any], path: str | Path) -> None:
    """Writes a checkpoint so that the file is always whole: the new one or the one before.

    Args:
        state: nested dicts and lists of tensors and plain data.
        path: the file; a temporary one beside it is renamed to it when it is on the disk.

    Raises:
        OSError: it cannot be written; what was there before is untouched.
    """
    path = Path(path)
    payload = io.BytesIO()
    torch.save(state, payload)
    body = payload.getbuffer()
    part = path.with_name(path.name + ".part")
    with open(part, "wb") as file:
        file.write(_MAGIC + hashlib.sha256(body).digest())
        file.write(body)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Reads a checkpoint. Nothing in the file is ever executed.

    Args:
        path: a file that :func:`save_checkpoint` wrote.

    Raises:
        CheckpointError: it is not whole, not a checkpoint, or holds more than tensors and plain data.
        OSError: it cannot be read.
    """
    data = Path(path).read_bytes()
    head = len(_MAGIC)
    digest, body = data[head : head + 32], data[head + 32 :]
    if data[:head] != _MAGIC:
        raise CheckpointError(f"{path} is not a checkpoint of torchrl-her")
    if hashlib.sha256(body).digest() != digest:
        raise CheckpointError(f"{path} is damaged: its checksum does not match")
    try:
        return torch.load(io.BytesIO(body), weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(f"{path} holds more than tensors and plain data") from error


def buffer_state_dict(buffer: TensorDictReplayBuffer) -> dict[str, Any]:
    """What a replay buffer holds: filled rows, writer, and priorities if it has any.

    TorchRL's own state holds the whole capacity, and for a prioritised sampler objects that a safe
    load refuses.
    """
    n = len(buffer)
    state: dict[str, Any] = {
        # As stored, without what transforms add; a copy, since a view would bring the whole capacity along.
        "rows": buffer.storage[:n].clone().to_dict() if n else None,
        "size": n,
        "writer": buffer.writer.state_dict(),
        "sampler": None,
    }
    if isinstance(buffer.sampler, PrioritizedSampler):
        sampler = buffer.sampler.state_dict()
        filled = torch.arange(n)
        state["sampler"] = {
            "sum": torch.as_tensor(sampler["_sum_tree"][filled]) if n else None,
            "min": torch.as_tensor(sampler["_min_tree"][filled]) if n else None,
            "max_priority": [
                None if value is None else torch.as_tensor(value) for value in sampler["_max_priority"]
            ],
        }
    return state


def load_buffer_state_dict(buffer: TensorDictReplayBuffer, state: dict[str, Any]) -> None:
    """Fills an empty buffer of the same make with what :func:`buffer_state_dict` gave."""
    n = state["size"]
    if n:
        buffer.storage.set(torch.arange(n), TensorDict.from_dict(state["rows"], batch_size=[n]))
    buffer.writer.load_state_dict(state["writer"])
    if state["sampler"] is not None:
        sampler = buffer.sampler.state_dict()
        filled = torch.arange(n)
        if n:
            sampler["_sum_tree"][filled] = state["sampler"]["sum"]
            sampler["_min_tree"][filled] = state["sampler"]["min"]
        sampler["_max_priority"] = tuple(state["sampler"]["max_priority"])
        buffer.sampler.load_state_dict(sampler)
