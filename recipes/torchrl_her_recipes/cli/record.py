"""``torchrl-her record``: writes demonstrations of a task to a file."""

from __future__ import annotations

from pathlib import Path

import click

import torchrl_her_recipes as recipes  # imports torch only when one of its names is used
from torchrl_her_recipes.cli.say import file_name


@click.command(short_help="record demonstrations of a task, for demonstrations.file=FILE")
@click.argument("task", metavar="TASK")
@click.option(
    "--episodes", type=click.IntRange(1), default=100, show_default=True, help="number of episodes to write"
)
@click.option("--out", type=click.Path(path_type=Path), help=".pt file to write (default: TASK_demos.pt)")
@click.option(
    "--policy",
    metavar="expert|FILE|NAME",
    help="policy that plays: the scripted expert (default), an exported policy, or a policy of the package",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="seed of starts and goals")
@click.option("--all", "keep_all", is_flag=True, help="write episodes that fail, too")
@click.option("--force", is_flag=True, help="replace the file if it exists")
def record(
    task: str, episodes: int, out: Path | None, policy: str | None, seed: int, keep_all: bool, force: bool
) -> int:
    """Play episodes of TASK and write those that achieve their goal to a file.

    To train with ten of them: torchrl-her train demonstrations.file=FILE demonstrations.episodes=10
    """
    file = out or Path(f"{file_name(task)}_demos.pt")
    recorded = recipes.record_demonstrations(
        task, file, episodes=episodes, policy=policy, seed=seed, keep_all=keep_all, force=force
    )
    demos = recorded.demonstrations
    click.echo(
        f"{recorded.achieved} of {recorded.played} episodes achieved their goal; {len(demos)} of them with "
        f"{len(demos.rows):,} transitions are in {file}"
    )
    return 0
