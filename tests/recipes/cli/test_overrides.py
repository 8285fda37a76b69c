"""``NAME=VALUE`` arguments: their values, sweeps, and options that are given twice."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_her_recipes.cli.overrides import parse_overrides, parse_value, split_sweep, sweep
from torchrl_her_recipes.config.plain_files import dump_yaml, parse_yaml

_PLAIN = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
_TRICKY = st.from_regex(r"[-+.0-9]{1,3}[eE][-+0-9]{1,3}", fullmatch=True)


@given(st.recursive(_PLAIN | _TRICKY, lambda own: st.lists(own) | st.dictionaries(st.text() | _TRICKY, own)))
@settings(max_examples=30)
def test_what_is_written_as_yaml_is_read_as_it_was(value: Any) -> None:
    assert parse_yaml(dump_yaml([value, value])) == [value, value]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("null", None),
        ("None", None),
        ("true", True),
        ("'3'", "3"),
        ("[1, 2]", [1, 2]),
        ("{bits: 8}", {"bits": 8}),
        ("gym:FetchReach-v4", "gym:FetchReach-v4"),
        ("/a/b=c", "/a/b=c"),
        ("[1e-3, -2.5E+1, .5e0]", [0.001, -25.0, 0.5]),
        ("[1e, e1, 1e-3m]", ["1e", "e1", "1e-3m"]),
    ],
)
def test_values_are_read_as_yaml(text: str, value: Any) -> None:
    assert parse_value(text) == value


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("1,2", ["1", "2"]),
        ("[1,2],[3]", ["[1,2]", "[3]"]),
        ("'a,b',c", ["'a,b'", "c"]),
        ("{a: [1,2], b: 3}", ["{a: [1,2], b: 3}"]),
    ],
)
def test_commas_in_brackets_and_quotes_do_not_separate(text: str, values: list[str]) -> None:
    assert split_sweep(text) == values


def test_a_sweep_has_all_combinations_and_leaves_names_of_presets_as_they_are() -> None:
    combinations = list(sweep({"preset": "demo,1", "seed": "0,1"}))
    assert combinations == [{"preset": name, "seed": seed} for name in ("demo", "1") for seed in (0, 1)]


@pytest.mark.parametrize("text", ["seed=", "algo=her,", "preset=", "=3", "seed"])
def test_what_has_no_name_or_no_value_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="needs a value|is written NAME=VALUE"):
        parse_overrides([text])


@pytest.mark.parametrize(
    "names",
    [
        ("seed", "seed"),
        ("seed", "run.seed"),
        ("task", "task.name"),
        ("preset", "preset"),
        ("task.options", "task.options.bits"),
    ],
)
def test_an_option_is_given_once(names: tuple[str, str]) -> None:
    with pytest.raises(ValueError, match="set the same option: give one of them"):
        parse_overrides([f"{name}=1" for name in names])


def test_options_beside_each_other_are_no_mistake() -> None:
    given = {"task.options.bits": "1", "task.options.max_steps": "2", "task": "bit_flip", "seed": "0"}
    assert parse_overrides(f"{name}={text}" for name, text in given.items()) == given
