"""What tests of fit share."""

import jax
import jax.numpy as jnp
import numpy as np
from programs import CODE, as_matrix

import jimpact as ji
from jimpact import Law

PAIR = ji.chain([1.0, 2.0])


BALLS = ji.chain([1.0, 1.0, 1.0])


SHOTS = np.array([[1.0, 0.0], [2.0, 0.3], [1.5, -1.0], [0.8, 0.1]])


def simulated(law, scene, pre, noise=0.0, seed=0):
    exact = np.array([ji.impact(law, scene, v).velocity for v in pre])
    return exact + noise * np.random.default_rng(seed).normal(size=exact.shape)


PRE_3 = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 0.0, -2.0], [1.0, 0.5, 0.0]])


def two_thirds(p):
    return p["restitution[1]"] * 2 / 3


class Coupled(Law):
    """A law made for the tests: gamma+ = -matrix gamma-, with a switch to misbehave."""

    matrix: jax.Array
    broken_below: float = -np.inf

    def impulses(self, contact):
        w = as_matrix(contact.delassus)
        change = -(self.matrix + jnp.eye(len(w))) @ contact.gap_velocity
        bad = self.matrix[0, 0] < self.broken_below
        p = jnp.where(bad, jnp.nan, jnp.linalg.solve(w, change))
        return ji.Impulses(p, None, jnp.where(bad, CODE["max_steps"], CODE["ok"]))


THREE = ji.Experiments(PRE_3, PRE_3)
