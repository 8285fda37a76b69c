"""Gradient steps on a GPU: recorded once as a CUDA graph, then launched many at a time."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_her.replay_buffers.n_steps import STEPS_KEY
from torchrl_her.trainers.learner import WEIGHT, LossLearner, check_rows


class GraphLearner(LossLearner):
    """The gradient steps of a :class:`~torchrl_her.LossLearner`, as one launch of a GPU for several steps.

    A gradient step of small networks is hundreds of small kernels, each of which takes longer to launch than
    to run. Here the kernels of several steps are recorded as a CUDA graph and then launched together. The
    first update with a number of steps is made without a graph. ``torch.compile`` makes fewer and larger
    kernels of them before, which takes a minute.

    What is recorded are kernels, and numbers that Python computed meanwhile: gamma, tau and all options of
    the loss must stay as they are. A learning rate may change; the steps are then recorded anew. Runs that do
    not learn, which happens only while buffers fill, are left out by steps without a graph. Steps that turn
    out not to be recordable are made without one, too, after a warning.

    Args:
        loss: as for :class:`~torchrl_her.LossLearner`.
        optimizer: with ``capturable=True``.
        target: one that moves the targets in the same way in each step, such as ``SoftUpdate``.
        max_grad_norm: likewise.
        runs: R.

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
        reason = why_not_recorded(loss, optimizer, target)
        if reason is not None:
            raise ValueError(f"these gradient steps cannot be recorded: {reason}; use LossLearner")
        super().__init__(loss, optimizer, target, max_grad_norm=max_grad_norm, runs=runs)
        self.steps_per_graph = steps_per_graph
        self._step = torch.compile(self._update) if compile else self._update
        self._recorded: dict[Any, _Recorded] = {}
        self._keys = [*loss.in_keys, WEIGHT, STEPS_KEY]
        self._priority = getattr(loss.tensor_keys, "priority", None)

    def update(self, rows: TensorDictBase, steps: int = 1, *, idle: Sequence[int] = ()) -> dict[str, Tensor]:
        """Gradient steps of each run; see :class:`~torchrl_her.trainers.Learner`."""
        if idle:
            return super().update(rows, steps, idle=idle)
        check_rows(rows, steps, self.runs)
        last, batch = rows.ndim - 1, rows.shape[-1] // steps
        seen = rows.select(*self._keys, strict=False).split(self.steps_per_graph * batch, last)
        made = [self._of(part, part.shape[-1] // batch)(part) for part in seen]
        if self._priority is not None and "priority" in made[0]:
            rows.set(self._priority, torch.cat([own["priority"] for own in made], last))
        measured: TensorDictBase = torch.cat([own["measured"] for own in made])
        return dict(measured.items())

    def _of(self, rows: TensorDictBase, steps: int) -> _Recorded:
        """The recorded steps for such rows."""
        rates = tuple(float(group["lr"]) for group in self.optimizer.param_groups)
        key = (steps, rows.shape, rates)
        if key not in self._recorded:
            self._recorded = {known: own for known, own in self._recorded.items() if known[-1] == rates}
            noise = getattr(self.loss, "noise", None)
            self._recorded[key] = _Recorded(
                lambda rows: self._steps(rows, steps), generators=getattr(noise, "generators", None) or ()
            )
        return self._recorded[key]

    def _steps(self, rows: TensorDictBase, steps: int) -> TensorDictBase:
        """Makes gradient steps: what they measured, [S, R] each, and the new priorities."""
        last = rows.ndim - 1
        parts = rows.split(rows.shape[last] // steps, last)
        measured = [self._step(part) for part in parts]
        together = {name: torch.stack([own[name] for own in measured]) for name in measured[0]}
        out = TensorDict({"measured": TensorDict(together, [steps])})
        if self._priority is not None and parts[0].get(self._priority, None) is not None:
            out["priority"] = torch.cat([part.get(self._priority) for part in parts], last)
        return out


class _Recorded:
    """What is called for the first time as it is, then recorded, and from then on launched.

    Args:
        call: always computes the same of rows of the same shape.
        generators: of its random numbers, beside torch's own.
    """

    def __init__(
        self, call: Callable[[TensorDictBase], TensorDictBase], generators: Sequence[torch.Generator]
    ) -> None:
        self._call, self._generators = call, generators
        self._graph: torch.cuda.CUDAGraph | None = None
        self._rows = self._out = TensorDict()  # what the graph reads and writes
        self._is_warm = self._failed = False

    def __call__(self, rows: TensorDictBase) -> TensorDictBase:
        if self._failed:
            return self._call(rows)
        if not self._is_warm:
            self._is_warm = True
            return self._beside(rows)
        if self._graph is None:
            try:
                self._graph = self._record(rows)
            except RuntimeError as error:  # nothing was computed: kernels that are recorded do not run
                self._failed = True
                reason = next(iter(str(error).splitlines()), type(error).__name__)
                warnings.warn(f"gradient steps are launched one by one: {reason}", stacklevel=4)
                return self._call(rows)
        else:
            self._rows.update_(rows, non_blocking=True)
        self._graph.replay()
        return self._out.clone()

    def _beside(self, rows: TensorDictBase) -> TensorDictBase:
        """Calls it on a stream of its own, as CUDA asks for before something is recorded."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            out = self._call(rows)
        torch.cuda.current_stream().wait_stream(stream)
        return out

    def _record(self, rows: TensorDictBase) -> torch.cuda.CUDAGraph:
        graph, self._rows = torch.cuda.CUDAGraph(), rows.clone()
        for generator in self._generators:
            graph.register_generator_state(generator)
        with torch.cuda.graph(graph):
            self._out = self._call(self._rows.copy())  # which entries are added to
        return graph


def why_not_recorded(
    loss: LossModule, optimizer: torch.optim.Optimizer, target: TargetNetUpdater | None
) -> str | None:
    """Why gradient steps cannot be recorded as a CUDA graph, or None if they can."""
    devices = {parameter.device for parameter in loss.parameters()}
    if any(device.type != "cuda" for device in devices):
        return f"networks on {', '.join(sorted(str(device) for device in devices))}"
    if not all(group.get("capturable", False) for group in optimizer.param_groups):
        return f"an optimizer without capturable=True, {type(optimizer).__name__}"
    if isinstance(target, HardUpdate):
        return "targets that are copied in some steps only, by a HardUpdate"
    return None
