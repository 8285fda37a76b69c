"""Imported last by the server that forks processes: they share its objects and never collect them."""

import gc

gc.collect()
gc.freeze()
