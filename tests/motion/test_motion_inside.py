"""Whole motions against closed forms: events, derivatives, batches, contact, ledger."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_cases import stack, status

import jimpact as ji
from jimpact.motion.dynamics import kinematics
from jimpact.motion.flow import status_at_start
from jimpact.motion.simulate import CHUNK
from jimpact.motion.tables import nan_derivatives
from jimpact.motion.transitions import impact_jump


def test_what_a_motion_does_not_reach_has_no_derivatives():
    """NaN in both modes, unless its cotangent is 0; whatever the sum of the tangents is."""
    known, inputs, move = (
        jnp.array([True, False]),
        jnp.array([1.0, 2.0]),
        jnp.array([1.0, -1.0]),
    )

    def reached(x, known=known):
        return jnp.sum(x**2) + nan_derivatives(x, known)[:, 0]

    np.testing.assert_array_equal(
        jax.jvp(reached, (inputs,), (move,))[1], [-2.0, jnp.nan]
    )
    pull = jax.vjp(reached, inputs)[1]
    np.testing.assert_array_equal(pull(jnp.array([1.0, 0.0]))[0], 2 * inputs)
    for cotangent in ([0.0, 1e-30], [1.0, -1.0]):
        assert np.isnan(pull(jnp.array(cotangent))[0]).all()
    both = jax.vjp(lambda x: nan_derivatives(x, jnp.array([False, False])), inputs)[1]
    assert np.isnan(both(move[:, None])[0]).all()
    modes = jax.jacfwd, jax.jacrev

    @jax.jit
    def all_hessians(x, known):
        return [second(first(reached))(x, known) for first in modes for second in modes]

    for hessians in all_hessians(inputs, known):
        np.testing.assert_array_equal(
            hessians[0], 2 * np.eye(2)
        )  # as if both were known
        assert np.isnan(hessians[1]).all()


@pytest.mark.slow  # compiles programs of its own
def test_runs_of_the_program_follow_each_other():
    dropped = 0.97, [0.1, 0.101, 0.102], [0.0] * 3, 5.0
    motion = stack(*dropped)
    count = int(motion.events.count)
    assert status(motion) == "ok"
    assert count > 2 * CHUNK
    assert motion.events.time.shape == (3 * CHUNK,)
    assert (np.diff(motion.events.time[:count]) >= 0).all()
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12)
    taken = np.nansum(motion.events.energy, axis=0)
    np.testing.assert_allclose(taken, motion.contact_work[-1], rtol=1e-12)
    ended = stack(*dropped, max_events=CHUNK + 100)
    assert status(ended) == "max_events"
    assert int(ended.events.count) == CHUNK + 100
    for row, all_rows in zip(*(jax.tree.leaves(m.events)[1:] for m in (ended, motion))):
        np.testing.assert_allclose(
            row, all_rows[: CHUNK + 100], rtol=1e-9
        )  # another program


@pytest.mark.slow  # compiles programs of its own
def test_a_motion_back_in_time_is_reported():
    ball, start = (
        ji.System(ji.Column([1.0]), gravity=True),
        SimpleNamespace(q=jnp.ones(1), v=jnp.ones(1), t=jnp.asarray(1.0)),
    )
    codes = [
        status_at_start(ball, start, jnp.asarray(end), 1e-9) for end in (2.0, 1.0, 0.0)
    ]
    assert [ji.STATUS[int(code)].name for code in codes] == [
        "ok",
        "backward",
        "backward",
    ]


A_BASE, W_BASE = 0.1, 2 * np.pi * 1.5  # of a plate at A sin(w t)


PLATE = ji.System(ji.Column([2.0]), gravity=True, base=ji.HarmonicBase(A_BASE, 1.5))


@pytest.mark.slow  # compiles programs of its own
def test_gaps_are_seen_from_the_base():
    """f = q - y_b, f' = v - y_b', and f'' = -y_b'' where q'' = 0."""
    t = 0.1
    gap, _ = kinematics(PLATE, jnp.array([0.5]), jnp.array([-1.0]), jnp.asarray(t))
    sine, cosine = A_BASE * np.sin(W_BASE * t), A_BASE * np.cos(W_BASE * t)
    np.testing.assert_allclose(gap.value, [0.5 - sine], rtol=1e-14)
    np.testing.assert_allclose(gap.rate, [-1.0 - W_BASE * cosine], rtol=1e-14)
    np.testing.assert_allclose(gap.drift, [W_BASE**2 * sine], rtol=1e-13)


@pytest.mark.slow  # compiles programs of its own
def test_the_base_works_at_its_own_speed():
    """p u with p = m (1 + e) (u - v): T+ - T- is that and what restitution takes."""
    u, v, e = A_BASE * W_BASE, -1.0, 0.5
    state = SimpleNamespace(q=jnp.zeros(1), v=jnp.array([v]))
    zero = jnp.zeros(())
    jump = impact_jump(PLATE, ji.Newton(e), zero, state, jnp.array([True]), zero, None)
    p = 2.0 * (1 + e) * (u - v)
    np.testing.assert_allclose(jump.v, [v + p / 2.0], rtol=1e-14)
    np.testing.assert_allclose(jump.base_work, p * u, rtol=1e-14)
    np.testing.assert_allclose(jump.energy[0], [-(1 - e**2) * (u - v) ** 2], rtol=1e-14)
    np.testing.assert_allclose(
        jump.base_work + jump.energy.sum(), jump.v[0] ** 2 - v**2, rtol=1e-13
    )
