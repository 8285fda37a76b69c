"""Alternatives for sections of a recipe, such as the learner: for each, a class with its options."""
