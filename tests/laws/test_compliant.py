"""Compliant contacts: gapped chains against scipy, forces of a pair, histories, gap scales."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import programs
import pytest
from compliant_reference import elastic_plastic, viscous
from programs import chain, names
from reference import chain_matrices, lzb_oracle
from scipy.optimize import brentq

import jimpact as ji

STRIKE = jnp.array([1.0, 0.0, 0.0])


def gapped_states(number, seed, e_least=0.3, wall=False):
    rng = np.random.default_rng(seed)
    states = []
    n = 3
    m = n - 1 + wall
    for _ in range(number):
        closed = rng.uniform(size=m) < 0.3
        states.append(
            chain(
                10 ** rng.uniform(-0.7, 0.7, n),
                np.sort(rng.normal(size=n))[::-1].copy(),
                wall,
                k=10 ** rng.uniform(-1, 1, m),
                e=rng.uniform(e_least, 1.0, m),
                eta=rng.choice([1.0, 1.5, 1.3], m),
                gaps=np.where(closed, 0, 10 ** rng.uniform(-2, 1, m)),
            )
        )
    return states


@pytest.mark.parametrize("wall", [False, True])
def test_gapped_chains_against_scipy(wall):
    states = gapped_states(8, seed=33, wall=wall)
    for s in states:
        s.after = elastic_plastic(
            np.asarray(s.mass), s.normals, s.velocity, s.k, s.eta, s.e, s.gaps
        )[0]
    programs.check_held("compliant", states, allowed=1e-6)


def test_energy_is_what_the_restitution_leaves():
    states = gapped_states(32, seed=5, e_least=0.2)
    lossless = [programs.State(**(vars(s) | {"e": 1.0})) for s in states]
    out, _ = programs.values("compliant")(states + lossless)
    energy = [0.5 * s.velocity @ s.mass @ s.velocity for s in states]
    assert (out.energy_change[:32] < 0).all()
    assert (out.energy_change[:32] > -np.array(energy)).all()
    assert (np.abs(out.energy_change[32:]) < 1e-7 * np.array(energy)).all()
    assert set(names(out.status)) <= {"ok", "plastic_limit"}


@pytest.mark.parametrize(
    ("eta", "force"),
    [
        (1.5, lambda k: ji.Hertz(k)),
        pytest.param(1.0, lambda k: ji.LinearSpring(k), marks=pytest.mark.slow),
    ],
)
def test_forces_without_losses(eta, force):
    """Forces without an e, and chains, are faster paths of the canonical program."""
    k = [1.0, 2.5, 0.7]
    given = [
        chain([1.0, 1.0, 1.0, 1.0], [1, 0, 0, 0], e=1.0, k=k, eta=eta),
        chain(
            [1.0, 2.0, 1.5, 0.7],
            [1.0, 0.4, 0.1, -0.6],
            k=k,
            eta=eta,
            gaps=[0.0, 0.3, 0.0],
        ),
    ]

    @jax.jit
    @jax.vmap
    def run(masses, v, k, gaps):
        return ji.impact(ji.Compliant(force(k)), ji.chain(masses, gaps=gaps), v)

    rows = [
        (np.diag(s.mass), s.velocity, *(np.broadcast_to(x, 3) for x in (s.k, s.gaps)))
        for s in given
    ]
    out = run(*(np.array(x, float) for x in zip(*rows)))
    same, _ = programs.values("compliant")(given)
    np.testing.assert_allclose(out.velocity, same.velocity, atol=2e-7)
    np.testing.assert_array_equal(out.status, same.status)


def test_lzb_against_an_oracle_of_another_formulation():
    """Chains with walls, mixed exponents, precompression, by scipy with events."""
    rows = [
        # masses, wall, k, e, eta, v, stored
        ([3, 1, 2], False, [1, 3], [0.95, 0.4], [1.5, 1.5], [1, 0, -0.5], 0.0),
        (
            [1, 4, 0.5, 2],
            False,
            [0.05, 20, 1],
            [0.3, 0.9, 1],
            [1.3] * 3,
            [1, 0.2, 0, 0],
            0.0,
        ),
        ([1, 1, 1], "left", [1, 2, 0.7], [0.8, 0.9, 0.6], [2] * 3, [-1, -1, -1], 0.0),
        (
            [1, 2, 1],
            True,
            [4, 2, 0.7],
            [0.8, 0.9, 0.6],
            [1, 1.5, 2],
            [1, 0.5, 0.2],
            0.0,
        ),
        ([1, 2, 1], False, [1, 2], [0.9, 0.7], [1.5, 1.5], [1, 0, 0.2], [0.3, 0.05]),
    ]
    states = []
    for masses, wall, k, e, eta, v, stored in rows:
        after, p, *_ = lzb_oracle(*chain_matrices(masses, wall), v, k, e, eta, stored)
        states.append(
            chain(
                masses,
                v,
                wall,
                k=k,
                e=e,
                eta=eta,
                stored=stored,
                after=after,
                impulse=p,
            )
        )
    programs.check_held("lzb", states, allowed=2e-7)


# ------------------------------------------------------------------------------------ forces

# name: (force of (k, damping), the same by numpy, its smooth sign)
FORCES = {
    "kelvin-voigt": (ji.KelvinVoigt, lambda k, c: lambda x, u: k * x + c * u, None),
    "hunt-crossley": (
        ji.HuntCrossley,
        lambda k, d: lambda x, u: k * np.maximum(x, 0) ** 1.5 * (1 + d * u),
        lambda k, d: lambda x, u: 1 + d * u,
    ),
    "kuwabara-kono": (
        ji.KuwabaraKono,
        lambda k, a: lambda x, u: k * np.sqrt(np.maximum(x, 0)) * (x + 1.5 * a * u),
        lambda k, a: lambda x, u: x + 1.5 * a * u,
    ),
}
COUNT = 16


@functools.cache
def damped(name):
    """(k, damping, masses, v, gaps) -> outcome of three balls and its slope along all of them."""

    def velocity(k, c, mass, v, gaps):
        return ji.impact(
            ji.Compliant(FORCES[name][0](k, c)), ji.chain(mass, gaps=gaps), v
        )

    return jax.jit(jax.vmap(velocity))


def draw(number=COUNT, seed=1):
    rng = np.random.default_rng(seed)
    mass = 10 ** rng.uniform(-0.7, 0.7, (number, 3))
    v = np.sort(rng.normal(size=(number, 3)))[:, ::-1].copy()
    k, c = (
        10 ** rng.uniform(-1, 1, (number, 2)),
        10 ** rng.uniform(-2, 0.5, (number, 2)),
    )
    closed = rng.uniform(size=(number, 2)) < 0.3
    return k, c, mass, v, np.where(closed, 0, 10 ** rng.uniform(-2, 1, (number, 2)))


@pytest.mark.parametrize(
    "force",
    [
        pytest.param(x, marks=[pytest.mark.release] if x != "kelvin-voigt" else [])
        for x in FORCES
    ],
)
def test_damped_chains_against_scipy(force):
    """Forces that slacken at x > 0 and are loaded again, at any damping; none of it elastic."""
    k, c, mass, v, gaps = draw()
    c[-1], gaps[-1] = 0.0, [0.0, 0.1]  # without damping
    out = damped(force)(k, c, mass, v, gaps)
    _, numpy_force, onset = FORCES[force]
    for i in range(COUNT - 1):
        expected = viscous(
            *chain_matrices(mass[i]),
            v[i],
            numpy_force(k[i], c[i]),
            gaps[i],
            onset=onset and onset(k[i], c[i]),
        )
        np.testing.assert_allclose(
            out.velocity[i], expected, atol=1e-6 * np.abs(v[i]).max()
        )
    assert (np.asarray(out.status) == 0).all()
    assert (np.asarray(out.energy_change)[:-1] <= 0).all()
    assert abs(float(out.energy_change[-1])) < 1e-7
    assert (np.asarray(out.impulse) >= 0).all()


@pytest.mark.parametrize(
    "force",
    [
        pytest.param(
            x, marks=pytest.mark.slow if x == "hunt-crossley" else pytest.mark.release
        )
        for x in FORCES
    ],
)
def test_damped_derivatives(force):
    """At a generic gapped state, in stiffness, damping, gaps and velocity; both modes."""
    k, c, mass, v, gaps = (jnp.asarray(z[3]) for z in draw())

    def velocity(theta):
        k, c, gaps, v = theta
        law = ji.Compliant(FORCES[force][0](k, c), rtol=1e-10)
        return ji.impact(law, ji.chain(mass, gaps=gaps), v).velocity

    at = (k, c, gaps, v)
    rng = np.random.default_rng(0)
    along = jax.tree.map(
        lambda z: jnp.asarray(rng.normal(size=z.shape)) * jnp.abs(z), at
    )
    f = jax.jit(lambda s: velocity(jax.tree.map(lambda z, d: z + s * d, at, along)))
    rate = jax.jit(lambda d: jax.jvp(velocity, (at,), (d,))[1])(along)
    h = 1e-4
    np.testing.assert_allclose(rate, (f(h) - f(-h)) / (2 * h), atol=1e-5)
    weight = jnp.array([0.3, -1.0, 0.7])
    back = jax.jit(lambda: jax.vjp(velocity, at)[1](weight))()[0]
    total = sum(float(jnp.sum(a * b)) for a, b in zip(back, along))
    assert total == pytest.approx(float(weight @ rate), rel=1e-8)


def test_restitution_of_a_damped_spring():
    """Swinging and creeping, and the series between them: `m x'' = -k x - c x'` until F = 0."""
    k, m = 2.0, 0.7
    near = 1 + np.array([-2e-4, -9e-5, 9e-5, 2e-4])
    zeta = np.concatenate([[0.01, 0.3, 0.65, 0.8], near, [1.2, 3.0, 1.0]])
    closed = ji.measured_restitution(
        ji.KelvinVoigt(k, 2 * zeta * np.sqrt(k * m)), m, 1.0
    )
    for e, z in zip(closed[:-1], zeta):
        # x is a sum of exp(r t sqrt(k / m)), and x'' = 0 where the force ends
        r = np.roots([1.0, 2 * z, 1.0]).astype(complex)
        end = 2 * np.log(r[1] / r[0]) / (r[0] - r[1])
        v = (r[0] * np.exp(r[0] * end) - r[1] * np.exp(r[1] * end)) / (r[0] - r[1])
        np.testing.assert_allclose(e, -v.real, rtol=1e-5)
    assert float(closed[-1]) == pytest.approx(np.exp(-2), rel=1e-13)  # critical


@pytest.mark.slow
@pytest.mark.parametrize("zeta", [0.89, 0.99995, 1.0, 1.12])
def test_derivatives_of_restitution_about_critical_damping(zeta):
    """First to third, beside Cauchy's integrals of the formula around a circle."""

    def restitution(damping):
        return ji.measured_restitution(
            ji.KelvinVoigt(0.5, damping), 2.0, 1.0
        )  # zeta = damping / 2

    turn = np.exp(2j * np.pi * (np.arange(64) + 0.5) / 64)
    z = zeta + 0.25 * turn
    e = np.exp(-2 * z * np.arccos(z) / np.sqrt(1 - z**2))
    slope = restitution
    for order, factor in ((1, 1), (2, 2), (3, 6)):
        slope = jax.grad(slope)
        expected = factor * np.mean(e * turn**-order).real / 0.25**order / 2**order
        np.testing.assert_allclose(slope(2 * zeta), expected, rtol=1e-11)


