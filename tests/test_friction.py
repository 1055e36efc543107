"""LZB with Coulomb friction: closed forms, small steps, limits, invariances, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from friction_reference import routh, small_steps

import jimpact as ji

BLOCK = (
    [1.0, 1.0, 5 / 12],
    [[0.0, 0.0], [1.0, 1.0], [0.5, -0.5]],
    [[1.0, 1.0], [0.0, 0.0], [1.0, 1.0]],
)


def outcome(mass, normals, tangents, v, e, k, mu, rtol=1e-8):
    law = ji.LZB(e, k, 1.5, friction=mu, rtol=rtol)
    return ji.impact(law, ji.Scene(mass, normals, tangents=tangents), v)


COUNT = 40  # scenes in all planar batches: one compilation


@pytest.fixture(scope="module")
def planar():
    """Two contacts in three coordinates; one program for all of this file's uses."""
    return jax.jit(jax.vmap(outcome))


def random_scenes(count, rows=1, n=3, seed=5, most=0.0):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(count, n, n))
    normals, tangents = rng.normal(size=(count, n, 2)), rng.normal(size=(count, n, 2 * rows))
    v = rng.normal(size=(count, n))
    recedes = (np.einsum("cni,cn->ci", normals, v) >= 0).all(axis=1)
    v[recedes] *= -1
    e, k = rng.uniform(0.3, 1, (count, 2)), 10 ** rng.uniform(-1, 1, (count, 2))
    mu = 10 ** rng.uniform(-2, most, (count, 2))
    return a @ a.transpose(0, 2, 1) + np.eye(n), normals, tangents, v, e, k, mu


def rod(angle, length=1.0):
    """A rod that strikes the ground with its lower end."""
    across, up = -length / 2 * np.cos(angle), length / 2 * np.sin(angle)
    return (
        np.array([1.0, 1.0, length**2 / 12]),
        np.array([[0.0], [1.0], [across]]),
        np.array([[1.0], [0.0], [up]]),
    )


def one_contact(mass, normals, tangents, v, e, mu, stored):
    law = ji.LZB(e, friction=mu, initial_energy=stored)
    return ji.impact(law, ji.Scene(mass, normals, tangents=tangents), v)


def one_contact_by_steps(mass, normals, tangents, v, e, mu, stored):
    """Not in closed form, since beside it there is another one, open."""
    far = jnp.array([[0.0], [1.0], [0.0]])
    normals, tangents = (jnp.concatenate([x, far], axis=1) for x in (normals, tangents))
    scene = ji.Scene(mass, normals, tangents=tangents, gaps=jnp.array([0.0, 1.0]))
    return ji.impact(ji.LZB(e, friction=mu, initial_energy=stored, rtol=1e-10), scene, v)


@pytest.fixture(scope="module")
def by_steps():
    return jax.jit(jax.vmap(one_contact_by_steps))


def test_one_contact_is_rouths(by_steps):
    cases = [
        (*rod(angle), np.array(v), e, mu)
        for angle in (0.3, 0.8, 1.2, 1.5)
        for mu in (0.0, 0.1, 0.3, 0.8, 5.0)  # slip, slip and stick, reversal, jam
        for v in ([0.5, -1, 0.0], [-0.3, -1, 0.2], [2.0, -1, 1.0], [0, -1, 0.0])
        for e in (0.5, 0.9)
    ]
    mass, normals, tangents, v, e, mu = (np.stack(x) for x in zip(*cases))

    expected = np.array(
        [
            routh(ji.Scene(m, n, tangents=h), *x)
            for m, n, h, *x in zip(mass, normals, tangents, v, mu, e)
        ]
    )
    for function, allowed in ((jax.jit(jax.vmap(one_contact)), 1e-13), (by_steps, 1e-9)):
        out = function(mass, normals, tangents, v, e, mu, np.zeros(len(v)))
        np.testing.assert_array_equal(out.status, 0)
        np.testing.assert_allclose(out.impulse[:, 0], expected[:, 0], atol=allowed)
        np.testing.assert_allclose(out.tangential_impulse[:, 0], expected[:, 1], atol=allowed)
    kinds = np.abs(expected[:, 1]) < mu * expected[:, 0] - 1e-6
    assert kinds.any()
    assert not kinds.all()


def any_state(count):
    """Precompressed, separating, plastic."""
    rng = np.random.default_rng(0)
    a, normals, tangents = (rng.normal(size=(count, 3, k)) for k in (3, 1, 1))
    mass, v = a @ a.transpose(0, 2, 1) + 0.3 * np.eye(3), rng.normal(size=(count, 3))
    e, mu = rng.uniform(0, 1, count), 10 ** rng.uniform(-2, 1, count)
    e[:20] = 0.0
    stored = np.where(np.arange(count) % 2, rng.exponential(0.5, count), 0.0)
    return mass, normals, tangents, v, e, mu, stored


