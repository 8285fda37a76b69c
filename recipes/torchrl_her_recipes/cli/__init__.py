"""The command line. Commands and their arguments are checked before torch is imported."""

from torchrl_her_recipes.cli.group import main

__all__ = ["main"]
