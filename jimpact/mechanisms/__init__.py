"""Bodies and their scenes at a configuration."""
