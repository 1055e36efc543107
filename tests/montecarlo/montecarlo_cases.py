"""Shared heads: Monte Carlo: statistics, distributions, failures, resume, sensitivity."""

import jax
import jax.numpy as jnp

from jimpact import (
    Binary,
    Uniform,
    chain,
    monte_carlo,
)

BALLS = chain([0.25, 1.0, 0.25])
LAW = Binary(1.0, order="earliest")
BEFORE = [1.0, 0.0, -1.0]
GAPS = Uniform(0.0, 1e-5)
CHUNK = 256  # one compiled program for most of this file


def sampled(samples=1000, law=LAW, velocity=BEFORE, gaps=GAPS, **options):
    return monte_carlo(
        law, BALLS, velocity, gaps, samples, **({"chunk": CHUNK} | options)
    )


def sometimes_bad(key):
    gaps = jax.random.uniform(key, (2,), minval=-1e-7, maxval=1e-5)
    return jnp.where(gaps > 9.9e-6, jnp.nan, gaps)
