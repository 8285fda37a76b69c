"""Writes policies as ONNX files, and checks that onnxruntime returns the policy's actions with them.

Of torch's two exporters, this module uses the one based on ``torch.export`` (``dynamo=True``), which is
maintained and converts all networks of this library. The older one, based on TorchScript, is deprecated and
fails at layer normalization over a width that depends on the input's shape.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_her.files.writing import written
from torchrl_her_recipes.policies.info import KEYS, PolicyInfo
from torchrl_her_recipes.policies.network import TensorPolicy

SUFFIX = ".onnx"
TOLERANCE = 1e-5  # largest allowed difference of actions, relative to the largest action if it is above 1

_OPSET = 18  # version of ONNX operators: the lowest that torch writes without conversion; of 2023


def need_onnx() -> ModuleType:
    """Returns the package ``onnxruntime``; raises an ImportError if a package for ONNX files is missing."""
    try:
        # Imported here, since few users need these packages, which are an extra and take a second to import.
        import onnx  # noqa: F401, PLC0415
        import onnxruntime  # noqa: PLC0415
        import onnxscript  # noqa: F401, PLC0415
    except ImportError as error:
        raise ImportError(
            "ONNX files need onnx, onnxruntime and onnxscript: pip install '.[onnx]'"
        ) from error
    return onnxruntime


def write_onnx(
    policy: TensorDictModuleBase,
    info: PolicyInfo,
    recipe: Mapping[str, Any],
    path: str | Path,
    *,
    states: TensorDictBase,
) -> PolicyInfo:
    """Writes a policy as an ONNX file, in float32, for any number of rows.

    The graph has the inputs ``observation`` [batch, width] and ``desired_goal`` [batch, width], and the
    output ``action`` [batch, width], or [batch] of integers. It includes normalization and the scaling of
    actions. The file's metadata contain ``info`` and ``recipe`` as JSON.

    The file gets its name only when onnxruntime has returned the policy's actions with it.

    Args:
        policy: Policy from :func:`~torchrl_her_recipes.policies.network.load_network`.
        info: Inputs, outputs and origin of the policy.
        recipe: Recipe of the run that trained the policy, as plain values.
        path: Path of the file.
        states: Rows of ``observation`` and ``desired_goal`` on which actions are compared.

    Returns:
        The info that the file contains, with the dtypes of the ONNX graph.

    Raises:
        ValueError: onnxruntime returns other actions.
        ImportError: onnx, onnxruntime or onnxscript is missing.
        OSError: The file cannot be written.
    """
    runtime = need_onnx()
    path, module = Path(path), TensorPolicy(policy)
    info = replace(info, dtype="float32", action_dtype="int64" if info.discrete else "float32")
    proto = _graph_of(module, info)
    for name, facts in (("card", info.to_dict()), ("recipe", recipe)):
        proto.metadata_props.add(key=f"torchrl_her.{name}", value=json.dumps(facts))
    inputs = {key: states[key].reshape(-1, info.widths[key]).float() for key in KEYS}
    with written(path) as part:
        part.write_bytes(model := proto.SerializeToString())
        session = runtime.InferenceSession(model, providers=["CPUExecutionProvider"])
        (action,) = session.run(["action"], {key: value.numpy() for key, value in inputs.items()})
        _check_actions(module, torch.from_numpy(action), info, inputs)
    return info


def _check_actions(module: TensorPolicy, action: Tensor, info: PolicyInfo, inputs: dict[str, Tensor]) -> None:
    """Raises a ValueError if actions differ from the policy's by more than :data:`TOLERANCE`.

    See :meth:`TensorPolicy.deviation` for the difference of actions that are integers.
    """
    worst = float(module.deviation(action, *inputs.values()).nan_to_num(torch.inf).max())
    scale = max([1.0, *(abs(side) for side in (*info.low, *info.high) if abs(side) < float("inf"))])
    limit = TOLERANCE * (1.0 if info.discrete else scale)
    if not worst <= limit:
        raise ValueError(
            f"the ONNX file was removed, since it does not act like the policy of {info.task}: on "
            f"{len(action):,} states of the task, onnxruntime's actions differ by up to {worst:.1e}, "
            f"more than {limit:.0e}"
        )


def _graph_of(module: TensorPolicy, info: PolicyInfo) -> Any:
    """Converts a policy to an ONNX protobuf, without paths and stack traces of this machine."""
    inputs = tuple(torch.zeros(2, info.widths[key]) for key in KEYS)  # a batch size of 1 would become fixed
    batch = torch.export.Dim("batch")
    with _silent():
        program = torch.onnx.export(
            module,
            inputs,
            dynamo=True,
            dynamic_shapes=tuple({0: batch} for _ in KEYS),
            input_names=list(KEYS),
            output_names=["action"],
            opset_version=_OPSET,
            external_data=False,
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    graph = proto.graph
    values = (*graph.input, *graph.output, *graph.value_info)
    for part in (proto, graph, *graph.node, *graph.initializer, *values):
        part.ClearField("metadata_props")  # stack traces, which contain paths of files
        part.ClearField("doc_string")
    return proto


@contextmanager
def _silent() -> Iterator[None]:
    """Context manager that suppresses messages of torch's exporter that do not concern the policy."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)  # suppresses a notice that torchvision is missing
    try:
        with warnings.catch_warnings(action="ignore"):  # of equal batch sizes and deprecated calls
            yield
    finally:
        log.setLevel(level)
