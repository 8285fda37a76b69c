"""Writing policies as ONNX files, and checking them against the policy itself.

torch has two exporters. The one over ``torch.export`` (``dynamo=True``) is maintained and converts all
networks of this library; the older one over TorchScript is deprecated and fails at layer normalization over
a width that depends on the input's shape.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_her.files.writing import written
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.runs.exported.card import KEYS, PolicyCard
from torchrl_her_recipes.runs.exported.network import TensorPolicy
from torchrl_her_recipes.runs.exported.onnx_file import CARD, DIGEST, RECIPE, check_onnx, digest, need_onnx
from torchrl_her_recipes.runs.exported.onnx_policy import OnnxPolicy

TOLERANCE = 1e-5  # of actions, relative to the greatest one where that is above 1

_OPSET = 18  # the lowest that torch's exporter writes without converting; runtimes have it since 2023


def write_onnx(
    policy: TensorDictModuleBase,
    card: PolicyCard,
    recipe: Recipe,
    path: str | Path,
    *,
    states: TensorDictBase,
) -> None:
    """Writes a policy as an ONNX file that takes any number of rows and gives their actions, in float32.

    The graph has the inputs ``observation`` [batch, width] and ``desired_goal`` [batch, width] and the output
    ``action`` [batch, width], or integers [batch]. Normalization and the scaling of actions are inside.
    The card and the recipe are in the file's metadata, as JSON.

    The file gets its name only after onnxruntime has given the policy's actions with what was written.

    Args:
        policy: of :func:`~torchrl_her_recipes.load_policy` or the like.
        card: what it expects.
        recipe: of the run that trained it.
        path: of the file.

    Keyword Args:
        states: rows of ``observation`` and ``desired_goal`` on which the actions are compared.

    Raises:
        ValueError: onnxruntime gives other actions, or the graph has an operator that policies must not have.
        ImportError: onnx, onnxruntime or onnxscript is missing.
        OSError: the file cannot be written.
    """
    need_onnx(writes=True)
    path, own = Path(path), TensorPolicy(policy)
    card = replace(card, dtype="float32", action_dtype="int64" if card.discrete else "float32")
    proto = _graph_of(own, card)
    described = {CARD: json.dumps(card.to_dict()), RECIPE: json.dumps(recipe.to_dict())}
    described[DIGEST] = digest(proto, described[CARD], described[RECIPE])
    for name, text in described.items():
        proto.metadata_props.add(key=name, value=text)
    with written(path) as part:
        part.write_bytes(proto.SerializeToString())
        try:
            read_again = OnnxPolicy(check_onnx(part.read_bytes()))
        except ValueError as error:
            raise ValueError(f"this policy cannot be written as an ONNX file: the file {error}") from error
        check_actions(own, read_again, card, states)


def check_actions(
    own: TensorPolicy, written: TensorDictModuleBase, card: PolicyCard, states: TensorDictBase
) -> None:
    """Compares the actions of a file with those of the policy that it was made of.

    Args:
        own: the policy.
        written: the file's.
        card: has the limits of actions.
        states: rows to act on.

    Raises:
        ValueError: they differ by more than :data:`TOLERANCE`. For integers, their values do.
    """
    seen = {key: states[key].reshape(-1, card.widths[key]).float() for key in KEYS}
    action = written(TensorDict(seen, [len(seen[KEYS[0]])]))["action"]
    worst = float(own.deviation(action, *seen.values()).nan_to_num(torch.inf).max())
    scale = max([1.0, *(abs(side) for side in (*card.low, *card.high) if abs(side) < float("inf"))])
    limit = TOLERANCE * (1.0 if card.discrete else scale)
    if not worst <= limit:
        raise ValueError(
            f"the ONNX file would not act as the policy of {card.task} does: on {len(action):,} states of "
            f"the task, onnxruntime's actions differ by up to {worst:.1e}, more than {limit:.0e}; it was "
            "removed"
        )


def _graph_of(own: TensorPolicy, card: PolicyCard) -> Any:
    """The policy as a protobuf, without what tells of the machine that made it."""
    inputs = tuple(torch.zeros(2, card.widths[key]) for key in KEYS)  # 2: torch takes 1 for a constant
    batch = torch.export.Dim("batch")
    with _silent():
        program = torch.onnx.export(
            own,
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
    for each in (*proto.graph.node, *proto.graph.initializer, *proto.graph.value_info):
        each.ClearField("metadata_props")  # stack traces, which have paths of files
        each.ClearField("doc_string")
    for each in (*proto.graph.input, *proto.graph.output, proto.graph, proto):
        each.ClearField("metadata_props")
        each.ClearField("doc_string")
    return proto


@contextmanager
def _silent() -> Iterator[None]:
    """Without notices of torch's exporter that say nothing about the policy."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)  # that torchvision is not installed
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that both inputs have the same batch; its own old calls
            yield
    finally:
        log.setLevel(level)
