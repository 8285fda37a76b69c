"""Runs: training, evaluation, checkpoints, and what they leave behind."""
