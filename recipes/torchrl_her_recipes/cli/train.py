"""``torchrl-her train``: trains one run, or all runs of a sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import torchrl_her_recipes as recipes  # imports torch only when one of its names is used
from torchrl_her_recipes.cli.overrides import single
from torchrl_her_recipes.cli.say import INTERRUPTED, exit_code, say_result, success_line
from torchrl_her_recipes.cli.train_options import (
    OptionsCommand,
    complete,
    folder_option,
    requests,
    with_folder,
)
from torchrl_her_recipes.config.imports import command_line
from torchrl_her_recipes.config.plain_files import dump_yaml
from torchrl_her_recipes.config.recipe import Recipe, check_extending
from torchrl_her_recipes.config.resolve import SHAPING, auto_options, left_open


@click.command(cls=OptionsCommand, short_help="train, or resume a run")
@click.option("-m", "--multirun", is_flag=True, help="train a sweep: algo=her,cher seed=0,1 are four runs")
@click.option("--jobs", type=click.IntRange(1), help="runs of a sweep at once (default: one for each core)")
@click.option(
    "--resume",
    metavar="RUN",
    type=click.Path(path_type=Path),
    help="resume the run in this folder; epochs=N sets a new total number of epochs",
)
@click.option("--show", is_flag=True, help="only print all options of the run as YAML")
@folder_option
@click.argument("options", metavar="[NAME=VALUE]...", nargs=-1, shell_complete=complete)
def train(
    options: tuple[str, ...],
    multirun: bool,
    jobs: int | None,
    resume: Path | None,
    show: bool,
    folder: str | None,
) -> int:
    """Train a policy; for instance: torchrl-her train task=hand_v0 algo=filtered_her seed=0

    Options are named by themselves (gamma=0.95) or with their group (learner.gamma=0.95).
    """
    options = with_folder(options, folder)
    if jobs is not None and not multirun:
        raise click.UsageError("--jobs is for a sweep: give -m as well")
    if resume is not None:
        if multirun or show:
            raise click.UsageError("--resume cannot be given together with -m or --show")
        changes = single(options)
        check_extending(changes)
        if not resume.is_dir():
            raise ValueError(f"{resume} is no folder of a run: it has no config.yaml")
        click.echo(f"run: {resume}")
        _say_finished(recipes.RunFolder(resume), changes)
        return _say_end(recipes.resume(resume, options=changes))
    runs = requests(options, multirun=multirun)  # all recipes are checked before the first run starts
    if show:
        documents = [dump_yaml(recipe.to_dict()) for recipe in runs.values()]
        click.echo("---\n".join(documents), nl=False)
        return 0
    if multirun:
        return _sweep(runs, jobs, anew=not any(option.startswith("folder=") for option in options))
    ((home, recipe),) = runs.items()
    return _say_end(_train(recipe, home))


def _train(recipe: Recipe, folder: Path) -> recipes.RunResult:
    components = recipes.build(recipe)
    click.echo(f"run: {folder}")
    if chosen := auto_options(recipe):
        values = (f"{name}={getattr(getattr(components.recipe, group), name)}" for group, name in chosen)
        click.echo(f"chosen for this environment (auto): {' '.join(values)}")
    if (stages := components.recipe.curriculum.stages) and recipe.curriculum.stages is None:
        click.echo(
            "algo=auto chose a curriculum, since random actions seldom change the achieved goal: the first "
            f"stage brings entries {stages[0]['achieved_goal']} of the observation to it (algo=filtered_her "
            "trains without a curriculum)"
        )
    near_far = (components.recipe.task.options or {}).get(SHAPING)
    if near_far and left_open(recipe.task, SHAPING):
        click.echo(
            f"algo=auto chose task.options.shaping={near_far}, since random actions never come near a goal: "
            "missing it by less than the second distance has a higher reward, the nearer the higher "
            "(algo=filtered_her trains without)"
        )
    if recipe.learner.device == "auto":
        click.echo(f"learner.device=auto: {next(components.loss.parameters()).device}")
    return recipes.run(components, folder)


def _sweep(requested: dict[Path, Recipe], jobs: int | None, *, anew: bool) -> int:
    """Trains several runs on all cores; if one fails, the others are still trained."""
    runs = {home.name: recipe for home, recipe in requested.items()}
    folder = next(iter(requested)).parent
    if anew:  # no folder is given: resumes an unfinished sweep of the same runs, if there is one
        folder = recipes.unfinished_sweep(runs, folder.parent) or folder
    plan, workers = recipes.plan_study(runs, folder), recipes.make_workers(jobs=jobs)
    click.echo(f"sweep: {len(plan.to_go)} of {len(runs)} runs to go: {folder}")
    click.echo("\n".join(plan.table(workers.at_once)))
    result = recipes.run_study(runs, folder, workers=workers)
    say_result(result, of=f"{folder}/")
    if every := [success for successes in result.successes.values() for success in successes]:
        left = len(runs) - len(result.successes)
        unfinished = f"; {left} of {len(runs)} did not end" if left else ""
        click.echo(f"the whole sweep: {success_line(every)}{unfinished}")
    return exit_code(interrupted=result.interrupted, failed=bool(result.failed))


def _say_finished(home: recipes.RunFolder, changes: dict[str, Any]) -> None:
    epochs, rows = home.recipe().run.epochs, home.rows()
    if "epochs" not in changes and rows and rows[-1]["epoch"] >= epochs:
        click.echo(
            f"the run has finished its {epochs} epochs; epochs=N adds more, if it was trained with "
            "keep_buffer=true"
        )


def _say_end(result: recipes.RunResult) -> int:
    assert result.folder is not None
    if result.interrupted:
        click.echo(f"interrupted: everything so far was saved in {result.folder}")
        task = recipes.RunFolder(result.folder).recipe().task.name
        click.echo(f"resume it with: {command_line('train', '--resume', result.folder, task=task)}")
        return INTERRUPTED
    left = "" if result.reached == result.success else f", reached at some step {result.reached:.0%}"
    click.echo(f"{success_line(result.successes)}{left} in the last evaluation")
    home = recipes.RunFolder(result.folder)
    files = [path.name for path in (home.curves, home.video, home.metrics, home.checkpoint) if path.exists()]
    click.echo(f"run: {home.path} ({', '.join(files)})")
    return 0
