"""Parts that all environments share."""
