"""Fits of laws to measured velocities."""
