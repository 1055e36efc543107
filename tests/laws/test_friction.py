"""Coulomb friction in every law that has it: closed forms, the law itself on random scenes, slopes.

The scenes run as lanes of two programs, see friction_programs.py.
"""

import functools
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from friction_programs import LAWS, run
from friction_reference import blocks, regularized, routh, small_steps
from programs import CODE, OPTIMIZED, failed, names

import jimpact as ji

close = np.testing.assert_allclose

KINEMATIC = ("newton", "moreau", "matrix", "binary")


# ---------------------------------------------------------------------------- one contact

MASS, RADIUS, INERTIA = 2.0, 0.5, 0.2
DISC = (
    np.array([MASS, MASS, INERTIA]),
    np.array([[0.0], [1.0], [0.0]]),
    np.array([[1.0], [0.0], [RADIUS]]),
)  # (x, y, turn) of a disc on the ground


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(x, marks=[] if x == "moreau" else [pytest.mark.release])
        for x in LAWS
    ],
)
def test_disc_in_closed_form(name):
    """It sticks for `-(1 + e_t) v_t / W_tt`; friction gives at most mu p of that."""
    e_ts = (-0.3, 0.0, 1.0) if name in KINEMATIC or name == "poisson" else (0.0,)
    grid = np.array(
        list(itertools.product((0.0, 0.1, 0.4, 50.0), e_ts, (-2.0, 0.3), (0.0, 1.5)))
    )
    mu, e_t, x_rate, turn = grid.T
    e, y_rate, count = 0.6, -1.3, len(grid)
    v = np.stack([x_rate, np.full(count, y_rate), turn], axis=1)
    scenes = (np.tile(x, (count, *(1,) * np.ndim(x))) for x in DISC)
    out, _ = run(name, *scenes, v, np.full(count, e), mu, e_t)
    slip = x_rate + RADIUS * turn
    p = MASS * (1 + e) * 1.3
    w = 1 / MASS + RADIUS**2 / INERTIA
    side = np.clip(-(1 + e_t) * slip / w, -mu * p, mu * p)
    if name == "poisson":  # in compression it sticks at rest, in expansion at -e_t v_t-
        most = mu * MASS * 1.3
        first = np.clip(-slip / w, -most, most)
        side = first + np.clip(
            -(slip + w * first + e_t * slip) / w, -e * most, e * most
        )
    off = 1e-8 if name in ("lzb", "compliant") else 1e-13
    assert not out.status.any()
    close(out.impulse[:, 0], p, rtol=off)
    close(out.tangential_impulse[:, 0], side, atol=off)
    close(out.velocity[:, 0], x_rate + side / MASS, atol=off)
    close(out.velocity[:, 2], turn + RADIUS * side / INERTIA, atol=2 * off)
    assert not out.impulse[:, 1].any()
    if name == "poisson":
        return
    stuck = np.abs(side) < mu * p  # v_t+ = -e_t v_t-
    close((out.velocity @ DISC[2][:, 0])[stuck], (-e_t * slip)[stuck], atol=off)
    assert 0 < stuck.sum() < len(stuck)


@pytest.mark.slow
@pytest.mark.parametrize("v", [(0.1, -1.0, 0.3), (0.5, -1.0, -1.0), (-0.4, -1.0, 0.0)])
def test_binary_is_newton_at_one_contact_after_another(v):
    block, e, rubs = (
        ji.Block(1.0, 2.0, corners="base").scene(),
        0.5,
        dict(friction=0.2, tangential_restitution=0.1),
    )
    out = ji.impact(ji.Binary(e, **rubs), block, v)
    normals, tangents, after = (
        np.asarray(block.normals),
        np.asarray(block.tangents),
        np.array(v),
    )
    for _ in range(20):
        rate = normals.T @ after
        j = int(np.argmin(rate))
        if rate[j] > -1e-12:
            break
        alone = ji.Scene(block.mass, normals[:, [j]], tangents=tangents[:, [j]])
        after = np.asarray(ji.impact(ji.Newton(e, **rubs), alone, after).velocity)
    close(out.velocity, after, atol=1e-12)
    assert ji.STATUS[int(out.status)].name in ("ok", "order_dependent")


def rod(angle, length=1.0):
    """A rod that strikes the ground with its lower end."""
    across, up = -length / 2 * np.cos(angle), length / 2 * np.sin(angle)
    return (
        np.array([1.0, 1.0, length**2 / 12]),
        np.array([[0.0], [1.0], [across]]),
        np.array([[1.0], [0.0], [up]]),
    )


RODS = [
    (*rod(angle), np.array(v), e, mu)
    for angle in (0.3, 0.8, 1.2, 1.5)
    for mu in (0.0, 0.1, 0.3, 0.8, 5.0)  # slip, slip and stick, reversal, jam
    for v in ([0.5, -1, 0.0], [-0.3, -1, 0.2], [2.0, -1, 1.0], [0, -1, 0.0])
    for e in (0.5, 0.9)
]


