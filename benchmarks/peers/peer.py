"""What a library has to do in order to be measured."""

from __future__ import annotations

from typing import ClassVar, Protocol

from torchrl_her_recipes import Recipe


class Peer(Protocol):
    """A library that trains what a recipe describes.

    Attributes:
        name: of the library and its algorithm, as tables show it.
        differs: what it does otherwise than our DDPG, for the text beside the tables.
    """

    name: ClassVar[str]
    differs: ClassVar[str]

    def __init__(self, recipe: Recipe) -> None: ...

    @property
    def updates(self) -> int:
        """Gradient steps so far."""
        ...

    def fill(self, frames: int) -> None:
        """Plays that many environment steps into the replay buffer, without learning."""
        ...

    def gradient_steps(self, steps: int) -> int:
        """Makes that many gradient steps with all that belongs to them; returns how many it made.

        What belongs to them: drawing transitions, relabeling those that are relabeled when they are drawn,
        targets, losses, the optimizer, target networks, and priorities where there are any.
        """
        ...

    def loop(self, frames: int) -> int:
        """Trains: plays, stores and learns; returns the environment steps."""
        ...
