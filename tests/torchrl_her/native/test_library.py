"""Compiling: where libraries are kept, and what is said where that fails."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from torchrl_her.native import CannotCompile, load_steps
from torchrl_her.native.library import _EXTRAS


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An empty cache, and no library that is loaded already."""
    load_steps.cache_clear()
    monkeypatch.setenv("TORCHRL_HER_CACHE", str(tmp_path / "cache"))


def fake_compiler(folder: Path, text: str) -> Path:
    path = folder / "fake++"
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(0o755)
    return path


def test_a_missing_compiler_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(CannotCompile, match="there is no C\\+\\+ compiler no-such-compiler"):
        load_steps(torch.float32)


def test_without_any_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(CannotCompile, match=r"there is no C\+\+ compiler \(g\+\+ or clang\+\+\)"):
        load_steps(torch.float32)


def test_what_the_compiler_says_is_passed_on_and_nothing_is_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    compiler = fake_compiler(tmp_path, 'echo "out of order" >&2; exit 1')
    monkeypatch.setenv("CXX", str(compiler))
    with pytest.raises(CannotCompile, match="cannot compile steps.cpp: out of order"):
        load_steps(torch.float32)
    assert list((tmp_path / "cache").iterdir()) == []


def test_it_tries_with_fewer_options_where_the_compiler_knows_less(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    log = tmp_path / "calls"
    compiler = fake_compiler(tmp_path, f'echo "$*" >> {log}; exit 1')
    monkeypatch.setenv("CXX", str(compiler))
    with pytest.raises(CannotCompile):
        load_steps(torch.float32)
    calls = [line for line in log.read_text(encoding="utf-8").splitlines() if "-o" in line.split()]
    assert len(calls) == len(_EXTRAS)
    assert "-fopenmp" in calls[0]
    assert "=native" not in calls[-1]


def test_other_types_have_no_steps() -> None:
    with pytest.raises(CannotCompile, match=r"torch.float32, torch.float64, got torch.bfloat16"):
        load_steps(torch.bfloat16)


def test_a_cache_that_cannot_be_written_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder", encoding="utf-8")
    monkeypatch.setenv("TORCHRL_HER_CACHE", str(tmp_path / "file"))
    with pytest.raises(CannotCompile, match="steps.cpp cannot be compiled or loaded"):
        load_steps(torch.float32)


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
def test_it_is_compiled_once_and_then_found_in_the_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("CXX", "g++")
    load_steps(torch.float32)
    (library,) = (tmp_path / "cache").iterdir()
    made = library.stat().st_mtime_ns
    load_steps.cache_clear()
    load_steps(torch.float32)
    assert [(path, path.stat().st_mtime_ns) for path in (tmp_path / "cache").iterdir()] == [(library, made)]
