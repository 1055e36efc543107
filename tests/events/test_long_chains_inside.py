"""Chains of so many bodies that a look ahead tells whether they come to rest together."""

import jax
import jax.numpy as jnp
import pytest

import jimpact as ji
from jimpact.core.contact import contact_of
from jimpact.events.impact_dynamics import flow_of
from jimpact.events.look_ahead import comes_to_rest

pytestmark = pytest.mark.release  # they compile programs of their own

ROW = 12  # balls in a row: more contacts than return as multiples of themselves


def test_a_look_ahead_concludes_nothing_without_a_margin():
    """Before the first impact one contact holds all that it has to carry: 12 balls at e = .5 end as
    a block, but this is not known yet. At rest, all but 1e-12 of the velocity, it is."""
    scene, m = ji.chain([1.0] * ROW), ROW - 1
    contact = contact_of(scene, jnp.zeros(ROW).at[0].set(1.0))
    dynamics = ji.LZB(0.5).dynamics(contact)
    problem = jax.tree.map(lambda x: x[..., None], dynamics.problem)
    flow, modes, y = flow_of(problem, dynamics.equations, 1.5, "chain")
    every = jnp.ones((m, 1), bool)
    none = jnp.zeros((m, 1), bool)
    asked = jnp.ones((1, 1), bool)
    # in the limit all balls move at 1 / ROW: contact j carries the momentum of those behind it
    behind = jnp.arange(ROW - 1.0, 0.0, -1.0)[:, None]
    impulse = (
        2 * behind / ROW
    )  # in units of Q / sqrt(W_jj), of the inverse mass of both balls
    look = jax.jit(comes_to_rest)
    assert not look(flow, modes, y, every, impulse, asked)
    rows = flow.rows(y)
    slow = flow.with_rows(y, rows._replace(g=1e-12 * rows.g))
    assert look(flow, modes, slow, every, 1e-12 * impulse, asked)
    assert not look(flow, modes, slow, none, 0 * impulse, asked)
