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
    from torchrl_her_recipes.policies import TrainedPolicy, export_policy, load_policy, load_trained
    from torchrl_her_recipes.recipe import Recipe
    from torchrl_her_recipes.running import RunResult, resume, run

__all__ = [
    "ALGORITHMS",
    "Algorithm",
    "Parts",
    "Recipe",
    "RunResult",
    "TrainedPolicy",
    "build_parts",
    "export_policy",
    "get_algorithm",
    "load_actor",
    "load_policy",
    "load_trained",
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
    "TrainedPolicy": "policies",
    "build_parts": "parts",
    "export_policy": "policies",
    "get_algorithm": "algorithms",
    "load_actor": "playing",
    "load_policy": "policies",
    "load_trained": "policies",
    "play": "playing",
    "resume": "running",
    "run": "running",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
