"""Kinematic laws with Coulomb friction: closed forms, the law itself on random scenes, existence."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.status import CODE

MASS, RADIUS, INERTIA = 2.0, 0.5, 0.2
DISK = ji.Scene(
    [MASS, MASS, INERTIA], [[0.0], [1.0], [0.0]], tangents=[[1.0], [0.0], [RADIUS]]
)  # (x, y, turn) of a disk on the ground
PARTICLE = ji.Scene(DISK.mass, DISK.normals, tangents=[[1.0], [0.0], [0.0]])  # turns freely
FLAT = ji.rocking_block(width=1.5, height=1.0, mass=2.0)


def number(x):
    """Always of the same type, so that impacts of the same sizes share one compiled program."""
    return jnp.asarray(x, float)


def moreau(e, mu, e_t=0.0):
    return ji.Moreau(number(e), friction=number(mu), tangential_restitution=number(e_t))


def newton(e, mu, e_t=0.0):
    return ji.Newton(number(e), friction=number(mu), tangential_restitution=number(e_t))


def matrix(e, mu, e_t=0.0):
    return ji.RestitutionMatrix(
        jnp.atleast_2d(number(e)), friction=number(mu), tangential_restitution=number(e_t)
    )


LAWS = {"newton": newton, "moreau": moreau, "matrix": matrix}
SLOW = pytest.mark.slow
close = np.testing.assert_allclose


def stacked(outcomes):
    return jax.tree.map(lambda *x: np.stack(x), *outcomes)


# ---------------------------------------------------------------------------- one contact


@pytest.mark.parametrize("name", ["newton", "moreau", pytest.param("matrix", marks=SLOW)])
def test_disk_closed_form(name):
    """Sticking needs `-(1 + e_t) v_t / W_tt`; friction gives at most mu p of it."""
    grid = np.array(
        list(itertools.product((0.0, 0.1, 0.4, 50.0), (-0.3, 0.0, 1.0), (-2.0, 0.3), (0.0, 1.5)))
    )
    mu, e_t, x_rate, turn = grid.T
    e, y_rate = 0.6, -1.3
    v = np.stack([x_rate, np.full_like(mu, y_rate), turn], axis=1)
    rows = zip(mu, e_t, v, strict=True)
    out = stacked([ji.impact(LAWS[name](e, m, t), DISK, v) for m, t, v in rows])
    slip = x_rate + RADIUS * turn
    w_tt = 1 / MASS + RADIUS**2 / INERTIA
    p = MASS * (1 + e) * 1.3
    side = np.clip(-(1 + e_t) * slip / w_tt, -mu * p, mu * p)
    close(out.impulse[:, 0], p, rtol=1e-14)
    close(out.tangential_impulse[:, 0], side, atol=1e-14)
    close(out.velocity[:, 0], x_rate + side / MASS, atol=1e-14)
    close(out.velocity[:, 2], turn + RADIUS * side / INERTIA, atol=1e-13)
    assert not np.asarray(out.status).any()
    stuck = np.abs(side) < mu * p  # v_t+ = -e_t v_t-
    after = np.asarray(out.velocity) @ np.asarray(DISK.tangents)[:, 0]
    close(after[stuck], (-e_t * slip)[stuck], atol=1e-14)
    assert 0 < stuck.sum() < len(stuck)


def test_particle_example():
    """Example 6.2: e = 0.5, mu = 0.3; the bound is sufficient, yet a particle always dissipates."""
    bound = 2 * 0.3 / (1 - 0.5 - 0.3**2 * (1 + 0.5))
    close(bound, 1.64383561643835616, rtol=1e-14)
    ratio = np.array([0.01, 0.4, 1.0, 1.6, 1.65, 3.0, 40.0])
    v = np.stack([np.ones(7), -ratio, np.zeros(7)], axis=1)
    out = stacked([ji.impact(matrix(0.5, 0.3), PARTICLE, x) for x in v])
    after = np.asarray(out.velocity)
    close(out.energy_change, np.sum(after**2 - v**2, axis=1), rtol=1e-13)
    assert (np.asarray(out.energy_change) < 0).all()
    assert (ratio > bound).any()
    assert (ratio < bound).any()
    # the law slides where friction does not suffice to stop: mu (1 + e) |y'| < |x'|
    slides = 0.3 * 1.5 * ratio < 1
    close(after[:, 0], np.where(slides, 1 - 0.45 * ratio, 0.0), atol=1e-14)


@SLOW
def test_given_slip_agrees_with_the_law():
    """(6.54)-(6.57) with xi = 1: the law finds that slip by itself, and the same impulses."""
    e, mu = np.array([[0.5, 0.1], [0.2, 0.3]]), 0.2
    fast, slow = np.array([2.0, -0.6, -0.3]), np.array([0.1, -0.6, -0.3])
    out, stuck = (ji.impact(matrix(e, mu), FLAT, v) for v in (fast, slow))
    p, side = ji.friction_impulses(FLAT, e, mu, 1.0, fast)
    assert float((FLAT.tangents.T @ out.velocity)[0]) > 0  # still sliding: xi = 1 was right
    close(out.impulse, p, rtol=1e-12)
    close(out.tangential_impulse, side, rtol=1e-12)
    assert int(out.status) == 0
    # with less speed the given slip would turn back: there the law sticks
    p, side = ji.friction_impulses(FLAT, e, mu, 1.0, slow)
    assert float((FLAT.tangents.T @ (slow + ji.velocity_change(FLAT, p, side)))[0]) < 0
    close(FLAT.tangents.T @ stuck.velocity, 0, atol=1e-14)
    assert int(stuck.status) == CODE["impulse_not_unique"]


# ------------------------------------------------------------------------- coupled contacts


@pytest.mark.parametrize("name", ["newton", "moreau"])
def test_block_lying_flat(name):
    """W_tt is singular: v+ is unique, p_t is shared where friction allows it."""
    e, e_t, v = 0.5, np.array([0.0, 0.2, 0.2]), np.array([0.5, -1.0, -1.0])
    mu = np.array([0.0, 10.0, 0.2])
    out = stacked([ji.impact(LAWS[name](e, *x), FLAT, v) for x in zip(mu, e_t, strict=True)])
    free = ji.impact(ji.Newton(e), FLAT, v)  # without friction
    close(out.velocity[0], free.velocity, atol=1e-14)
    close(out.impulse[0], free.impulse, atol=1e-14)
    slip = np.asarray(FLAT.tangents.T @ v)
    close(FLAT.tangents.T @ out.velocity[1], -0.2 * slip, atol=1e-14)  # mu -> infinity: sticks
    shares = out.tangential_impulse[1] / out.impulse[1]  # in proportion to the load
    close(shares[0], shares[1], rtol=1e-12)
    close(out.tangential_impulse[2], -0.2 * out.impulse[2], atol=1e-14)  # slides
    codes = [CODE["ok"], CODE["impulse_not_unique"], CODE["ok"]]
    assert out.status.tolist() == codes
    gamma = np.asarray(FLAT.normals.T @ v)
    close(
        np.asarray(out.velocity) @ np.asarray(FLAT.normals), -e * np.array([gamma] * 3), atol=1e-14
    )


def test_uneven_load_is_shared_as_friction_allows():
    """Corner A takes no impulse, so that B alone must hold the block: half each is not allowed."""
    rate = -1.0  # about A, hitting with B; at e = 0 with a = 1 Newton would make A pull
    scene = ji.rocking_block(width=1.0, height=3.0)
    v = rate * np.array([-1.5, 0.5, 1.0])
    out = ji.impact(moreau(0.0, 5.0), scene, v)
    close(out.impulse[1], 0, atol=1e-14)
    close(out.tangential_impulse[1], 0, atol=1e-14)
    close(scene.tangents[:, 0] @ out.velocity, 0, atol=1e-14)
    # rolling over to B without slip: Housner
    close(out.velocity[2], rate * ji.housner_restitution(3.0), rtol=1e-13)


def test_open_corner_takes_no_part():
    scene = ji.rocking_block(1.5, 1.0, angle=0.3)  # only A, contact 2, is closed
    v = np.array([0.4, -1.0, 0.1])
    alone = ji.Scene(scene.mass, scene.normals[:, 1:], scene.tangents[:, 1:])
    for make in (newton, moreau):
        out, single = (ji.impact(make(0.4, 0.3), s, v) for s in (scene, alone))
        close(out.velocity, single.velocity, atol=1e-14)
        assert float(out.impulse[0]) == 0 == float(out.tangential_impulse[0])
        assert int(out.status) == 0


def random_scenes(count, n, m, tangents, coupling, seed=3):
    generator = np.random.default_rng(seed)
    a = coupling * generator.normal(size=(count, n, n)) / np.sqrt(n)
    scenes = (
        a @ a.transpose(0, 2, 1) + np.eye(n),
        generator.normal(size=(count, n, m)),
        generator.normal(size=(count, n, tangents * m)),
    )
    return scenes, generator.normal(size=(count, n)), generator.uniform(0, 1, (count, m))


def misfit(scene, v, out, e, e_t, mu, complementary):
    """By how much an outcome breaks `r = 0` (or complementarity), the cone, and dissipation."""
    _, normals, tangents = scene
    p = np.asarray(out.impulse)
    side = np.asarray(out.tangential_impulse).reshape(len(p), -1)
    gamma, after = normals.T @ v, normals.T @ out.velocity
    slip = (tangents.T @ out.velocity + e_t * (tangents.T @ v)).reshape(len(p), -1)
    rate = after + e * gamma
    normal = np.minimum(rate, p) if complementary else rate
    bound = mu * np.maximum(p, 0)
    cone = np.maximum(np.linalg.norm(side, axis=1) - bound, 0)
    power = bound * np.linalg.norm(slip, axis=1) + np.sum(side * slip, axis=1)
    size = 1 + np.abs(p).max()
    return max(np.abs(normal).max(), cone.max(), np.abs(power).max() / size) / size


RANDOM = [
    pytest.param("moreau", 4, 3, 1, id="moreau"),
    pytest.param("newton", 4, 2, 1, id="newton"),
    pytest.param("moreau", 6, 2, 2, id="moreau in space"),
    pytest.param("newton", 8, 4, 1, id="newton, search", marks=SLOW),
    pytest.param("newton", 6, 2, 2, id="newton in space", marks=SLOW),
    pytest.param("moreau", 12, 6, 1, id="moreau, many", marks=SLOW),
    pytest.param("moreau", 24, 8, 2, id="moreau in space, many", marks=SLOW),
]


@pytest.mark.parametrize(("name", "n", "m", "tangents"), RANDOM)
def test_outcomes_satisfy_the_law(name, n, m, tangents):
    count, e, e_t = 80, 0.5, 0.1
    coupling = 1.0 if tangents == 1 and m < 4 else 0.3
    scenes, v, mu = random_scenes(count, n, m, tangents, coupling)
    if m >= 4 and name == "newton":  # a law of equations: contacts that hardly feel each other
        scenes[1][:], scenes[2][:] = 0.1 * scenes[1], 0.1 * scenes[2]
        scenes[1][:, np.arange(m), np.arange(m)] = 1.0
        scenes[2][:, m + np.arange(m), np.arange(m)] = 1.0
        v[:, :m] = -np.abs(v[:, :m]) - 1
    run = jax.jit(
        jax.vmap(lambda a, b, c, v, mu: ji.impact(LAWS[name](e, mu, e_t), ji.Scene(a, b, c), v))
    )
    out = run(*scenes, v, mu)
    solved = 0
    for i in range(count):
        one = jax.tree.map(lambda x, i=i: np.asarray(x[i]), out)
        if one.status >= CODE["infeasible"]:
            continue
        if (scenes[1][i].T @ v[i] < 0).any():
            scene = [x[i] for x in scenes]
            assert misfit(scene, v[i], one, e, e_t, mu[i], name == "moreau") < 1e-11
            solved += 1
    assert solved > 0.6 * count
    if name == "newton" and tangents == 1 and m < 4:
        assert_existence(scenes, v, mu, e, e_t, np.asarray(out.status))


def assert_existence(scenes, v, mu, e, e_t, status):
    """`infeasible` exactly where no pattern of push, pull, stick and slip is consistent."""
    for i, (mass, normals, tangents) in enumerate(zip(*scenes)):
        gamma = normals.T @ v[i]
        if (gamma >= 0).all():
            continue
        both = np.concatenate([normals, tangents], axis=1)
        given = np.concatenate([(1 + e) * gamma, (1 + e_t) * (tangents.T @ v[i])])
        exists = any(consistent(both.T @ np.linalg.solve(mass, both), given, mu[i]))
        assert exists == (status[i] != CODE["infeasible"])


def consistent(w, given, mu):
    m = len(mu)
    for pattern in itertools.product((0, 1, -1, None), repeat=m):
        a, right = w.copy(), -given
        for i, slip in enumerate(pattern):
            if slip != 0:
                a[m + i], right[m + i] = np.eye(2 * m)[m + i], 0.0
                a[m + i, i] = 0.0 if slip is None else mu[i] * slip
        x = np.linalg.solve(a, right)
        p, side, rate = x[:m], x[m:], (w @ x + given)[m:]
        room = 1e-9 * (1 + np.abs(x).max())
        yield all(
            p[i] <= room
            if slip is None
            else p[i] >= -room
            and (slip * rate[i] >= -room if slip else abs(side[i]) <= mu[i] * p[i] + room)
            for i, slip in enumerate(pattern)
        )


def test_existence_is_reported():
    """Normal and tangential directions so coupled that nothing, or several things, may happen."""
    none = ji.Scene(
        np.ones(3),
        [[-1.0, 3.0], [1.0, 1.0], [-1.0, 2.0]],
        tangents=[[-2.0, -2.0], [-3.0, -3.0], [-1.0, 2.0]],
        gaps=np.zeros(2),
    )
    several = ji.Scene(
        np.ones(3),
        [[-1.0, 1.0], [-3.0, 1.0], [-2.0, -3.0]],
        tangents=[[0.0, -2.0], [3.0, 2.0], [-3.0, 2.0]],
        gaps=np.zeros(2),
    )
    law = newton(0.5, 1.0)
    out = ji.impact(law, none, [-1.0, -1.0, 1.0])
    assert int(out.status) == CODE["infeasible"]
    with pytest.raises(RuntimeError, match="infeasible"):
        ji.raise_on_failure(out)
    out = ji.impact(law, several, [1.0, 0.0, 1.0])
    assert int(out.status) == CODE["several_outcomes"]
    close(np.asarray(several.normals).T @ out.velocity, [1.5, 1.0], atol=1e-12)


@SLOW
def test_unequal_walls_jam():
    """A particle between two walls: it cannot leave one as the other one would have it."""
    walls = ji.Scene(np.ones(2), [[1.0, -1.0], [0.0, 0.0]], tangents=[[0.0, 0.0], [1.0, 1.0]])
    out = ji.impact(moreau([0.8, 0.2], 0.5), walls, [-1.0, 0.3])
    assert int(out.status) == CODE["infeasible"]
    out = ji.impact(moreau([0.2, 0.2], 0.5), walls, [-1.0, 0.3])
    close(out.velocity[0], 0.2, atol=1e-14)


# --------------------------------------------------------------------------------- in space


def test_dimer_in_space():
    """Turned about the vertical it does the same; along the rod it is the planar dimer."""
    e, mu, angle = 0.5, 0.3, 0.0
    planar, v = ji.dimer(0.2, 1.0, angle=angle), np.array([0.9, -1.0, 0.4])
    expected = ji.impact(moreau(e, mu), planar, v)

    def turned(yaw, along, across, spin):
        scene = ji.dimer_3d(0.2, 1.0, angle=angle, yaw=yaw)
        c, s = np.cos(yaw), np.sin(yaw)
        v = np.array([along * c - across * s, along * s + across * c, -1.0, 0.3, 0.4, spin])
        out = ji.impact(moreau(e, mu), scene, v)
        x, y = out.velocity[:2]
        return out, np.array([c * x + s * y, c * y - s * x, *out.velocity[2:]])

    # the planar dimer turns about -y: theta' > 0 is a positive pitch rate
    scene = ji.dimer_3d(0.2, 1.0, angle=angle)
    out = ji.impact(moreau(e, mu), scene, [0.9, 0.0, -1.0, 0.0, 0.4, 0.0])
    close(np.asarray(out.velocity)[[0, 2, 4]], expected.velocity, atol=1e-12)
    close(np.asarray(out.velocity)[[1, 3, 5]], 0, atol=1e-12)
    close(out.tangential_impulse[::2], expected.tangential_impulse, atol=1e-12)
    results = [turned(yaw, 0.9, 0.7, 2.0) for yaw in (0.0, 0.8, -2.0)]
    for out, velocity in results:
        close(velocity, results[0][1], atol=1e-11)
        assert int(out.status) == 0
        assert float(out.energy_change) < 0
        sizes = np.linalg.norm(np.asarray(out.tangential_impulse).reshape(2, 2), axis=1)
        close(sizes, mu * np.asarray(out.impulse), rtol=1e-10)  # both slide
    # without friction, and with so much that nothing slides
    fixed = ji.impact(moreau(e, 1e3), scene, [0.9, 0.7, -1.0, 0.3, 0.4, 2.0])
    close(scene.tangents.T @ fixed.velocity, 0, atol=1e-10)
    bare = ji.impact(moreau(e, 0.0), scene, [0.9, 0.7, -1.0, 0.3, 0.4, 2.0])
    close(np.asarray(bare.velocity)[[2, 4]], [e, -e * 0.4], atol=1e-12)  # gamma+ = -e gamma-
    close(np.asarray(bare.velocity)[[0, 1, 3, 5]], [0.9, 0.7, 0.3, 2.0], atol=1e-12)


# ------------------------------------------------------------- derivatives, fields, arguments


SLIDING = (0.3, np.array([0.9, -1.0, 0.4]))
STICKING = (3.0, np.array([0.2, -1.0, 0.4]))


@pytest.mark.parametrize("name", ["moreau", pytest.param("newton", marks=SLOW)])
def test_derivatives(name):
    """In (e, mu, e_t, width), forward and reverse, against differences, sliding and sticking."""

    def outcome(x, v):
        scene = ji.rocking_block(x[3], 1.0, mass=2.0)
        out = ji.impact(LAWS[name](x[0], x[1], x[2]), scene, v)
        return jnp.concatenate([out.velocity, out.energy_change[None]])

    def energy(x, v):
        return outcome(x, v)[-1]

    slope_of = jax.jit(jax.jacfwd(outcome) if name == "newton" else jax.grad(energy))
    for mu, v in (SLIDING, STICKING):
        x = np.array([0.5, mu, 0.2, 1.3])
        step = 1e-6 * np.eye(4)
        differences = np.stack([outcome(x + d, v) - outcome(x - d, v) for d in step], axis=1) / 2e-6
        slope = slope_of(x, v)
        close(slope, differences if name == "newton" else differences[-1], rtol=1e-7, atol=1e-8)
        in_mu = np.abs(np.atleast_2d(slope)[:, 1]).max()
        assert (in_mu > 0.1) == (mu == SLIDING[0])  # sticking: mu is no matter


@SLOW
def test_derivatives_in_space():
    def outcome(x, v):
        out = ji.impact(moreau(x[0], x[1], x[2]), ji.dimer_3d(x[3], 1.0, yaw=0.4), v)
        return jnp.concatenate([out.velocity, out.energy_change[None]])

    v = np.array([0.9, 0.7, -1.0, 0.3, 0.4, 2.0])
    x, step = np.array([0.5, 0.3, 0.2, 0.25]), 1e-6 * np.eye(4)
    run = jax.jit(jax.vmap(outcome, (0, None)))
    differences = (run(x + step, v) - run(x - step, v)).T / 2e-6
    close(jax.jit(jax.jacfwd(outcome))(x, v), differences, rtol=1e-7, atol=1e-8)
    slope = jax.jit(jax.grad(lambda x: outcome(x, v)[-1]))(x)
    close(slope, differences[-1], rtol=1e-7, atol=1e-8)


def test_without_friction_nothing_changes():
    for law in (ji.Newton(0.5), ji.Moreau(0.5), ji.RestitutionMatrix([[0.5]])):
        assert law.friction is None is law.tangential_restitution
        assert len(jax.tree.leaves(law)) == 1
    assert ji.Newton(0.5).by_blocks()
    assert not newton(0.5, 0.3).by_blocks()
    out = ji.impact(ji.Newton(0.5), FLAT, np.array([0.5, -1.0, 0.0]))
    assert out.tangential_impulse.tolist() == [0.0, 0.0]


@SLOW
def test_float32():
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), FLAT)
    law = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), moreau(0.5, 0.2))
    v = jnp.array([0.5, -1.0, -1.0], jnp.float32)
    out = ji.impact(law, scene, v)
    assert out.velocity.dtype == jnp.float32
    close(out.velocity, ji.impact(moreau(0.5, 0.2), FLAT, v.astype(float)).velocity, atol=1e-6)
    assert int(out.status) == 0


@SLOW
def test_friction_is_fitted():
    truth = newton(0.6, jnp.array([0.3, 0.15]))
    speeds = [[2.0, -1.0, 0.3], [3.0, -1.0, -0.4]]
    after = [ji.impact(truth, FLAT, v).velocity for v in speeds]
    data = ji.Experiments(pre=speeds, post=np.array(after), sigma=0.01)
    start = newton(0.6, jnp.array([0.2, 0.2]))
    found = ji.fit(start, FLAT, data, free=("friction",), starts=1)
    close(found.law.friction, [0.3, 0.15], atol=1e-9)


BAD = {
    "mu": (lambda: newton(0.5, -0.1), "`friction`.*-0.1"),
    "mu of a contact": (lambda: moreau(0.5, [0.1, -0.2]), "`friction`.*index 1"),
    "nan": (lambda: matrix([[0.5]], np.nan), "`friction`"),
    "e_t": (lambda: newton(0.5, 0.1, 1.1), "`tangential_restitution`"),
    "e_t alone": (lambda: ji.Newton(0.5, tangential_restitution=0.3), "without `friction`"),
    "chain": (
        lambda: ji.impact(newton(0.5, 0.1), ji.chain([1.0, 1.0]), [1.0, 0.0]),
        "`scene`.*tangents.*`friction`",
    ),
    "no tangents": (
        lambda: ji.impact(moreau(0.5, 0.1), ji.Scene([1.0], [[1.0]]), [-1.0]),
        "`scene`.*tangents.*`friction`",
    ),
    "count": (
        lambda: ji.impact(moreau(0.5, [0.1] * 3), FLAT, [0.0, -1.0, 0.0]),
        "`friction`.*one entry per contact",
    ),
    "both": (
        lambda: ji.impact(matrix(np.eye(3), 0.1), FLAT, [0.0, -1.0, 0.0]),
        "`matrix`.*`friction`",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments(name):
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        call()