@pytest.mark.slow
def test_rods_are_rouths():
    """One contact with friction: slip, slip and stick, reversal, jam."""
    mass, normals, tangents, v, e, mu = (np.stack(x) for x in zip(*RODS))
    expected = np.array(
        [
            routh(ji.Scene(m, n, tangents=h), *x)
            for m, n, h, *x in zip(mass, normals, tangents, v, mu, e)
        ]
    )
    out, _ = run("lzb", mass, normals, tangents, v, e, mu)
    assert not out.status.any()
    close(out.impulse[:, 0], expected[:, 0], atol=1e-7)
    close(out.tangential_impulse[:, 0], expected[:, 1], atol=1e-7)
    kinds = np.abs(expected[:, 1]) < mu * expected[:, 0] - 1e-6
    assert kinds.any()
    assert not kinds.all()


def by_small_impulses(scene, v, mu, e, stored, dp=2e-5):
    """(p, p_t) of one contact with energy `stored` beforehand, summed up, and the least gamma."""
    wn, wnt, wt, g, u = (float(x.ravel()[0]) for x in blocks(scene, v))
    p = side = 0.0
    least = g
    while stored > 0 or g < 0:
        hold = min(max(-wnt / wt, -mu), mu)
        ratio = hold if abs(u) <= mu * wt * dp else -mu * np.sign(u)
        middle = g + (wn + wnt * ratio) * dp / 2
        stored -= middle * dp / (1.0 if middle < 0 else e**2)
        g, u = g + (wn + wnt * ratio) * dp, u + (wnt + wt * ratio) * dp
        p, side, least = p + dp, side + ratio * dp, min(g, least)
    return p, side, least


def test_a_single_contact_in_closed_form():
    """It is not integrated. Slopes in mu and e, one-sided at 0; it expands first and turns back."""
    mass, normals, tangents = rod(0.8)

    @jax.jit
    @jax.vmap
    def impulses_with_slopes(v, mu, e, stored):
        def impulses(mu, e):
            law = ji.LZB(e, friction=mu, initial_energy=stored)
            out = ji.impact(law, ji.Scene(mass, normals, tangents=tangents), v)
            return jnp.concatenate([out.impulse, out.tangential_impulse])

        return impulses(mu, e), jnp.stack(jax.jacfwd(impulses, argnums=(0, 1))(mu, e))

    v = [(0.5, -1, 0), (-0.3, -1, 0.2), (2, -1, 1)]
    rows = [
        (v, mu, e, 0.0)
        for v in v
        for mu in (0.0, 0.1, 0.8, 5.0)
        for e in (0.0, 0.5, 0.9)
    ]
    loaded = [
        ((u, 0.1, 0.0), mu, 0.7, 0.4) for u in (1.0, -1.0) for mu in (0.1, 1.0, 5.0)
    ]
    found, slopes = impulses_with_slopes(*map(np.array, zip(*rows, *loaded)))
    scene, h = ji.Scene(mass, normals, tangents=tangents), 1e-6
    for (v, mu, e, _), p, slope in zip(rows, found, slopes):
        e = max(e, 1e-9)
        expected = np.array(routh(scene, v, mu, e))
        close(p, expected, atol=1e-8)
        for dmu, de, one in ((h, 0, slope[0]), (0, h, slope[1])):
            close(
                one,
                (np.array(routh(scene, v, mu + dmu, e + de)) - expected) / h,
                atol=1e-4,
            )
    *expected, least = np.array([by_small_impulses(scene, *row) for row in loaded]).T
    close(found[-len(loaded) :], np.transpose(expected), atol=3e-4)
    assert (least < 0).any()  # drawn back by friction, and compressed


@pytest.mark.release
@pytest.mark.parametrize("rod", [RODS[16], RODS[54]], ids=["slips", "jams"])
def test_regularized_friction_is_rouths(rod):
    """The independent integration itself, against the closed form."""
    mass, normals, tangents, v, e, mu = rod
    scene = ji.Scene(mass, normals, tangents=tangents)
    p, side = routh(scene, v, mu, e)
    after, uncertainty = regularized(scene, v, 1.0, 1.5, e, mu, eps=1e-5)
    close(after, v + (normals[:, 0] * p + tangents[:, 0] * side) / mass, atol=1e-8)
    assert uncertainty < 1e-4


HELD = np.load(Path(__file__).parents[1] / "held" / "friction_space.npz")


def held(contacts):
    """Impacts in space, and what an independent integration gives (see space_reference.py)."""
    return {name[:-2]: HELD[name] for name in HELD if name.endswith(f"_{contacts}")}


HELD_CONTACTS = [
    pytest.param(1, marks=pytest.mark.release),
    pytest.param(2, marks=pytest.mark.release),
]


@pytest.mark.parametrize("contacts", HELD_CONTACTS)
def test_lzb_in_space_is_the_independent_one(contacts):
    """Boxes on a corner or an edge, and the measured cube: v+ of another integration.

    Of those on an edge one or two vibrate between stick and slip, and say so.
    """
    x = held(contacts)
    scenes = (x[name] for name in ("mass", "normals", "tangents", "velocity"))
    k = np.pad(x["stiffness"], ((0, 0), (0, 2 - contacts)), constant_values=1.0)
    out, _ = run("lzb", *scenes, x["restitution"], x["friction"], k=k)
    ends = out.status == 0
    assert (ends | (contacts > 1) & (out.status == CODE["max_steps"])).all()
    assert ends.sum() >= 4
    error = np.abs(out.velocity - x["after"]).max(axis=1)
    assert (error <= 1e-7 + 3 * x["uncertainty"])[ends].all(), error


