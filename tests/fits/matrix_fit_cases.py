"""What tests of matrix fit share."""

import jax
import jax.numpy as jnp
import numpy as np

import jimpact as ji
from jimpact import RestitutionMatrix, fit

CHAIN = ji.chain([1.0, 2.0, 3.0])


E_TRUE = np.array([[0.3, 0.1], [0.5, 0.4]])


START = 0.3 * np.eye(2)


# four shots; the compiled fit is shared by all tests that use four of three bodies
PRE = np.array([[1.0, 0.0, -0.2], [1.0, 0.3, 0.0], [0.5, 0.2, -0.4], [0.9, 0.9, -0.3]])


after = jax.jit(
    jax.vmap(lambda e, v: ji.impact(RestitutionMatrix(e), CHAIN, v).velocity, (None, 0))
)


def shots(matrix, noise=0.0, seed=0, pre=PRE):
    post = np.asarray(after(jnp.asarray(matrix), jnp.asarray(pre)))
    return ji.Experiments(
        pre, post + noise * np.random.default_rng(seed).normal(size=post.shape)
    )


def fitted(data, start=START, **options):
    free = options.pop("free", True)
    return fit(
        RestitutionMatrix(start), CHAIN, data, {"matrix": free}, starts=2, **options
    )


# the unconstrained minimum of these data creates energy
PUSHED = shots(np.array([[0.1, 0.2], [0.95, 0.1]]), noise=0.1, seed=4)


PROBLEM = ji.FitProblem.from_shots(RestitutionMatrix(START), CHAIN, PUSHED)


OUTSIDE = np.array([0.2, 0.1, 1.2, 0.3])  # creates energy, too
