"""``torchrl-her plot``: the virtual goals of a run."""

from __future__ import annotations

from pathlib import Path

import click

import torchrl_her_recipes as recipes  # its names are loaded when they are used: torch comes with them


@click.command(short_help="draw virtual goals of a run beside q*")
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="the figure (default: virtual_goals.png in RUN)")
def plot(run: Path, out: Path | None) -> int:
    """Draw a heat map of a run's virtual goals beside the target q*.

    RUN is the folder of a run, or of a combination of a study.
    """
    if not run.is_dir():
        raise ValueError(f"{run} is no folder of a run")
    figure = out or run / "virtual_goals.png"
    recipes.plot_virtual_goals(run, figure)
    click.echo(figure)
    return 0
