"""Rendering of gymnasium's environments, and messages for those that cannot be rendered."""

from __future__ import annotations

import os
import sys

import gymnasium

PICTURES = "rgb_array"
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_DRAWN_BY = "MUJOCO_GL"


def draws(env: gymnasium.Env) -> bool:
    """Returns whether an environment gives pictures if it is made with ``render_mode="rgb_array"``."""
    return PICTURES in env.metadata.get("render_modes", [])


def choose_renderer() -> None:
    """Makes MuJoCo render by EGL if there is no display, unless ``MUJOCO_GL`` is set.

    Otherwise MuJoCo would try to open a window, and fail.
    """
    if sys.platform == "linux" and not any(os.environ.get(name) for name in _DISPLAYS):
        os.environ.setdefault(_DRAWN_BY, "egl")


def cannot_draw(name: str, error: Exception) -> str:
    """Returns a message of one line that an environment cannot be rendered."""
    hint = ""
    if "mujoco" in sys.modules:
        by = os.environ.get(_DRAWN_BY)
        tried = "in a window" if by is None else f"by {_DRAWN_BY}={by}"
        hint = f" (MuJoCo was to draw {tried}; {_DRAWN_BY} may be glfw, egl or osmesa)"
    reason = " ".join(f"{type(error).__name__}: {error}".split())
    return f"{name} could not be drawn: {reason}{hint}"
