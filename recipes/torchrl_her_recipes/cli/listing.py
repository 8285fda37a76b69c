"""``torchrl-her list``: prints all names that the other commands accept."""

from __future__ import annotations

import click

from torchrl_her_envs.registry import GYM, get_task_spec, task_names
from torchrl_her_recipes.config.algorithms import ALGORITHMS
from torchrl_her_recipes.config.policy_header import read_header
from torchrl_her_recipes.config.searches.spaces import space_names, space_summary
from torchrl_her_recipes.config.shipped import PLURALS, file_summary, files_of_options, policy_files
from torchrl_her_recipes.config.shortcuts import KINDS
from torchrl_her_recipes.config.study import load_study, study_names


@click.command("list", short_help="tasks, algorithms, choices of options, studies, policies, spaces, presets")
def listing() -> int:
    """List all names that the other commands accept, with a summary of each."""
    sections = {
        "tasks": {name: get_task_spec(name).summary for name in task_names()}
        | {f"{GYM}ID": "any gymnasium environment with goals, by its id (gym:my_module:MyEnv-v0)"}
        | {"my_module:make_env": "a TorchRL environment of your own, by its function or class"},
        "algorithms": {name: algorithm.summary for name, algorithm in ALGORITHMS.items()},
        **{f"choices of {group}": kind.summaries() for group, kind in KINDS.items()},
        "studies": {name: load_study(name).summary for name in study_names()},
        "trained policies": {
            name: "{success:.0%} success on {task}".format_map(read_header(path)["info"])
            for name, path in policy_files().items()
        },
        "spaces": {name: space_summary(name) for name in space_names()},
        **{
            PLURALS[kind]: {name: file_summary(kind, name) for name in names}
            for kind, names in files_of_options().items()
        },
    }
    for title, entries in sections.items():
        click.echo(f"{title}:")
        for name, summary in entries.items():
            click.echo(f"  {name:<20} {summary}")
    return 0
