"""Benchmarks of collecting in other processes."""
