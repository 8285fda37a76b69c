"""Settings of searches for good options, and search spaces: the options that a search varies."""
