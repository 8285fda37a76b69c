"""``torchrl-her train``: one run, or a sweep over several."""

from __future__ import annotations

from pathlib import Path

import click
import yaml

import torchrl_her_recipes as recipes  # its names are loaded when they are used: torch comes with `build`
from torchrl_her_recipes.cli.say import BAD_INPUT_ERRORS, INTERRUPTED, fail, one_line
from torchrl_her_recipes.cli.train_options import OptionsCommand, RunRequest, complete, requests
from torchrl_her_recipes.config.imports import imported_modules


@click.command(cls=OptionsCommand, short_help="train, or go on with a run")
@click.option("-m", "--multirun", is_flag=True, help="a sweep: algo=her,cher seed=0,1 are four runs")
@click.option(
    "--resume", metavar="RUN", type=click.Path(path_type=Path), help="go on with the run in this folder"
)
@click.option("--show", is_flag=True, help="print all options of the run as YAML, and train nothing")
@click.argument("options", metavar="[NAME=VALUE]...", nargs=-1, shell_complete=complete)
def train(options: tuple[str, ...], multirun: bool, resume: Path | None, show: bool) -> int:
    """Train a policy; for instance: torchrl-her train task=hand_v0 algo=filtered_her seed=0

    Options are named by themselves (gamma=0.95) or with their group (learner.gamma=0.95).
    """
    if resume is not None:
        if options or multirun or show:
            raise click.UsageError("--resume takes the folder of a run and nothing else")
        if not resume.is_dir():
            raise ValueError(f"{resume} is no folder of a run: it has no config.yaml")
        _say_start(resume)
        return _say_end(recipes.resume(resume))
    wanted = list(requests(options, multirun=multirun))  # all are checked before the first one starts
    if show:
        shown = [yaml.safe_dump(each.recipe.to_dict(), sort_keys=False) for each in wanted]
        click.echo("---\n".join(shown), nl=False)
        return 0
    codes = []
    for each in wanted:
        codes.append(_train(each) if len(wanted) == 1 else _train_one_of(each))
        if codes[-1] == INTERRUPTED:
            break  # Ctrl-C ends the whole sweep
    return max(codes)


def _train(wanted: RunRequest) -> int:
    components = recipes.build(wanted.recipe)
    _say_start(wanted.folder)
    return _say_end(recipes.run(components, wanted.folder))


def _train_one_of(wanted: RunRequest) -> int:
    """A run of a sweep: if it fails, the others are trained nevertheless."""
    try:
        return _train(wanted)
    except BAD_INPUT_ERRORS as error:
        return fail(f"{wanted.folder}: {one_line(error)}")


def _say_start(folder: Path) -> None:
    click.echo(f"run: {folder}")


def _say_end(result: recipes.RunResult) -> int:
    assert result.folder is not None
    if result.interrupted:
        click.echo(f"interrupted: everything so far was saved in {result.folder}")
        imports = "".join(f"--import {module} " for module in imported_modules())
        click.echo(f"go on with: torchrl-her {imports}train --resume {result.folder}")
        return INTERRUPTED
    click.echo(f"success {result.success:.0%} in the last evaluation")
    home = recipes.RunFolder(result.folder)
    files = [path.name for path in (home.curves, home.video, home.metrics, home.checkpoint) if path.exists()]
    click.echo(f"run: {home.path} ({', '.join(files)})")
    return 0
