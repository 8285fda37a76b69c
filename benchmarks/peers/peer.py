"""The interface of libraries that benchmarks compare."""

from __future__ import annotations

from typing import ClassVar, Protocol

from torchrl_her_recipes import Recipe


class Peer(Protocol):
    """A library that trains an agent with the options of a recipe.

    Attributes:
        name: name of the library and its algorithm in tables.
        differs: differences from this project's DDPG, for the text below the tables.
    """

    name: ClassVar[str]
    differs: ClassVar[str]

    def __init__(self, recipe: Recipe) -> None: ...

    @property
    def updates(self) -> int:
        """Number of gradient steps so far."""
        ...

    def fill(self, frames: int) -> None:
        """Collects ``frames`` environment steps into the replay buffer, without learning."""
        ...

    def gradient_steps(self, steps: int) -> int:
        """Takes ``steps`` complete gradient steps; returns the number of steps that it took.

        They include sampling transitions, relabeling if it is done when sampling, targets, losses, the
        optimizer, target networks, and priorities if there are any.
        """
        ...

    def loop(self, frames: int) -> int:
        """Collects ``frames`` environment steps, stores them and learns; returns the number of steps."""
        ...