def test_particle_of_example_6_2():
    """e = .5, mu = .3; the bound of (6.62) is sufficient, yet a particle always dissipates."""
    ratio = np.array([0.01, 0.4, 1.0, 1.6, 1.65, 3.0, 40.0])
    bound = 2 * 0.3 / (1 - 0.5 - 0.3**2 * (1 + 0.5))
    close(bound, 1.64383561643835616, rtol=1e-14)
    v = np.stack([np.ones(7), -ratio, np.zeros(7)], axis=1)
    particle = (DISC[0], DISC[1], np.array([[1.0], [0.0], [0.0]]))
    scenes = (np.tile(x, (7, *(1,) * np.ndim(x))) for x in particle)
    out, found = run("moreau", *scenes, v, 0.5 * np.ones(7), 0.3 * np.ones(7))
    after = out.velocity
    close(out.energy_change, np.sum((after**2 - v**2)[:, :2], axis=1), rtol=1e-12)
    assert (out.energy_change < 0).all()
    assert found.energetic.all()
    slides = 0.3 * 1.5 * ratio < 1
    close(after[:, 0], np.where(slides, 1 - 0.45 * ratio, 0.0), atol=1e-13)
    assert (ratio > bound).any()
    assert (ratio < bound).any()


# ------------------------------------------------------------------------- coupled contacts

FLAT = ji.Block(1.5, 1.0, 2.0, corners="base").scene()


def of_scene(scene, count):
    mass = np.diag(np.asarray(scene.mass))
    arrays = (mass, np.asarray(scene.normals), np.asarray(scene.tangents))
    return [np.tile(x, (count, 1, 1)) for x in arrays]


@pytest.mark.parametrize("name", ["newton", "moreau"])
def test_block_lying_flat(name):
    """W_tt is singular: v+ is unique, p_t is shared where friction allows it."""
    e, v = 0.5, np.array([0.5, -1.0, -1.0])
    mu, e_t = np.array([0.0, 10.0, 0.2]), np.array([0.0, 0.2, 0.2])
    out, _ = run(name, *of_scene(FLAT, 3), np.tile(v, (3, 1)), np.full(3, e), mu, e_t)
    slip = np.asarray(FLAT.tangents).T @ v
    gamma = np.asarray(FLAT.normals).T @ v
    close(
        out.velocity @ np.asarray(FLAT.normals), -e * np.array([gamma] * 3), atol=1e-13
    )
    close(out.velocity[0, 0], v[0], atol=1e-14)  # without friction
    close(
        np.asarray(FLAT.tangents).T @ out.velocity[1], -0.2 * slip, atol=1e-13
    )  # it sticks
    share = out.tangential_impulse[1] / out.impulse[1]  # in proportion to mu p
    close(share[0], share[1], rtol=1e-10)
    close(out.tangential_impulse[2], -0.2 * out.impulse[2], atol=1e-13)  # it slides
    assert names(out.status) == ["ok", "impulse_not_unique", "ok"]


def random_scenes(count, rows=1, n=3, seed=5, most=0.0, coupling=1.0):
    rng = np.random.default_rng(seed)
    a = coupling * rng.normal(size=(count, n, n))
    normals, tangents = (
        rng.normal(size=(count, n, 2)),
        rng.normal(size=(count, n, 2 * rows)),
    )
    v = rng.normal(size=(count, n))
    v[(np.einsum("cni,cn->ci", normals, v) >= 0).all(axis=1)] *= -1
    e, k = rng.uniform(0.3, 1, (count, 2)), 10 ** rng.uniform(-1, 1, (count, 2))
    mu = 10 ** rng.uniform(-2, most, (count, 2))
    return (a @ a.transpose(0, 2, 1) + np.eye(n), normals, tangents, v), e, mu, k


def misfit(scene, v, out, e, e_t, mu, complementary):
    """By how much an outcome breaks `r = 0` (or complementarity), the cone, and dissipation."""
    _, normals, tangents = scene
    p = out.impulse
    side = out.tangential_impulse.reshape(len(p), -1)
    slip = (tangents.T @ out.velocity + e_t * (tangents.T @ v)).reshape(len(p), -1)
    rate = normals.T @ out.velocity + e * (normals.T @ v)
    normal = np.minimum(rate, p) if complementary else rate
    bound = mu * np.maximum(p, 0)
    cone = np.maximum(np.linalg.norm(side, axis=1) - bound, 0)
    power = bound * np.linalg.norm(slip, axis=1) + np.sum(side * slip, axis=1)
    size = 1 + np.abs(p).max()
    return max(np.abs(normal).max(), cone.max(), np.abs(power).max() / size) / size


