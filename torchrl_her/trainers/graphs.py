"""Gradient steps on a GPU: recorded once as a CUDA graph, then launched many at a time."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.replay_buffers.n_steps import STEPS_KEY
from torchrl_her.trainers.learner import WEIGHT, LossLearner, check_rows


class GraphLearner(LossLearner):
    """Makes the gradient steps of a :class:`~torchrl_her.LossLearner`, several in one launch of a GPU.

    A gradient step of small networks is hundreds of small kernels, each of which takes longer to launch than
    to run. Here the kernels of several steps are recorded as a CUDA graph and then launched together. The
    first update with each number of steps is made without a graph. Before kernels are recorded,
    ``torch.compile`` makes fewer and larger ones of them.

    A graph repeats kernels with the numbers that Python gave them when they were recorded. So gamma, tau, and
    all other options of the loss, the targets and the optimizer must stay as they are, but for the learning
    rate: with another one, the steps are recorded anew. If you load a state into the optimizer, make the
    learner afterwards. Runs that do not learn (``idle``), which happens only while buffers fill, are left out
    by steps without a graph.

    Args:
        loss: TorchRL loss on a GPU, see :class:`~torchrl_her.LossLearner`.
        optimizer: optimizer of the loss's parameters; it is made ``capturable``.
        target: update that moves the targets in the same way in each step, such as ``SoftUpdate``.
        max_grad_norm: norm to which gradients are clipped, see :class:`~torchrl_her.LossLearner`.
        runs: R, the number of independent runs.

    Keyword Args:
        compile: whether ``torch.compile`` is used.
        steps_per_graph: the most gradient steps of one launch.

    Raises:
        ValueError: these steps cannot be recorded, see :func:`why_not_recorded`.

    Example:
        >>> from torchrl_her import make_actor, make_critic, make_ddpg_loss, make_target_updater
        >>> loss = make_ddpg_loss(make_actor((9, 2), 3), make_critic((9, 2), 3))
        >>> optimizer = torch.optim.Adam(loss.parameters())
        >>> GraphLearner(loss, optimizer, make_target_updater(loss, tau=0.01, hard_interval=0))
        Traceback (most recent call last):
        ...
        ValueError: these gradient steps cannot be recorded: networks on cpu; use LossLearner
    """

    def __init__(
        self,
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        target: TargetNetUpdater | None = None,
        *,
        max_grad_norm: float = 3.0,
        runs: int = 1,
        compile: bool = True,
        steps_per_graph: int = 32,
    ) -> None:
        reason = why_not_recorded(loss, target)
        if reason is not None:
            raise ValueError(f"these gradient steps cannot be recorded: {reason}; use LossLearner")
        super().__init__(loss, optimizer, target, max_grad_norm=max_grad_norm, runs=runs)
        self.steps_per_graph = steps_per_graph
        self._device = next(loss.parameters()).device
        self._step = torch.compile(self._update, dynamic=False) if compile else self._update
        self._recorded: dict[Any, _Recorded] = {}
        self._keys = [*loss.in_keys, WEIGHT, STEPS_KEY]
        self._priority = getattr(loss.tensor_keys, "priority", None)

    def update(self, rows: TensorDictBase, steps: int = 1, *, idle: Sequence[int] = ()) -> dict[str, Tensor]:
        """Makes gradient steps for each run; see :class:`~torchrl_her.trainers.Learner`.

        Raises:
            ValueError: the rows are not of R runs or not a whole number of batches.
            RuntimeError: the steps could not be recorded, for example because the loss reads a number from
                the GPU.
        """
        for group in self.optimizer.param_groups:
            if "capturable" in group:
                group["capturable"] = True
        if idle:
            with _uncaptured():
                return super().update(rows, steps, idle=idle)
        check_rows(rows, steps, self.runs)
        last, batch = rows.ndim - 1, rows.shape[-1] // steps
        parts = rows.select(*self._keys, strict=False).split(self.steps_per_graph * batch, last)
        results = [self._recorded_for(part, part.shape[-1] // batch)(part) for part in parts]
        if self._priority is not None and "priority" in results[0]:
            rows.set(self._priority, torch.cat([result["priority"] for result in results], last))
        measured: TensorDictBase = torch.cat([result["measured"] for result in results])
        return dict(measured.items())

    def _recorded_for(self, rows: TensorDictBase, steps: int) -> _Recorded:
        rates = tuple(float(group["lr"]) for group in self.optimizer.param_groups)
        key = (steps, rows.shape, rates)
        if key not in self._recorded:
            self._recorded = {
                known: recorded for known, recorded in self._recorded.items() if known[-1] == rates
            }
            noise = getattr(self.loss, "noise", None)
            self._recorded[key] = _Recorded(
                lambda rows: self._steps(rows, steps),
                device=self._device,
                generators=getattr(noise, "generators", None) or (),
            )
        return self._recorded[key]

    def _steps(self, rows: TensorDictBase, steps: int) -> TensorDictBase:
        """Makes gradient steps; returns their losses, [S, R] each, and the new priorities."""
        last = rows.ndim - 1
        parts = rows.split(rows.shape[last] // steps, last)
        measured = [self._step(part) for part in parts]
        together = {name: torch.stack([losses[name] for losses in measured]) for name in measured[0]}
        out = TensorDict({"measured": TensorDict(together, [steps])})
        if self._priority is not None and parts[0].get(self._priority, None) is not None:
            out["priority"] = torch.cat([part.get(self._priority) for part in parts], last)
        return out


class _Recorded:
    """Function that is called directly at first, then recorded as a CUDA graph, and launched from then on."""

    def __init__(
        self,
        call: Callable[[TensorDictBase], TensorDictBase],
        *,
        device: torch.device,
        generators: Sequence[torch.Generator],
    ) -> None:
        self._call, self._device, self._generators = call, device, generators
        self._graph: torch.cuda.CUDAGraph | None = None
        self._rows = self._out = TensorDict()  # tensors that the graph reads and writes
        self._was_called = False

    def __call__(self, rows: TensorDictBase) -> TensorDictBase:
        with torch.cuda.device(self._device):
            if not self._was_called:
                self._was_called = True
                # A copy has the strides of the rows to be recorded; with others, torch.compile would compile
                # while the graph is recorded, which fails.
                return self._call_on_another_stream(rows.clone())
            if self._graph is None:
                self._graph = self._record(rows)
            else:
                self._rows.update_(rows, non_blocking=True)
            self._graph.replay()
            return self._out.clone()

    def _call_on_another_stream(self, rows: TensorDictBase) -> TensorDictBase:
        """Makes a call on a side stream, as CUDA requires before a recording."""
        stream = torch.cuda.Stream(self._device)
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream), _uncaptured():
            out = self._call(rows)
        torch.cuda.current_stream().wait_stream(stream)
        return out

    def _record(self, rows: TensorDictBase) -> torch.cuda.CUDAGraph:
        graph, self._rows = torch.cuda.CUDAGraph(), rows.clone()
        for generator in self._generators:
            graph.register_generator_state(generator)
        try:
            # A stream of this device: torch's default for graphs is one of the device that was first used.
            with torch.cuda.graph(graph, stream=torch.cuda.Stream(self._device)):
                self._out = self._call(self._rows.copy())  # a copy, since the call adds entries
        except RuntimeError as error:
            first: BaseException = error
            while first.__context__ is not None:  # later errors follow from the first one
                first = first.__context__
            reason = next(iter(str(first).splitlines()), type(first).__name__)
            raise RuntimeError(
                f"gradient steps cannot be recorded as a CUDA graph: {reason}; use LossLearner "
                "(in recipes, compile=never)"
            ) from error
        return graph


@contextmanager
def _uncaptured() -> Iterator[None]:
    """Suppresses torch's warning about steps of a ``capturable`` optimizer without a graph."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*capturable=True.*")
        yield


def why_not_recorded(loss: LossModule, target: TargetNetUpdater | None = None) -> str | None:
    """Returns why gradient steps cannot be recorded as a CUDA graph, or None if they can.

    Args:
        loss: any loss of TorchRL.
        target: update of its target networks.
    """
    if getattr(getattr(loss, "terms", None), "cloning", None) is not None:
        return "behavior cloning of demonstrations, whose places in a batch are read from the GPU"
    devices = {parameter.device for parameter in loss.parameters()}
    if any(device.type != "cuda" for device in devices) or len(devices) != 1:
        return f"networks on {', '.join(sorted(str(device) for device in devices))}"
    if isinstance(target, HardUpdate):
        return "targets that are copied in some steps only, by a HardUpdate"
    return None
