"""A window in which pictures are shown one after the other."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

_INCHES = 5.0


class Window:
    """A window of matplotlib's, which needs no further package.

    Without a display it shows nothing, and warns once.

    Args:
        title: title of the window.
        fps: pictures a second, at most.

    Example:
        >>> import matplotlib, warnings
        >>> matplotlib.use("agg")  # no display
        >>> with warnings.catch_warnings():
        ...     warnings.simplefilter("ignore")
        ...     window = Window("gray", fps=100)
        >>> window.show(np.full((8, 8, 3), 128, np.uint8))
        >>> window.close()
    """

    def __init__(self, title: str, *, fps: float) -> None:
        self._figure = plt.figure(figsize=(_INCHES, _INCHES))
        self._axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self._axes.set_axis_off()
        self._image: Any = None
        self._pause = 1.0 / fps
        self._due = 0.0
        if self._figure.canvas.required_interactive_framework is None:
            gymnasium.logger.warn("there is no display for a window: render_mode='rgb_array' gives pictures")
        else:
            self._figure.canvas.manager.set_window_title(title)
            self._figure.show()

    def show(self, picture: np.ndarray) -> None:
        """Shows a picture [height, width, 3] of uint8 at the frame rate, unless the window was closed."""
        if not plt.fignum_exists(self._figure.number):
            return
        if self._image is None:
            self._image = self._axes.imshow(picture)
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        self._figure.canvas.start_event_loop(max(1e-3, self._due - time.perf_counter()))
        self._due = time.perf_counter() + self._pause

    def close(self) -> None:
        """Closes the window."""
        plt.close(self._figure)
