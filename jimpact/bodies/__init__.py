"""Bodies: gaps, tangents and mass of blocks, dimers, discs and pendulums."""
