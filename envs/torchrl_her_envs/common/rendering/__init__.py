"""Videos and windows of any environment that can be rendered."""
