"""Binary collisions beyond held values: a plain reference, numbers of collisions, endless ones."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import names

import jimpact as ji

START = jnp.array([1.0, 0.0, 0.0])
ORDERS = ["fastest", "earliest", "left_to_right", (2, 0, 3, 0, 1)]
LANES = 2000


@functools.cache
def program():
    @jax.jit
    @jax.vmap
    def run(masses, e, v):
        law, scene = ji.Binary(e), ji.chain(masses)
        return ji.impact(law, scene, v), law.collisions(scene, v)

    return run


def three_balls(masses, e, v):
    """Outcomes and numbers of collisions of a batch, always compiled for the same shape."""
    count = len(masses)
    e = np.broadcast_to(np.reshape(e, (count, -1)), (count, 2))
    padded = [
        np.resize(np.asarray(x, float), (LANES, np.shape(x)[1])) for x in (masses, e, v)
    ]
    return jax.tree.map(lambda x: np.asarray(x)[:count], program()(*padded))


def test_number_of_collisions_is_that_of_the_chebyshev_solution():
    rng = np.random.default_rng(0)
    masses, e = 10.0 ** rng.uniform(-1, 1, (LANES, 3)), rng.uniform(0.02, 1, LANES)
    c = np.sqrt(
        1 / (1 + masses[:, 1] / masses[:, 0]) / (1 + masses[:, 1] / masses[:, 2])
    )
    z = (1 + e) / (2 * np.sqrt(e)) * c
    ratio = np.pi / np.arccos(np.minimum(z, 1 - 1e-9))
    clear = np.abs(ratio - np.round(ratio)) > 1e-6
    above_rounding = e ** (ratio / 2) > 1e-10
    expected = np.where(z >= 1, -1, np.ceil(ratio) - 1)
    use = (clear & above_rounding) | (z >= 1)
    assert use.mean() > 0.85
    assert ((z >= 1) & use).sum() > 50
    assert len(np.unique(expected[use])) > 6
    out, count = three_balls(masses, e, np.tile(START, (LANES, 1)))
    np.testing.assert_array_equal(count[use], expected[use])
    reported = np.where(expected[use] < 0, "plastic_limit", "ok")
    np.testing.assert_array_equal(names(out.status[use]), reported)


def plain(normals, mass, gaps, v, e, order, limit=10_000):
    """The law in a few lines of numpy, without tolerances; contacts in the order they collide."""
    m, inverse = normals.shape[1], np.linalg.inv(mass)
    delassus = normals.T @ inverse @ normals
    v, place, done, gaps = np.array(v), 0, [], np.array(gaps)
    while len(done) < limit:
        gamma = normals.T @ v
        ready = [j for j in range(m) if gamma[j] < -1e-13]
        if not ready:
            break
        if order == "fastest":
            j = min(ready, key=lambda j: gamma[j])
        elif order == "earliest":
            j = min(ready, key=lambda j: (round(gaps[j] / -gamma[j], 14), gamma[j]))
            gaps = np.maximum(gaps + gamma * gaps[j] / -gamma[j], 0.0)
            gaps[j] = 0.0
        else:
            cycle = range(m) if order == "left_to_right" else order
            while cycle[place % len(cycle)] not in ready:
                place += 1
            j = cycle[place % len(cycle)]
            place += 1
        v = v + inverse @ normals[:, j] * (-(1 + e[j]) * gamma[j] / delassus[j, j])
        done.append(j)
    return v, done


def random_problem(rng):
    """Five velocities and four contacts, with gaps: a chain or any system."""
    e, v = rng.uniform(0.3, 1, 4), rng.normal(size=5)
    masses, gaps = 10.0 ** rng.uniform(-0.5, 0.5, 5), rng.uniform(0, 1, 4)
    if rng.uniform() < 0.5:
        return e, v, np.diag(masses), np.asarray(ji.chain(masses).normals), gaps
    root = rng.normal(size=(5, 5))
    return e, v, np.diag(masses) + 0.3 * root @ root.T, rng.normal(size=(5, 4)), gaps


@pytest.mark.parametrize("order", ORDERS, ids=str)
def test_against_the_plain_reference(order):
    rng = np.random.default_rng(7)
    problems = [random_problem(rng) for _ in range(60)]
    e, v, mass, normals, gaps = (np.stack(column) for column in zip(*problems))

    @jax.jit
    @jax.vmap
    def run(e, v, mass, normals, gaps):
        scene, law = ji.Scene(mass, normals, gaps=gaps), ji.Binary(e, order)
        return ji.impact(law, scene, v), law.collisions(scene, v)

    out, count = run(e, v, mass, normals, gaps)
    lengths = set()
    for i in range(60):
        expected, done = plain(normals[i], mass[i], gaps[i], v[i], e[i], order)
        if int(count[i]) < 0:  # hundreds of collisions are finished at once
            assert len(done) > 100
            assert names(out.status[i]) == ["plastic_limit"]
            np.testing.assert_allclose(out.velocity[i], expected, rtol=0, atol=1e-7)
            continue
        np.testing.assert_allclose(out.velocity[i], expected, rtol=0, atol=1e-11)
        assert int(count[i]) == len(done)
        assert names(out.status[i]) == ["ok"]
        lengths.add(len(done))
    assert len(lengths) > 4  # lanes of a batch end on their own


def test_sequence():
    """Contacts in their order, with times and velocities; two collisions are (6.13), corrected."""
    rng = np.random.default_rng(1)
    masses, gaps, e = (
        10.0 ** rng.uniform(-0.5, 0.5, 5),
        rng.uniform(0, 1, 4),
        rng.uniform(0.3, 1, 4),
    )
    v = -np.sort(rng.normal(size=5))
    scene = ji.chain(masses, gaps=gaps)
    steps = ji.Binary(e, "earliest").sequence(scene, v)
    expected, done = plain(
        np.asarray(scene.normals), np.diag(masses), gaps, v, e, "earliest"
    )
    assert [step[0] for step in steps] == done
    assert len(done) > 2
    times = [step[1] for step in steps]
    assert times == sorted(times)
    np.testing.assert_allclose(steps[-1][2], expected, atol=1e-13)
    two = ji.Binary([0.9, 0.8]).sequence(ji.chain([1.0, 2.0, 3.0]), START, limit=2)
    np.testing.assert_allclose(two[-1][2], [-4 / 15, -19 / 375, 57 / 125], atol=1e-14)
    two = ji.Binary(0.0).sequence(ji.chain(jnp.ones(3)), START, limit=2)
    np.testing.assert_allclose(two[-1][2], [0.5, 0.25, 0.25], atol=1e-15)
    assert ji.Binary(e).sequence(scene, np.arange(5.0)) == []


@pytest.mark.slow
def test_ball_and_ground_in_both_orders():
    """(6.3) and (6.4); ball 1 on top, +x up in the formulas: -v for `chain`."""
    scene, v = ji.chain([2.0, 5.0], wall=True), [1.0, 0.5]
    out = ji.impact(ji.Binary([0.8, 0.7], (1, 0), max_collisions=2), scene, v)
    np.testing.assert_allclose(
        -out.velocity, [103 / 140, -241 / 700], rtol=0, atol=1e-14
    )
    assert names(out.status) == ["max_steps"]
    law = ji.Binary([0.8, 0.7], (0, 1))
    out = ji.impact(law, scene, v)
    np.testing.assert_allclose(
        -out.velocity, [3839 / 4900, 1807 / 24500], rtol=0, atol=1e-14
    )
    assert names(out.status) == ["ok"]
    assert int(law.collisions(scene, v)) == 3


def endless_by_recursion(c, e, qn):
    """Plain iteration of the ratio of successive closing speeds, which knows no scale."""
    j = int(np.argmin(qn))
    ratio = (c * (1 + e[j]) * -qn[j] - qn[1 - j]) / -qn[j]
    for _ in range(3000):
        if ratio <= 0:
            return False
        j = 1 - j
        ratio = c * (1 + e[j]) - e[1 - j] / ratio
    return True


def test_endless_collisions_are_recognized_inside_their_cone_only():
    rng = np.random.default_rng(5)
    masses, e = 10.0 ** rng.uniform(-1, 1, (LANES, 3)), rng.uniform(0, 0.3, (LANES, 2))
    e[:150, 0], e[80:220, 1] = 0.0, 0.0
    v = np.stack([np.ones(LANES), np.zeros(LANES), rng.uniform(-0.2, 2, LANES)], axis=1)
    out, count = three_balls(masses, e, v)
    c = np.sqrt(
        1 / (1 + masses[:, 1] / masses[:, 0]) / (1 + masses[:, 1] / masses[:, 2])
    )
    z = c * np.sqrt((1 + e).prod(axis=1)) / np.maximum(np.sqrt(e).sum(axis=1), 1e-300)
    root = np.sqrt(
        [1 / masses[:, 0] + 1 / masses[:, 1], 1 / masses[:, 1] + 1 / masses[:, 2]]
    ).T
    gamma = np.diff(v, axis=1)
    one = (gamma < 0).sum(axis=1) == 1
    expected = [endless_by_recursion(*row) for row in zip(c, e, gamma / root)]
    use = one & (np.abs(z - 1) > 1e-4)
    np.testing.assert_array_equal((count < 0)[use], np.array(expected)[use])
    inside, outside = use & (count < 0), use & (z > 1) & (count >= 0)
    assert inside.sum() > 120
    assert outside.sum() > 60  # z >= 1 is not enough
    common = (masses * v).sum(axis=1) / masses.sum(axis=1)
    np.testing.assert_allclose(
        out.velocity[inside], np.tile(common[inside, None], 3), atol=1e-13
    )


def test_kink_where_a_collision_appears():
    """Elastic (1, m, 1): z = 1/2 at m = 1, where the third collision of m < 1 vanishes."""

    @jax.jit
    @jax.vmap
    def f(m):
        def after(m):
            scene = ji.chain(jnp.stack([jnp.ones_like(m), m, jnp.ones_like(m)]))
            return ji.impact(ji.Binary(1.0), scene, START).velocity

        return after(m), jax.jacfwd(after)(m)

    h = 1e-7
    v, slope = f(np.array([1 - 2 * h, 1 - h, 1.0, 1 + h, 1 + 2 * h]))
    np.testing.assert_allclose(slope[1], (v[1] - v[0]) / h, atol=1e-6)
    np.testing.assert_allclose(slope[3], (v[4] - v[3]) / h, atol=1e-6)
    np.testing.assert_allclose(v[1], v[3], atol=1e-6)  # continuous
    assert np.abs(slope[3] - slope[1]).max() > 0.1


@pytest.mark.slow
def test_extreme_masses_and_speeds_are_right_or_flagged():
    """A light ball between heavy ones collides more often than `max_collisions` allows."""
    rng, count = np.random.default_rng(2), 500
    masses, v = 10.0 ** rng.uniform(-6, 6, (count, 4)), rng.normal(size=(count, 4))
    e = rng.choice([0.0, 0.3, 0.9, 1.0], (count, 3))
    v = v * 10.0 ** rng.uniform(-6, 6, (count, 1))

    @jax.jit
    @jax.vmap
    def run(masses, e, v):
        scene = ji.chain(masses)
        out = ji.impact(ji.Binary(e), scene, v)
        return out, ji.audit(out, scene, v), ji.kinetic_energy(scene, v)

    out, found, energy = jax.tree.map(np.asarray, run(masses, e, v))
    fine = np.array([not row.failure for row in ji.STATUS])[out.status]
    assert fine.mean() > 0.75
    assert np.isfinite(out.velocity[fine]).all()
    assert found.kinematic[fine].all()
    assert found.kinetic[fine].all()
    assert (out.energy_change / energy)[fine].max() < 1e-9


def test_a_chain_is_never_made_dense():
    masses = jnp.ones(137)
    for order in ORDERS[:3]:
        law = ji.Binary(0.9, order)
        trace = jax.make_jaxpr(lambda v, law=law: ji.impact(law, ji.chain(masses), v))(
            masses
        )
        assert "136]" in str(trace)
        assert "136,136" not in str(trace)


@pytest.mark.slow
def test_second_derivatives_in_every_pair_of_modes():
    """All are of one program: they agree to rounding of the largest entry."""

    def after(e):
        return ji.impact(
            ji.Binary(e), ji.chain([1.0, 2.0, 0.7]), [1.0, 0.0, -0.4]
        ).velocity[2]

    e, modes = jnp.array([0.9, 0.6]), (jax.jacfwd, jax.jacrev)
    found = [outer(inner(after))(e) for outer in modes for inner in modes]
    assert np.abs(found[0]).max() > 0.1
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-13)
