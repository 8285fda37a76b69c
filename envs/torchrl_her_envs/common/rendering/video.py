"""Writes frames to files: GIF, and MP4 if the optional extra is installed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

try:
    import imageio.v2 as imageio_v2

    imageio: Any = imageio_v2
except ImportError:  # only MP4 files need imageio
    imageio = None

_COLORS = 255  # number of colors of a GIF; the last of 256 is transparent, for unchanged pixels
_SAMPLES = 12  # number of frames from which a GIF's colors are chosen


def write_video(frames: Sequence[Tensor], path: str | Path, *, fps: float = 25) -> Path:
    """Writes frames to a video file in the format of its suffix.

    A GIF loops for ever and shares one palette. Its frames last a multiple of 0.01 s, and equal frames in a
    row are stored as one that lasts longer. An MP4 (H.264) needs ``pip install ".[video]"``; a side of odd
    length grows by one pixel in it.

    Args:
        frames: pictures [height, width, 3] of uint8, all of one size.
        path: file to write; ends in ``.gif`` or ``.mp4``. Missing folders are made.
        fps: frames a second.

    Returns:
        The path.

    Raises:
        ValueError: no frames, frames of different shapes, ``fps`` not above 0, or another suffix.
        ImportError: an MP4 is to be written without the extra ``video``.

    Example:
        >>> import tempfile
        >>> frames = [torch.full((32, 32, 3), 50 * k, dtype=torch.uint8) for k in range(3)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_video(frames, Path(folder) / "gray.gif", fps=10).name
        'gray.gif'
    """
    path, suffix = Path(path), Path(path).suffix.lower()
    if suffix not in _WRITERS:
        raise ValueError(f"cannot write {path.name!r}: its suffix must be one of {', '.join(_WRITERS)}")
    shapes = {tuple(frame.shape) for frame in frames}
    if len(shapes) != 1:
        raise ValueError(
            f"a video needs frames, all of one shape, got {len(frames)} of shapes {sorted(shapes)}"
        )
    if fps <= 0:
        raise ValueError(f"fps must be above 0, got {fps}")
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_stem(f"{path.stem}.part")  # renamed when complete, so no video lacks its end
    try:
        _WRITERS[suffix](frames, part, fps)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path


def _write_gif(frames: Sequence[Tensor], path: Path, fps: float) -> None:
    palette = _shared_palette(frames)
    # Dithering would make still areas flicker, and the file large.
    images = [_image(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = max(20, 10 * round(100 / fps))  # milliseconds; many viewers slow down frames below 20
    images[0].save(path, save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=True)


def _write_mp4(frames: Sequence[Tensor], path: Path, fps: float) -> None:
    try:
        if imageio is None:
            raise ImportError("no module named 'imageio'")
        # Without a macro block size of 1 the plugin would stretch frames to multiples of 16.
        writer = imageio.get_writer(
            path, format="FFMPEG", fps=fps, codec="libx264", quality=8, macro_block_size=1
        )
    except ImportError as error:  # imageio, or its plugin, is missing
        raise ImportError('writing an MP4 needs the extra "video": pip install ".[video]"') from error
    with writer:
        for frame in frames:
            writer.append_data(_even(frame))


_WRITERS = {".gif": _write_gif, ".mp4": _write_mp4}


def _shared_palette(frames: Sequence[Tensor]) -> Image.Image:
    """Computes a palette for all frames from some that are evenly spread, the last one included."""
    which = torch.linspace(0, len(frames) - 1, min(_SAMPLES, len(frames))).round().long().tolist()
    sample = _image(torch.cat([frames[index] for index in which]))
    counted = sample.getcolors(maxcolors=sample.width * sample.height) or []
    # Colors are weighted by the root of their area: else backgrounds fill the palette, and balls turn gray.
    weighted = [color for count, color in counted for _ in range(math.isqrt(count))]
    return _image(torch.tensor([weighted], dtype=torch.uint8)).quantize(_COLORS, Image.Quantize.MEDIANCUT)


def _image(frame: Tensor) -> Image.Image:
    return Image.fromarray(frame.contiguous().numpy())


def _even(frame: Tensor) -> np.ndarray:
    """Makes the sides of a frame even, as H.264 requires, by repeating the last row and column."""
    height, width, _ = frame.shape
    return np.pad(frame.numpy(), ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
