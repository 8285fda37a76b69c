"""``torchrl-her study`` trains all runs of a comparison; ``torchrl-her report`` writes a page about runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

import torchrl_her_recipes as recipes  # imports torch only when one of its names is used
from torchrl_her_recipes.cli.say import FAILED, INTERRUPTED, say_result
from torchrl_her_recipes.config.study import load_study, study_names

_FOLDER = click.Path(path_type=Path)


def _complete(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    names = [CompletionItem(name) for name in study_names() if name.startswith(incomplete)]
    return [*names, CompletionItem(incomplete, type="file")]


@click.command(short_help="run a whole comparison on all cores and draw its figure")
@click.argument("name", shell_complete=_complete)
@click.option("--seeds", type=click.IntRange(1), help="number of seeds of each combination")
@click.option("--frames", type=click.IntRange(1), help="environment steps of each run")
@click.option("--quick", is_flag=True, help="shrink the study so that it takes minutes")
@click.option("--folder", type=_FOLDER, help="output folder (default: runs/NAME)")
@click.option(
    "--plan", is_flag=True, help="only print unfinished runs, with the remaining time if it can be estimated"
)
@click.option("--jobs", type=click.IntRange(1), help="batches of seeds at once (default: one for each core)")
@click.option("--ray", metavar="ADDRESS", help="train on a Ray cluster at this address: auto, or HOST:PORT")
@click.option(
    "--gpus-per-job",
    type=click.FloatRange(0.0),
    default=0.0,
    help="with --ray, number of GPUs for each job, such as 0.25 to share one among four",
)
def study(
    name: str,
    seeds: int | None,
    frames: int | None,
    quick: bool,
    folder: Path | None,
    plan: bool,
    jobs: int | None,
    ray: str | None,
    gpus_per_job: float,
) -> int:
    """Train a study: NAME is one in `torchrl-her list`, or a .yaml file. The same command resumes it."""
    if jobs is not None and ray is not None:
        raise click.UsageError("--jobs and --ray cannot be given together")
    if gpus_per_job and ray is None:
        raise click.UsageError("--gpus-per-job needs --ray: without it, all jobs share this machine's GPUs")
    loaded = load_study(name, seeds=seeds, frames=frames, quick=quick)
    home = folder or Path("runs") / (loaded.name + ("_quick" if quick else ""))
    to_do = recipes.plan_study(loaded, home)
    workers: Any = recipes.make_workers(jobs=jobs, ray=ray, gpus_per_job=gpus_per_job)
    left = to_do.to_go
    steps = f"{to_do.steps_to_go(left):,} environment steps in all"
    click.echo(f"{loaded.name}: {len(left)} batched runs to go, {steps}: {home}")
    click.echo("\n".join(to_do.table(workers.at_once)))
    if plan:
        workers.close()
        return 0
    result = recipes.run_study(loaded, home, workers=workers)
    say_result(result)
    if result.figure is not None:
        click.echo(result.figure)
        return 0
    click.echo("interrupted: " * result.interrupted + "the same command resumes it")
    return INTERRUPTED if result.interrupted else FAILED


def _refuse_follow(_context: click.Context, _parameter: click.Parameter, given: bool) -> None:
    if given:
        raise click.UsageError(
            "no option --follow; choose `tensorboard --logdir runs`, which shows curves during training"
        )


@click.command(short_help="write a page about a study or runs, with curves, goals and a film")
@click.argument("names", metavar="NAME|RUN...", nargs=-1, required=True, shell_complete=_complete)
@click.option("--folder", type=_FOLDER, help="folder of the study's runs (default: runs/NAME)")
@click.option("--out", type=_FOLDER, help="folder of the page (default: FOLDER/report)")
@click.option(
    "--export",
    "tidy",
    type=_FOLDER,
    help="also write the study's numbers, as CSV files with one row per value, into this folder",
)
@click.option("--follow", is_flag=True, hidden=True, expose_value=False, callback=_refuse_follow)
def report(names: tuple[str, ...], folder: Path | None, out: Path | None, tidy: Path | None) -> int:
    """Write a page about the finished part of the study NAME, or about runs. Trains nothing.

    RUN is the folder of a run, or a folder that contains such folders.
    """
    home = Path(names[0])
    if home.is_dir() and names[0] not in study_names():
        return _report_runs([Path(name) for name in names], folder, out, tidy)
    if len(names) > 1:
        raise ValueError(f"give the name of one study or folders of runs, got {', '.join(names)}")
    loaded = load_study(names[0])
    home = folder or Path("runs") / loaded.name
    if not home.is_dir():
        raise ValueError(f"there is no folder {home}; `torchrl-her study {loaded.name}` makes its runs")
    if tidy is not None:
        recipes.write_results(loaded, home, tidy)
        click.echo(tidy)
    click.echo(recipes.write_report(loaded, home, out or home / "report"))
    return 0


def _report_runs(runs: list[Path], folder: Path | None, out: Path | None, tidy: Path | None) -> int:
    for option, value in (("--folder", folder), ("--export", tidy)):
        if value is not None:
            raise click.UsageError(f"{option} goes with the name of a study, not with folders of runs")
    for run in runs:
        if not run.is_dir():
            raise ValueError(f"{run} is no folder of a run")
    click.echo(recipes.write_runs_report(runs, out or runs[0] / "report"))
    return 0
