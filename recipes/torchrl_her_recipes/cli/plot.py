"""``torchrl-her plot``: draws the virtual goals of a run."""

from __future__ import annotations

from pathlib import Path

import click

import torchrl_her_recipes as recipes  # imports torch only when one of its names is used


@click.command(short_help="draw a heat map of a run's virtual goals")
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="the figure (default: virtual_goals.png in RUN)")
def plot(run: Path, out: Path | None) -> int:
    """Draw a heat map of a run's virtual goals beside a heat map of q*, the target distribution of IBS.

    RUN is the folder of a run, or of one combination of a study.
    """
    if not run.is_dir():
        raise ValueError(f"{run} is no folder of a run")
    figure = out or run / "virtual_goals.png"
    recipes.plot_virtual_goals(run, figure)
    click.echo(figure)
    return 0
