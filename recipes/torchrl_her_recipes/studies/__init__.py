"""Studies: many runs that are compared."""