@pytest.mark.release
@pytest.mark.parametrize(
    ("name", "rows"),
    [
        pytest.param("moreau", 1, id="moreau, planar"),
        pytest.param("newton", 1, id="newton, planar"),
        pytest.param("moreau", 2, id="moreau, in space"),
        pytest.param("newton", 2, id="newton, in space", marks=pytest.mark.slow),
    ],
)
def test_outcomes_satisfy_the_kinematic_law(name, rows):
    """Cone, opposition to slip, complementarity; where nothing does, it is reported."""
    e_t = 0.1
    scenes, e, mu, _ = random_scenes(
        64, rows, n=4 if rows == 1 else 6, coupling=1.0 if rows == 1 else 0.3, seed=3
    )
    e = np.tile(e[:, :1], 2)
    out, _ = run(name, *scenes, e, mu, np.full(64, e_t))
    reported = np.isin(names(out.status), ["infeasible", "max_steps", "not_finite"])
    assert reported.mean() < (0.3 if name == "newton" else 0.02)
    for i in np.flatnonzero(~reported):
        lane = jax.tree.map(lambda x, i=i: x[i], out)
        scene, v = [x[i] for x in scenes[:3]], scenes[3][i]
        assert misfit(scene, v, lane, e[i], e_t, mu[i], name == "moreau") < 1e-11
    if name == "newton" and rows == 1:
        for i in range(64):  # `infeasible` exactly where no pattern is consistent
            mass, normals, tangents, v = (x[i] for x in scenes)
            both = np.concatenate([normals, tangents], axis=1)
            given = np.concatenate(
                [(1 + e[i]) * (normals.T @ v), (1 + e_t) * (tangents.T @ v)]
            )
            several = solutions(both.T @ np.linalg.solve(mass, both), given, mu[i])
            assert (several == 0) == (names(out.status[i]) == ["infeasible"])
            if several > 1:
                assert ji.STATUS[out.status[i]].name != "ok"


def solutions(w, given, mu):
    """How many velocities patterns of push, pull, stick and slip allow."""
    m, found = len(mu), set()
    for pattern in itertools.product((0, 1, -1, None), repeat=m):
        a, right = w.copy(), -given
        for i, slip in enumerate(pattern):
            if slip != 0:
                a[m + i], right[m + i] = np.eye(2 * m)[m + i], 0.0
                a[m + i, i] = 0.0 if slip is None else mu[i] * slip
        x = np.linalg.solve(a, right)
        p, side, rate = x[:m], x[m:], (w @ x + given)[m:]
        room = 1e-9 * (1 + np.abs(x).max())
        if all(
            p[i] <= room
            if slip is None
            else p[i] >= -room
            and (
                slip * rate[i] >= -room if slip else abs(side[i]) <= mu[i] * p[i] + room
            )
            for i, slip in enumerate(pattern)
        ):
            found.add(tuple(np.round(w @ x, 7)))
    return len(found)


def test_none_and_several_outcomes_are_reported():
    """Normal and tangential directions so coupled that nothing, or several things, may happen."""
    none = (
        [[-1.0, 3.0], [1.0, 1.0], [-1.0, 2.0]],
        [[-2.0, -2.0], [-3.0, -3.0], [-1.0, 2.0]],
        [-1.0, -1.0, 1.0],
    )
    several = (
        [[-1.0, 1.0], [-3.0, 1.0], [-2.0, -3.0]],
        [[0.0, -2.0], [3.0, 2.0], [-3.0, 2.0]],
        [1.0, 0.0, 1.0],
    )
    normals, tangents, v = (np.array(x) for x in zip(none, several))
    out, _ = run(
        "newton", np.ones((2, 3)), normals, tangents, v, 0.5 * np.ones(2), np.ones(2)
    )
    assert names(out.status) == ["infeasible", "several_outcomes"]
    close(normals[1].T @ out.velocity[1], [1.5, 1.0], atol=1e-12)
    # a particle between two walls with unequal e cannot leave one as the other would have it
    walls = np.tile([[1.0, -1.0], [0.0, 0.0], [0.0, 0.0]], (2, 1, 1))
    across = np.tile([[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]], (2, 1, 1))
    e = np.array([[0.8, 0.2], [0.2, 0.2]])
    v = np.tile([-1.0, 0.3, 0.0], (2, 1))
    out, _ = run("moreau", np.ones((2, 3)), walls, across, v, e, 0.5 * np.ones(2))
    assert ji.STATUS[out.status[0]].name == "infeasible"
    close(out.velocity[1, 0], 0.2, atol=1e-13)


# ---------------------------------------------------------------------------------- LZB


