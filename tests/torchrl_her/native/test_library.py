"""Compiling: where libraries are kept, and what is said where that fails."""

from __future__ import annotations

import importlib.util
import platform
import shutil
import sys
from pathlib import Path

import pytest
import torch

from torchrl_her.native import CannotCompile, library, load_library, load_steps
from torchrl_her.native.library import (
    _EXTRAS,
    compile_library,
    find_ziglang,
    levels,
    shipped_name,
)

V3 = "sse2 avx avx2 bmi1 bmi2 f16c fma movbe abm"
V4 = f"{V3} avx512f avx512bw avx512cd avx512dq avx512vl"
# With OpenMP it needs a function that is nowhere, so that it compiles but does not load.
TINY = """
#if defined(_OPENMP)
extern "C" int nowhere();
int needed = nowhere();
#endif
extern "C" int answer() { return ANSWER; }
"""
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An empty cache, and no library that is loaded already."""
    load_steps.cache_clear()
    monkeypatch.setenv("TORCHRL_HER_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(library, "_SHIPPED", tmp_path / "shipped")


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A source whose function gives 1, and a wheel's libraries: 3 for x86-64-v3, 8 on ARM, damaged for v4."""
    source = tmp_path / "tiny.cpp"
    name = shipped_name("tiny.cpp", "float")
    for level, answer in (("x86-64-v3", "3"), ("armv8-a", "8")):
        (tmp_path / "shipped" / level).mkdir(parents=True)
        source.write_text(TINY.replace("ANSWER", answer), encoding="utf-8")
        compile_library(["g++"], source, tmp_path / "shipped" / level / name, real="float", extras=())
    (tmp_path / "shipped" / "x86-64-v4").mkdir()
    (tmp_path / "shipped" / "x86-64-v4" / name).write_text("damaged", encoding="utf-8")
    source.write_text(TINY.replace("ANSWER", "1"), encoding="utf-8")
    return source


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
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(CannotCompile, match=r"there is no C\+\+ compiler \(g\+\+ or clang\+\+"):
        load_steps(torch.float32)


def test_a_compiler_from_pip_is_found_where_there_is_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(importlib.util, "find_spec", {"ziglang": object()}.get)
    assert find_ziglang() == [sys.executable, "-m", "ziglang", "c++"]
    tried: list[list[str]] = []
    monkeypatch.setattr(library, "_load_compiled", lambda compiler, *_: tried.append(compiler) or "loaded")
    assert load_library("steps.cpp") == "loaded"
    assert tried == [find_ziglang()]
    monkeypatch.setattr(library, "_load_shipped", lambda *_: "shipped")  # at once, and no slower
    assert load_library("steps.cpp") == "shipped"
    assert len(tried) == 1
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(CannotCompile, match="CXX asks for another"):
        find_ziglang()


@pytest.mark.parametrize(
    ("machine", "flags", "expected"),
    [
        ("x86_64", "sse2 avx", []),
        ("x86_64", V3.replace("fma", "fma4"), []),
        ("x86_64", V3, ["x86-64-v3"]),
        ("x86_64", f"{V3} avx512f avx512cd avx512er avx512pf", ["x86-64-v3"]),  # a Xeon Phi
        ("x86_64", V4, ["x86-64-v4", "x86-64-v3"]),
        ("x86_64", f"{V4} avx512_bf16 amx_tile", ["x86-64-v4", "x86-64-v3"]),
        ("x86_64", "", []),  # macOS lists nothing
        ("aarch64", "fp asimd", ["armv8-a"]),
        ("arm64", "", ["armv8-a"]),
        ("riscv64", V4, []),
    ],
)
def test_a_processor_runs_the_levels_all_of_whose_instructions_it_has(
    machine: str, flags: str, expected: list[str]
) -> None:
    assert levels(machine, flags.split()) == expected


@needs_compiler
def test_what_compiles_but_does_not_load_is_compiled_with_other_options(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tiny: Path
) -> None:
    log = tmp_path / "calls"
    monkeypatch.setenv("CXX", str(fake_compiler(tmp_path, f'echo "$*" >> {log}; exec g++ "$@"')))
    assert load_library(str(tiny)).answer() == 1
    calls = [line.split() for line in log.read_text(encoding="utf-8").splitlines() if " -o " in line]
    assert "-fopenmp" in calls[0]
    assert len(calls) > 1
    assert "-fopenmp" not in calls[-1]
    (kept,) = (tmp_path / "cache").iterdir()
    kept.unlink()  # the library is mapped into memory: do not write into its file
    kept.write_text("damaged", encoding="utf-8")
    assert load_library(str(tiny)).answer() == 1


@needs_compiler
@pytest.mark.parametrize(
    ("machine", "flags", "answer"),
    [("x86_64", V3, 3), ("x86_64", V4, 3), ("aarch64", "fp asimd", 8), ("arm64", "", 8)],  # v4 is damaged
)
def test_without_a_compiler_the_wheels_library_is_loaded(
    monkeypatch: pytest.MonkeyPatch, tiny: Path, machine: str, flags: str, answer: int
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(library, "_processor_flags", lambda: f"flags : {flags}")
    assert load_library(str(tiny)).answer() == answer


@needs_compiler
def test_a_wheels_library_is_not_loaded_on_a_processor_that_cannot_run_it(
    monkeypatch: pytest.MonkeyPatch, tiny: Path
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(library, "_processor_flags", lambda: "flags : sse2 avx")
    with pytest.raises(CannotCompile, match="there is no C\\+\\+ compiler no-such-compiler"):
        load_library(str(tiny))


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


@needs_compiler
def test_it_is_compiled_once_and_then_found_in_the_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tiny: Path
) -> None:
    monkeypatch.setenv("CXX", "g++")
    load_library(str(tiny))
    (library,) = (tmp_path / "cache").iterdir()
    made = library.stat().st_mtime_ns
    load_library(str(tiny))
    assert [(path, path.stat().st_mtime_ns) for path in (tmp_path / "cache").iterdir()] == [(library, made)]
