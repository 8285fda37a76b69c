"""A window with keys, on SDL's dummy display."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
import pygame
import pytest

from torchrl_her_envs.common.rendering.key_window import Command, KeyWindow


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> Iterator[KeyWindow]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window = KeyWindow("a title")
    yield window
    window.close()


def press(key: int, letter: str = "") -> None:
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key, unicode=letter))


def test_pictures_are_shown_as_they_are_and_scaled_to_the_window(window: KeyWindow) -> None:
    picture = np.zeros((200, 300, 3), np.uint8)
    picture[:100, :, 0] = 255
    window.show(picture)
    surface = pygame.display.get_surface()
    assert surface.get_size() == (300, 200)
    assert surface.get_at((150, 50))[:3] == (255, 0, 0)
    assert surface.get_at((150, 150))[:3] == (0, 0, 0)
    small = np.full((20, 40, 3), 90, np.uint8)
    window.show(small)  # in a window of at least 160 by 160 pixels
    surface = pygame.display.get_surface()
    assert surface.get_size() == (160, 160)
    assert surface.get_at((80, 80))[:3] == (90, 90, 90)
    assert surface.get_at((80, 5))[:3] == (0, 0, 0)  # above the picture, which keeps its proportions
    assert window.title == "a title"


def test_keys_are_commands_in_the_order_in_which_they_are_pressed(window: KeyWindow) -> None:
    for key in (pygame.K_SPACE, pygame.K_RIGHT, pygame.K_n, pygame.K_x, pygame.K_r, pygame.K_KP_PLUS):
        press(key)
    press(pygame.K_MINUS, "-")
    press(pygame.K_1, "+")  # as on a Swiss keyboard
    press(pygame.K_q)
    press(pygame.K_ESCAPE)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert window.commands() == [
        Command.PAUSE, Command.STEP, Command.STEP, Command.RESET, Command.FASTER, Command.SLOWER,
        Command.FASTER, Command.QUIT, Command.QUIT, Command.QUIT,
    ]  # fmt: skip
    assert window.commands() == []


def test_without_a_display_one_line_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ValueError, match=r"needs a display, and there is none: .*--out FILE.mp4") as error:
        KeyWindow("a title")
    assert "\n" not in str(error.value)
    monkeypatch.setenv("SDL_VIDEODRIVER", "nowhere")
    with pytest.raises(ValueError, match=r"there is none \(.*nowhere.*\): work where"):
        KeyWindow("a title")


def test_a_display_that_is_no_display_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """SDL falls back to a driver that shows nothing."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    try:
        monkeypatch.setenv("SDL_VIDEODRIVER", "")
        monkeypatch.setenv("DISPLAY", ":77")
        with pytest.raises(ValueError, match="there is none: work where"):
            KeyWindow("a title")
    finally:
        pygame.display.quit()


def test_without_the_extra_its_name_is_in_the_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"pygame-ce: pip install '\.\[window\]'"):
        KeyWindow("a title")
