"""Writing files whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def part_of(path: Path) -> Path:
    """Where a file is written before it takes its place; its suffix stays, for those who write by it.

    Example:
        >>> part_of(Path("runs/curves.png")).name
        'curves.part.png'
    """
    return path.with_stem(f"{path.stem}.part")


@contextmanager
def written(path: str | Path) -> Iterator[Path]:
    """A file that is always either the new one or the one before, even after a loss of power.

    Gives the path to write to, beside the file. At the end what was written there is synced to the disk and
    takes the file's place; after an error it is removed.

    Args:
        path: the file.

    Raises:
        OSError: it cannot be written; the one before is untouched.

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
        if error.errno is None:  # of a library, and not of the system
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        part.unlink(missing_ok=True)  # missing if all went well; otherwise it would waste a full disk
    if os.name == "posix":  # elsewhere a folder cannot be opened
        _sync(path.parent)  # or a loss of power may undo the renaming


def write_text(path: str | Path, text: str) -> None:
    """Writes a text in UTF-8, lines ending as they do in it.

    Raises:
        OSError: the file cannot be written; the one before is untouched.
    """
    with written(path) as part:
        part.write_text(text, encoding="utf-8", newline="")


def _sync(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