@pytest.mark.slow
def test_restitution_of_a_pair():
    """`measured_restitution` is what an impact gives; Hunt and Crossley's implicit relation."""
    e, speed = 0.5, 2.5
    a = brentq(
        lambda a: a * (1 + e) - np.log1p(a) + np.log1p(-a * e), 1e-3, (1 - 1e-13) / e
    )
    got = ji.measured_restitution(
        ji.HuntCrossley(3.0, a / speed), jnp.array([0.2, 4.0]), speed
    )
    np.testing.assert_allclose(got, e, atol=1e-9)
    found = ji.calibrate(ji.HuntCrossley(3.0, 0.0), e, 0.2, speed)
    assert float(found.damping) == pytest.approx(a / speed, rel=1e-7)
    assert float(ji.calibrate(ji.Hertz(1.0), 0.4, 1.0, 1.0).restitution) == 0.4


@pytest.mark.slow
def test_damping_of_a_users_own_force_is_calibrated():
    """The same force as Hunt and Crossley's, whose damping is known: value and slope in e."""

    def force(x, rate, parameters):
        return parameters["stiffness"] * x**1.5 * (1 + parameters["damping"] * rate)

    def own(e):
        start = ji.UserForce(force, {"stiffness": 3.0, "damping": 0.1})
        return ji.calibrate(start, e, 0.2, 1.3).parameters["damping"]

    def known(e):
        return ji.calibrate(ji.HuntCrossley(3.0, 0.0), e, 0.2, 1.3).damping

    np.testing.assert_allclose(own(0.65), known(0.65), rtol=1e-8)
    slopes = [jax.jacfwd(own)(0.65), jax.grad(own)(0.65), jax.grad(known)(0.65)]
    np.testing.assert_allclose(slopes[:2], [slopes[2]] * 2, rtol=1e-6)


