"""Whole motions: flights between impacts, impacts by any law, persistent contact."""
