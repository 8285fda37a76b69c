"""What the benchmarks of training compare: a module for each library, with the interface of :mod:`.peer`."""
