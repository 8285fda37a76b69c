"""Trees of sums in C++: compiled once, and done without where that cannot be.

What they compute is tested with the trees themselves.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from torchrl_her.native.trees import load_trees
from torchrl_her.replay_buffers.runs.trees import SumTrees


@pytest.fixture(autouse=True)
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setenv("TORCHRL_HER_CACHE", str(tmp_path / "cache"))
    load_trees.cache_clear()
    yield
    load_trees.cache_clear()


def draw() -> list[int]:
    trees = SumTrees(100)
    trees.set(torch.zeros(2, dtype=torch.int64), torch.tensor([3, 70]), torch.tensor([1.0, 3.0]))
    return trees.draw(torch.tensor([[0.1, 0.3, 0.9]], dtype=torch.float64))[0].flatten().tolist()


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
def test_it_is_compiled_once_and_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CXX", "g++")
    assert draw() == [3, 70, 70]
    (library,) = (tmp_path / "cache").iterdir()
    made = library.stat().st_mtime_ns
    load_trees.cache_clear()
    assert load_trees() is not None
    assert [path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()] == [made]


def test_without_a_compiler_tensors_do_the_work(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert load_trees() is None
    assert draw() == [3, 70, 70]