def test_restitution_of_a_force_that_only_a_coarser_tolerance_follows():
    """The power .25 of x, guarded by 1e-30, ends `max_steps` at 1e-11: `impact` has the answer."""

    def force(x, rate, damping):
        x = jnp.maximum(x, 1e-30)
        return 1e9 * x**1.5 + damping * x**0.25 * jnp.maximum(rate, 0.0)

    guarded = ji.UserForce(force, 2.0e6)
    out = ji.impact(ji.Compliant(guarded), ji.chain([1e4], wall=True), [0.7])
    assert int(out.status) == 0
    measured = ji.measured_restitution(guarded, 1e4, 0.7)
    np.testing.assert_allclose(measured, -out.velocity[0] / 0.7, rtol=1e-7)


@pytest.mark.slow
def test_an_impact_of_a_pair_without_an_end_says_why():
    pulls = ji.UserForce(lambda x, rate, p: jnp.zeros_like(x), None)
    with pytest.warns(UserWarning, match="ends with"):
        assert np.isnan(ji.measured_restitution(pulls, 1.0, 1.0))


@pytest.mark.slow
def test_calibration_is_differentiable():
    def damping(x):
        return ji.calibrate(ji.KelvinVoigt(2.0, 0.0), x[0], x[1], x[2]).damping

    at, h = jnp.array([0.7, 1.3, 0.8]), 1e-4
    forward, reverse, values = jax.jit(
        lambda x, moved: (
            jax.jacfwd(damping)(x),
            jax.jacrev(damping)(x),
            jax.vmap(damping)(moved),
        )
    )(at, at[None] + h * jnp.concatenate([jnp.eye(3), -jnp.eye(3)]))
    np.testing.assert_allclose(
        forward, (values[:3] - values[3:]) / (2 * h), rtol=1e-5, atol=1e-7
    )
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)


