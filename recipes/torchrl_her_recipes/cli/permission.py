"""``--allow-import``: for commands that read recipes from files, which may name modules of somebody else."""

from __future__ import annotations

import click

from torchrl_her_recipes.config.imports import allow_imports


def _permit(context: click.Context, _parameter: click.Parameter, given: bool) -> None:
    if given:
        context.with_resource(allow_imports())  # until the command ends


allow_import = click.option(
    "--allow-import",
    is_flag=True,
    expose_value=False,
    callback=_permit,
    help="import the module that a task in a file names (module:function, gym:module:ID), if you trust it",
)
