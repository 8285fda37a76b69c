"""Toy environments: bit flipping, treasure hunt, chain, and a puck with momentum."""
