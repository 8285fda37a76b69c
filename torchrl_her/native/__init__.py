"""C++ code that is compiled for this machine: gradient steps, and trees of priorities."""

from torchrl_her.native.job import Activation, Algorithm, Layer, Norm, structures
from torchrl_her.native.library import CannotCompile, load_library
from torchrl_her.native.steps import load_steps
from torchrl_her.native.trees import load_trees

__all__ = [
    "Activation",
    "Algorithm",
    "CannotCompile",
    "Layer",
    "Norm",
    "load_library",
    "load_steps",
    "load_trees",
    "structures",
]
