"""Help, completion and parsing of the arguments of ``torchrl-her train``."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from typing import Any

import click

from torchrl_her_recipes.cli.overrides import ARGUMENTS, named_values, parse_overrides, single, sweep
from torchrl_her_recipes.cli.say import file_name
from torchrl_her_recipes.config import shortcuts
from torchrl_her_recipes.config.algorithms import STRATEGIES
from torchrl_her_recipes.config.options import AUTO
from torchrl_her_recipes.config.plain_files import naming
from torchrl_her_recipes.config.presets import load_preset
from torchrl_her_recipes.config.recipe import Recipe, make_recipe
from torchrl_her_recipes.config.shipped import shipped_names

folder_option = click.option("--folder", metavar="DIR", help="output folder")


def with_folder(options: tuple[str, ...], folder: str | None) -> tuple[str, ...]:
    """Adds ``folder=DIR`` to the arguments if ``--folder DIR`` was given."""
    return options if folder is None else (*options, f"folder={folder}")


def requests(options: tuple[str, ...], *, multirun: bool) -> dict[Path, Recipe]:
    """Returns the runs that arguments describe, as a dict from each run's folder to its recipe."""
    now = f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    if not multirun:
        values = single(options)
        folder = values.pop("folder", None)
        recipe = _recipe(values)
        return {Path(folder or f"runs/{now}_{label(recipe)}"): recipe}
    given = parse_overrides(options)
    root = Path(given.pop("folder", "") or f"runs/sweep_{now}")
    runs: dict[Path, Recipe] = {}
    for number, values in enumerate(sweep(given)):
        recipe = _recipe(values)
        if recipe in runs.values():
            written = " ".join(f"{name}={value}" for name, value in values.items())
            raise ValueError(f"the sweep has the same run twice: {written}; give each value once")
        runs[root / f"{label(recipe)}_{number}"] = recipe
    return runs


def _recipe(values: Mapping[str, Any]) -> Recipe:
    options = dict(values)
    preset = options.pop("preset", None)
    base = load_preset(preset) if preset else None
    if not str(preset).endswith((".yaml", ".yml")):
        return make_recipe(base, **options)
    with naming(Path(str(preset)), "and the options beside it do not work"):
        return make_recipe(base, **options)


def label(recipe: Recipe) -> str:
    """Returns the name of a run's folder, in characters that every file system allows."""
    algo = recipe.hindsight.algo
    return "_".join([file_name(recipe.task.name), *([algo] if algo != AUTO else []), f"s{recipe.run.seed}"])


class OptionsCommand(click.Command):
    """A command whose help lists the options of a recipe, group by group."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        presets = f"start from the values of a preset: {', '.join(shipped_names('preset'))}, or a YAML file"
        folder = "folder of the run (default: a new one in runs/)"
        with formatter.section("Besides options"):
            formatter.write_dl([("preset=NAME", presets), ("folder=DIR", folder)])
        for group, kind in shortcuts.GROUPS.items():
            doc = (kind.__doc__ or "").splitlines()[0].rstrip(".")
            with formatter.section(f"{group}: {doc[0].lower()}{doc[1:]}"):
                formatter.write_dl(list(_rows(group)))


def _rows(group: str) -> Iterator[tuple[str, str]]:
    """Yields a group's options with their help; an option that the default choice lacks names its choices."""
    if kind := shortcuts.KINDS.get(group):
        known = f"one of {', '.join(kind)}; `torchrl-her list` describes them"
        yield _written(group, "name", kind.default), known
    first, *_ = choices = shortcuts.choices_of(group)
    plain = {
        _written(group, option.name, option.default): option.metadata["help"]
        for option in fields(choices[first])
    }
    yield from plain.items()
    others: dict[tuple[str, str], list[str]] = {}
    for name, choice in choices.items():
        for option in fields(choice):
            if (written := _written(group, option.name, option.default)) not in plain:
                others.setdefault((written, option.metadata["help"]), []).append(name)
    for (written, help), names in others.items():
        yield written, f"{help} ({', '.join(names)})"


def _written(group: str, name: str, default: Any) -> str:
    """Returns an option with its default in the form of the command line."""
    key = shortcuts.short_name(group, name)
    text = str(default).lower() if isinstance(default, bool) else default
    text = f"[{','.join(default)}]" if isinstance(default, tuple) else text
    return key if default is None else f"{key}={text}"


def complete(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    """Completes names of options (short or with their group), and values of options with a list of names."""
    name, equals, begun = incomplete.partition("=")
    if equals:
        return [f"{name}={value}" for value in _values().get(name, ()) if value.startswith(begun)]
    names = ["task", "algo", "curriculum", *shortcuts.KINDS, *ARGUMENTS, *shortcuts.short_names()]
    if "." in name:
        names = [f"{group}.{option}" for group, known in shortcuts.option_names().items() for option in known]
    return [f"{option}=" for option in dict.fromkeys(names) if option.startswith(name)]


def _values() -> dict[str, Collection[str]]:
    """Returns the possible values of each option that has a fixed list of them."""
    classes = [kind for group in shortcuts.GROUPS for kind in reversed(shortcuts.choices_of(group).values())]
    choices = {option.name: option.metadata["choices"] for kind in classes for option in fields(kind)}
    return {**choices, **named_values(), "strategy": STRATEGIES}
