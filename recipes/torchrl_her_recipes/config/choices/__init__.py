"""Sections of a recipe that are one of several classes, each with options of its own."""
