"""Recipes: whole training runs composed of the library and the tasks."""

from torchrl_her_recipes.algorithms import ALGORITHMS, Algorithm, get_algorithm
from torchrl_her_recipes.parts import Parts, build_parts
from torchrl_her_recipes.play import load_actor, play
from torchrl_her_recipes.recipe import Recipe
from torchrl_her_recipes.run import RunResult, resume, run

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
