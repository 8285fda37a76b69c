"""Films and windows of any environment that gives pictures."""