@pytest.mark.release
def test_user_forces():
    """One's own force is the built-in one; without a value it is reported; it cannot pull."""
    gaps = jnp.array([0.0, 0.2])
    user = ji.UserForce(
        lambda x, rate, p: p["k"] * x + p["c"] * rate, {"k": 1.0, "c": 0.3}
    )
    outcomes = [
        ji.impact(ji.Compliant(force), ji.chain(jnp.ones(3), gaps=gaps), STRIKE)
        for force in (user, ji.KelvinVoigt(1.0, 0.3))
    ]
    np.testing.assert_allclose(outcomes[0].velocity, outcomes[1].velocity, atol=1e-8)
    for function in (
        lambda x, rate, _: x * jnp.nan,
        lambda x, rate, _: jnp.sqrt(0.1 - x),
    ):
        out = ji.impact(
            ji.Compliant(ji.UserForce(function)), ji.chain([1.0, 1.0]), [1.0, 0.0]
        )
        assert names(out.status) == ["not_finite"]
    sticky = ji.UserForce(lambda x, rate, _: x - 0.05)
    out = ji.impact(ji.Compliant(sticky), ji.chain([1.0, 1.0]), [1.0, 0.0])
    assert float(out.impulse[0]) > 0
    assert float(out.energy_change) == pytest.approx(0, abs=1e-7)


@pytest.mark.slow
def test_a_force_that_is_cut_at_0_keeps_the_tolerance():
    """Hunt-Crossley, while a heavy ball drives a light one: the cut is an event."""
    k, d, gaps = np.array([1.0, 4.0]), np.array([2.5, 1.0]), np.array([0.0, 0.03])
    masses, v = [4.0, 0.03, 0.6], np.array([11.0, 0.0, -0.7])
    force = FORCES["hunt-crossley"]
    after = jax.jit(
        lambda d: ji.impact(
            ji.Compliant(force[0](k, d)), ji.chain(masses, gaps=gaps), v
        )
    )(d)
    expected = viscous(
        *chain_matrices(masses), v, force[1](k, d), gaps, onset=force[2](k, d)
    )
    np.testing.assert_allclose(after.velocity, expected, atol=1.5e-8 * 11)


