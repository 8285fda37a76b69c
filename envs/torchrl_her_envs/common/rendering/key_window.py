"""A window that shows pictures and takes keys; it needs the package pygame-ce."""

from __future__ import annotations

import os
import sys
from enum import Enum
from typing import Any

import numpy as np

_SHOW_NOTHING = ("dummy", "offscreen")  # drivers that SDL falls back to if there is no display
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
_LEAST = 160  # least width and height of a window, in pixels
_NO_DISPLAY = (
    "a window needs a display, and there is none{reason}: work where there is one (over ssh: ssh -Y), or "
    "write a film with --out FILE.mp4"
)


class Command(Enum):
    """Command that a user gives by pressing a key; the value describes its keys."""

    PAUSE = "space: pause"
    STEP = "n or right arrow: one step"
    RESET = "r: next goals"
    FASTER = "+: faster"
    SLOWER = "-: slower"
    QUIT = "q or escape: quit"


class KeyWindow:
    """A resizable window for pictures, in which some keys are commands.

    Args:
        title: title of the window.

    Raises:
        ImportError: pygame is not installed.
        ValueError: there is no display.
    """

    def __init__(self, title: str) -> None:
        self._pygame = pygame = _import_pygame()
        if sys.platform == "linux" and not any(os.environ.get(name) for name in _DISPLAYS):
            raise ValueError(_NO_DISPLAY.format(reason=""))  # before SDL prints messages of its own
        try:
            pygame.display.init()
            driver = pygame.display.get_driver()
        except pygame.error as error:
            raise ValueError(_NO_DISPLAY.format(reason=f" ({error})")) from error
        if driver in _SHOW_NOTHING and os.environ.get("SDL_VIDEODRIVER", "") != driver:
            pygame.display.quit()
            raise ValueError(_NO_DISPLAY.format(reason=""))
        self._surface: Any = None
        self._shape = (0, 0)
        self._clock = pygame.time.Clock()
        self._commands = {
            pygame.K_SPACE: Command.PAUSE,
            pygame.K_RIGHT: Command.STEP,
            pygame.K_n: Command.STEP,
            pygame.K_r: Command.RESET,
            pygame.K_q: Command.QUIT,
            pygame.K_ESCAPE: Command.QUIT,
            pygame.K_PLUS: Command.FASTER,
            pygame.K_EQUALS: Command.FASTER,  # the same key as plus, without shift
            pygame.K_KP_PLUS: Command.FASTER,
            pygame.K_MINUS: Command.SLOWER,
            pygame.K_KP_MINUS: Command.SLOWER,
        }
        self.title = title

    @property
    def title(self) -> str:
        """Line above the picture."""
        return self._pygame.display.get_caption()[0]

    @title.setter
    def title(self, title: str) -> None:
        self._pygame.display.set_caption(title)

    def show(self, picture: np.ndarray) -> None:
        """Shows a picture [height, width, 3] of uint8, scaled to the window.

        The window takes the size of the first picture, and of each picture whose size differs from the last.
        """
        pygame = self._pygame
        height, width, _ = picture.shape
        if self._surface is None or (width, height) != self._shape:
            self._shape = width, height
            size = (max(_LEAST, width), max(_LEAST, height))
            self._surface = pygame.display.set_mode(size, pygame.RESIZABLE)
        drawn = pygame.image.frombuffer(np.ascontiguousarray(picture).tobytes(), (width, height), "RGB")
        wide, high = self._surface.get_size()
        scale = min(wide / width, high / height)
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        if size != (width, height):
            drawn = pygame.transform.smoothscale(drawn, size)
        self._surface.fill((0, 0, 0))
        self._surface.blit(drawn, ((wide - size[0]) // 2, (high - size[1]) // 2))
        pygame.display.flip()

    def commands(self) -> list[Command]:
        """Returns the commands given by keys since the last call; closing the window gives ``QUIT``."""
        pygame, commands = self._pygame, []
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                commands.append(Command.QUIT)
            elif event.type == pygame.KEYDOWN:
                # On some keyboards plus has no key of its own: only the typed character identifies it.
                typed = {"+": Command.FASTER, "-": Command.SLOWER}.get(getattr(event, "unicode", ""))
                command = typed or self._commands.get(event.key)
                commands += [] if command is None else [command]
        return commands

    def wait(self, rate: float) -> None:
        """Waits so that calls return ``rate`` times a second."""
        self._clock.tick(rate)

    def close(self) -> None:
        """Closes the window."""
        self._pygame.display.quit()


def _import_pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame  # noqa: PLC0415  (an optional package)
    except ImportError as error:
        raise ImportError("a window needs the package pygame-ce: pip install '.[window]'") from error
    return pygame
