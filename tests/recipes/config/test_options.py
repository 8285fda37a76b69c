"""Options: types and ranges are checked where they are defined."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from torchrl_her_recipes.config.options import Group, nearest, option, what_there_is


@dataclass(frozen=True, kw_only=True)
class Own(Group):
    """Options for these tests."""

    count: int = option(3, "whole", at_least=1)
    share: float | None = option(None, "within a range", above=0, at_most=1)
    kind: str = option("a", "one of two", choices=("a", "bee"), shown_as="own")
    fast: bool = option(False, "yes or no")


def test_values_become_what_the_option_is() -> None:
    own = Own(count=2.0, share="1e-1", fast=True)  # type: ignore[arg-type]
    assert (own.count, type(own.count), own.share, own.fast) == (2, int, 0.1, True)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"count": 0}, "count must be at least 1, got 0"),
        ({"count": 1.5}, "count must be a whole number, got 1.5"),
        ({"count": None}, "count must be a whole number, got None"),
        ({"count": True}, "count must be a whole number, got True"),
        ({"share": 0}, "share must be above 0 and at most 1, got 0.0"),
        ({"share": float("nan")}, "share must be above 0 and at most 1, got nan"),
        ({"kind": "be"}, "own must be one of a, bee, got 'be'; did you mean bee"),
        ({"kind": 3}, "own must be text, got 3"),
        ({"fast": 1}, "fast must be true or false, got 1"),
    ],
)
def test_mistakes_are_named(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Own(**values)  # type: ignore[arg-type]


def test_hints_for_unknown_names() -> None:
    assert nearest("zzz", ["her"]) == ""
    assert what_there_is("zzz", ["her"], "algorithms") == "; the algorithms are her"
