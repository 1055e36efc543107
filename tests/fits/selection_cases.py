"""What tests of selection share."""

import numpy as np

import jimpact as ji

PAIR = ji.chain([1.0, 2.0])


SPEED = np.linspace(0.5, 4.0, 12)


PRE = np.stack([SPEED, 0 * SPEED], axis=1)


def after(e, noise=0.0, seed=0):
    """What a pair with these restitution coefficients does, and an error of measurement."""
    v = SPEED[:, None] * np.stack([(1 - 2 * e) / 3, (1 + e) / 3], axis=1)
    return v + noise * np.random.default_rng(seed).normal(size=v.shape)
