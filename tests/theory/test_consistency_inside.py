"""Copositivity, the audit of restitution matrices (Props. 6.2-6.5), Carnot, friction bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from consistency_cases import HORN, close

from jimpact.theory.restitution_matrices import margin

MARGIN = jax.jit(margin)


@pytest.mark.parametrize(
    ("q", "expected"),
    [
        (np.eye(4), 1.0),
        (np.ones((5, 5)), 1.0),
        (np.zeros((5, 5)), 0.0),
        (-np.ones((5, 5)), -5.0),
        (HORN, 0.0),
        (HORN - 1e-6 * np.eye(5), -1e-6),
        # lowest eigenspaces of dimension 2 and 3 that hold positive vectors
        (np.outer([1.0, -1, 0, 0, 0], [1, -1, 0, 0, 0]), 0.0),
        (3 * np.eye(5) - np.diag([1, 1, 1, 0, 0]), 2.0),
        (np.kron(np.eye(2), [[1.0, -3], [-3, 1]]), -2.0),
        # blocks of zeros
        (np.pad([[1.0, -1.0], [-1.0, 0.5]], (0, 3)), (0.75 - np.sqrt(1.0625))),
        (np.diag([1.0, 0.0, 0.0, 2.0, 1.0]), 0.0),
        (1e-20 * (HORN - 0.5 * np.eye(5)), -0.5e-20),
    ],
)
def test_margin_closed_forms(q, expected):
    value, x = MARGIN(jnp.asarray(q, float))
    close(value, expected, 1e-14 * max(1e-20, np.abs(q).max(), abs(expected)) * 10)
    assert (np.asarray(x) >= 0).all()
    close(np.linalg.norm(x), 1.0)
    close(x @ q @ x, value, 1e-14 * max(np.abs(q).max(), 1e-20))


def test_margin_of_two_by_two():
    q = np.random.default_rng(0).normal(size=(500, 2, 2))
    q = q + q.transpose(0, 2, 1)
    a, b, c = q[:, 0, 0], q[:, 0, 1], q[:, 1, 1]
    lowest = (a + c) / 2 - np.hypot(
        (a - c) / 2, b
    )  # its eigenvector is positive iff b < 0
    close(
        jax.vmap(margin)(jnp.asarray(q))[0],
        np.where(b < 0, lowest, np.minimum(a, c)),
        1e-13,
    )


def test_margin_is_below_every_sample():
    """It is attained (a feasible witness), and nothing sampled or descended to is lower."""
    generator = np.random.default_rng(1)
    x = np.abs(generator.normal(size=(4000, 5)))
    x *= generator.random(x.shape) < 0.7  # faces, too
    x = x[x.any(1)]
    for q in generator.normal(size=(20, 5, 5)):
        q = q + q.T
        y = x / np.linalg.norm(x, axis=1, keepdims=True)
        for _ in range(60):  # projected gradient descent
            y = np.maximum(y - 0.1 * y @ q, 0)
            y /= np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-12)
        best = np.einsum("ki,ij,kj->k", y, q, y)[np.linalg.norm(y, axis=1) > 0.5].min()
        value, witness = MARGIN(jnp.asarray(q))
        assert value <= best + 1e-12
        assert value >= best - 1e-3
        close(witness @ q @ witness, value)


def test_margin_derivatives():
    q = jnp.asarray(np.random.default_rng(3).normal(size=(5, 5)))
    slope = jax.jit(jax.grad(lambda a: margin(a)[0]))(q)
    x = MARGIN(q)[1]
    close(slope, np.outer(x, x))
    change = np.random.default_rng(4).normal(size=(5, 5))
    h = 1e-6
    difference = (MARGIN(q + h * change)[0] - MARGIN(q - h * change)[0]) / (2 * h)
    close(np.sum(slope * change), difference, 1e-8)
    forward = jax.jit(lambda a, b: jax.jvp(lambda c: margin(c)[0], (a,), (b,))[1])
    close(forward(q, jnp.asarray(change)), np.sum(slope * change))
    value, x = margin(jnp.eye(2, dtype=jnp.float32))
    assert value.dtype == x.dtype == jnp.float32
