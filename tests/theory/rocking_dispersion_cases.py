"""Shared heads: A block that rocks about A and hits with B: check values, the V, its tip, what happens next."""

import jax.numpy as jnp
import numpy as np

import jimpact as ji

MU = np.array([0.0, 0.3, 1.0])
CRITICAL = [
    2**0.5,
    (8.81**0.5 - 0.9) / 2,
    0.5**0.5,
]  # of these mu; the roots of the two forms
BOTH = np.array([0.5, 1.0, 2.0, 3.0, *CRITICAL])
E = np.array([0.3, 0.8, 0.9, 1.0])


def solved(aspect, e, exponent, stiffness=(1.0, 1.0)):
    """All of one shape, and parameters as arrays: one program for this file."""
    exponent, stiffness = jnp.asarray(float(exponent)), jnp.asarray(stiffness)
    return ji.theory.rocking_dispersion(aspect, MU, e, stiffness, exponent, rtol=1e-10)