def check_random(rows, most_failed):
    """Random scenes, with the contacts in the other order, and faster: three lanes each."""
    count = 32
    scenes, e, mu, k = random_scenes(count, rows, n=3 * rows)
    mass, normals, tangents, v = scenes
    swapped = tangents.reshape(count, -1, 2, rows)[:, :, ::-1].reshape(tangents.shape)
    lanes = [
        (*scenes, e, mu, k),
        (mass, normals[:, :, ::-1], swapped, v, e[:, ::-1], mu[:, ::-1], k[:, ::-1]),
        (mass, normals, tangents, 1e3 * v, e, mu, k),
    ]
    *given, stiff = (np.concatenate(x) for x in zip(*lanes))
    out, found = run("lzb", *given, k=stiff)
    out, turned, faster = (
        jax.tree.map(lambda x, i=i: x[i : i + count], out)
        for i in (0, count, 2 * count)
    )
    good = ~failed(out.status)
    assert (~good).mean() <= most_failed
    p, side = (
        out.impulse,
        np.linalg.norm(out.tangential_impulse.reshape(count, 2, rows), axis=2),
    )
    assert found.consistent[:count][good].all()
    assert (p >= 0)[good].all()
    assert (side <= mu * p + 1e-6)[good].all()
    assert (out.energy_change <= 0)[good].all()
    both = good & ~failed(turned.status)
    close(turned.velocity[both], out.velocity[both], atol=5e-7)
    both = good & ~failed(faster.status)
    close(faster.velocity[both] / 1e3, out.velocity[both], atol=1e-8)
    return scenes, e, mu, k, out, good


def test_lzb_in_the_plane():
    scenes, e, mu, k, out, good = check_random(1, 0.02)
    for i in np.flatnonzero(good)[:3]:
        mass, normals, tangents, v = (x[i] for x in scenes)
        scene = ji.Scene(mass, normals, tangents=tangents)
        found = small_steps(scene, v, k[i], 1.5, e[i], mu[i], steps=2000)
        close(out.velocity[i], found, atol=1e-3 * np.abs(v).max())


def test_lzb_of_a_flat_block():
    """Both corners stick: W_tt is singular."""
    block = [x[0] for x in of_scene(ji.Block(1.0, 2.0, corners="base").scene(), 1)]
    rows = [
        ([1.0, -1.0, 0.0], 0.8, 0.3),
        ([0.1, -1.0, 0.2], 0.8, 0.6),
        ([0.0, -0.5, -1.0], 0.8, 0.6),
        ([-0.5, -0.5, -1.0], 0.5, 0.6),
    ]
    v, e, mu = (np.array(x) for x in zip(*rows))
    out, _ = run("lzb", *(np.tile(x, (4, 1, 1)) for x in block), v, e, mu)
    assert not failed(out.status).any()
    for i, (v, e, mu) in enumerate(rows[:2]):
        scene = ji.Scene(block[0], block[1], tangents=block[2])
        found = small_steps(scene, v, np.ones(2), 1.5, e, mu, steps=2000)
        close(out.velocity[i], found, atol=1e-3)


@pytest.mark.slow
def test_contacts_that_stick_together_share_friction_in_proportion_to_mu_f():
    """lambda_j / (mu_j F_j) are equal where tangents are, whatever the arms of the normals."""
    tangents = [[1, 1], [0, 0], [0.1, 0.1]]
    uneven = ji.Scene([1.0, 1.0, 0.1], [[0, 0], [1, 1], [-0.5, 0.6]], tangents=tangents)
    course = ji.history(
        ji.LZB(0.5, friction=[0.4, 0.3]), uneven, [0.0, -1.0, 0.0], samples=5
    )
    used = np.array(course.tangential_force / course.force)[1:-1] / [0.4, 0.3]
    assert (np.abs(used) > 0.01).all()
    assert (np.abs(used) < 1).all()
    close(used[:, 0], used[:, 1], rtol=1e-6)


@pytest.mark.release
def test_a_flat_block_at_a_fine_tolerance():
    """How the corners share what they hold is known to 1e-8 only: no step need be short for it."""
    e, mu = np.array([0.71, 0.58, 0.98, 0.47]), np.array([0.81, 0.83, 0.71, 0.42])
    v = np.array(
        [
            [0.10, -0.54, 0.36],
            [0.41, -1.04, -0.13],
            [-0.31, -1.46, 1.96],
            [-0.2, -1, 0.9],
        ]
    )
    block = ji.Block(1.0, 2.0, corners="base").scene()

    def fine(e, mu, v):
        return ji.impact(ji.LZB(e, friction=mu, rtol=1e-12, max_steps=3000), block, v)

    program = jax.jit(jax.vmap(fine), compiler_options=OPTIMIZED)
    assert not np.any(program(e, mu, v).status)


