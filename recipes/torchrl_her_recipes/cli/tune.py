"""``torchrl-her tune``: searches for good options."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

import torchrl_her_recipes as recipes  # imports torch only when one of its names is used
from torchrl_her_recipes.cli.overrides import single
from torchrl_her_recipes.cli.say import exit_code, fail
from torchrl_her_recipes.cli.train_options import complete, folder_option, label, with_folder
from torchrl_her_recipes.config.imports import command_line
from torchrl_her_recipes.config.presets import load_preset
from torchrl_her_recipes.config.recipe import make_recipe
from torchrl_her_recipes.config.searches.search import PRUNERS, SAMPLERS, Search
from torchrl_her_recipes.config.searches.spaces import load_space, space_for, space_names
from torchrl_her_recipes.config.shortcuts import merge

if TYPE_CHECKING:
    from torchrl_her_recipes.tuning.search import SearchResult

_SEEDS = 3  # default number of seeds that each trial trains


@click.command(short_help="search for good options with Optuna, on all cores")
@click.option(
    "--trials", type=click.IntRange(1), help="number of trials (default: 50; no limit with --minutes)"
)
@click.option(
    "--minutes", type=click.FloatRange(0.0, min_open=True), help="minutes after which no further trial begins"
)
@click.option("--jobs", type=click.IntRange(1), help="trials at once (default: one for each core)")
@click.option(
    "--space",
    "space_name",
    metavar="NAME|FILE",
    help=f"search space: a YAML file, or {', '.join(space_names())} (default: that of the learner)",
)
@click.option("--sampler", type=click.Choice(SAMPLERS), default="tpe", help="Optuna's sampler (default: tpe)")
@click.option(
    "--pruner",
    type=click.Choice(PRUNERS),
    default="median",
    help="trials to end early: those below the median, all but the best third at each rung of successive "
    "halving, or none (default: median)",
)
@folder_option
@click.argument("options", metavar="[NAME=VALUE]...", nargs=-1, shell_complete=complete)
def tune(
    options: tuple[str, ...],
    folder: str | None,
    trials: int | None,
    minutes: float | None,
    jobs: int | None,
    space_name: str | None,
    sampler: Any,
    pruner: Any,
) -> int:
    """Search for good options; for instance: torchrl-her tune preset=demo num_runs=3 --trials 30

    Takes the options of `torchrl-her train`; options that are given are not varied. Each trial trains
    num_runs seeds side by side. The same command resumes an interrupted search.
    """
    values = single(with_folder(options, folder))
    folder, preset = values.pop("folder", None), values.pop("preset", None)
    base = merge({"num_runs": _SEEDS}, load_preset(preset) if preset else {})
    recipe = make_recipe(base, **values)
    space = load_space(space_name) if space_name else space_for(recipe)
    search = Search(recipe=recipe, space=space.without(values), sampler=sampler, pruner=pruner)
    home = Path(folder or f"runs/tune_{label(recipe)}")
    click.echo(f"search: {home}")
    click.echo(f"varied: {', '.join(search.space.ranges)}")
    workers: Any = recipes.make_workers(jobs=jobs)
    result = recipes.tune(search, home, trials=trials, minutes=minutes, workers=workers, say=_say_trial)
    return _say(result, task=recipe.task.name)


def _say_trial(line: str) -> None:
    tqdm.write(line)  # unlike print, keeps the line above the progress bar
    sys.stdout.flush()  # so that the line appears at once if the output goes to a file


def _say(result: SearchResult, *, task: str) -> int:
    for number, reason in result.failed.items():
        fail(f"trial {number} failed: {reason}")
    for line in recipes.search_summary(result.study):
        click.echo(line)
    if result.best is not None:
        preset = f"preset={result.folder / 'best.yaml'}"
        click.echo(f"the best: {command_line('train', preset, task=task)}")
    return exit_code(interrupted=result.interrupted, failed=result.best is None)
