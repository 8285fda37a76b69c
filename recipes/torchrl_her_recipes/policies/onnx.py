"""Policies as ONNX files for onnxruntime, checked against the policy itself when they are written.

torch has two exporters. The one over ``torch.export`` (``dynamo=True``) is maintained and converts all
networks of this library; the older one over TorchScript is deprecated and fails at layer normalization over
a width that depends on the input's shape.
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
TOLERANCE = 1e-5  # greatest difference of actions; relative to the greatest action if that is above 1

_OPSET = 18  # the lowest version that torch's exporter writes by itself; runtimes have it since 2023


def need_onnx() -> ModuleType:
    """Returns the package ``onnxruntime``, if all packages for writing ONNX files are installed."""
    try:
        # Imported here, since these packages are an extra that few users need, and take a second to import.
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
    """Writes a policy as an ONNX file, which maps any number of rows to actions, in float32.

    The graph has the inputs ``observation`` [batch, width] and ``desired_goal`` [batch, width] and the output
    ``action`` [batch, width], or integers [batch]. Normalization and the scaling of actions are inside.
    ``info`` and ``recipe`` are in the file's metadata, as JSON.

    The file is written under another name first. It is renamed when onnxruntime has returned the policy's
    actions with it.

    Args:
        policy: The network of :func:`~torchrl_her_recipes.policies.network.load_network`.
        info: Inputs, outputs and origin of the policy.
        recipe: Values of the recipe of the run that trained it.
        path: The file.
        states: Rows of ``observation`` and ``desired_goal`` on which the actions are compared.

    Returns:
        The info about the policy as it is in the file.

    Raises:
        ValueError: onnxruntime gives other actions.
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

    For integers, the values of actions are compared, since two actions may have the same value.
    """
    worst = float(module.deviation(action, *inputs.values()).nan_to_num(torch.inf).max())
    scale = max([1.0, *(abs(side) for side in (*info.low, *info.high) if abs(side) < float("inf"))])
    limit = TOLERANCE * (1.0 if info.discrete else scale)
    if not worst <= limit:
        raise ValueError(
            f"the ONNX file would not act as the policy of {info.task} does: on {len(action):,} states of "
            f"the task, onnxruntime's actions differ by up to {worst:.1e}, more than {limit:.0e}; it was "
            "removed"
        )


def _graph_of(module: TensorPolicy, info: PolicyInfo) -> Any:
    """Converts the policy to a protobuf without traces of the machine that made it."""
    inputs = tuple(torch.zeros(2, info.widths[key]) for key in KEYS)  # torch takes a size of 1 for a constant
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
    for part in (*proto.graph.node, *proto.graph.initializer, *proto.graph.value_info):
        part.ClearField("metadata_props")  # stack traces, which contain paths of files
        part.ClearField("doc_string")
    for part in (*proto.graph.input, *proto.graph.output, proto.graph, proto):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    return proto


@contextmanager
def _silent() -> Iterator[None]:
    """Suppresses notices of torch's exporter that do not concern the policy."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)  # suppresses a notice that torchvision is missing
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings about equal batch sizes and deprecated calls
            yield
    finally:
        log.setLevel(level)
