"""What is only faster gives the same: compared with the canonical program of the law.

Canonical is: a dense scene, an array of exponents, padded contacts, one of a batch. Faster are
numbers for exponents (1, 1.5, 2), tuples, chains, single impacts; the impulse
form is another formulation of first order.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import programs
import pytest
from programs import chain, failed

import jimpact as ji

V = [1.0, 0.4, 0.1, -0.6]
E, K = [0.9, 0.7, 0.8], [1.0, 2.5, 0.7]


def states(eta):
    """Four balls without a wall: generic, at rest, precompressed, light in the middle."""
    return [
        chain([1.0, 2.0, 1.5, 0.7], V, e=E, k=K, eta=eta),
        chain([1.0, 1.0, 1.0, 1.0], [1, 0, 0, 0], e=1.0, k=K, eta=eta),
        chain([2.0, 1.0, 1.0, 3.0], [0, 0, 0, 0], e=E, eta=eta, stored=[0.1, 0.0, 0.3]),
        chain([1.0, 1e-2, 1.0, 1.0], [1, 0, 0, -1], e=E, k=[1, 10, 1], eta=eta),
    ]


def faster(law):
    """Compiled for chains of four balls: (masses, v, e, k, stored) -> outcome."""

    @jax.jit
    @jax.vmap
    def run(masses, v, e, k, stored):
        return ji.impact(law(e, k, stored), ji.chain(masses), v)

    def of(states):
        rows = [
            (
                np.diag(s.mass),
                s.velocity,
                *(np.broadcast_to(x, 3) for x in (s.e, s.k, s.stored)),
            )
            for s in states
        ]
        return jax.tree.map(np.asarray, run(*(np.array(x, float) for x in zip(*rows))))

    return of


PATHS = {
    "linear": (1.0, lambda e, k, u: ji.LZB(e, k, 1.0, u)),
    "Hertz": (1.5, lambda e, k, u: ji.LZB(e, k, 1.5, u)),
    "quadratic": (2.0, lambda e, k, u: ji.LZB(e, k, 2.0, u)),
    "mixed": ([1.0, 1.5, 1.3], lambda e, k, u: ji.LZB(e, k, (1.0, 1.5, 1.3), u)),
}


@pytest.mark.release
@pytest.mark.parametrize(
    "path",
    [
        "linear",
        "Hertz",
        pytest.param("quadratic", marks=pytest.mark.slow),
        pytest.param("mixed", marks=pytest.mark.slow),
    ],
)
def test_exponents_and_chains(path):
    eta, law = PATHS[path]
    given = states(eta)
    out, (same, _) = faster(law)(given), programs.values("lzb")(given)
    assert not failed(out.status).any()
    np.testing.assert_allclose(out.velocity, same.velocity, atol=2e-7)
    np.testing.assert_allclose(out.impulse, same.impulse, atol=4e-7)
    np.testing.assert_allclose(out.energy_change, same.energy_change, atol=4e-7)
    np.testing.assert_array_equal(out.status, same.status)


@pytest.mark.release
def test_a_single_impact_is_one_of_a_batch():
    """Not batched, eager, filled up with open contacts; chains and their dense scenes."""
    given = [
        *states(1.5)[:2],
        chain([1.0, 3.0], [1.0, -0.5], wall="right", e=E[:2], k=K[:2]),
        chain([3.0, 1.0], [-1.0, -2.5], wall="left", e=E[:2], k=K[:2]),
        chain([1.0, 2.0, 0.5], [1.0, 0.2, 0.3], e=E[:2], k=K[:2], gaps=[0.0, 0.1]),
    ]
    walls = [False, False, "right", "left", False]
    (same, _) = programs.values("lzb")(given)
    for i, (s, wall) in enumerate(zip(given, walls)):
        n, m = s.size
        law = ji.LZB(*(jnp.broadcast_to(jnp.asarray(x, float), m) for x in (s.e, s.k)))
        gaps = np.broadcast_to(s.gaps, m)
        for scene in (
            ji.chain(np.diag(s.mass), wall, gaps=gaps),
            ji.Scene(s.mass, s.normals),
        ):
            if scene.gaps is None and gaps.any():
                continue  # open contacts of a dense scene are left out before
            out = ji.impact(law, scene, jnp.asarray(s.velocity, float))
            np.testing.assert_allclose(out.velocity, same.velocity[i, :n], atol=2e-7)
            np.testing.assert_allclose(out.impulse, same.impulse[i, :m], atol=4e-7)
            assert int(out.status) == same.status[i]


def test_numbers_of_contacts_share_one_program(caplog):
    law = ji.LZB(0.9)
    ji.impact(law, ji.chain([1.0, 1.0]), [1.0, 0.0])
    with jax.log_compiles():
        for balls in range(3, 10):
            out = ji.impact(law, ji.chain(np.ones(balls)), np.eye(balls)[0])
            assert out.velocity.shape == (balls,)
            assert out.impulse.shape == (balls - 1,)
    assert "impact" not in caplog.text


@pytest.mark.release
def test_directions_at_one_point():
    """Their steps are found once: as one direction alone, and in reverse."""
    given, way = jnp.array([0.9, 0.7, 1.0, 2.5]), jnp.array([0.3, -1.0, 0.5, 2.0])

    def after(x):
        return ji.impact(
            ji.LZB(x[:2], x[2:]), ji.chain(jnp.ones(3)), jnp.eye(3)[0]
        ).velocity

    @jax.jit
    def all_ways(x):
        return (
            jax.jacfwd(after)(x),
            jax.jacrev(after)(x),
            jax.jvp(after, (x,), (way,))[1],
        )

    forward, reverse, alone = all_ways(given)
    np.testing.assert_allclose(forward @ way, alone, atol=1e-12)
    np.testing.assert_allclose(reverse, forward, atol=1e-9)


@functools.cache
def long_chain(dense):
    normals = ji.chain(jnp.ones(12)).normals

    @jax.jit
    def run(masses, v):
        scene = ji.Scene(masses, normals) if dense else ji.chain(masses)
        return ji.impact(ji.LZB(0.9), scene, v)

    return run


@pytest.mark.release
def test_windows_of_long_chains():
    masses, v = np.linspace(1, 2, 12), np.eye(12)[0]
    out, same = long_chain(False)(masses, v), long_chain(True)(masses, v)
    np.testing.assert_allclose(out.velocity, same.velocity, atol=2e-7)
    assert int(out.status) == int(same.status) == 0


def test_a_chain_is_never_made_dense():
    trace = jax.make_jaxpr(
        lambda v: ji.impact(ji.LZB(0.9), ji.chain(jnp.ones(137)), v).velocity
    )
    text = str(trace(jnp.ones(137)))
    assert "136" in text
    assert "136,136" not in text


def test_values_and_derivatives_are_one_program():
    """In both modes: the Jacobian comes with the values; its product is no program."""
    v = jnp.array([1.0, 0.0, 0.0])

    def last(e):
        return ji.impact(ji.LZB(e), ji.chain(jnp.ones(3)), v).velocity[2]

    def programs(derivative):
        text = str(jax.make_jaxpr(derivative)(jnp.full(2, 0.9)))
        return text.count(":lanes[") + text.count("= lanes[")

    assert programs(jax.jacfwd(last)) == programs(jax.jacfwd(jax.jacfwd(last))) == 1
    assert programs(jax.grad(last)) == programs(jax.hessian(last)) == 1