@pytest.mark.slow
def test_lzb_in_space():
    """The frame of the tangents does not matter; a motion in a plane is planar."""
    rng = np.random.default_rng(3)
    scenes, e, mu, k, out, good = check_random(2, 0.06)
    turned = scenes[2].copy()
    for j in (0, 2):
        a = rng.uniform(0, 6)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        turned[:, :, j : j + 2] = scenes[2][:, :, j : j + 2] @ turn
    again, _ = run("lzb", scenes[0], scenes[1], turned, scenes[3], e, mu, k=k)
    both = good & ~failed(again.status)
    close(again.velocity[both], out.velocity[both], atol=5e-7)
    # x, y, z and the spins of a rolling ball: along (.6, .8) it is the disc
    ball = np.diag([1.0, 1.0, 1.0, 0.4, 0.4, 1.0])
    up = np.array([0, 0, 1.0, 0, 0, 0])[:, None]
    both = np.zeros((6, 2))
    both[[0, 3], 0] = both[[1, 4], 1] = 1.0
    mu, p = np.array([0.1, 5.0]), 1.8
    twice = (
        np.stack([x, x]) for x in (ball, up, both, [0.6, 0.8, -1, 0.18, 0.24, 0.5])
    )
    space, _ = run("lzb", *twice, np.full(2, 0.8), mu)
    side = -np.minimum(mu * p, 1.3 / 3.5)
    close(space.velocity[:, :2] @ [0.6, 0.8], 1 + side, atol=1e-7)
    close(space.velocity[:, 2], p - 1, atol=1e-7)
    close(space.velocity[:, 3:5] @ [0.6, 0.8], 0.3 + side / 0.4, atol=1e-7)
    assert (space.velocity[:, 5] == 0.5).all()


@pytest.mark.slow
def test_lzb_without_friction():
    """mu = 0 is the frictionless law; no tangents are needed without `friction`."""
    (mass, normals, tangents, v), e, _, k = random_scenes(16, seed=8)
    none, _ = run("lzb", mass, normals, tangents, v, e, np.zeros((16, 2)), k=k)
    bare = jax.jit(
        jax.vmap(lambda m, n, v, e, k: ji.impact(ji.LZB(e, k, 1.5), ji.Scene(m, n), v))
    )(mass, normals, v, e, k)
    good = ~failed(bare.status) & ~failed(none.status)
    assert good.sum() >= 15
    close(none.velocity[good], np.asarray(bare.velocity)[good], atol=1e-7)
    assert not none.tangential_impulse.any()


# -------------------------------------------------------------------------------- slopes

SLOPES = {"planar": (1, 4), "planar, both ways": (1, 4), "space": (2, 6)}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param("moreau", "planar, both ways", marks=pytest.mark.release),
        pytest.param("newton", "planar", marks=pytest.mark.release),
        pytest.param("binary", "planar", marks=pytest.mark.release),
        pytest.param("lzb", "planar, both ways", marks=pytest.mark.release),
        pytest.param("moreau", "space", marks=pytest.mark.release),
        pytest.param("lzb", "space", marks=pytest.mark.release),
    ],
)
def test_derivatives(name, kind):
    """Along a direction of v, e, mu and k: the slope of the values; in reverse mode, too."""
    rows, n = SLOPES[kind]
    scenes, e, mu, k = random_scenes(8, rows, n, most=-0.5)
    x = (scenes[3], np.minimum(e, 0.95), mu, k)
    rng = np.random.default_rng(1)
    way = tuple(0.3 * rng.normal(size=np.shape(y)) for y in x)
    weight = rng.normal(size=n)

    def along(x, way, mass, normals, tangents):
        def after(x):
            v, e, mu, k = x
            scene = ji.Scene(mass, normals, tangents=tangents, gaps=jnp.zeros(2))
            out = ji.impact(LAWS[name](e, mu, jnp.zeros(2), k), scene, v)
            return out.velocity, out.status

        out, (rate, _) = jax.jvp(after, (x,), (way,))
        if "both" in kind:
            (back,) = jax.vjp(lambda x: after(x)[0], x)[1](weight)
            return *out, rate, sum(jnp.vdot(a, b) for a, b in zip(back, way))
        return *out, rate, rate @ weight

    step, shifts = 1e-3, np.array([0, -2, -1, 1, 2])
    lanes = [np.concatenate([y + s * step * d for s in shifts]) for y, d in zip(x, way)]
    given = (np.concatenate([y] * 5) for y in (*way, *scenes[:3]))
    ways = tuple(next(given) for _ in way)
    v, status, rate, back = map(
        np.asarray, jax.jit(jax.vmap(along))(tuple(lanes), ways, *given)
    )
    f, fine = v.reshape(5, 8, n), ~failed(status).reshape(5, 8).any(axis=0)
    slope, rate, back = (
        (f[1] - 8 * f[2] + 8 * f[3] - f[4]) / (12 * step),
        rate[:8],
        back[:8],
    )
    assert fine.sum() >= (3 if name == "newton" else 6)
    close(back[fine], (rate @ weight)[fine], atol=1e-9)
    error = np.abs(rate - slope)[fine].max(axis=1)
    assert np.sort(error)[-2] < 2e-5, (
        error
    )  # one of them may cross a change of stick and slip


@pytest.mark.slow
def test_slopes_of_a_plastic_poisson():
    """At e = 0 towards the only side there is: what expands slides as it did."""
    particle = ji.Scene([1.0, 1.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]])
    after = jax.jacfwd(
        lambda e: ji.impact(ji.Poisson(e, 0.1), particle, [1.0, -1.0]).velocity
    )
    close(jax.jit(after)(0.0), [-0.1, 1.0], atol=1e-12)


def count(jaxpr):
    """Operations of a program, loops and branches included."""
    inner = [x for e in jaxpr.eqns for x in jax.tree.leaves(list(e.params.values()))]
    return len(jaxpr.eqns) + sum(
        count(getattr(x, "jaxpr", x)) for x in inner if hasattr(x, "jaxpr")
    )


