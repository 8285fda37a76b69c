"""The components of a run, made from a recipe."""
