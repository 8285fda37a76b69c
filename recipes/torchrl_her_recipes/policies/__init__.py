"""Trained policies: loaded from runs and files, measured, saved, exported, shown and recorded."""
