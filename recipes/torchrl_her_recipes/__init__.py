"""Recipes: whole training runs composed of the library and the tasks.

Names are loaded when they are first asked for, so that the command line can check versions before
it imports what depends on them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_her_recipes.algorithms import ALGORITHMS, Algorithm, get_algorithm
    from torchrl_her_recipes.parts import Parts, build_parts
    from torchrl_her_recipes.playing import load_actor, play
    from torchrl_her_recipes.recipe import Recipe
    from torchrl_her_recipes.running import RunResult, resume, run

__all__ = [
    "ALGORITHMS",
    "Algorithm",
    "Parts",
    "Recipe",
    "RunResult",
    "build_parts",
    "get_algorithm",
    "load_actor",
    "play",
    "resume",
    "run",
]
_HOMES = {
    "ALGORITHMS": "algorithms",
    "Algorithm": "algorithms",
    "Parts": "parts",
    "Recipe": "recipe",
    "RunResult": "running",
    "build_parts": "parts",
    "get_algorithm": "algorithms",
    "load_actor": "playing",
    "play": "playing",
    "resume": "running",
    "run": "running",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
