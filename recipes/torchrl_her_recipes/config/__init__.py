"""Configuration of runs as plain values. No module in this package imports torch."""
