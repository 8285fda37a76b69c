"""A window, without a display."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_her_envs.common.rendering.window import Window

NO_DISPLAY = "ignore:.*there is no display"


@pytest.mark.filterwarnings(NO_DISPLAY)
def test_a_window_without_a_display_draws_in_time() -> None:
    window = Window("a title", fps=50)
    picture = np.zeros((16, 16, 3), np.uint8)
    for shade in (0, 100, 200):
        window.show(picture + np.uint8(shade))
    drawn = np.asarray(window._figure.canvas.buffer_rgba())
    assert drawn[5, 5].tolist() == [200, 200, 200, 255]
    window.close()
    window.show(picture)  # as if somebody had closed it: nothing happens
