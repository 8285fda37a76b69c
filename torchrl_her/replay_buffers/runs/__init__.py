"""Replay of several runs in one buffer: R equal blocks of rows, drawn from and written to in one pass."""
