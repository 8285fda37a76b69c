"""Searches for good options: trials by Optuna, several at once, in a folder that a search goes on in."""
