"""Reading numpy's files of arrays, which may come from anybody."""

from __future__ import annotations

import math
from pathlib import Path
from zipfile import BadZipFile, ZipFile

import numpy as np

_LARGEST = 1 << 27  # bytes of all arrays of a file
_FILE = ".npy"  # what numpy calls the files in its own


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays that ``numpy.savez`` wrote, if they are of numbers.

    What a file declares is compared with what it unpacks to before memory is taken for it.

    Raises:
        ValueError: it is damaged, or too large.
        OSError: it cannot be read.
    """
    try:
        with ZipFile(path) as archive:
            size = sum(own.file_size for own in archive.infolist())
            if size > _LARGEST:
                raise ValueError(f"its arrays take {size:,} bytes, more than {_LARGEST:,}")
            return {name.removesuffix(_FILE): _read(archive, name) for name in archive.namelist()}
    except Exception as error:  # of any type: zlib's, zipfile's, those of Python's parser
        if isinstance(error, OSError) and error.filename is not None:
            raise  # it is not there, or must not be read
        said = str(error) if type(error) is ValueError else f"it holds no arrays ({type(error).__name__})"
        raise ValueError(f"{path} is damaged: {said}") from error


def _read(archive: ZipFile, name: str) -> np.ndarray:
    """One of the arrays.

    Raises:
        ValueError: it is none of numbers, or has another size than it declares.
    """
    with archive.open(name) as file:
        content = file.read(archive.getinfo(name).file_size + 1)
    if not name.endswith(_FILE):
        raise BadZipFile(name)
    with archive.open(name) as file:
        read = np.lib.format.read_array_header_1_0 if np.lib.format.read_magic(file) == (1, 0) else None
        if read is None:
            raise BadZipFile(name)
        shape, by_column, kind = read(file)
        begin = file.tell()
    if kind.kind not in "biuf":
        raise ValueError(f"{name[:80]!r} holds no numbers")
    if math.prod(shape) * kind.itemsize != len(content) - begin or min(shape, default=1) < 0:
        raise ValueError(f"{name[:80]!r} declares the shape {list(shape)[:8]}, which is not its own")
    array = np.frombuffer(content[begin:], kind)
    return array.reshape(shape, order="F" if by_column else "C").copy()
