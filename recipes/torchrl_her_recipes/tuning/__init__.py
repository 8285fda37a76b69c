"""Searches for good options: trials by Optuna, several at once, in a folder that resumes."""

from importlib.util import find_spec

if find_spec("optuna") is None:
    raise ImportError("a search needs Optuna: pip install '.[tune]'")
