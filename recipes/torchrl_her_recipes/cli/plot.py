"""``torchrl-her plot``: pictures of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import torchrl_her_recipes as recipes  # its names are loaded when they are used: torch comes with them
from torchrl_her_recipes.cli.permission import allow_import

_PICTURES = {"goals": "virtual_goals.png", "values": "values.png", "times": "times.png"}


@click.command(short_help="virtual goals beside q*, values in a toy environment, or times to solve chains")
@click.argument("what", type=click.Choice(list(_PICTURES)))
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="the picture (default: in the folder of the first run)"
)
@allow_import
def plot(what: Any, runs: tuple[Path, ...], out: Path | None) -> int:
    """Draw a picture of runs.

    goals: a heat map of a run's virtual goals beside the target q*. values: what agents make of bit_flip or
    treasure_hunt. times: how long chains took to be solved, beside the times of ideal learners.

    RUN is the folder of a run, or of a combination of a study.
    """
    for folder in runs:
        if not folder.is_dir():
            raise ValueError(f"{folder} is no folder of a run")
    if what == "goals" and len(runs) > 1:
        raise ValueError(f"goals are drawn of one folder, got {len(runs)}")
    picture = out or runs[0] / _PICTURES[what]
    recipes.plot_runs(what, runs, picture)
    click.echo(picture)
    return 0
