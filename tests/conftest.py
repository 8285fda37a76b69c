"""What all tests share: one thread, a seed, and leaving nothing behind."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator

import pytest
import torch
from torchrl.envs.utils import exploration_type

from .emulated import emulated_device

gc.disable()  # until all is collected, see below

# Small tensors are fastest in one thread, and the workers of pytest-xdist share the cores. The second line is
# for the processes that tests start.
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # for tests whose GPU sums in a fixed order


@pytest.fixture(autouse=True, scope="session")
def _state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Runs of tests are not noted among those of the user, and do not wait for the disk."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield


@pytest.fixture(autouse=True)
def _seed() -> Iterator[None]:
    torch.manual_seed(0)
    before = exploration_type()
    yield
    assert exploration_type() is before


def pytest_collection_finish() -> None:
    """Garbage is collected from now on, but not sought among modules and tests, which stay."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that take long begin first, so that no worker is left alone with one of them at the end."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)


@pytest.fixture(params=["cpu", "emulated", "cuda"])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """Where a part is tried: on the CPU, on a device that is emulated, and on a GPU if there is one."""
    if request.param == "emulated":
        with emulated_device() as emulated:
            yield emulated
    elif request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    else:
        yield torch.device(request.param, *([0] if request.param == "cuda" else []))


@pytest.fixture
def make_generator(device: torch.device) -> Callable[[int], torch.Generator]:
    """Makes sources of random numbers on the device."""

    def make(seed: int) -> torch.Generator:
        return torch.Generator(device).manual_seed(seed)

    return make
