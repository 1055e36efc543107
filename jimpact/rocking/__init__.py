"""Rocking of a block."""
