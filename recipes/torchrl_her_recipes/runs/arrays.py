"""Reads numpy's files of arrays."""

from __future__ import annotations

from pathlib import Path
from zipfile import ZipFile

import numpy as np

_LARGEST = 1 << 27  # bytes of all arrays of a file


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays that ``numpy.savez`` wrote, if they hold numbers."""
    with open(path, "rb") as file:
        try:
            with ZipFile(file) as archive:
                size = sum(record.file_size for record in archive.infolist())
            if size > _LARGEST:
                raise ValueError(f"its arrays take {size:,} bytes, more than {_LARGEST:,}")
            file.seek(0)
            arrays = dict(np.load(file, allow_pickle=False))
            if odd := [name for name, array in arrays.items() if array.dtype.kind not in "biuf"]:
                raise ValueError(f"{odd[0][:80]!r} holds no numbers")
            return arrays
        except Exception as error:  # errors of any type: zlib's, zipfile's, those of Python's parser
            said = str(error) if type(error) is ValueError else f"it holds no arrays ({type(error).__name__})"
            raise ValueError(f"{path} is damaged: {said}") from error
