"""CUDA graphs that are not there: kernels are recorded on the CPU, and launched again when a graph is.

Within :func:`emulated_graphs`, what torch offers for CUDA graphs works on the tensors of
:func:`~tests.emulated.emulated_device`. While a graph is recorded nothing happens to tensors that were there
before, as on a GPU, and to read a number from one is refused. What Python does between two kernels happens
once, when the graph is recorded, and not when it is launched.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from typing import Any
from unittest.mock import Mock, patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from .emulated import DeviceGenerator, tensors_in


class CapturingError(RuntimeError):
    """What CUDA raises where a graph would have to wait for a number."""


class Graph:
    """In place of ``torch.cuda.CUDAGraph``.

    Attributes:
        launched: how often any graph was.
    """

    launched = 0

    def __init__(self) -> None:
        self.kernels: list[tuple[Any, Any, dict[str, Any], Any]] = []
        self.generators: list[torch.Generator] = []

    def register_generator_state(self, generator: torch.Generator) -> None:
        """A graph's kernels draw from a generator only if it was told so."""
        assert isinstance(generator, DeviceGenerator)
        self.generators.append(generator)

    @torch.no_grad()
    def replay(self) -> None:
        Graph.launched += 1
        with torch._C.DisableTorchFunction():  # where tensors are was checked when they were recorded
            for kernel, args, options, before in self.kernels:
                again = kernel(*args, **options)
                for own, new in zip(tensors_in(before), tensors_in(again), strict=True):
                    if own.data_ptr() != new.data_ptr():
                        own.copy_(new)


class _Recording(TorchDispatchMode):
    under_way = False

    def __init__(self, graph: Graph, **_options: Any) -> None:
        super().__init__()
        self.graph = graph
        self._own: list[Tensor] = []  # made meanwhile, and kept, so that no other tensor has their memory
        self._made: set[int] = set()  # their memory
        self._before: dict[int, tuple[Tensor, Tensor]] = {}  # bytes of memory, and what was there
        self._states: list[Tensor] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        options = dict(kwargs or {})
        if func is torch.ops.aten._local_scalar_dense.default:
            raise CapturingError("operation not permitted when stream is capturing: a number is read")
        source = options.get("generator")  # not the object that Python had, but with its state
        if source is not None and not any(
            torch.equal(source.get_state(), own.get_state()) for own in self.graph.generators
        ):
            raise CapturingError("the generator was not registered with the graph")
        for place, own in enumerate(func._schema.arguments):
            if own.alias_info is not None and own.alias_info.is_write:
                self._keep(args[place] if place < len(args) else options.get(own.name))
        out = func(*args, **options)
        known = {own.untyped_storage().data_ptr() for own in tensors_in((args, options))}
        new = [own for own in tensors_in(out) if own.untyped_storage().data_ptr() not in known]
        self._own += new
        self._made |= {own.untyped_storage().data_ptr() for own in new}
        self.graph.kernels.append((func, args, options, out))
        return out

    def _keep(self, written: Any) -> None:
        """Notes what is in tensors before they are written to."""
        for own in tensors_in(written):
            storage = own.untyped_storage()
            if storage.data_ptr() not in self._made and storage.data_ptr() not in self._before:
                memory = torch.empty(0, dtype=torch.uint8).set_(storage)
                self._before[storage.data_ptr()] = (memory, memory.clone())

    def __enter__(self) -> Any:
        _Recording.under_way = True
        self._states = [own.get_state() for own in self.graph.generators]
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        _Recording.under_way = False
        for memory, before in self._before.values():
            memory.copy_(before)
        for source, state in zip(self.graph.generators, self._states, strict=True):
            source.set_state(state)


@contextmanager
def emulated_graphs() -> Iterator[type[Graph]]:
    """Lets ``torch.cuda`` record graphs."""
    Graph.launched = 0
    nothing = {"Stream": Mock(), "current_stream": Mock(), "synchronize": Mock()}
    stream = Mock()
    stream.is_capturing = lambda: _Recording.under_way
    with ExitStack() as stack:
        stack.enter_context(patch.object(torch.accelerator, "current_stream", lambda: stream))
        for name, own in {
            **nothing,
            "is_available": lambda: True,
            "is_current_stream_capturing": lambda: _Recording.under_way,
            "stream": lambda stream: nullcontext(),
            "device": lambda device: nullcontext(),
            "CUDAGraph": Graph,
            "graph": _Recording,
        }.items():
            stack.enter_context(patch.object(torch.cuda, name, own))
        yield Graph
