"""Writes and reads files of policies: weights as safetensors, with a description in the header."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from torchrl_her.files.writing import written
from torchrl_her_recipes.config.plain_files import naming
from torchrl_her_recipes.config.policy_header import METADATA_KEY, read_header


def write_policy(path: Path, weights: Mapping[str, Tensor], description: Mapping[str, Any]) -> None:
    """Writes weights and their description; an interrupted write leaves no partial file.

    Args:
        path: Path of the file.
        weights: ``state_dict()`` of a policy. Entries that are not tensors are not written.
        description: Plain values that JSON can represent.
    """
    tensors = {
        name: value.detach().to("cpu", copy=True).contiguous()  # safetensors refuses shared memory
        for name, value in weights.items()
        if isinstance(value, Tensor)
    }
    data = save(tensors, {METADATA_KEY: json.dumps(description)})
    with written(path) as part:
        part.write_bytes(data)


def read_policy(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Returns the description and the weights of a policy's file."""
    description = read_header(path)
    with naming(path):
        try:
            return description, load(path.read_bytes())
        except SafetensorError as error:
            raise ValueError(str(error)) from error
