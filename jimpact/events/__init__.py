"""Event-aligned integration."""
