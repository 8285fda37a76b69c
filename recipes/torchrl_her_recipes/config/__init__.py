"""Configuration of runs as plain values. No module in here imports torch."""