def test_frictionless_scenes_pay_nothing():
    block = ji.Block(1.0, 2.0, corners="base").scene()
    bare = ji.Scene(block.mass, block.normals, gaps=block.gaps)

    def operations(scene, **given):
        program = jax.make_jaxpr(
            lambda v: ji.impact(ji.LZB(0.8, **given), scene, v).velocity
        )
        return count(program(np.array([1.0, -1.0, 0.0])).jaxpr)

    plain = operations(bare)
    assert operations(block) < 1.25 * plain  # tangential rows, which the compiler drops


BAD = {
    "mu": (lambda: ji.Newton(0.5, friction=-0.1), "`friction`.*-0.1"),
    "mu of a contact": (
        lambda: ji.Moreau(0.5, friction=[0.1, -0.2]),
        "`friction`.*index 1",
    ),
    "mu of LZB": (lambda: ji.LZB(0.5, friction=-0.1), "`friction`.*-0.1"),
    "nan": (lambda: ji.RestitutionMatrix([[0.5]], friction=np.nan), "`friction`"),
    "e_t": (
        lambda: ji.Newton(0.5, friction=0.1, tangential_restitution=1.1),
        "`tangential_restitution`",
    ),
    "e_t alone": (
        lambda: ji.Newton(0.5, tangential_restitution=0.3),
        "without `friction`",
    ),
    "chain": (
        lambda: ji.impact(
            ji.Newton(0.5, friction=0.1), ji.chain([1.0, 1.0]), [1.0, 0.0]
        ),
        "`scene`.*tangents.*`friction`",
    ),
    "no tangents": (
        lambda: ji.impact(ji.LZB(0.5, friction=0.1), ji.Scene([1.0], [[1.0]]), [-1.0]),
        "tangents",
    ),
    "count": (
        lambda: ji.impact(ji.Moreau(0.5, friction=[0.1] * 3), FLAT, [0.0, -1.0, 0.0]),
        "`friction`",
    ),
    "both": (
        lambda: ji.impact(
            ji.RestitutionMatrix(np.eye(3), friction=0.1), FLAT, [0.0, -1.0, 0.0]
        ),
        "`matrix`.*`friction`",
    ),
    "method": (lambda: ji.LZB(0.8, friction=0.1, method="impulse"), "`method`"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments(name):
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        call()


# ------------------------------------------------------------------ a real cube, in space

CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


@functools.cache
def cube_impacts():
    path = Path(__file__).parents[1] / "held" / "cube_impacts.csv"
    return np.genfromtxt(path, delimiter=",", names=True)


def cube(row):
    """Mass matrix, normals, tangents and velocity (board axes) of an impact of its lowest corners."""
    quaternion = np.array([row[f"quat_{c}"] for c in "wxyz"])
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    turn = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + 2 * (w * turn + turn @ turn)
    mass = np.zeros((6, 6))
    mass[:3, :3] = 0.37 * np.eye(3)
    mass[3:, 3:] = turn @ np.diag([9.57e-4, 9.57e-4, 9.09e-4]) @ turn.T
    gaps = [row[f"corner_{i}_gap_m"] for i in range(1, 9)]
    lowest = np.sort(np.argsort(gaps, kind="stable")[: int(row["contacts"])])
    arms = (0.0474 * CORNERS[lowest] - [0, 0, 0.0057]) @ turn.T - [0, 0, 0.0036]
    points = np.array(  # velocity (3,) of each corner from that of the body
        [
            np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
            for x, y, z in arms
        ]
    )
    v = [row[f"{name}_{c}_pre_{unit}"] for name, unit in RATES for c in "xyz"]
    return mass, points[:, 2].T, points[:, :2].reshape(-1, 6).T, np.array(v)


RATES = (("v", "m_s"), ("omega", "rad_s"))


@pytest.mark.slow
@pytest.mark.parametrize("contacts", [1, 2])
def test_lzb_of_a_real_cube(contacts):
    """Corners that slip, stop, stick (two of one body redundantly) and break loose."""
    rows = cube_impacts()[cube_impacts()["contacts"] == contacts]
    scenes = [np.stack(x) for x in zip(*map(cube, rows))]
    out, found = run("lzb", *scenes, np.full(len(rows), 0.27), rows["mu"])
    after = np.stack(
        [rows[f"lzb_{name}_{c}"] for name, _ in RATES for c in "xyz"], axis=1
    )
    assert not out.status.any()
    assert found.consistent.all()
    close(out.velocity, after, atol=5e-7)


@pytest.mark.release
def test_slopes_where_a_real_cube_comes_to_stick():
    """Derivatives in mu and e: once up to 1e223."""
    rows = cube_impacts()[cube_impacts()["contacts"] == 1]
    scenes = [np.stack(x) for x in zip(*map(cube, rows))]
    given = np.stack([rows["mu"], np.full(len(rows), 0.27)], axis=1)

    @jax.jit
    @jax.vmap
    def along(given, way, mass, normals, tangents, v):
        def after(given):
            law = ji.LZB(given[1], friction=given[0])
            return ji.impact(
                law, ji.Scene(mass, normals, tangents=tangents), v
            ).velocity

        return jax.jvp(after, (given,), (way,))

    step, shifts = 1e-4, (0, 1, -1)
    lanes = [
        (given + s * step * way, way + 0 * given) for way in np.eye(2) for s in shifts
    ]
    x, ways = (np.concatenate(part) for part in zip(*lanes))
    v, slope = along(x, ways, *(np.concatenate([y] * len(lanes)) for y in scenes))
    v, slope = (np.asarray(y).reshape(2, 3, len(rows), 6) for y in (v, slope))
    close(slope[:, 0], (v[:, 1] - v[:, 2]) / (2 * step), atol=2e-2)
    sticks = rows["toss"] == 46
    assert np.abs(slope[0, 0, sticks]).max() < 0.01


@pytest.mark.release
def test_history_of_contacts_with_friction():
    """It starts and ends as the impact does, in the cone and against the slip meanwhile."""
    law, scene = ji.LZB(0.8, friction=0.3), ji.Block(1.0, 2.0, corners="base").scene()
    v = np.array([1.0, -1.0, 0.0])
    out, h = ji.impact(law, scene, v), ji.history(law, scene, v, samples=50)
    assert h.slip.shape == h.tangential_force.shape == (50, 2)
    close(h.slip[0], np.asarray(scene.tangents).T @ v, rtol=1e-9)
    close(h.velocity[-1], out.velocity, atol=1e-7)
    close(h.tangential_impulse[-1], out.tangential_impulse, atol=1e-7)
    assert (np.abs(h.tangential_force) <= 0.3 * h.force * (1 + 1e-9)).all()
    assert (h.tangential_force * h.slip <= 1e-9).all()


def straight(kind):
    """Body, and slips (t, n) of its contact: a disc of 0.3 m, a sphere of 0.2 m."""
    if kind == "disc":
        return ji.Disc(0.3, 2.0), np.array([0.0, -1.2, 0.0])
    return ji.Sphere(0.2, 2.0), np.array([0.0, 0.0, -1.2, 0.0, 0.0, 0.5])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["disc", "sphere"])
def test_slope_of_a_contact_that_falls_straight(kind):
    """Without slip it sticks at once: `dv+/dv-` takes the slip away, `1 - M^-1 H K^-1 H^T`."""
    body, v = straight(kind)
    scene = body.scene(body.touching())
    h, mass = np.asarray(scene.tangents), np.asarray(scene.mass)
    normal = np.asarray(scene.normals)[:, 0]
    moves = (
        np.linalg.solve(np.diag(mass), h)
        if mass.ndim == 1
        else np.linalg.solve(mass, h)
    )
    right = np.eye(len(v)) - moves @ np.linalg.solve(h.T @ moves, h.T)
    right[np.ix_(normal != 0, normal != 0)] = -0.6
    law = ji.LZB(0.6, friction=0.2)
    for jacobian in (jax.jacfwd, jax.jacrev):
        close(
            jacobian(lambda v: ji.impact(law, scene, v).velocity)(v), right, atol=1e-7
        )


@pytest.mark.slow
def test_slope_of_a_block_that_falls_flat():
    """Both corners stick at once: differences meet the slope as they shrink, like h^0.4."""
    block = ji.Block(0.5, 0.3)
    scene, law, v = (
        block.scene(block.touching()),
        ji.LZB(0.4, friction=0.5),
        np.array([0, -1.0, 0]),
    )

    @jax.jit
    def after(v):
        return ji.impact(law, scene, v).velocity

    slope, way = jax.jacfwd(after)(v) @ np.eye(3)[0], np.eye(3)[0]
    steps = np.array([1e-4, 1e-6])
    off = [
        np.abs((after(v + s * way) - after(v - s * way)) / (2 * s) - slope).max()
        for s in steps
    ]
    assert off[1] < 0.3 * off[0] < 0.3 * 0.3


@pytest.mark.slow
def test_slip_across_is_taken_at_once():
    """In space, u- = 0 and slip that begins at once along x: du_y+/du_y- = 0, dp_y/du_y- = -1/b.

    W_nt = (c, 0), W_tt = diag(a, b), c > mu a: a small slip across decays as a power of p.
    """
    c, b, mu, e = 0.9, 2.0, 0.15, 0.5
    normals = jnp.array([[1.0], [0.0], [0.0]])
    tangents = jnp.array([[c, 0.0], [0.7, 0.0], [0.0, b**0.5]])
    scene = ji.Scene(jnp.ones(3), normals, tangents=tangents)

    def after(u):
        v = jnp.stack([-1.0 + 0 * u, -c * -1.0 / 0.7 + 0 * u, u / b**0.5])
        out = ji.impact(ji.LZB(e, friction=mu), scene, v)
        return jnp.concatenate([tangents.T @ out.velocity, out.tangential_impulse])

    slope = jax.jit(jax.jacfwd(after))(0.0)
    close(slope[jnp.array([1, 3])], [0.0, -1 / b], atol=1e-9)