@pytest.mark.slow
def test_forces_that_are_positive_at_touch():
    """A contact ends at x = 0 with the force that it has there, elastic or damped.

    `F = g(x) (1 + c x')` at a wall: `log((1 + c v) / (1 - c u)) = c (v + u)`, whatever g is.
    """

    @jax.jit
    @jax.vmap
    def run(preload, damping):
        force = ji.UserForce(
            lambda x, rate, p: (p[0] + 40.0 * x + 70.0 * x**2) * (1 + p[1] * rate),
            jnp.stack([preload, damping]),
        )
        law = ji.Compliant(force)
        gapped = ji.chain([0.7, 1.9, 1.1], gaps=[0.3, 0.05])
        chain = ji.impact(law, gapped, [1.2, 0.2, -0.4])
        return ji.impact(law, ji.Scene([2.3], [[1.0]]), [-0.8]), chain

    c = 0.9
    wall, chain = run(jnp.array([0.0, 2.0, 25.0, 6.0]), jnp.array([0.0, 0.0, 0.0, c]))
    u = brentq(
        lambda u: np.log((1 + 0.8 * c) / (1 - u * c)) - c * (0.8 + u),
        0.1,
        0.8,
        xtol=1e-14,
    )
    np.testing.assert_allclose(wall.velocity[:, 0], [0.8, 0.8, 0.8, u], atol=1e-8)
    np.testing.assert_allclose(chain.energy_change[:3], 0.0, atol=1e-8)
    assert float(chain.energy_change[3]) < -0.01
    assert not np.any([*wall.status, *chain.status])


@pytest.mark.slow
def test_many_balls_strike_many():
    """M of ten Hertz balls strike the others: M + 2 go forward with 99 % of the energy; M = 7: 8."""
    v = jnp.asarray([[1.0] * m + [0.0] * (10 - m) for m in range(1, 8)])
    law, scene = ji.Compliant(ji.Hertz(1.0)), ji.chain(jnp.ones(10))
    got = np.asarray(jax.jit(jax.vmap(lambda v: ji.impact(law, scene, v).velocity))(v))
    assert [int((row > 0).sum()) for row in got] == [3, 4, 5, 6, 7, 8, 8]
    for m, row in enumerate(got[:5], start=1):
        tail = row[10 - (m + 2) :]
        assert 0.989 < tail @ tail / (row @ row) < 0.995
    ends = (0.00267195494026627602, 0.147390307201133049, 0.985865866417338406)
    np.testing.assert_allclose(got[0, -3:], ends, atol=1e-6)


@pytest.mark.slow
def test_history_of_one_ball_on_a_linear_spring():
    """Half a period of `x = v / w sin(w t)`, of 1 kg, k = 2 N/m and 1 m/s."""
    history = ji.history(
        ji.LZB(1.0, 2.0, exponent=1.0), ji.chain([1.0], wall=True), [1.0]
    )
    w, t = np.sqrt(2.0), np.asarray(history.time)
    x = np.sin(w * t) / w
    np.testing.assert_allclose(t[-1], np.pi / w, rtol=1e-7)
    np.testing.assert_allclose(history.indentation[:, 0], x, atol=1e-7)
    np.testing.assert_allclose(history.force[:, 0], 2 * x, atol=1e-7)
    np.testing.assert_allclose(history.energy[:, 0], x**2, atol=1e-7)
    np.testing.assert_allclose(history.gap_velocity[:, 0], -np.cos(w * t), atol=1e-7)
    np.testing.assert_allclose(history.impulse[:, 0], 1 - np.cos(w * t), atol=1e-7)
    np.testing.assert_allclose(history.approach[:, 0], x, atol=1e-7)


