"""Trained policies: loads, measures, exports and shows them, and records their episodes."""
