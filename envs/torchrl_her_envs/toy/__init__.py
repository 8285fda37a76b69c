"""Toy environments: bit flipping, treasure hunt, chain."""
