"""``torchrl-her check``: plays random actions on a task and prints facts and advice before training."""

from __future__ import annotations

from pathlib import Path

import click

import torchrl_her_recipes as recipes  # imports torch only when one of its names is used
from torchrl_her_recipes.cli.say import file_name
from torchrl_her_recipes.cli.train_options import OptionsCommand, complete, requests
from torchrl_her_recipes.config.plain_files import dump_yaml


@click.command(cls=OptionsCommand, short_help="play random actions on a task, and suggest options")
@click.option("--steps", type=click.IntRange(1), default=3_000, show_default=True, help="random steps")
@click.argument("options", metavar="[NAME=VALUE]...", nargs=-1, shell_complete=complete)
def check(options: tuple[str, ...], steps: int) -> int:
    """Play random actions on a task; for instance: torchrl-her check task=gym:FetchPush-v4

    Prints, within half a minute, what hindsight can learn from, and suggests options. Trains nothing. Takes
    the options of `torchrl-her train`.
    """
    (recipe,) = requests(options, multirun=False).values()
    facts = recipes.look_at(recipe, steps=steps)
    file = Path(f"{file_name(recipe.task.name)}_stages.yaml")
    click.echo("\n".join(_table(facts)))
    lines = recipes.advice(facts, recipe, str(file))
    if any(str(file) in line for line in lines):
        if not file.exists():
            file.write_text(dump_yaml(facts.stages, default_flow_style=None))
        click.echo(f"  stages                {file}")
    click.echo("")
    click.echo("\n".join(f"- {line}" for line in lines) or "no obstacle to learning was found")
    return 0


def _table(facts: recipes.Facts) -> list[str]:
    bounds = [] if facts.actions is None else sorted(set(facts.actions))
    actions = ", ".join(f"{low:.5g} to {high:.5g}" for low, high in bounds[:4]) or "discrete"
    rows = {
        "played": f"{facts.steps:,} random steps, {facts.episodes} episodes of up to {facts.max_steps}",
        "a step takes": f"{1e3 * facts.seconds:.2g} ms",
        "actions": actions,
        "observation": f"entries with standard deviations from {facts.scales[0]:.2g} to {facts.scales[1]:.2g}"
        + (f", {len(facts.constant)} that never change" if facts.constant else ""),
        "goals achieved": f"in {facts.achieved:.0%} of the episodes",
        "ends without goals": f"as by a fall: {facts.fallen:.1%} of the episodes",
        "the achieved goal": f"changes, by the reward, in {facts.moved:.0%} of the episodes",
        "the filter": f"keeps later goals of the episode for {facts.kept:.1%} of the transitions",
    }
    return [f"  {name:<20}  {text}" for name, text in rows.items()]
