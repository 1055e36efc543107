"""Numerical kernels: no physics beyond the equations each file states at its top."""
