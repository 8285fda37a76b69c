"""Lines that the command line prints."""

from __future__ import annotations

import pytest

from torchrl_her_recipes.cli.say import say_warning


def test_colors_of_a_warning_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    say_warning("\x1b[33mWARN: The reward is\n an array\x1b[0m")  # as gymnasium's are
    assert capsys.readouterr().err == "torchrl-her: warning: WARN: The reward is an array\n"
