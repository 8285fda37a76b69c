"""Writes model cards: pages in Markdown about exported policies, with the command that trains them."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from torchrl_her.files.writing import write_text
from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.config.plain_files import dump_yaml
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.shortcuts import GROUPS, locate
from torchrl_her_recipes.policies.info import PolicyInfo
from torchrl_her_recipes.policies.onnx import SUFFIX

_TEMPLATE = Path(__file__).parents[1] / "templates" / "model_card.md"
_MARK = "<!-- written by torchrl-her export; it may be replaced by the next export -->"


def card_path(policy: str | Path) -> Path:
    """Returns the path of the model card that belongs to a policy's file: beside it, with the suffix .md.

    Example:
        >>> card_path("mine.onnx").name
        'mine.md'
    """
    return Path(policy).with_suffix(".md")


def check_free(path: Path) -> None:
    """Raises a ValueError for a file that is not a model card, or whose first line a user has changed."""
    if path.exists() and not path.read_text(errors="replace").startswith(_MARK):
        raise ValueError(
            f"{path} exists, and export did not write it: choose another --out, or --no-card "
            "(in Python card=False)"
        )


def write_model_card(path: Path, file: str, card: PolicyInfo, recipe: Recipe) -> None:
    """Writes the model card of a policy, which is in the file ``file`` and was trained with ``recipe``."""
    page = Environment(undefined=StrictUndefined, autoescape=False)  # the page is Markdown, not HTML
    page.filters |= {"quote": shlex.quote, "side": _side, "tojson": json.dumps}
    text = page.from_string(_TEMPLATE.read_text()).render(
        mark=_MARK,
        file=file,
        card=card,
        command=training_command(recipe),
        trained_on=recipe.task.name,
        summary=get_task_spec(card.task).summary,
        is_onnx=file.endswith(SUFFIX),
    )
    write_text(path, text.rstrip() + "\n")


def training_command(recipe: Recipe) -> str:
    """Returns the command that trains a recipe, with all options that differ from the defaults.

    Example:
        >>> from torchrl_her_recipes import make_recipe
        >>> training_command(make_recipe(task="hand_v1", algo="cher", seed=3))
        'torchrl-her train task=hand_v1 algo=cher seed=3'
    """
    words, changed = [], recipe.changed()
    if recipe.curriculum.stages is not None:
        changed["curriculum"].pop("name", None)  # the file that the stages were read from
    for group, values in recipe.to_dict().items():
        for name, value in values.items():
            named = name == "name" and group in GROUPS
            always = (group, name) in (("task", "name"), ("hindsight", "algo"), ("run", "seed"))
            if always or name in changed.get(group, {}):
                words.append(shlex.quote(f"{group if named else _short(group, name)}={_text(value)}"))
    return " ".join(["torchrl-her train", *words])


def _short(group: str, name: str) -> str:
    """Returns the short name of an option, or its name with the group if the short one is not unique."""
    try:
        return name if locate(name) == (group, name) else f"{group}.{name}"
    except ValueError:
        return f"{group}.{name}"


def _text(value: Any) -> str:
    """Formats a value as YAML on one line."""
    text = dump_yaml(value, default_flow_style=True, width=1 << 20).strip()
    return text.removesuffix("...").strip()


def _side(values: tuple[float, ...]) -> str:
    """Formats limits of actions as a list, or as one number if all are equal."""
    return f"{values[0]:g}" if len(set(values)) == 1 else f"[{', '.join(f'{each:g}' for each in values)}]"
