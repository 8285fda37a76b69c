"""ONNX files are checked before anything of them runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from torchrl_her_recipes import load_policy
from torchrl_her_recipes.runs.exported.onnx_export import write_onnx
from torchrl_her_recipes.runs.exported.onnx_file import CARD, DIGEST, RECIPE, digest, need_onnx, read_onnx

from .tiny import needs_onnx, states, tiny_policy


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("onnx") / "mine.onnx"
    policy = tiny_policy()
    write_onnx(policy.actor, policy.card, policy.recipe, path, states=states(policy.card, 5))
    return path


@needs_onnx
def test_each_damaged_byte_of_the_weights_is_found(written: Path, tmp_path: Path) -> None:
    import onnx  # noqa: PLC0415

    whole = written.read_bytes()
    weights = max(onnx.load(written).graph.initializer, key=lambda own: len(own.raw_data)).raw_data
    place = whole.index(weights) + len(weights) // 2
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    with pytest.raises(ValueError, match=r"bad.onnx is damaged: its checksum does not match"):
        load_policy(bad)


@needs_onnx
@pytest.mark.parametrize("keep", [0, 1, 100, 0.5, 0.99])
def test_files_that_are_cut_short_give_one_line(written: Path, tmp_path: Path, keep: float) -> None:
    whole, bad = written.read_bytes(), tmp_path / "bad.onnx"
    bad.write_bytes(whole[: int(keep * len(whole)) if keep < 1 else int(keep)])
    with pytest.raises(ValueError, match=r"bad.onnx is (damaged|no exported policy)") as raised:
        load_policy(bad)
    assert "\n" not in str(raised.value)


def _another_domain(proto: Any) -> None:
    proto.opset_import.add(domain="com.evil", version=1)


def _custom_operator(proto: Any) -> None:
    proto.graph.node[0].domain = "com.evil"


def _python_operator(proto: Any) -> None:
    proto.graph.node[0].op_type = "PyOp"


def _loop(proto: Any) -> None:
    proto.graph.node[0].op_type = "Loop"


def _graph_within(proto: Any) -> None:
    attribute = proto.graph.node[0].attribute.add(name="body", type=5)
    attribute.g.name = "inner"


def _external(proto: Any) -> None:
    own = proto.graph.initializer[0]
    own.ClearField("raw_data")
    own.data_location = 1
    own.external_data.add(key="location", value="../../etc/passwd")


def _function(proto: Any) -> None:
    proto.functions.add(name="f", domain="")


def _sparse(proto: Any) -> None:
    proto.graph.sparse_initializer.add()


def _other_inputs(proto: Any) -> None:
    proto.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 10


def _claims_more_than_there_is(proto: Any) -> None:
    proto.graph.initializer[0].dims[0] = 1 << 40


def _large_step(proto: Any) -> None:
    """A product of two vectors of 10,000 numbers."""
    import onnx  # noqa: PLC0415

    for name, shape in (("tall", (10_000, 1)), ("flat", (1, 10_000))):
        own = proto.graph.initializer.add()
        own.CopyFrom(onnx.helper.make_tensor(name, 1, shape, b"\0" * 40_000, raw=True))
    proto.graph.node.add(op_type="MatMul", input=["tall", "flat"], output=["large"])


def _other_card(proto: Any) -> None:
    for each in proto.metadata_props:
        if each.key == CARD:
            each.value = json.dumps({**json.loads(each.value), "seed": "none"})


def _other_learner(proto: Any) -> None:
    for each in proto.metadata_props:
        if each.key == RECIPE:
            each.value = json.dumps({"learner": {"name": "theirs"}})


def _no_json(proto: Any) -> None:
    for each in proto.metadata_props:
        if each.key == CARD:
            each.value = "[" * 100_000


@needs_onnx
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_another_domain, "operators of the domain 'com.evil', not of ONNX alone"),
        (_custom_operator, "operators of the domain 'com.evil', not of ONNX alone"),
        (_python_operator, "policies have no operator 'PyOp'"),
        (_loop, "policies have no operator 'Loop'"),
        (_graph_within, "has a graph or sparse weights"),
        (_external, "its weights lie in another file"),
        (_function, "a policy has no functions"),
        (_sparse, "a policy has no functions, training steps or sparse weights"),
        (_other_inputs, r"it must have observation \[9\], desired_goal \[2\] and action \[3\], got "),
        (_claims_more_than_there_is, "is damaged: "),
        (_large_step, "a step of it takes 100,000,000 numbers, more than 16,777,216"),
        (_other_card, "seed of a policy must be a whole number"),
        (_other_learner, "is no exported policy: unknown learner 'theirs'"),
        (_no_json, "is damaged: its description is not JSON"),
    ],
)
def test_files_that_somebody_made_are_refused(
    written: Path, tmp_path: Path, change: Callable[[Any], None], message: str
) -> None:
    """Their checksum is right, so that it is not what finds them."""
    import onnx  # noqa: PLC0415

    proto = onnx.load(written)
    change(proto)
    metadata = {each.key: each for each in proto.metadata_props}
    metadata[DIGEST].value = digest(proto, metadata[CARD].value, metadata[RECIPE].value)
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(proto.SerializeToString())
    with pytest.raises(ValueError, match=message) as raised:
        read_onnx(bad)
    assert str(raised.value).startswith(f"{bad} is ")
    assert "\n" not in str(raised.value)


@needs_onnx
def test_models_of_others_and_large_files_are_refused(tmp_path: Path) -> None:
    import onnx  # noqa: PLC0415

    graph = onnx.helper.make_graph([], "empty", [], [])
    onnx.save(onnx.helper.make_model(graph), tmp_path / "theirs.onnx")
    with pytest.raises(ValueError, match="theirs.onnx is damaged, or is no exported policy"):
        read_onnx(tmp_path / "theirs.onnx")
    with open(tmp_path / "large.onnx", "wb") as file:
        file.truncate((1 << 28) + 1)  # takes no room
    with pytest.raises(ValueError, match="it has 268,435,457 bytes, more than 268,435,456"):
        read_onnx(tmp_path / "large.onnx")


@pytest.mark.parametrize("missing", ["onnx", "onnxruntime"])
def test_without_the_extra_one_line_names_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, missing: str
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=r"ONNX files need onnx and onnxruntime: pip install '.\[onnx\]'"):
        need_onnx()
    (tmp_path / "mine.onnx").write_bytes(b"")
    with pytest.raises(ImportError, match="ONNX files need"):
        load_policy(tmp_path / "mine.onnx")
