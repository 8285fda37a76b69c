"""The command line ``torchrl-her``. Arguments are checked before torch is imported, to fail fast."""

from torchrl_her_recipes.cli.group import main

__all__ = ["main"]
