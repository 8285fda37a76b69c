"""How the command line prints errors and warnings, in one line each, and its exit codes."""

from __future__ import annotations

import sys
from typing import Any

import click
from tqdm import tqdm

FAILED = 1
BAD_INPUT = 2
BAD_INPUT_ERRORS = (OSError, ValueError, ImportError, MemoryError)
INTERRUPTED = 130


def fail(message: str, code: int = BAD_INPUT) -> int:
    """Prints why a command failed, and returns its exit code."""
    click.echo(f"torchrl-her: {message}", err=True)
    return code


def say_warning(message: Warning | str, *_where: Any, **_more: Any) -> None:
    """Prints a warning in one line, above a progress bar if there is one."""
    stream = sys.stderr
    tqdm.write(f"torchrl-her: warning: {' '.join(str(message).split())}", file=stream)


def one_line(error: BaseException) -> str:
    """The message of an error."""
    if isinstance(error, OSError) and error.strerror is not None:
        return f"cannot use {error.filename}: {error.strerror.lower()}"
    if isinstance(error, MemoryError):
        return "there is not enough memory: buffer_size, hidden or batch_size may be too large"
    return " ".join(str(error).split()) or type(error).__name__


def file_name(task: str) -> str:
    """The name of a task as part of a file's name: gym:ID has letters that some file systems refuse.

    Example:
        >>> file_name("gym:torchrl_her/HandThrow-v1")
        'gym_torchrl_her_HandThrow-v1'
    """
    return task.replace("/", "_").replace(":", "_")
