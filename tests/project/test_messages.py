"""What messages tell users to write works as written."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pytest
import yaml

from torchrl_her_recipes.config.choices.learners import LEARNERS
from torchrl_her_recipes.config.recipe import make_recipe
from torchrl_her_recipes.config.shortcuts import locate

ROOT = Path(__file__).parents[2]
_ARGUMENT = re.compile(r"(?<![\w.\[])([a-z_]+(?:\.[a-z_]+)*)=([^\s,;()`:]+)")
# Arguments of functions, in messages that only those who write Python meet.
_PYTHON = {"at_least", "at_most", "card", "folder", "format", "gpus_per_job", "high", "info_keys", "length"}
_PYTHON |= {"low", "name", "num_links", "policy", "preset", "render_mode", "run"}
_BASES = [
    {"task": "hand_v1"},
    {"task": "hand_v1", "algo": "cher_ibs", "normalize": True},
    {"task": "hand_v1", "algo": "filtered_her_ibs", "behavior": "mega"},
    {"task": "hand_v1", "epsilon_end": 0},
    {"task": "hand_v1", "demonstrations.file": "some.pt", "demonstrations.episodes": 1},
    {
        "task": "hand_v1",
        "demonstrations.file": "some.pt",
        "demonstrations.episodes": 1,
        "demonstrations.starts_share": 0.5,
    },
    *({"task": "bit_flip" if name == "dqn" else "hand_v1", "learner": name} for name in LEARNERS),
]


def _texts(path: Path) -> Iterator[str]:
    """The strings of a module, without its docstrings; what an f-string fills in reads ``{}``."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    inner = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    skipped = inner | {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if id(node) in skipped:
            continue
        if isinstance(node, ast.JoinedStr):
            yield "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def _arguments() -> set[tuple[str, str]]:
    """Each NAME=VALUE of a message, with ``{}`` for values that are known when it is shown."""
    modules = chain((ROOT / "recipes").rglob("*.py"), (ROOT / "envs").rglob("*.py"))
    sentences = (text for path in modules for text in _texts(path) if " " in text)
    return {found.groups() for text in sentences for found in _ARGUMENT.finditer(text)}


ARGUMENTS = sorted(own for own in _arguments() if own[0] not in _PYTHON)


def test_messages_are_found() -> None:
    assert len(ARGUMENTS) > 50
    assert {("algo", "cher"), ("failure", "never_pays"), ("order", "threshold")} <= set(ARGUMENTS)


@pytest.mark.parametrize("name", sorted({name for name, _ in ARGUMENTS}))
def test_options_in_messages_exist(name: str) -> None:
    group, _ = locate(name if not name.startswith("task.options") else "task.options")
    assert group


@pytest.mark.parametrize(
    ("name", "value"),
    [own for own in ARGUMENTS if re.fullmatch(r"[a-z\d._]+", own[1]) and own[0].split(".")[0] != "task"],
)
def test_values_in_messages_are_allowed(name: str, value: str) -> None:
    """Somewhere at least: a learner's options are refused with other learners."""
    refusals = []
    for base in _BASES:
        try:
            make_recipe(**{**base, name: yaml.safe_load(value)})
        except ValueError as error:
            refusals.append(str(error))
        else:
            return
    pytest.fail("; ".join(dict.fromkeys(refusals)))


@pytest.mark.parametrize("name", ["max_steps", "termination", "achieved_reward", "parallel", "info_keys"])
def test_options_of_gymnasium_tasks_are_named_in_full(name: str) -> None:
    with pytest.raises(ValueError, match=rf"write task\.options\.{name}="):
        locate(name)
