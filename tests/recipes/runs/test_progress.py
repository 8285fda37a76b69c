"""How a run shows how far it is, on a terminal and elsewhere."""

from __future__ import annotations

import sys

import pytest

from torchrl_her_recipes import build, run

from ..small import small

SHORT = {"warmup_frames": 400, "frames_per_update": 16}


def test_where_there_is_no_terminal_each_epoch_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    result = run(build(small(epochs=2, **SHORT)))
    captured = capsys.readouterr()
    assert captured.out == ""
    seconds, success = ([row[name] for row in result.rows] for name in ("seconds", "success"))
    assert captured.err.splitlines() == [
        f"epoch 1 of 2: 480 frames, 30 updates, {seconds[0]:.0f} s, success {success[0]:.0%}",
        f"epoch 2 of 2: 960 frames, 60 updates, {seconds[1]:.0f} s, success {success[1]:.0%}",
    ]


def test_on_a_terminal_there_is_a_bar(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    run(build(small(epochs=1, **SHORT)))
    said = capsys.readouterr().err
    assert "480/480" in said
    assert "epoch 1 of 1" not in said
