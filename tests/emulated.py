"""A device that is not there: tensors on the CPU, under the placement rules of CUDA.

Within :func:`emulated_device`, tensors and modules can be moved to :data:`DEVICE`. Operations on tensors of
several devices are refused where CUDA refuses them, and so are generators that are elsewhere and
conversions to numpy. The numbers are those of the CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode, resolve_name
from torch.utils._pytree import tree_leaves, tree_map
from torchrl.objectives import utils

DEVICE = torch.device("cuda", 0)
CPU = torch.device("cpu")

_GENERATOR = torch.Generator
_FACTORIES = {
    getattr(torch, name)
    for name in [
        "arange",
        "as_tensor",
        "empty",
        "empty_like",
        "empty_strided",
        "eye",
        "full",
        "full_like",
        "linspace",
        "ones",
        "ones_like",
        "rand",
        "rand_like",
        "randint",
        "randint_like",
        "randn",
        "randn_like",
        "randperm",
        "scalar_tensor",
        "tensor",
        "zeros",
        "zeros_like",
    ]
}
_MOVES = {Tensor.to, Tensor.cpu, Tensor.copy_, Tensor.type_as, Tensor.__deepcopy__}
_INDEXING = {Tensor.__getitem__, Tensor.__setitem__, Tensor.index_put, Tensor.index_put_}
_ON_THE_CPU_ONLY = {Tensor.numpy, Tensor.__array__}


class PlacementError(RuntimeError):
    """What CUDA would have raised."""


class OnDevice(Tensor):
    """Marks a tensor as being on the device."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    device = property(lambda self: DEVICE)  # type: ignore[assignment]
    is_cuda = property(lambda self: True)  # type: ignore[assignment]
    is_cpu = property(lambda self: False)  # type: ignore[assignment]

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        if id(self) not in memo:
            copy = self.detach().clone().as_subclass(OnDevice).requires_grad_(self.requires_grad)
            memo[id(self)] = nn.Parameter(copy, self.requires_grad) if self._is_a_parameter else copy
        return memo[id(self)]

    def __reduce_ex__(self, protocol: Any) -> Any:  # files can be loaded where there is no such device
        return self.detach().as_subclass(Tensor).__reduce_ex__(protocol)

    @property
    def _is_a_parameter(self) -> bool:
        return isinstance(self, nn.Parameter)


class DeviceGenerator(torch.Generator):
    """A source of random numbers on the device."""

    device = DEVICE


class _Made(type):
    """Makes generators on the device they are asked for, and takes both kinds for generators."""

    def __call__(cls, device: Any = "cpu") -> torch.Generator:
        return DeviceGenerator() if torch.device(device).type == DEVICE.type else _GENERATOR(device)

    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, _GENERATOR)


class _Generator(metaclass=_Made):
    pass


@contextmanager
def emulated_device() -> Iterator[torch.device]:
    """Lets tensors and modules be moved to :data:`DEVICE`."""
    emulation = _Emulation()
    with (
        patch.object(utils, "vmap", emulation.vmap),  # of TorchRL's losses
        patch.object(torch, "Generator", _Generator),
        emulation,
    ):
        yield DEVICE


class _Emulation(TorchFunctionMode):
    def __init__(self) -> None:
        super().__init__()
        self._within_vmap = False

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        options = dict(kwargs or {})
        tensors = tensors_in((args, options))
        there = [isinstance(leaf, OnDevice) for leaf in tensors]
        if func is torch._has_compatible_shallow_copy_type:
            return there[0] == there[1]  # if not, modules make their parameters anew
        after = _is_there_after(func, args, options, there)
        problem = _problem(func, args, options, tensors, there, after)
        if problem and not self._within_vmap:
            raise PlacementError(f"{resolve_name(func) or func} got {problem}")
        if options.get("device") is not None:
            options["device"] = CPU
        if func is Tensor.to:
            args = [CPU if isinstance(own, str | torch.device) else own for own in args]
        out = func(*args, **options)
        if self._within_vmap or isinstance(out, torch.Size):
            return out
        return (
            _put(out, there=after) if isinstance(out, Tensor) else tree_map(partial(_put, there=after), out)
        )

    def vmap(self, func: Callable[..., Any], *args: Any, **options: Any) -> Callable[..., Any]:
        """What is mapped sees other tensors, which cannot be marked: only what goes in and out is checked."""
        mapped = torch.vmap(func, *args, **options)

        def call(*given: Any, **named: Any) -> Any:
            there = {isinstance(leaf, OnDevice) for leaf in tensors_in((given, named))}
            if len(there) > 1:
                raise PlacementError("vmap got tensors on the CPU and on the device")
            before, self._within_vmap = self._within_vmap, True
            try:
                out = mapped(*given, **named)
            finally:
                self._within_vmap = before
            return tree_map(partial(_put, there=there == {True}), out)

        return call


def tensors_in(value: Any) -> list[Tensor]:
    """Tensors of nested containers. Torch's own function for that takes longer than what is emulated."""
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, list | tuple):
        return [leaf for own in value for leaf in tensors_in(own)]
    if isinstance(value, TensorDictBase):
        return list(value.values(True, True))
    return tensors_in(list(value.values())) if isinstance(value, dict) else []


def _put(value: Any, *, there: bool) -> Any:
    """A tensor in its place; anything else as it is."""
    if isinstance(value, TensorDictBase):
        return value.apply(partial(_put, there=there))
    if not isinstance(value, Tensor) or isinstance(value, OnDevice) == there:
        return value
    return value.as_subclass(OnDevice if there else Tensor)


def _is_there_after(func: Any, args: Any, options: dict[str, Any], there: list[bool]) -> bool:
    """Whether what comes out is on the device."""
    if func is Tensor.cpu:
        return False
    if func in (Tensor.copy_, Tensor.__deepcopy__) or func in _INDEXING:
        return there[0]
    asked = options.get("device")
    if func is Tensor.to:
        for own in args[1:]:
            if isinstance(own, Tensor):
                return isinstance(own, OnDevice)
            asked = own if isinstance(own, str | torch.device) else asked
    return any(there) if asked is None else torch.device(asked).type == DEVICE.type


def _problem(
    func: Any,
    args: Any,
    options: dict[str, Any],
    tensors: Sequence[Tensor],
    there: list[bool],
    after: bool,
) -> str:
    """What CUDA does not like about a call; an empty text if it does."""
    generator = options.get("generator")
    if generator is not None and isinstance(generator, DeviceGenerator) != after:
        return "a generator on another device"
    if func in _ON_THE_CPU_ONLY and there[0]:
        return "a tensor on the device"
    copied = func in (Tensor.to, Tensor.copy_) and after and not there[-1]
    if copied and torch.cuda.is_available() and torch.cuda.is_current_stream_capturing():
        return "a tensor on the CPU, while a graph is recorded"
    if func in _MOVES or func in _FACTORIES or all(there) or not any(there):
        return ""
    if func is Tensor.__setitem__ and not any(isinstance(own, Tensor) for own in tree_leaves(args[1])):
        return ""  # a copy into a slice
    if func in _INDEXING and there[0]:  # by an index from anywhere
        new = args[2] if func is Tensor.__setitem__ else None
        if not isinstance(new, Tensor) or isinstance(new, OnDevice) or new.ndim == 0:
            return ""
    elif func not in _INDEXING and all(
        own or tensor.ndim == 0 for own, tensor in zip(there, tensors, strict=True)
    ):
        return ""  # numbers may be anywhere
    return "tensors on the CPU and on the device"
