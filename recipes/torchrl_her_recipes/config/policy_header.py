"""Reads the description of a policy, plain values in the header of its file, without the weights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from torchrl_her_recipes.config.plain_files import naming, shown

POLICY_SUFFIX = ".safetensors"
METADATA_KEY = "torchrl_her"

_LARGEST_HEADER = 1 << 22  # largest size of a header in bytes


def read_header(path: Path) -> dict[str, Any]:
    """Returns the description in the header of a policy's file, without reading its weights.

    Example:
        >>> from torchrl_her_recipes.config import shipped
        >>> header = read_header(shipped.policy_files()["hand_v1"])
        >>> header["info"]["task"], header["recipe"]["learner"]["gamma"]
        ('hand_v1', 0.98)
    """
    with open(path, "rb") as file, naming(path):
        size = int.from_bytes(file.read(8), "little")
        if size > _LARGEST_HEADER:
            raise ValueError(f"its header must have at most {_LARGEST_HEADER:,} bytes, got {size:,}")
        description = json.loads(json.loads(file.read(size))["__metadata__"][METADATA_KEY])
        if not isinstance(description, dict):
            raise ValueError(f"its description must hold names and values, got {shown(description)}")
    return description
