"""The structures are those of the C++ source, field by field."""

from __future__ import annotations

import re
from enum import IntEnum
from pathlib import Path

import pytest
import torch

import torchrl_her.native
from torchrl_her.native import Activation, Algorithm, Layer, Norm, structures

SOURCES = "".join(
    (Path(torchrl_her.native.__file__).parent / name).read_text(encoding="utf-8")
    for name in ("gemm.h", "network.h", "steps.cpp")
)


def fields_in_c(name: str) -> list[str]:
    body = re.search(rf"struct {name} \{{(.*?)\n\}};", SOURCES, re.DOTALL)
    assert body is not None
    text = re.sub(r"//[^\n]*", "", body[1])
    declared = re.findall(r"(?:const )?(?:int64_t|int32_t|uint8_t|int|long|real|\w+)\s*([^;]+);", text)
    return [part.strip().lstrip("*").strip() for line in declared for part in line.split(",")]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("name", "attribute"), [("Job", "job"), ("Tensors", "tensors"), ("Entry", "entry"), ("Adam", "adam")]
)
def test_fields_have_the_same_order(name: str, attribute: str, dtype: torch.dtype) -> None:
    kind = getattr(structures(dtype), attribute)
    assert [field for field, _ in kind._fields_] == fields_in_c(name)


def test_the_layer_has_the_same_order() -> None:
    assert [name for name, _ in Layer._fields_] == fields_in_c("Layer")


@pytest.mark.parametrize(
    ("name", "kind"), [("Algorithm", Algorithm), ("Activation", Activation), ("Norm", Norm)]
)
def test_words_have_the_same_numbers(name: str, kind: type[IntEnum]) -> None:
    body = re.search(rf"enum {name} \{{(.*?)\}};", SOURCES)
    assert body is not None
    assert [word.strip().removeprefix("k").upper() for word in body[1].split(",")] == [
        own.name for own in kind
    ]
