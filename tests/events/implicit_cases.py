"""Shared heads: Method 'implicit': impacts by steps without events, of `LZB` and `Compliant`."""

import jax.numpy as jnp
from spatial_scenes import NAMED

import jimpact as ji


def pressed(name):
    """Scene and velocity of a body on the ground."""
    body = NAMED[name]()
    return ji.Scene(body.mass, body.normals, body.tangents), jnp.asarray(body.velocity)
