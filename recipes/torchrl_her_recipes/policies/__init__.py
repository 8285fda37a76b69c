"""Trained policies: loading from runs and files, measuring, saving, exporting, showing and recording."""
