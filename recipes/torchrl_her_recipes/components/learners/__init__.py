"""One builder for each learner. They are found by the names in :mod:`torchrl_her_recipes.config.learners`."""
