"""Runs: training, evaluation, checkpoints, and the files that a run writes."""