def test_one_contact_from_any_state(by_steps):
    given = any_state(160)
    alone, steps = jax.jit(jax.vmap(one_contact))(*given), by_steps(*given)
    np.testing.assert_array_equal(alone.status, 0)
    np.testing.assert_array_equal(steps.status, 0)
    np.testing.assert_allclose(alone.velocity, steps.velocity, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_one_contact():
    given = any_state(100)
    forward, backward, steps = (
        jax.jit(jax.vmap(jac(lambda *x, f=f: f(*x).velocity, argnums=(3, 4, 5, 6))))(*given)
        for jac, f in (
            (jax.jacfwd, one_contact),
            (jax.jacrev, one_contact),
            (jax.jacfwd, one_contact_by_steps),
        )
    )
    for x, y in zip(forward, backward):
        np.testing.assert_allclose(x, y, atol=1e-12)
    for x, y in zip(forward[:3], steps[:3]):
        np.testing.assert_allclose(x, y, atol=1e-6)
    # from 0 stored energy steps of x^eta have no slope, the closed form has
    np.testing.assert_allclose(forward[3][1::2], steps[3][1::2], atol=1e-6)
    before, after = (one_contact(*(x[40] for x in given[:6]), u).velocity for u in (0.0, 1e-7))
    np.testing.assert_allclose(forward[3][40], (after - before) / 1e-7, atol=1e-5)


def test_small_steps_agree(planar):
    flat = [
        (*map(np.array, BLOCK), np.array(v), np.full(2, e), np.ones(2), np.full(2, mu))
        for v, e, mu in (
            ([1.0, -1.0, 0.0], 0.8, 0.3),
            ([0.1, -1.0, 0.2], 0.8, 0.6),  # both corners stick, K_tt singular
            ([0.0, -0.5, -1.0], 0.8, 0.6),
            ([-0.5, -0.5, -1.0], 0.5, 0.6),
        )
    ]
    mixed = [tuple(x[i] for x in random_scenes(8)) for i in range(8)]
    flat = [(np.diag(m), *rest) for m, *rest in flat]
    cases = flat + mixed + [tuple(x[i] for x in random_scenes(COUNT)) for i in range(12, COUNT)]
    out = planar(*(np.stack(x) for x in zip(*cases)))
    for case, velocity, status in zip(cases[:12], out.velocity, out.status):
        mass, normals, tangents, v, e, k, mu = case
        scene = ji.Scene(mass, normals, tangents=tangents)
        found = small_steps(scene, v, k, 1.5, e, mu, steps=2000)
        assert status == 0
        np.testing.assert_allclose(velocity, found, atol=1e-3 * np.abs(v).max())


@pytest.mark.slow
def test_tolerance_is_honest():
    """What wedges is flagged."""
    scenes = random_scenes(200)
    out, exact = (
        jax.jit(jax.vmap(lambda *x, r=r: outcome(*x, rtol=r)))(*scenes) for r in (1e-8, 1e-11)
    )
    good = (np.asarray(out.status) == 0) & (np.asarray(exact.status) == 0)
    assert good.sum() >= 196
    error = np.abs(out.velocity - exact.velocity).max(axis=1) / np.abs(scenes[3]).max(axis=1)
    assert error[good].max() < 1e-7


def test_random_scenes_hold_what_is_promised(planar):
    """Energy, cone, gap velocities, order of contacts, velocity scaling."""
    scenes = random_scenes(COUNT)
    mass, normals, _, v, e, k, mu = scenes
    out = planar(*scenes)
    good = np.asarray(out.status) == 0
    assert good.sum() >= COUNT - 1
    assert np.asarray(out.energy_change)[good].max() <= 0
    p, side = np.asarray(out.impulse)[good], np.asarray(out.tangential_impulse)[good]
    assert p.min() >= 0
    assert (np.abs(side) <= mu[good] * p + 1e-7).all()
    before, after = (np.einsum("cni,cn->ci", normals, x)[good] for x in (v, out.velocity))
    assert (after > -1e-7 * np.abs(before).max(axis=1, keepdims=True)).all()  # 10 rtol
    swapped = planar(
        mass, *(x[:, :, ::-1] for x in scenes[1:3]), v, *(x[:, ::-1] for x in (e, k, mu))
    )
    np.testing.assert_allclose(swapped.velocity[good], out.velocity[good], atol=3e-7)
    faster = planar(mass, *scenes[1:3], 1e3 * v, e, k, mu)
    np.testing.assert_allclose(faster.velocity[good] / 1e3, out.velocity[good], atol=1e-9)


@pytest.mark.slow
def test_limits_of_friction(planar):
    scenes = random_scenes(COUNT, seed=8)
    none = planar(*scenes[:6], np.zeros((COUNT, 2)))

    def frictionless(mass, normals, v, e, k):
        return ji.impact(ji.LZB(e, k, 1.5), ji.Scene(mass, normals), v)

    smooth = jax.jit(jax.vmap(frictionless))(*scenes[:2], *scenes[3:6])
    good = np.asarray(smooth.status) == 0
    assert good.sum() >= COUNT - 1
    np.testing.assert_array_equal(none.status[good], 0)
    np.testing.assert_allclose(none.velocity[good], smooth.velocity[good], atol=1e-7)
    np.testing.assert_array_equal(none.tangential_impulse, 0.0)
    mass, normals, tangents = rod(0.8)
    sticks = outcome(mass, normals, tangents, np.array([1.0, -1.0, 0.0]), 0.9, 1.0, 100.0)
    np.testing.assert_allclose(tangents.T @ sticks.velocity, 0.0, atol=1e-9)


@pytest.mark.slow
def test_open_contacts_and_no_approach():
    mass, normals, tangents = BLOCK
    scene = ji.Scene(mass, normals, tangents=tangents, gaps=[0.0, 1e-3])
    out = ji.impact(ji.LZB(0.8, friction=0.3), scene, [0.5, -1.0, 0.0])
    alone = ji.Scene(mass, np.array(normals)[:, :1], tangents=np.array(tangents)[:, :1])
    one = ji.impact(ji.LZB(0.8, friction=0.3), alone, [0.5, -1.0, 0.0])
    np.testing.assert_allclose(out.velocity, one.velocity, atol=1e-9)
    assert out.impulse[1] == 0
    away = ji.impact(ji.LZB(0.8, friction=0.3), scene, [0.5, 1.0, 0.0])
    np.testing.assert_array_equal(away.velocity, [0.5, 1.0, 0.0])
    assert away.status == 0


def test_plastic_contacts_stick_or_slide():
    mass, normals, tangents = rod(1.2)
    out = outcome(mass, normals, tangents, np.array([0.5, -1.0, 0.0]), 0.0, 1.0, 0.1)
    p, side = routh(ji.Scene(mass, normals, tangents=tangents), [0.5, -1.0, 0.0], 0.1, 1e-9)
    assert float(out.impulse[0]) == pytest.approx(p, abs=1e-7)
    assert float(out.tangential_impulse[0]) == pytest.approx(side, abs=1e-7)


@pytest.mark.slow
def test_space():
    """Small steps; the frame of the tangents does not matter; a motion in a plane is planar."""
    rng = np.random.default_rng(3)
    mass, normals, tangents, v, e, k, mu = random_scenes(12, rows=2, n=6, seed=5)
    one = jax.jit(jax.vmap(outcome))
    out = one(mass, normals, tangents, v, e, k, mu)
    np.testing.assert_array_equal(out.status[:4], 0)
    for i in range(4):
        scene = ji.Scene(mass[i], normals[i], tangents=tangents[i])
        found = small_steps(scene, v[i], k[i], 1.5, e[i], mu[i])
        np.testing.assert_allclose(out.velocity[i], found, atol=1e-3 * np.abs(v[i]).max())
    turned = tangents.copy()
    for j in (0, 2):
        a = rng.uniform(0, 6)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        turned[:, :, j : j + 2] = tangents[:, :, j : j + 2] @ turn
    good = out.status == 0
    again = one(mass, normals, turned, v, e, k, mu)
    np.testing.assert_allclose(again.velocity[good], out.velocity[good], atol=3e-7)
    side = np.linalg.norm(np.asarray(out.tangential_impulse).reshape(12, 2, 2), axis=2)
    assert (side[good] <= (mu * np.asarray(out.impulse))[good] + 1e-6).all()
    ball = np.diag([1.0, 1.0, 1.0, 0.4, 0.4])  # x, y, z and the spins of a rolling ball
    up = np.array([[0.0], [0.0], [1.0], [0.0], [0.0]])
    both = np.array([[1.0, 0], [0, 1.0], [0, 0], [1.0, 0], [0, 1.0]])
    flat = outcome(ball, up, both[:, :1], np.array([1.0, 0, -1, 0.3, 0]), 0.8, 1.0, 0.1)
    space = outcome(ball, up, both, np.array([0.6, 0.8, -1, 0.18, 0.24]), 0.8, 1.0, 0.1)
    along = np.array([[0.6, 0.8, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0.6, 0.8]]) @ space.velocity
    np.testing.assert_allclose(along, np.asarray(flat.velocity)[[0, 2, 3]], atol=1e-8)


def differences(function, at, along):
    """Central differences of a solver at a tight tolerance, extrapolated once."""

    def slope(h):
        return (np.asarray(function(at + h * along)) - np.asarray(function(at - h * along))) / (
            2 * h
        )

    return (4 * slope(5e-5) - slope(1e-4)) / 3


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "n"), [(1, 4), (2, 6)])
def test_derivatives(rows, n):
    mass, normals, tangents, v, e, k, mu = random_scenes(10, rows=rows, n=n, seed=5, most=-0.5)
    rng = np.random.default_rng(1)

    def at(i, theta, rtol):
        split = np.cumsum([n, 2, 2, 2 * n])
        v, e, k, h, mu = jnp.split(theta, [*split])
        h = tangents_[i] * (1 + h.reshape(n, 2).repeat(rows, axis=1))
        return outcome(mass_[i], normals_[i], h, v, e, k, mu, rtol)

    mass_, normals_, tangents_ = jnp.asarray(mass), jnp.asarray(normals), jnp.asarray(tangents)
    tight = jax.jit(lambda i, theta: at(i, theta, 1e-12))
    forward = jax.jit(jax.jacfwd(lambda theta, i: at(i, theta, 1e-8).velocity))
    for i in range(10):
        theta = np.concatenate([v[i], 0.98 * e[i], k[i], np.zeros(2 * n), mu[i]])
        if int(tight(i, theta).status):
            continue
        along = rng.normal(size=theta.shape) * 0.3
        exact = differences(lambda x, i=i: tight(i, x).velocity, theta, along)
        found = forward(theta, i) @ along
        np.testing.assert_allclose(found, exact, atol=1e-6 * (1 + np.abs(exact).max()))
    if rows == 1:
        backward = jax.jit(jax.jacrev(lambda theta, i: at(i, theta, 1e-8).velocity))
        np.testing.assert_allclose(backward(theta, i), forward(theta, i), atol=1e-12)


