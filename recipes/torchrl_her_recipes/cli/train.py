"""``torchrl-her train``: one run, or a sweep over several."""

from __future__ import annotations

from pathlib import Path

import click
import yaml

import torchrl_her_recipes as recipes  # its names are loaded when they are used: torch comes with `build`
from torchrl_her_recipes.cli.permission import allow_import
from torchrl_her_recipes.cli.say import BAD_INPUT_ERRORS, INTERRUPTED, fail, one_line, success_line
from torchrl_her_recipes.cli.train_options import (
    OptionsCommand,
    RunRequest,
    complete,
    extending,
    requests,
)
from torchrl_her_recipes.config.imports import foreign_module, imported_modules


@click.command(cls=OptionsCommand, short_help="train, or go on with a run")
@click.option("-m", "--multirun", is_flag=True, help="a sweep: algo=her,cher seed=0,1 are four runs")
@click.option(
    "--resume",
    metavar="RUN",
    type=click.Path(path_type=Path),
    help="go on with the run in this folder; with epochs=N, up to so many epochs",
)
@click.option("--show", is_flag=True, help="print all options of the run as YAML, and train nothing")
@allow_import
@click.argument("options", metavar="[NAME=VALUE]...", nargs=-1, shell_complete=complete)
def train(options: tuple[str, ...], multirun: bool, resume: Path | None, show: bool) -> int:
    """Train a policy; for instance: torchrl-her train task=hand_v0 algo=filtered_her seed=0

    Options are named by themselves (gamma=0.95) or with their group (learner.gamma=0.95).
    """
    if resume is not None:
        if multirun or show:
            raise click.UsageError("--resume cannot be given together with -m or --show")
        changes = extending(options)
        if not resume.is_dir():
            raise ValueError(f"{resume} is no folder of a run: it has no config.yaml")
        _say_start(resume)
        return _say_end(recipes.resume(resume, options=changes))
    wanted = list(requests(options, multirun=multirun))  # all are checked before the first one starts
    if show:
        shown = [yaml.safe_dump(each.recipe.to_dict(), sort_keys=False) for each in wanted]
        click.echo("---\n".join(shown), nl=False)
        return 0
    return _say_end(_train(wanted[0])) if len(wanted) == 1 else _sweep(wanted)


def _train(wanted: RunRequest) -> recipes.RunResult:
    components = recipes.build(wanted.recipe)
    _say_start(wanted.folder)
    if wanted.recipe.learner.device == "auto":
        click.echo(f"learner.device=auto: {next(components.loss.parameters()).device}")
    return recipes.run(components, wanted.folder)


def _sweep(wanted: list[RunRequest]) -> int:
    """Several runs, one after the other: if one fails, the others are trained nevertheless."""
    codes, successes = [], []
    for each in wanted:
        try:
            result = _train(each)
        except BAD_INPUT_ERRORS as error:
            codes.append(fail(f"{each.folder}: {one_line(error)}"))
            continue
        codes.append(_say_end(result))
        if result.interrupted:
            return INTERRUPTED  # Ctrl-C ends the whole sweep
        successes += result.successes
    if successes:
        click.echo(f"the whole sweep: {success_line(successes)}{_failed(codes)}")
    return max(codes)


def _failed(codes: list[int]) -> str:
    failed = sum(code != 0 for code in codes)
    return f"; {failed} of {len(codes)} failed" if failed else ""


def _say_start(folder: Path) -> None:
    click.echo(f"run: {folder}")


def _say_end(result: recipes.RunResult) -> int:
    assert result.folder is not None
    if result.interrupted:
        click.echo(f"interrupted: everything so far was saved in {result.folder}")
        imports = "".join(f"--import {module} " for module in imported_modules())
        foreign = foreign_module(recipes.RunFolder(result.folder).recipe().task.name)
        allowed = " --allow-import" if foreign and foreign not in imported_modules() else ""
        click.echo(f"go on with: torchrl-her {imports}train --resume {result.folder}{allowed}")
        return INTERRUPTED
    click.echo(f"{success_line(result.successes)} in the last evaluation")
    home = recipes.RunFolder(result.folder)
    files = [path.name for path in (home.curves, home.video, home.metrics, home.checkpoint) if path.exists()]
    click.echo(f"run: {home.path} ({', '.join(files)})")
    return 0
