"""Runs studies and sweeps: plans their jobs, trains them on workers, and draws their figures."""
