"""Builders of learners, found by their names in :mod:`torchrl_her_recipes.config.choices.learners`."""
