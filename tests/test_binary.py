"""Binary collisions: closed forms, a plain reference in numpy, endless sequences, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.laws.binary import Binary

OK, ORDER, PLASTIC, STOPPED = (
    next(i for i, row in enumerate(ji.STATUS) if row.name == name)
    for name in ("ok", "order_dependent", "plastic_limit", "max_steps")
)
START = jnp.array([1.0, 0.0, 0.0])


LANES = 4000


@jax.jit
@jax.vmap
def _three_balls(masses, e, v):
    law, scene = Binary(e), ji.chain(masses)
    return ji.impact(law, scene, v), law.collisions(scene, v)


def three_balls(masses, e, v):
    """Outcomes and numbers of collisions of a batch, always compiled for the same shape."""
    count = len(masses)
    e = np.broadcast_to(np.reshape(e, (count, -1)), (count, 2))
    padded = [np.resize(np.asarray(x, float), (LANES, np.shape(x)[1])) for x in (masses, e, v)]
    return jax.tree.map(lambda x: np.asarray(x)[:count], _three_balls(*padded))


# masses, e, number of collisions (-1: endless), v+ for v- = (1, 0, 0)
TABLE = [
    ((1, 1, 1), 1.0, 2, (0, 0, 1)),
    ((1, 1, 1), 0.9, 3, (0.047625, 0.049875, 0.9025)),
    ((1, 1, 1), 0.5, 3, (0.203125, 0.234375, 0.5625)),
    ((1, 1, 1), 0.2, 3, (0.304, 0.336, 0.36)),
    ((1, 1, 1), 0.08, 10, (0.333331857173357, 0.333333890488082, 0.333334252338561)),
    ((1, 1, 1), 0.07, -1, (1 / 3, 1 / 3, 1 / 3)),
    ((1, 1, 1), 0.0, -1, (1 / 3, 1 / 3, 1 / 3)),
    ((3, 2, 5), 0.0, -1, (0.3, 0.3, 0.3)),
    ((1, 4, 1), 1.0, 2, (-0.6, 0.24, 0.64)),
    ((4, 1, 4), 1.0, 4, (-0.024, 0.1024, 0.9984)),
    ((10, 1, 10), 1.0, 7, (-0.0248383410809091, 0.295127496956844, 0.995325591385225)),
    ((1, 2, 3), 0.8, 2, (-0.2, -0.048, 0.432)),
    ((2, 1, 2), 0.4, 4, (0.313481481481481, 0.43998024691358, 0.466528395061728)),
]


def test_number_of_collisions_and_outcomes():
    masses, e, count, expected = (np.array(column, float) for column in zip(*TABLE))
    v = np.tile(START, (len(TABLE), 1))
    out, found = three_balls(masses, e, v)
    np.testing.assert_array_equal(found, count)
    np.testing.assert_allclose(out.velocity, expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(out.status, np.where(count < 0, PLASTIC, OK))
    gamma = np.diff(np.asarray(out.velocity), axis=1)[count < 0]
    np.testing.assert_allclose(gamma, 0.0, atol=1e-15)


def test_number_of_collisions_is_that_of_the_chebyshev_solution():
    rng = np.random.default_rng(0)
    masses, e = 10.0 ** rng.uniform(-1, 1, (LANES, 3)), rng.uniform(0.02, 1, LANES)
    c = np.sqrt(
        1 / (1 + masses[:, 1] / masses[:, 0]) / (1 + masses[:, 1] / masses[:, 2])
    )  # cosine of the kinetic angle
    z = (1 + e) / (2 * np.sqrt(e)) * c
    ratio = np.pi / np.arccos(np.minimum(z, 1 - 1e-9))
    clear = np.abs(ratio - np.round(ratio)) > 1e-6
    above_rounding = e ** (ratio / 2) > 1e-10
    expected = np.where(z >= 1, -1, np.ceil(ratio) - 1)
    use = (clear & above_rounding) | (z >= 1)
    assert use.sum() > 3500
    assert ((z >= 1) & use).sum() > 100
    assert len(np.unique(expected[use])) > 6
    out, count = three_balls(masses, e, np.tile(START, (LANES, 1)))
    np.testing.assert_array_equal(count[use], expected[use])
    np.testing.assert_array_equal(out.status[use], np.where(expected[use] < 0, PLASTIC, OK))


def closing_speeds(law, scene, v):
    """Closing speed before every collision."""
    speeds = []
    for contact, _, after in law.sequence(scene, v):
        speeds.append(-float(ji.gap_velocity(scene, v)[contact]))
        v = after
    return speeds, float(ji.gap_velocity(scene, v).min())


def test_closing_speeds():
    speeds, least = closing_speeds(Binary(0.9), ji.chain([3.0, 2.0, 1.0]), np.array(START))
    np.testing.assert_allclose(speeds, [1, 1.14], atol=1e-14)
    assert least == pytest.approx(0.178, abs=1e-14)  # w_3 = -0.178: it separates


def test_ball_and_ground_in_both_orders():
    """Ball 1 on top, +x up in the formulas: -v for `chain`."""
    m1, m2, e1, e2, v1, v2 = 2.0, 5.0, 0.8, 0.7, -1.0, -0.5
    scene, mu = ji.chain([m1, m2], wall=True), m1 / m2
    first = (
        (mu - e1) / (1 + mu) * v1 - e2 * (1 + e1) / (1 + mu) * v2,
        mu * (1 + e1) / (1 + mu) * v1 - e2 * (1 - e1 * mu) / (1 + mu) * v2,
    )
    out = ji.impact(Binary([e1, e2], (1, 0), max_collisions=2), scene, [-v1, -v2])
    np.testing.assert_allclose(-out.velocity, [103 / 140, -241 / 700], rtol=0, atol=1e-14)
    np.testing.assert_allclose(-out.velocity, first, rtol=0, atol=1e-14)
    assert int(out.status) == STOPPED
    law = Binary([e1, e2], (0, 1))
    out = ji.impact(law, scene, [-v1, -v2])
    np.testing.assert_allclose(-out.velocity, [3839 / 4900, 1807 / 24500], rtol=0, atol=1e-14)
    assert int(out.status) == OK
    assert int(law.collisions(scene, [-v1, -v2])) == 3


def pair_of_collisions(masses, e1, e2):
    """(6.13) corrected."""
    m21, m32 = masses[1] / masses[0], masses[2] / masses[1]
    both = (1 + m21) * (1 + m32)
    return jnp.stack(
        [
            (1 - m21 * e1) / (1 + m21),
            (1 - m32 * e2) * (1 + e1) / both,
            (1 + e1) * (1 + e2) / both,
        ]
    )


def two_collisions(masses, e1, e2):
    law = Binary(jnp.stack([e1, e2]), max_collisions=2)
    return ji.impact(law, ji.chain(masses), START).velocity


def test_two_collisions_and_their_derivatives():
    at = (jnp.array([1.0, 2.0, 3.0]), 0.9, 0.8)
    np.testing.assert_allclose(two_collisions(*at), [-4 / 15, -19 / 375, 57 / 125], atol=1e-14)
    expected = jax.jacfwd(pair_of_collisions, argnums=(0, 1, 2))(*at)
    for mode in (jax.jacfwd, jax.jacrev):
        got = jax.jit(mode(two_collisions, argnums=(0, 1, 2)))(*at)
        for a, b in zip(got, expected):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)
    # equal plastic balls: what is left after two of endless collisions
    steps = Binary(0.0).sequence(ji.chain(jnp.ones(3)), START, limit=2)
    np.testing.assert_allclose(steps[-1][2], [0.5, 0.25, 0.25], atol=1e-15)


@pytest.mark.parametrize(
    ("gaps", "expected", "code"),
    [
        ((1.0, 2.0), (-3 / 5, -4 / 25, 31 / 25), OK),
        ((2.0, 1.0), (-31 / 25, 4 / 25, 3 / 5), OK),
        ((1.0, 1.0), (-3 / 5, -4 / 25, 31 / 25), ORDER),
        (None, (-3 / 5, -4 / 25, 31 / 25), ORDER),
    ],
)
def test_the_order_of_two_approaching_contacts(gaps, expected, code):
    scene, v = ji.chain([0.25, 1.0, 0.25], gaps=gaps), jnp.array([1.0, 0.0, -1.0])
    out = ji.impact(Binary(1.0, "earliest"), scene, v)
    np.testing.assert_allclose(out.velocity, expected, atol=1e-14)
    assert int(out.status) == code
    blind = ji.impact(Binary(1.0), scene, v)  # gaps do not matter to the others
    np.testing.assert_allclose(blind.velocity, (-3 / 5, -4 / 25, 31 / 25), atol=1e-14)
    assert int(blind.status) == ORDER


def test_ties():
    # times are equal, speeds are not: the fastest goes first, and it is said
    out = ji.impact(
        Binary(1.0, "earliest"), ji.chain(jnp.ones(3), gaps=[0.1, 0.2]), jnp.array([1.0, 0.0, -2.0])
    )
    assert int(out.status) == ORDER
    np.testing.assert_allclose(out.velocity, [-2, 0, 1], atol=1e-14)
    # equally fast contacts that share no body commute: no order dependence
    apart = ji.impact(Binary(0.9), ji.chain(jnp.ones(4)), jnp.array([1.0, 0.0, 0.0, -1.0]))
    assert int(apart.status) == OK
    # within rounding only: 0.1 + 0.2 > 0.3, the lower index goes first all the same
    close, v = ji.chain([0.25, 1.0, 0.25]), np.array([0.3, 0.0, -(0.1 + 0.2)])
    assert v[2] < -0.3
    out = ji.impact(Binary(1.0), close, v)
    assert int(out.status) == ORDER
    np.testing.assert_allclose(out.velocity / 0.3, (-3 / 5, -4 / 25, 31 / 25), atol=1e-14)
    clear = ji.impact(Binary(1.0), close, np.array([0.3, 0.0, -0.3 * (1 + 1e-9)]))
    assert int(clear.status) == OK
    np.testing.assert_allclose(clear.velocity / 0.3, (-31 / 25, 4 / 25, 3 / 5), atol=1e-8)


def plain(scene, v, e, order, limit=10_000):
    """The law in a few lines of numpy, without tolerances; contacts in the order they collide."""
    n_mat, m = np.asarray(scene.normals), scene.contacts
    mass = np.asarray(scene.mass)
    inverse = np.diag(1 / mass) if mass.ndim == 1 else np.linalg.inv(mass)
    delassus = n_mat.T @ inverse @ n_mat
    v, place, done = np.array(v), 0, []
    gaps = np.zeros(m) if scene.gaps is None else np.array(scene.gaps)
    while len(done) < limit:
        gamma = n_mat.T @ v
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
        v = v + inverse @ n_mat[:, j] * (-(1 + e[j]) * gamma[j] / delassus[j, j])
        done.append(j)
    return v, done


ORDERS = ["fastest", "earliest", "left_to_right", (2, 0, 3, 0, 1)]


def random_problem(rng, dense):
    """Five velocities and four contacts, with gaps."""
    e, v = rng.uniform(0.3, 1, 4), rng.normal(size=5)
    masses, gaps = 10.0 ** rng.uniform(-0.5, 0.5, 5), rng.uniform(0, 1, 4)
    if not dense:
        return e, v, masses, np.asarray(ji.chain(masses).normals), gaps
    root = rng.normal(size=(5, 5))
    return e, v, np.diag(masses) + 0.3 * root @ root.T, rng.normal(size=(5, 4)), gaps


@pytest.mark.parametrize("dense", [False, True], ids=["chain", "dense"])
@pytest.mark.parametrize("order", ORDERS, ids=str)
def test_against_the_plain_reference(order, dense):
    rng = np.random.default_rng(7)
    problems = [random_problem(rng, dense) for _ in range(60)]
    e, v, mass, normals, gaps = (np.stack(column) for column in zip(*problems))

    @jax.jit
    @jax.vmap
    def run(e, v, mass, normals, gaps):
        scene = ji.Scene(mass, normals, gaps=gaps) if dense else ji.chain(mass, gaps=gaps)
        law = Binary(e, order)
        return ji.impact(law, scene, v), law.collisions(scene, v)

    out, count = run(e, v, mass, normals, gaps)
    lengths = set()
    for k in range(60):
        scene = ji.Scene(mass[k], normals[k], gaps=gaps[k])
        expected, done = plain(scene, v[k], e[k], order)
        np.testing.assert_allclose(out.velocity[k], expected, rtol=0, atol=1e-11)
        assert int(count[k]) == len(done)
        assert int(out.status[k]) == OK
        lengths.add(len(done))
    assert len(lengths) > 4  # lanes of a batch end on their own


def test_sequence():
    rng = np.random.default_rng(1)
    e, v, mass, _, gaps = random_problem(rng, False)
    scene = ji.chain(mass, gaps=gaps)
    steps = Binary(e, "earliest").sequence(scene, v)
    expected, done = plain(scene, v, e, "earliest")
    assert [step[0] for step in steps] == done
    assert len(done) > 2
    times = [step[1] for step in steps]
    assert times == sorted(times)
    assert times[0] > 0
    np.testing.assert_allclose(steps[-1][2], expected, atol=1e-13)
    assert len(Binary(e).sequence(scene, v, limit=1)) == 1
    assert Binary(e).sequence(scene, np.arange(5.0)) == []


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
    masses, e = 10.0 ** rng.uniform(-1, 1, (3000, 3)), rng.uniform(0, 0.3, (3000, 2))
    e[:200, 0], e[100:300, 1] = 0.0, 0.0
    v = np.stack([np.ones(3000), np.zeros(3000), rng.uniform(-0.2, 2, 3000)], axis=1)
    out, count = three_balls(masses, e, v)
    c = np.sqrt(1 / (1 + masses[:, 1] / masses[:, 0]) / (1 + masses[:, 1] / masses[:, 2]))
    z = c * np.sqrt((1 + e).prod(axis=1)) / np.maximum(np.sqrt(e).sum(axis=1), 1e-300)
    root = np.sqrt([1 / masses[:, 0] + 1 / masses[:, 1], 1 / masses[:, 1] + 1 / masses[:, 2]]).T
    gamma = np.diff(v, axis=1)
    # the first to collide is the fastest in m/s; with one approaching contact it is that one
    one = (gamma < 0).sum(axis=1) == 1
    expected = [endless_by_recursion(*row) for row in zip(c, e, gamma / root)]
    use = one & (np.abs(z - 1) > 1e-4)
    np.testing.assert_array_equal(np.asarray(count < 0)[use], np.array(expected)[use])
    assert set(np.unique(out.status[use])) == {OK, PLASTIC}
    inside, outside = use & (count < 0), use & (z > 1) & (count >= 0)
    assert inside.sum() > 200
    assert outside.sum() > 100  # z >= 1 is not enough
    assert (z[inside] > 1).all()
    common = (masses * v).sum(axis=1) / masses.sum(axis=1)
    np.testing.assert_allclose(out.velocity[inside], np.tile(common[inside, None], 3), atol=1e-13)


def test_velocity_is_continuous_over_the_edge_of_the_cone():
    e, n = 0.05, 41
    v3 = np.linspace(0.2, 0.6, n)
    v = np.stack([np.ones(n), np.zeros(n), v3], axis=1)
    args = jnp.ones((n, 3)), jnp.full(n, e)
    _, count = three_balls(*args, v)
    edge = int(np.argmax(np.asarray(count) >= 0))
    assert 0 < edge < n
    low, high = v3[edge - 1], v3[edge]
    for _ in range(40):
        middle = 0.5 * (low + high)
        _, count = three_balls(*args, np.tile([1.0, 0.0, middle], (n, 1)))
        low, high = (middle, high) if int(count[0]) < 0 else (low, middle)
    out, count = three_balls(*args, np.tile([[1.0, 0, low], [1.0, 0, high]], (21, 1))[:n])
    assert int(count[0]) == -1
    assert int(count[1]) > 3
    np.testing.assert_allclose(out.velocity[0], out.velocity[1], atol=1e-10)


def test_many_contacts_without_end():
    masses, v = jnp.array([1.0, 2.0, 0.5, 1.0, 3.0]), jnp.array([1.0, 0.3, 0.0, 0.1, -0.2])

    @jax.jit
    def end(e, v):
        law, scene = Binary(e), ji.chain(masses)
        out = ji.impact(law, scene, v)
        return out.velocity, (out.status, law.collisions(scene, v))

    for e in (0.0, 0.05):
        velocity, (status, count) = end(e, v)
        assert int(status) == PLASTIC
        assert int(count) == -1
        np.testing.assert_allclose(velocity, float(jnp.sum(masses * v) / masses.sum()), atol=1e-12)
    slope, _ = jax.jacfwd(end, argnums=(0, 1), has_aux=True)(0.05, v)
    np.testing.assert_allclose(slope[0], 0.0, atol=1e-10)
    np.testing.assert_allclose(slope[1], np.tile(masses / masses.sum(), (5, 1)), atol=1e-10)
    assert int(end(0.9, v)[1][0]) == OK


def test_redundant_contacts():
    """A ball between two walls: the series of impulses, though W is singular."""
    between = ji.chain([2.0], wall="both")
    for e in ([0.5, 0.8], [0.9, 0.9], [1.0, 0.99]):
        out = ji.impact(Binary(e), between, [1.0])
        assert int(out.status) == PLASTIC
        assert float(out.velocity[0]) == pytest.approx(0.0, abs=1e-12)
        assert float(out.impulse[1]) == pytest.approx(2 * (1 + e[1]) / (1 - e[0] * e[1]))
    assert int(ji.impact(Binary(1.0, max_collisions=50), between, [1.0]).status) == STOPPED
    assert int(ji.impact(Binary([0.3, 0.0]), between, [1.0]).status) == OK  # stays at the wall
    twice = ji.Scene([1.0, 1.0], [[-1.0, -1.0], [1.0, 1.0]])
    out = ji.impact(Binary(0.5), twice, [1.0, 0.0])
    np.testing.assert_allclose(out.velocity, [0.25, 0.75], atol=1e-15)
    assert int(out.status) == ORDER


def test_open_contacts_collide_but_for_the_order_earliest():
    scene, v = ji.chain(jnp.ones(3), gaps=jnp.array([0.0, 1e-3])), jnp.array([1.0, 0.0, 0.0])
    for order in ORDERS[:3]:
        out = ji.impact(Binary(1.0, order), scene, v)
        np.testing.assert_allclose(out.velocity, [0, 0, 1], atol=1e-15)
        np.testing.assert_allclose(out.impulse, [1, 1], atol=1e-15)
    assert Binary(1.0, "earliest").sequence(scene, v)[1][1] == pytest.approx(1e-3)


def test_derivatives_against_the_plain_reference():
    rng = np.random.default_rng(11)
    e, v, masses, _, _ = random_problem(rng, False)
    v = -np.sort(v)

    def f(masses, e, v):
        return ji.impact(Binary(e), ji.chain(masses), v).velocity

    forward = jax.jit(jax.jacfwd(f, argnums=(0, 1, 2)))(masses, e, v)
    reverse = jax.jit(jax.jacrev(f, argnums=(0, 1, 2)))(masses, e, v)
    args, h = [masses, e, v], 1e-6
    for i, (a, b) in enumerate(zip(forward, reverse)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)
        for k in range(len(args[i])):
            ends = []
            for sign in (-1, 1):
                moved = [x.copy() for x in args]
                moved[i][k] += sign * h
                ends.append(plain(ji.chain(moved[0]), moved[2], moved[1], "fastest"))
            assert ends[0][1] == ends[1][1]
            assert len(ends[0][1]) > 3
            np.testing.assert_allclose(a[:, k], (ends[1][0] - ends[0][0]) / (2 * h), atol=1e-8)


def test_kink_where_a_collision_appears():
    """Elastic (1, m, 1): z = 1/2 at m = 1, where the third collision of m < 1 vanishes."""

    @jax.jit
    def f(m):
        scene = ji.chain(jnp.stack([jnp.ones_like(m), m, jnp.ones_like(m)]))
        return ji.impact(Binary(1.0), scene, START).velocity, Binary(1.0).collisions(scene, START)

    slopes = {}
    for side in (-1, 1):
        near, far = 1 + side * 1e-7, 1 + side * 2e-7
        assert int(f(near)[1]) == (3 if side < 0 else 2)
        np.testing.assert_allclose(f(near)[0], f(1.0)[0], atol=1e-6)
        slope = (f(far)[0] - f(near)[0]) / (far - near)
        slopes[side], _ = jax.jacfwd(f, has_aux=True)(near)
        np.testing.assert_allclose(slopes[side], slope, atol=1e-6)
    assert np.abs(slopes[1] - slopes[-1]).max() > 0.1


def extreme(dtype, count=500):
    rng = np.random.default_rng(2)
    masses, v = 10.0 ** rng.uniform(-6, 6, (count, 4)), rng.normal(size=(count, 4))
    e = rng.choice([0.0, 0.3, 0.9, 1.0], (count, 3))
    v = v * 10.0 ** rng.uniform(-6, 6, (count, 1))
    args = [jnp.asarray(x, dtype) for x in (masses, e, v)]
    run = jax.jit(
        jax.vmap(
            lambda masses, e, v: (
                out := ji.impact(Binary(e), ji.chain(masses), v),
                ji.audit(ji.chain(masses), v, out),
                ji.kinetic_energy(ji.chain(masses), v),
            )
        )
    )
    out, found, energy = run(*args)
    assert out.velocity.dtype == dtype
    fine = np.array([not row.failure for row in ji.STATUS])[np.asarray(out.status)]
    assert np.isfinite(np.asarray(out.velocity)[fine]).all()
    assert np.asarray(found.kinematic)[fine].all()
    assert np.asarray(found.kinetic)[fine].all()
    gain = np.asarray(out.energy_change) / np.asarray(energy)
    assert gain[fine].max() < (1e-9 if dtype == jnp.float64 else 1e-5)
    return fine.mean()


def test_extreme_masses_and_speeds_are_right_or_flagged():
    # a light ball between heavy ones collides more often than `max_collisions` allows
    assert extreme(jnp.float64) > 0.75
    assert extreme(jnp.float32) > 0.75


def test_scaling_is_exact():
    masses, v, e = np.array([4.0, 1.0, 4.0]), np.array([1.0, 0.2, -0.7]), np.full(1, 0.9)
    scales = np.array([(1.0, 1.0), (2.0**40, 1.0), (1.0, 2.0**-40)])
    out, count = three_balls(masses * scales[:, :1], np.tile(e, (3, 1))[:, 0], v * scales[:, 1:])
    for k in (1, 2):
        np.testing.assert_allclose(out.velocity[k] / scales[k, 1], out.velocity[0], rtol=1e-14)
        assert int(count[k]) == int(count[0]) > 2


def test_a_chain_is_never_made_dense():
    masses = jnp.ones(137)
    for order in ORDERS[:3]:
        trace = jax.make_jaxpr(lambda v: ji.impact(Binary(0.9, order), ji.chain(masses), v))(masses)  # noqa: B023
        assert "136]" in str(trace)
        assert "136,136" not in str(trace)


def test_bad_input():
    for e in (-0.1, 1.1, np.nan):
        with pytest.raises(ValueError, match="restitution"):
            Binary(e)
    for order in ("slowest", (), (0, -1), (0, 1.0), (0, True), 3, None):
        with pytest.raises(ValueError, match="order"):
            Binary(0.5, order)
    for limit in (0, -3, 2.5, True):
        with pytest.raises(ValueError, match="max_collisions"):
            Binary(0.5, max_collisions=limit)
    balls, v = ji.chain(jnp.ones(3)), [1.0, 0.0, 0.0]
    for order, words in [
        ((0, 1, 2), "0 to 1"),
        ((0,), "contact 1 is missing"),
        ((0, 0, 1), "twice in a row"),
        ((0, 1, 0), "twice in a row"),
    ]:
        for call in (ji.impact, Binary.collisions, Binary.sequence):
            with pytest.raises(ValueError, match=words):
                call(Binary(0.5, order), balls, v)
    assert Binary(0.5, [0, np.int64(1)]).order == (0, 1)
    with pytest.raises(ValueError, match="restitution"):
        Binary([0.5, 0.5, 0.5]).collisions(balls, v)
    with pytest.raises(ValueError, match="velocity"):
        Binary(0.5).collisions(balls, [1.0, 0.0])
    one = ji.impact(Binary(0.5, (0,)), ji.chain(jnp.ones(2)), [1.0, 0.0])
    np.testing.assert_allclose(one.velocity, [0.25, 0.75])


def test_not_finite_is_flagged():
    out, _ = three_balls(jnp.ones((1, 3)), jnp.full(1, jnp.nan), START[None, :])
    assert ji.STATUS[int(out.status[0])].name == "not_finite"
