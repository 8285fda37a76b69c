"""Makers for goals: the space of a task's goals, weights of virtual goals, and proposed goals."""
