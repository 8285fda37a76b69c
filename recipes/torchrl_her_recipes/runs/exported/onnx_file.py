"""Reading ONNX files of exported policies: nothing of a file runs before all of it was checked."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from torchrl_her_recipes.config.plain_files import reason
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.exported.card import KEYS, PolicyCard

SUFFIX = ".onnx"
CARD, RECIPE, DIGEST = "torchrl_her.card", "torchrl_her.recipe", "torchrl_her.sha256"  # names of metadata

_LARGEST = 1 << 28  # bytes of a file
_MOST = 1 << 24  # numbers that a row of a batch takes in any step of a graph
_DOMAINS = ("", "ai.onnx")
# What networks of policies are made of. Missing on purpose: control flow, and whatever makes tensors as large
# as a number in the file says (Expand, Tile, Pad, Range, ConstantOfShape, Resize).
# fmt: off
OPERATORS = frozenset((
    "Abs", "Add", "ArgMax", "ArgMin", "Cast", "Clip", "Concat", "Constant", "Cos", "Div", "Elu",
    "Erf", "Exp", "Flatten", "Gather", "Gelu", "Gemm", "Greater", "HardSigmoid", "Identity",
    "LayerNormalization", "LeakyRelu", "Less", "Log", "MatMul", "Max", "Min", "Mul", "Neg", "Pow",
    "Reciprocal", "ReduceMax", "ReduceMean", "ReduceSum", "Relu", "Reshape", "Selu", "Shape",
    "Sigmoid", "Sin", "Slice", "Softmax", "Softplus", "Split", "Sqrt", "Squeeze", "Sub", "Tanh",
    "Transpose", "Unsqueeze", "Where",
))
# fmt: on


@dataclass(frozen=True)
class OnnxFile:
    """An ONNX file that was checked.

    Attributes:
        model: the bytes of the file.
        card: what the policy expects.
        recipe: of the run that trained it.
    """

    model: bytes
    card: PolicyCard
    recipe: Recipe


def need_onnx(*, writes: bool = False) -> tuple[ModuleType, ModuleType]:
    """The packages ``onnx`` and ``onnxruntime``.

    Keyword Args:
        writes: whether ``onnxscript`` is needed, too, as torch's exporter is written with it.

    Raises:
        ImportError: one of them is missing; the message names the extra.
    """
    try:
        # All are an extra that few need, and take a second to import.
        import onnx  # noqa: PLC0415
        import onnxruntime  # noqa: PLC0415

        if writes:
            import onnxscript  # noqa: F401, PLC0415
    except ImportError as error:
        what = "onnx, onnxruntime and onnxscript" if writes else "onnx and onnxruntime"
        raise ImportError(f"ONNX files need {what}: pip install '.[onnx]'") from error
    return onnx, onnxruntime


def read_onnx(path: str | Path) -> OnnxFile:
    """Reads a policy's ONNX file, and refuses whatever is not one.

    Nothing is executed: the file may have no operators of its own, no control flow, no weights in other
    files, and no step whose result is large.

    Args:
        path: a file that :func:`~torchrl_her_recipes.export_policy` wrote.

    Raises:
        ValueError: the file is damaged, or is not such a file.
        ImportError: onnx or onnxruntime is missing.
        OSError: it cannot be read.
    """
    need_onnx()
    size = Path(path).stat().st_size
    if size > _LARGEST:
        raise ValueError(f"{path} is no exported policy: it has {size:,} bytes, more than {_LARGEST:,}")
    model = Path(path).read_bytes()
    try:
        return check_onnx(model)
    except ValueError as error:
        raise ValueError(f"{path} {reason(error)}") from error


def check_onnx(model: bytes) -> OnnxFile:
    """Checks the bytes of an ONNX file.

    Raises:
        ValueError: they are damaged, or not those of an exported policy. The message goes on after the name
            of the file.
    """
    # protobuf comes with onnx, and both are imported only where ONNX files are.
    from google.protobuf.message import DecodeError  # noqa: PLC0415

    onnx, _ = need_onnx()
    try:
        proto = onnx.load_model_from_string(model)
    except (DecodeError, ValueError) as error:
        raise ValueError("is damaged, or is no ONNX file") from error
    metadata = {entry.key: entry.value for entry in proto.metadata_props}
    if not all(isinstance(own, str) for pair in metadata.items() for own in pair):
        raise ValueError("is damaged: its description is no text")
    if not {CARD, RECIPE, DIGEST} <= set(metadata):
        raise ValueError(
            "is damaged, or is no exported policy: `torchrl-her export RUN --format onnx` writes one"
        )
    _check_operators(proto)
    if digest(proto, metadata[CARD], metadata[RECIPE]) != metadata[DIGEST]:
        raise ValueError("is damaged: its checksum does not match")
    card, recipe = _card_of(metadata)
    _check_shapes(proto, card)
    return OnnxFile(model, card, recipe)


def digest(proto: Any, card: str, recipe: str) -> str:
    """A checksum of all that a policy's file says, however its bytes are laid out."""
    total = hashlib.sha256()
    for own in proto.graph.initializer:
        total.update(repr((own.name, own.data_type, list(own.dims))).encode())
        total.update(own.raw_data)
    for node in proto.graph.node:
        named = sorted(
            (each.name, each.SerializeToString(deterministic=True).hex()) for each in node.attribute
        )
        total.update(repr((node.op_type, list(node.input), list(node.output), named)).encode())
    for text in (card, recipe):
        total.update(hashlib.sha256(text.encode()).digest())
    return total.hexdigest()


