"""Moreau's and Poisson's complementarity problems against every support, scipy and closed forms.

The core is seen through the laws: `0 <= W p + (1 + e) gamma- _|_ p >= 0` is Moreau's impulse.
"""

import jax
import jax.numpy as jnp
import numpy as np
import programs
import pytest
from programs import State, names
from scipy.optimize import linprog, nnls

import jimpact as ji


def enumerate_supports(a, q):
    """Oracle: try every support."""
    m, root = len(q), np.sqrt(np.diag(a))
    size = np.abs(q / root).max()
    a, q = a / np.outer(root, root), q / root / size
    for mask in range(2**m):
        on = [i for i in range(m) if mask >> i & 1]
        z = np.zeros(m)
        if on:
            z[on] = np.linalg.lstsq(a[np.ix_(on, on)], -q[on], rcond=1e-15)[0]
        w = a @ z + q
        tolerance = max(1e-9, 8e-16 * np.abs(z).max())  # what rounding of z leaves in w
        if min(z.min(), w.min()) >= -tolerance and np.abs(w[on]).sum() <= tolerance:
            return z / root * size, w * root * size
    return None


def problem(state):
    """W and gamma- of a state."""
    n = np.asarray(state.normals, float)
    return n.T @ np.linalg.solve(np.asarray(state.mass, float), n), n.T @ state.velocity


def spread(count, coordinates, seed):
    """Masses over six decades: entries of W over twelve."""
    rng = np.random.default_rng(seed)
    return [
        State(
            np.diag(10.0 ** rng.uniform(-3, 3, coordinates)),
            rng.normal(size=(coordinates, 3)),
            rng.normal(size=coordinates),
            e=rng.uniform(size=3),
        )
        for _ in range(count)
    ]


@pytest.mark.slow
def test_moreau_and_poisson_against_every_support():
    states = spread(100, 4, seed=5)
    states = [s for s in states if (problem(s)[1] < 0).any()]
    (moreau, _), (poisson, _) = (
        programs.values(name)(states) for name in ("moreau", "poisson")
    )
    for i, state in enumerate(states):
        w, gamma = problem(state)
        root = np.sqrt(np.diag(w))
        size = 1e-8 * np.abs(gamma / root).max()
        p, _ = enumerate_supports(w, (1 + state.e) * gamma)
        got = moreau.impulse[i]
        np.testing.assert_allclose((w @ got) / root, (w @ p) / root, atol=size)
        p_c, gamma_c = enumerate_supports(w, gamma)
        p = (
            p_c * (1 + state.e)
            + enumerate_supports(w, gamma_c + w @ (state.e * p_c))[0]
        )
        np.testing.assert_allclose(
            (w @ poisson.impulse[i]) / root, (w @ p) / root, atol=size
        )


def test_plastic_moreau_is_nonnegative_least_squares():
    rng = np.random.default_rng(1)
    states = [
        State(np.eye(4), rng.normal(size=(4, 3)), rng.normal(size=4), e=0)
        for _ in range(30)
    ]
    out, _ = programs.values("moreau")(states)
    for state, p in zip(states, out.impulse):
        if (state.normals.T @ state.velocity < 0).any():
            np.testing.assert_allclose(
                p, nnls(state.normals, -state.velocity)[0], atol=1e-11
            )


def integer_states(count, seed=2):
    """Two coordinates, three contacts, small integers: ties, redundant and contradictory ones."""
    rng = np.random.default_rng(seed)
    states = []
    while len(states) < count:
        n, v = rng.integers(-2, 3, size=(2, 3)), rng.integers(-2, 3, size=2)
        if not np.abs(n).sum(axis=0).all() or (n.T @ v >= 0).all():
            continue
        e = rng.integers(0, 3, size=3) / 2
        states.append(State(np.eye(2), n.astype(float), v.astype(float), e=e))
    return states


