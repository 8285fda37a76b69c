"""Joins a Ray cluster and queries its resources. Needs the extra `cluster`."""

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

_PATIENCE = 5.0  # seconds to wait for a connection to an address


def join(address: str) -> bool:
    """Connects this process to a Ray cluster, unless it is connected already.

    Args:
        address: HOST:PORT, or ``auto`` for the cluster that this machine is a node of.

    Returns:
        True if this process was connected, False if it had been connected before.

    Raises:
        ConnectionError: there is no such cluster, or this process is connected to another one.
    """
    if ray.is_initialized():
        current = ray.get_runtime_context().gcs_address
        if address not in ("auto", current):
            raise ConnectionError(
                f"this process is part of the Ray cluster at {current} already, not {address}"
            )
        return False
    try:
        if ":" in address:  # tested first, since Ray itself would try to connect for minutes
            host, port = address.rsplit(":", 1)
            socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
        with _signals_kept():
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        raise ConnectionError(f"cannot connect to a Ray cluster at {address}: {one_line(error)}") from error
    return True


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Restores the handler of SIGTERM after the block: Ray's handler would end a run without saving it."""
    before = signal.getsignal(signal.SIGTERM)
    yield
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)


def resource(name: str) -> float:
    """Returns the total amount of a resource, such as ``CPU``, on all nodes that are alive."""
    return float(ray.cluster_resources().get(name, 0))


def gpus() -> list[float]:
    """Returns the number of GPUs of each node that is alive."""
    return [float(node["Resources"].get("GPU", 0)) for node in ray.nodes() if node["Alive"]]


def one_line(error: Any) -> str:
    """Returns the message of an error in one line, without the traceback that Ray adds to it."""
    if isinstance(error, RayTaskError):
        return f"{type(error.cause).__name__}: {error.cause}"
    return next(iter(str(error).splitlines()), type(error).__name__)