@pytest.mark.release
def test_the_status_of_a_history_is_that_of_the_impact():
    """Bad parameters, unknown velocities and energies without a number, inside jit."""

    @jax.jit
    @jax.vmap
    def traced(e, v):
        law = ji.LZB(e, 2.0, exponent=1.0)
        return ji.history(law, ji.chain([1.0], wall=True), v[None], samples=2).status

    e = np.array([1.0, np.nan, 1.5, 1.0, 1.0])
    found = traced(e, np.array([1.0, 1.0, 1.0, np.nan, 1e-200]))
    wanted = ["ok", "not_finite", "out_of_range", "not_finite", "out_of_range"]
    assert names(found) == wanted


# ------------------------------------------------------------------------------- histories


@functools.cache
def histories():
    """Three balls and a wall (wall or first ball out of play), as a batch of any law."""

    def one(mass, v, e, k, eta):
        law = ji.LZB(e, k, eta)
        h = ji.history(law, ji.chain(mass, wall=True), v, samples=101)
        return h, ji.impact(law, ji.chain(mass, wall=True), v)

    return jax.jit(jax.vmap(one))


@pytest.mark.slow
def test_histories():
    """Half a sine, the energy ledger, the end of the impact, Falcon's wall force; no impact."""
    beads = np.append(np.full(2, 6.9716e9), 9.858e9)
    speed = np.sqrt(2 * 9.81 * 3.1e-3)
    e_beads = [0.96, 0.96, 0.92]
    small = np.full(3, 2.05e-3)
    rows = [
        (np.full(3, 2.0), [0, 0, 3.0], [1, 1, 1.0], [8, 8, 8.0], [1, 1, 1.0]),
        ([1, 2, 1.5], [1, 0.5, 0.2], [0.0, 0.8, 0.6], [1, 3, 2.0], [1.5] * 3),
        ([1, 2, 1.5], [1, 0.5, 0.2], [0.9, 0.8, 0.6], [1, 3, 2.0], [1.3] * 3),
        (small, [-1.0, 0, speed], e_beads, beads, [1.5] * 3),  # one bead
        (small, [-1.0, speed, speed], e_beads, beads, [1.5] * 3),  # two
        (small, [speed] * 3, e_beads, beads, [1.5] * 3),  # three
        ([1, 2, 1.5], [-3, -2, -1.0], [1, 1, 1.0], [1, 1, 1.0], [1.5] * 3),
    ]
    columns = [np.array(x, float) for x in zip(*rows)]
    h, out = jax.tree.map(np.asarray, histories()(*columns))
    # ball 3 at the wall alone: a sine, until it turns back and presses ball 2
    t, m, k, v = h.time[0], 2.0, 8.0, 3.0
    omega = np.sqrt(k / m)
    alone = t < 0.99 * np.pi / (2 * omega)
    assert alone.sum() > 10
    deep = v / omega * np.sin(omega * t[alone])
    np.testing.assert_allclose(h.indentation[0, alone, 2], deep, atol=2e-7)
    np.testing.assert_allclose(h.force[0, alone, 2], k * deep, atol=2e-6)
    np.testing.assert_allclose(h.maximum_force[0, 2], v * np.sqrt(k * m), rtol=1e-8)
    for i in (1, 2):
        np.testing.assert_allclose(h.velocity[i, -1], out.velocity[i], atol=1e-6)
        np.testing.assert_allclose(h.impulse[i, -1], out.impulse[i], atol=1e-6)
        kinetic = 0.5 * h.velocity[i] ** 2 @ columns[0][i]
        total = kinetic + h.energy[i].sum(axis=1)
        assert np.diff(total).max() < 1e-7
        np.testing.assert_allclose(
            total[0], 0.5 * columns[1][i] ** 2 @ columns[0][i], rtol=1e-12
        )
        assert (h.force[i] >= 0).all()
        assert (h.maximum_force[i] >= h.force[i].max(axis=0) - 1e-9).all()
    for i, newton in ((3, 51.66), (4, 52.90), (5, 52.90)):
        assert h.maximum_force[i, 2] == pytest.approx(newton, abs=0.01)
    assert h.duration[6] == 0.0
    assert not h.force[6].any()


def test_a_study_gives_contacts_with_forces_their_friction():
    """As other laws: `compare` would else show it without, in silence."""
    row = ji.REGISTRY["compliant"]
    assert float(row.build(stiffness=1e6, friction=0.3).friction) == 0.3
    assert row.in_python.startswith("ji.Compliant(force, ")
