"""Libraries that benchmarks of training compare: a module for each, with the interface of :mod:`.peer`."""