@pytest.mark.slow
def test_friction_is_fitted():
    scene = ji.Scene(*map(jnp.array, BLOCK[:2]), tangents=jnp.array(BLOCK[2]))
    before = np.array([[1.0, -1.0, 0.0], [1.5, -1.0, 0.5], [2.0, -0.5, -0.2]])
    law = ji.LZB(0.8, friction=0.2)
    after = jax.vmap(lambda v: ji.impact(law, scene, v).velocity)(before)
    shots = ji.Experiments(before, after)
    found = ji.fit(
        ji.LZB(0.6, friction=0.4), scene, shots, free=("restitution", "friction"), starts=2
    )
    assert float(found.law.friction) == pytest.approx(0.2, abs=1e-6)
    assert float(found.law.restitution) == pytest.approx(0.8, abs=1e-6)


def count(jaxpr):
    """Operations of a program, loops and branches included."""
    inner = [x for e in jaxpr.eqns for x in jax.tree.leaves(list(e.params.values()))]
    return len(jaxpr.eqns) + sum(
        count(getattr(x, "jaxpr", x)) for x in inner if hasattr(x, "jaxpr")
    )


def test_frictionless_scenes_pay_nothing():
    mass, normals, tangents = map(np.array, BLOCK)

    def operations(**given):
        scene = ji.Scene(mass, normals, tangents=tangents)
        program = jax.make_jaxpr(lambda v: ji.impact(ji.LZB(0.8, **given), scene, v).velocity)
        return count(program(np.array([1.0, -1.0, 0.0])).jaxpr)

    bare = jax.make_jaxpr(lambda v: ji.impact(ji.LZB(0.8), ji.Scene(mass, normals), v).velocity)
    plain = count(bare(np.array([1.0, -1.0, 0.0])).jaxpr)
    assert operations() <= plain + 5  # the push of tangential impulses that are 0
    assert operations(friction=0.1) > 1.2 * plain


def test_bad_input():
    mass, normals, tangents = BLOCK
    scene = ji.Scene(mass, normals, tangents=tangents)
    v = [1.0, -1.0, 0.0]
    with pytest.raises(ValueError, match="friction"):
        ji.LZB(0.8, friction=-0.1)
    with pytest.raises(ValueError, match="friction"):
        ji.LZB(0.8, friction=float("nan"))
    with pytest.raises(ValueError, match="friction"):
        ji.impact(ji.LZB(0.8, friction=[0.1, 0.2, 0.3]), scene, v)
    with pytest.raises(ValueError, match="tangents"):
        ji.impact(ji.LZB(0.8, friction=0.1), ji.Scene(mass, normals), v)
    with pytest.raises(ValueError, match="method"):
        ji.LZB(0.8, friction=0.1, method="impulse")
    with pytest.raises(TypeError, match="friction"):
        ji.history(ji.LZB(0.8, friction=0.1), scene, v)
    with pytest.raises(TypeError, match="friction"):
        ji.work_precision(scene, v, ji.LZB(0.8, friction=0.1), methods=("dop853",))
