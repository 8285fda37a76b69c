"""Writes files whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def part_of(path: Path) -> Path:
    """Temporary path for a file being written. It keeps the suffix, by which libraries choose the format.

    Example:
        >>> part_of(Path("runs/curves.png")).name
        'curves.part.png'
    """
    return path.with_stem(f"{path.stem}.part")


@contextmanager
def written(path: str | Path) -> Iterator[Path]:
    """Replaces a file atomically: even after a loss of power it is either the new or the old one.

    Yields a temporary path to write to. At the end, the temporary file is synced to the disk and replaces the
    file; after an error it is removed.

    Args:
        path: the file.

    Raises:
        OSError: the file cannot be written; its old content is untouched.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with written(f"{folder}/notes.txt") as part:
        ...         _ = part.write_text("all of it")
        ...     [path.name for path in Path(folder).iterdir()]
        ['notes.txt']
    """
    path = Path(path)
    part = part_of(path)
    try:
        yield part
        _sync(part)
        os.replace(part, path)
    except OSError as error:
        if error.errno is None:  # raised by a library and not by the operating system
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        part.unlink(missing_ok=True)  # after an error, the partial file must not fill the disk
    if os.name == "posix":  # only POSIX systems can open a folder
        _sync(path.parent)  # without this sync, a loss of power may undo the renaming


def write_text(path: str | Path, text: str) -> None:
    """Writes a text in UTF-8 and keeps its line endings.

    Raises:
        OSError: the file cannot be written; its old content is untouched.
    """
    with written(path) as part:
        part.write_text(text, encoding="utf-8", newline="")


def _sync(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
