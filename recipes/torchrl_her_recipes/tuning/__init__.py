"""Searches for good options with Optuna: runs several trials at once, and resumes interrupted searches."""

from importlib.util import find_spec

if find_spec("optuna") is None:
    raise ImportError("a search needs Optuna: pip install '.[tune]'")
