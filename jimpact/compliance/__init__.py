"""Contact forces, their scales and parameters."""
