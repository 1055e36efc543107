"""Error against time and work."""
