"""Joining a Ray cluster. Needs the extra `cluster`."""

from __future__ import annotations

import logging
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import ray
from ray.exceptions import RayTaskError

_PATIENCE = 5.0  # seconds to wait for an address to answer


def join(address: str) -> bool:
    """Makes this process part of a cluster, unless it is already.

    Args:
        address: HOST:PORT, or ``auto`` for the one that this machine is a node of.

    Returns:
        True if this process joined, False if it was part of the cluster already.

    Raises:
        ConnectionError: there is no such cluster, or this process is part of another one.
    """
    if ray.is_initialized():
        current = ray.get_runtime_context().gcs_address
        if address not in ("auto", current):
            raise ConnectionError(
                f"this process is part of the Ray cluster at {current} already, not {address}"
            )
        return False
    try:
        if ":" in address:  # Ray itself would try for minutes
            host, port = address.rsplit(":", 1)
            socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
        with _signals_kept():
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        raise ConnectionError(f"no Ray cluster at {address} lets us in: {one_line(error)}") from error
    return True


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Restores the handler of SIGTERM: Ray sets its own, which ends a run without saving it."""
    before = signal.getsignal(signal.SIGTERM)
    yield
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)


def resource(name: str) -> float:
    """Returns the present amount of a resource, such as ``CPU``, on all nodes together."""
    return float(ray.cluster_resources().get(name, 0))


def gpus() -> list[float]:
    """Returns the number of GPUs of each node."""
    return [float(node["Resources"].get("GPU", 0)) for node in ray.nodes() if node["Alive"]]


def one_line(error: Any) -> str:
    """Returns type and message of an error in one line, without its traceback."""
    if isinstance(error, RayTaskError):
        return f"{type(error.cause).__name__}: {error.cause}"
    return next(iter(str(error).splitlines()), type(error).__name__)
