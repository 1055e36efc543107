"""Quasi-Lagrange equations and the contact problem: closed forms, differences, a motion."""

import jax.numpy as jnp
import numpy as np
import pytest
from refusals import argument

import jimpact as ji

WIDE, HIGH, MASS, G = 1.0, 0.6, 2.0, 10.0
INERTIA = MASS * (WIDE**2 + HIGH**2) / 12
BLOCK = ji.System(ji.Block(WIDE, HIGH, MASS, corners="base"), gravity=G)
Q, V = np.array([0.2, 0.5, 0.3]), np.array([0.4, -0.2, 1.7])


def test_contact_problem_of_a_block():
    """D and B as printed for the rocking block (g's sign: gravity lets gaps close)."""
    problem = ji.theory.contact_problem(BLOCK, Q, V)
    sin, cos = np.sin(Q[2]), np.cos(Q[2])
    arms = np.array([HIGH * sin + WIDE * cos, HIGH * sin - WIDE * cos]) / 2
    np.testing.assert_allclose(
        problem.delassus, 1 / MASS + np.outer(arms, arms) / INERTIA
    )
    turning = (
        V[2] ** 2 / 2 * np.array([HIGH * cos - WIDE * sin, HIGH * cos + WIDE * sin])
    )
    np.testing.assert_allclose(problem.free, -G + turning, rtol=1e-12)
    flat = ji.theory.contact_problem(BLOCK, [0.0, HIGH / 2, 0.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(flat.forces(), MASS * G / 2)
    alone = flat.forces([True, False])
    np.testing.assert_allclose(alone, [G / float(flat.delassus[0, 0]), 0.0])


def quasi(q, v):
    """(qn, qt) of the block: gap velocities over their norms; x alone is tangential."""
    sin, cos = np.sin(q[2]), np.cos(q[2])
    arms = np.array([HIGH * sin + WIDE * cos, HIGH * sin - WIDE * cos]) / 2
    return np.append(
        (v[1] + arms * v[2]) / np.sqrt(1 / MASS + arms**2 / INERTIA),
        np.sqrt(MASS) * v[0],
    )


@pytest.mark.parametrize("force", [(0.0, 0.0), (3.0, 7.0)])
def test_quasi_lagrange_equations_of_a_block(force):
    """d/dt (qn, qt) by differences along the motion with these contact forces."""
    terms = ji.theory.quasi_lagrange(BLOCK, Q, V)
    sin, cos = np.sin(Q[2]), np.cos(Q[2])
    arms = np.array([HIGH * sin + WIDE * cos, HIGH * sin - WIDE * cos]) / 2
    a = np.array([0.0, -G + sum(force) / MASS, arms @ force / INERTIA])
    step = 1e-5
    ends = [quasi(Q + s * V + s**2 / 2 * a, V + s * a) for s in (step, -step)]
    rate = (ends[0] - ends[1]) / (2 * step)
    normal, tangential = terms.rates(force)
    np.testing.assert_allclose(np.append(normal, tangential), rate, atol=1e-8)
    lambda_bar = terms.norm * np.array(force)
    np.testing.assert_allclose(
        terms.matrix @ lambda_bar - terms.normal, rate[:2], atol=1e-8
    )
    np.testing.assert_allclose(np.diag(terms.matrix), 1.0, atol=1e-14)


def test_force_of_a_bilateral_constraint():
    """A pendulum of length 2 beside a wall: `lambda = m (g y - v^2) / L^2 - lambda_u x / L^2`."""
    body = ji.System(
        lambda q: q[:1], [MASS, MASS], potential=ji.gravity([0.0, MASS], G)
    )
    angle, speed, push = 0.7, 1.3, 4.0
    q = 2.0 * np.array([np.sin(angle), -np.cos(angle)])
    v = speed * np.array([np.cos(angle), np.sin(angle)])
    terms = ji.theory.quasi_lagrange(
        body, q, v, constraints=lambda q: jnp.array([q @ q - 4.0]) / 2
    )
    assert terms.bilateral == 1
    free = MASS * (G * q[1] - speed**2) / 4
    np.testing.assert_allclose(terms.bilateral_forces(), [free], rtol=1e-12)
    pushed = terms.bilateral_forces([push])
    np.testing.assert_allclose(pushed, [free - push * q[0] / 4], rtol=1e-12)
    np.testing.assert_allclose(
        terms.rates([push])[0][0], 0.0, atol=1e-12
    )  # it stays closed


def test_what_is_refused():
    base = ji.System(
        ji.Block(1.0, 2.0),
        gravity=True,
        base=ji.HarmonicBase(0.1, 1.0, direction="vertical"),
    )
    with pytest.raises(ValueError, match=argument("system")):
        ji.theory.quasi_lagrange(base, [0.0, 1.0, 0.0], [0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="`velocity`"):
        ji.theory.contact_problem(BLOCK, Q, [0.0, np.nan, 0.0])


@pytest.mark.release
def test_accelerations_of_a_motion():
    """A tilted block slides down on one corner without friction: those of the sampled velocities."""
    start = BLOCK.body.touching(0.3)
    motion = ji.simulate(BLOCK, ji.Moreau(0.0), start, jnp.zeros(3), 0.05, samples=51)
    assert int(motion.status) == 0
    t, q, v = (np.asarray(x) for x in (motion.time, motion.q, motion.velocity))
    k = 25
    closed = np.abs(BLOCK.gap_function(jnp.asarray(q[k]))) < 1e-9
    assert closed.sum() == 1
    problem = ji.theory.contact_problem(BLOCK, q[k], v[k])
    force = problem.forces(closed)
    assert float(force.max()) > 1
    push = np.asarray(BLOCK.body.normals(jnp.asarray(q[k]))) @ np.asarray(force)
    a = np.array([0, -G, 0]) + push / [
        MASS, MASS, INERTIA,
    ]  # fmt: skip
    np.testing.assert_allclose(
        a, (v[k + 1] - v[k - 1]) / (t[k + 1] - t[k - 1]), atol=2e-3
    )
    gaps = (problem.delassus @ force + problem.free)[closed]
    np.testing.assert_allclose(gaps, 0.0, atol=1e-9)
