"""Joining a Ray cluster. Needs the extra `cluster`."""

from __future__ import annotations

import logging
import socket
from typing import Any

import ray
from ray.exceptions import RayTaskError

_PATIENCE = 5.0  # seconds until an address that does not answer is given up
QUIET = {"log_to_driver": False, "logging_level": logging.ERROR}  # options of ``ray.init``


def join(address: str) -> None:
    """Makes this process part of a cluster, unless it is already.

    Args:
        address: HOST:PORT, or ``auto`` for the one that this machine is a node of.

    Raises:
        ConnectionError: there is none.
    """
    try:
        if ":" in address:  # Ray itself would try for minutes
            host, port = address.rsplit(":", 1)
            socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
        if not ray.is_initialized():
            ray.init(address=address, **QUIET)
    except (OSError, RuntimeError, ValueError) as error:
        raise ConnectionError(f"no Ray cluster at {address} lets us in: {one_line(error)}") from error


def resource(name: str) -> float:
    """How much of a resource, such as ``CPU``, the nodes have together just now."""
    return float(ray.cluster_resources().get(name, 0))


def one_line(error: Any) -> str:
    """What went wrong, without where."""
    if isinstance(error, RayTaskError):
        return f"{type(error.cause).__name__}: {error.cause}"
    return next(iter(str(error).splitlines()), type(error).__name__)
