"""Searches for good options: their settings, and the options that they vary."""
