"""Pictures of the throwing tasks."""
