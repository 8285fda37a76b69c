"""``torchrl-her clean``: what runs leave on the disk that nobody needs any more."""

from __future__ import annotations

from pathlib import Path

import click

import torchrl_her_recipes as recipes  # its names are loaded when they are used: torch comes with them

_UNITS = ("B", "kB", "MB", "GB", "TB")


@click.command(short_help="list, or remove, what finished runs do not need any more")
@click.argument("runs", metavar="RUNS", type=click.Path(path_type=Path))
@click.option("--yes", is_flag=True, help="remove it")
def clean(runs: Path, yes: bool) -> int:
    """List what can be removed of the runs in the folder RUNS, at any depth; with --yes, remove it.

    These are the replay buffers of finished runs (without them a run cannot be given more epochs; those of
    runs with keep_buffer=true are kept), older checkpoints of finished runs, and unfinished files of runs
    that were killed.
    """
    total = 0
    for waste in recipes.find_waste(runs):
        if yes:
            waste.remove()
        click.echo(f"{size_of(waste.size):>8}  {waste.path} ({waste.kind})")
        total += waste.size
    if not total:
        click.echo("there is nothing to remove")
    elif yes:
        click.echo(f"{size_of(total):>8}  removed")
    else:
        click.echo(f"{size_of(total):>8}  in all; `torchrl-her clean {runs} --yes` removes it")
    return 0


def size_of(count: int) -> str:
    """A number of bytes for people.

    Example:
        >>> size_of(0), size_of(999), size_of(1_500), size_of(229_000_000)
        ('0 B', '999 B', '1.5 kB', '229 MB')
    """
    size, unit = float(count), 0
    while size >= 999.5 and unit < len(_UNITS) - 1:
        size, unit = size / 1000, unit + 1
    digits = 1 if unit and size < 9.95 else 0
    return f"{size:.{digits}f} {_UNITS[unit]}"