def _card_of(metadata: dict[str, str]) -> tuple[PolicyCard, Recipe]:
    try:
        card, recipe = (json.loads(metadata[name]) for name in (CARD, RECIPE))
    except (ValueError, RecursionError) as error:
        raise ValueError("is damaged: its description is not JSON") from error
    try:
        return PolicyCard.from_dict(card), Recipe.of_file(recipe)
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"is no exported policy: {error}") from error


def _check_operators(proto: Any) -> None:
    """Refuses what could read other files, call code of others, or go on for long."""
    graph = proto.graph
    domains = [each.domain for each in proto.opset_import] + [node.domain for node in graph.node]
    if strange := [domain for domain in domains if domain not in _DOMAINS]:
        raise ValueError(f"is refused: it has operators of the domain {strange[0]!r}, not of ONNX alone")
    if proto.functions or proto.training_info or graph.sparse_initializer or graph.quantization_annotation:
        raise ValueError("is refused: a policy has no functions, training steps or sparse weights")
    if strange := [node.op_type for node in graph.node if node.op_type not in OPERATORS]:
        raise ValueError(f"is refused: policies have no operator {strange[0]!r}")
    for tensor in _tensors(graph):
        if tensor.data_location or tensor.external_data:
            raise ValueError("is refused: its weights lie in another file")


def _tensors(graph: Any) -> Iterator[Any]:
    """All constant tensors of a graph, those in its nodes included."""
    yield from graph.initializer
    for node in graph.node:
        for each in node.attribute:
            if each.HasField("g") or each.graphs or each.HasField("sparse_tensor") or each.sparse_tensors:
                raise ValueError(f"is refused: the operator {node.op_type!r} has a graph or sparse weights")
            yield from [each.t] if each.HasField("t") else each.tensors


def _check_shapes(proto: Any, card: PolicyCard) -> None:
    """Refuses graphs of other inputs and outputs than the card's, or with steps whose result is large."""
    onnx, _ = need_onnx()
    shown = {each.name: _dims(each)[1:] for each in proto.graph.input}
    written = {each.name: _dims(each)[1:] for each in proto.graph.output}
    if shown != {key: [card.widths[key]] for key in KEYS} or written != {"action": list(card.action_shape)}:
        raise ValueError(f"is no exported policy: it must have {card.expects()}, got {shown} and {written}")
    try:
        onnx.checker.check_model(proto, full_check=True)
        steps = onnx.shape_inference.infer_shapes(proto, strict_mode=True, data_prop=True).graph.value_info
    except Exception as error:  # of several types, which have no common base of their own
        raise ValueError(f"is damaged: {str(error).strip().splitlines()[0]}") from error
    sizes = [math.prod(_dims(each)) for each in steps]
    sizes += [math.prod(map(int, own.dims)) for own in _tensors(proto.graph)]
    if max(sizes, default=0) > _MOST:
        raise ValueError(f"is refused: a step of it takes {max(sizes):,} numbers, more than {_MOST:,}")


def _dims(value: Any) -> list[int]:
    """The dimensions of a graph's value; 1 for those that are not known, such as the batch."""
    return [each.dim_value if each.HasField("dim_value") else 1 for each in value.type.tensor_type.shape.dim]
