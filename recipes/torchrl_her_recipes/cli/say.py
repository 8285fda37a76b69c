"""Prints results, errors and warnings of the command line, one line each, and defines its exit codes."""

from __future__ import annotations

import re
import statistics
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

if TYPE_CHECKING:  # not at runtime, since this import would import torch
    from torchrl_her_recipes.studies.study import StudyResult

FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130

_HARDLY = 0.1  # below this success, a run has hardly learned anything


def fail(message: str) -> int:
    """Prints a message to the standard error stream, and returns the exit code for bad input."""
    click.echo(f"torchrl-her: {message}", err=True)
    return BAD_INPUT


def say_warning(message: Warning | str, *_where: Any, **_more: Any) -> None:
    """Prints a warning in one line, above a progress bar if there is one."""
    say_line(f"warning: {message}")


def say_line(message: str) -> None:
    """Prints a notice in one line, above a progress bar if there is one."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", message)  # without the colors of gymnasium's warnings
    tqdm.write(f"torchrl-her: {' '.join(plain.split())}", file=sys.stderr)


def one_line(error: BaseException) -> str:
    """Returns the message of an error in one line, without control characters."""
    return "".join(letter if letter.isprintable() else "?" for letter in _message(error))


def _message(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror is not None:
        return f"cannot use {error.filename}: {error.strerror.lower()}"
    if isinstance(error, MemoryError):
        return "there is not enough memory: buffer_size, hidden or batch_size may be too large"
    return " ".join(str(error).split()) or type(error).__name__


def say_result(result: StudyResult, *, of: str = "") -> None:
    """Prints the failed jobs of a study or sweep with their errors, and the success of finished jobs.

    Args:
        of: text before the names of failed jobs.
    """
    for label, reason in result.failed.items():
        fail(f"{of}{label} failed: {reason}")
    for label, successes in result.successes.items():
        click.echo(f"{label}: {success_line(successes)}")


def exit_code(*, interrupted: bool, failed: bool) -> int:
    """Returns the exit code of a command that trains several runs, and prints how to resume it."""
    if interrupted:
        click.echo("interrupted: the same command resumes it")
        return INTERRUPTED
    return FAILED if failed else 0


def success_line(successes: Sequence[float]) -> str:
    """Describes the success of runs: median, worst, and the number of runs that have hardly learned anything.

    Example:
        >>> success_line([0.9])
        'success 90%'
        >>> success_line([0.9, 0.02, 0.95])
        'median success 90%, worst 2%; 1 of 3 runs below 10%'
    """
    median, worst = statistics.median(successes), min(successes)
    if len(successes) == 1:
        return f"success {median:.0%}"
    below = sum(success < _HARDLY for success in successes)
    failed = f"; {below} of {len(successes)} runs below {_HARDLY:.0%}" if below else ""
    return f"median success {median:.0%}, worst {worst:.0%}{failed}"


def file_name(task: str) -> str:
    """Replaces the characters in a task's name that some file systems do not allow in names of files.

    Example:
        >>> file_name("gym:torchrl_her/HandThrow-v1")
        'gym_torchrl_her_HandThrow-v1'
    """
    return task.replace("/", "_").replace(":", "_")
