"""Writes reports: pages and tables about the runs of a study, or about single runs."""
