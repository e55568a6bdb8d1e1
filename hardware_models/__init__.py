"""Machine cards."""