def test_singular_and_degenerate_problems():
    """Feasible exactly where a linear programme is; then complementary to rounding."""
    states = integer_states(320)
    out, _ = programs.values("moreau")(states)
    reported = np.array(names(out.status))
    seen = {"infeasible": 0, "impulse_not_unique": 0, "ok": 0}
    for i, state in enumerate(states):
        w, gamma = problem(state)
        q = (1 + state.e) * gamma
        feasible = linprog(np.zeros(3), A_ub=-w, b_ub=q, method="highs").status == 0
        assert feasible == (reported[i] != "infeasible"), (w, q, reported[i])
        if reported[i] in seen:
            seen[reported[i]] += 1
        if feasible:
            p = out.impulse[i]
            rate = w @ p + q
            assert p.min() >= 0
            assert rate.min() > -1e-11
            assert np.abs(p * rate).max() < 1e-11
            unique = (
                np.linalg.matrix_rank(w[np.ix_(p > 1e-9, p > 1e-9)]) == (p > 1e-9).sum()
            )
            assert unique or reported[i] != "ok"
    assert min(seen.values()) > 10, seen


@pytest.mark.slow
def test_least_norm_of_many():
    """A table on four legs: of all impulses those of least norm, whatever their order."""
    legs = np.array([[1.0, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1]])
    order = [2, 0, 3, 1]

    @jax.jit
    @jax.vmap
    def impulse(normals, v):
        scene = ji.Scene(jnp.eye(3), normals)
        outs = [
            ji.impact(law, scene, v)
            for law in (ji.Newton(0.5), ji.Moreau(0.5), ji.Poisson(0.5))
        ]
        return jnp.stack([out.impulse for out in outs]), jnp.stack(
            [out.status for out in outs]
        )

    v = np.array([[-1.0, 0, 0], [-1.0, -0.05, 0.0]])
    p, status = impulse(
        np.stack([legs, legs, legs[:, order]]), np.stack([v[0], v[1], v[1]])
    )
    np.testing.assert_allclose(p[0], 0.375, atol=1e-13)
    assert set(names(status)) == {"impulse_not_unique"}
    np.testing.assert_allclose(np.asarray(p[2]), np.asarray(p[1])[:, order], atol=1e-13)


@pytest.mark.release
def test_derivatives_of_every_order():
    """Two contacts, W = [[1, -a], [-a, 1]], the first struck: p = (1, a) / (1 - a^2)."""

    def second(a):
        w = jnp.stack([jnp.stack([1.0, -a]), jnp.stack([-a, 1.0])])
        scene = ji.Scene(jnp.linalg.inv(w), jnp.eye(2))
        return ji.impact(ji.Moreau(0.0), scene, jnp.array([-1.0, 0.0])).impulse[1]

    def all_of(a):
        forward, reverse = jax.jacfwd(second), jax.jacrev(second)
        return reverse(a), jax.jvp(reverse, (a,), (1.0,))[1], jax.grad(forward)(a)

    a = 0.5
    first, *again = jax.jit(all_of)(a)
    np.testing.assert_allclose(first, (1 + a**2) / (1 - a**2) ** 2, rtol=1e-12)
    np.testing.assert_allclose(again, 2 * a * (3 + a**2) / (1 - a**2) ** 3, rtol=1e-12)


def test_derivatives_at_a_kink_are_one_sided():
    """Contact 2 takes part while v3 < 1/2: p2 = max(0, (1 - 2 v3) / 3)."""

    def p2(v3):
        return ji.impact(
            ji.Moreau(0.0), ji.chain(jnp.ones(3)), jnp.stack([1.0, 0.0, v3])
        ).impulse[1]

    low, at, high = jax.jit(jax.vmap(jax.grad(p2)))(
        jnp.array([0.5 - 1e-9, 0.5, 0.5 + 1e-9])
    )
    assert float(low) == pytest.approx(-2 / 3)
    assert float(high) == 0.0
    assert min(abs(float(at) - side) for side in (-2 / 3, 0.0)) < 1e-12


def test_unequal_restitution_gains_energy_from_an_edge_on_and_says_so():
    masses, v = [4.8, 0.6, 4.25], [0.7, 2.4, -2.1]
    e2 = np.linspace(0, 1, 41)
    states = [programs.chain(masses, v, e=[x, x]) for x in e2]
    states += [programs.chain(masses, v, e=[0.05, x]) for x in e2]
    out, _ = programs.values("moreau")(states)
    assert out.energy_change[:41].max() < 1e-12
    gains = out.energy_change[41:] > 1e-6
    edge = int(np.argmax(gains))
    assert 2 < edge < 38
    assert (gains == (np.arange(41) >= edge)).all()
    assert programs.failed(out.status[41:])[gains].all()
