"""The emulated device refuses what CUDA refuses, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from .emulated import DEVICE, DeviceGenerator, PlacementError, emulated_device


@pytest.fixture(autouse=True)
def _emulation() -> Iterator[None]:
    with emulated_device():
        yield


def here() -> Tensor:
    return torch.arange(3)


def there() -> Tensor:
    return torch.arange(3, device=DEVICE)


def _with_new_values(value: Tensor, index: slice, new: Tensor) -> Tensor:
    value[index] = new
    return value


REFUSED: dict[str, Callable[[], object]] = {
    "sum": lambda: here() + there(),
    "in place": lambda: there().add_(here()),
    "cat": lambda: torch.cat((here(), there())),
    "index_select": lambda: there().index_select(0, here()),
    "gather": lambda: there().gather(0, here()),
    "index of the device": lambda: here()[there()],
    "new values": lambda: there().__setitem__(here(), here()),
    "where": lambda: torch.where(there() > 1, here(), here()),
    "numpy": lambda: there().numpy(),
    "generator here": lambda: torch.rand(3, device=DEVICE, generator=torch.Generator()),
    "generator there": lambda: torch.rand(3, generator=DeviceGenerator()),
    "linear": lambda: nn.Linear(3, 1).to(DEVICE)(here().float()),
}
ALLOWED: dict[str, Callable[[], Tensor]] = {
    "a number": lambda: there() + torch.tensor(2),
    "index from here": lambda: there()[here()],
    "reduction": lambda: there().sum(),
    "like": lambda: torch.zeros_like(there()),
    "to": lambda: here().to(DEVICE),
    "to another": lambda: here().to(there()),
    "copy": lambda: there().copy_(here()),
    "new values of a slice": lambda: _with_new_values(there(), slice(0, 2), here()[:2]),
    "new": lambda: there().new_zeros(2),
    "generator": lambda: torch.rand(3, device=DEVICE, generator=DeviceGenerator()),
    "linear": lambda: nn.Linear(3, 1).to(DEVICE)(there().float()),
    "split": lambda: there().split(1)[0],
    "tensordict": lambda: TensorDict({"a": here()}, [3]).to(DEVICE)[1:]["a"],
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name: str) -> None:
    with pytest.raises(PlacementError):
        REFUSED[name]()


@pytest.mark.parametrize("name", ALLOWED)
def test_allowed(name: str) -> None:
    assert ALLOWED[name]().device == DEVICE


def test_what_comes_back_is_here() -> None:
    for back in (there().cpu(), there().to("cpu"), TensorDict({"a": there()}, [3]).cpu()["a"]):
        assert back.device.type == "cpu"
        assert (back + here()).tolist() == [0, 2, 4]
    assert there().tolist() == here().numpy().tolist() == [0, 1, 2]
    assert int(there()[2]) == 2


def test_gradients_and_optimizers_stay_there() -> None:
    net = nn.Linear(2, 1).to(DEVICE)
    before = net.weight.tolist()
    optimizer = torch.optim.Adam(net.parameters(), fused=True)
    net(torch.ones(5, 2, device=DEVICE)).sum().backward()
    assert net.weight.grad is not None
    assert net.weight.grad.device == DEVICE
    optimizer.step()
    assert net.weight.device == DEVICE
    assert net.weight.tolist() != before
    assert {value.device for value in net.state_dict().values()} == {DEVICE}
