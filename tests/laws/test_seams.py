"""What lies between a law and a scene: rounding, no approach, redundant contacts, padded shots."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import CODE

import jimpact as ji

FOUR = ji.chain(np.ones(4))


ULP = np.spacing(0.7)


# four balls side by side, their velocities apart by a few units in the last place
SIDE_BY_SIDE = 0.7 + ULP * np.array(list(itertools.product(range(-2, 3), repeat=4)))


def statuses(law, scene, states):
    return np.asarray(
        jax.jit(jax.vmap(lambda v: ji.impact(law, scene, v).status))(states)
    )


def test_one_unit_in_the_last_place_is_no_impact():
    v = np.array([0.7, 0.1 * 7, 0.7, 0.7])
    out = ji.impact(ji.Moreau(0.9), FOUR, v)
    assert int(out.status) == 0
    assert np.array_equal(out.velocity, v)
    assert not out.impulse.any()


def test_ten_times_the_rounding_is_an_impact():
    """Velocities of 0.7 are known within eps: an approach of 30 eps is one."""
    v = np.array([0.7 + 60 * ULP, 0.7, 0.7, 0.7])
    assert ji.impact(ji.Moreau(0.9), FOUR, v).impulse[0] > 0


@pytest.mark.parametrize(
    "law",
    [
        ji.Newton(0.9),
        ji.Newton([0.9, 0.5, 0.2]),
        ji.RestitutionMatrix(0.9 * np.eye(3)),
        ji.Binary(0.9),
        pytest.param(ji.Poisson(0.9), marks=pytest.mark.slow),
        pytest.param(ji.LZB(0.9), marks=pytest.mark.slow),
        pytest.param(ji.Compliant(ji.Hertz(1.0)), marks=pytest.mark.slow),
    ],
    ids=lambda law: type(law).__name__,
)
def test_velocities_that_differ_by_rounding_are_equal(law):
    assert not statuses(law, FOUR, SIDE_BY_SIDE).any()


def test_a_common_velocity_does_not_hide_an_approach():
    """2e-12 m/s of approach at 1 m/s is an impact, and its gap velocity is reversed."""
    v = 1.0 + 1e-12 * np.array([1.0, 0.0, -1.0, -2.0])
    out = ji.impact(ji.Newton(0.5), FOUR, v)
    assert int(out.status) == 0
    after = ji.gap_velocity(FOUR, out.velocity)
    np.testing.assert_allclose(after, 0.5e-12, atol=3e-15)


def test_rounding_keeps_its_derivative():
    """A contact at rest that is touched: gamma- = 0 within rounding, d gamma-/dv is N^T all the same."""
    balls, v = ji.chain(np.ones(3)), jnp.array([1.0, 0.7, 0.1 * 7])
    exact = jnp.array([1.0, 0.7, 0.7])
    slopes = jax.jit(jax.jacfwd(lambda v: ji.impact(ji.Newton(0.5), balls, v).velocity))
    np.testing.assert_allclose(slopes(v), slopes(exact), atol=1e-14)


@pytest.mark.slow
def test_poisson_on_redundant_contacts():
    """Two contacts of one pair of bodies: v+ depends on how they share p_c, if their e differ."""
    pair = ji.Scene([1.0, 1.0], [[-1.0, -1.0], [1.0, 1.0]])

    @jax.jit
    def status(e):
        return ji.impact(ji.Poisson(e), pair, jnp.array([1.0, 0.0])).status

    assert int(status(jnp.array([0.5, 0.5]))) == CODE["impulse_not_unique"]
    assert int(status(jnp.array([0.5, 0.6]))) == CODE["several_outcomes"]
    scalar = ji.impact(ji.Poisson(0.5), pair, [1.0, 0.0])
    assert int(scalar.status) == CODE["impulse_not_unique"]


@pytest.mark.release
def test_poisson_with_friction():
    """Coulomb's law in both phases, on random planar scenes; compression is a plastic Moreau impact."""
    rng = np.random.default_rng(0)
    count, e_t = 64, 0.3
    v, mass = rng.normal(size=(count, 4)), rng.uniform(0.5, 2, (count, 4))
    normals, tangents = rng.normal(size=(2, count, 4, 2))
    e, mu = rng.uniform(size=(2, count, 2))

    @jax.jit
    @jax.vmap
    def run(mass, normals, tangents, v, e, mu):
        scene = ji.Scene(mass, normals, tangents=tangents)
        plastic = ji.impact(ji.Moreau(0.0, mu), scene, v)
        return ji.impact(ji.Poisson(e, mu, e_t), scene, v), plastic

    out, first = run(mass, normals, tangents, v, e, mu)
    assert not np.isin(
        out.status, [c for c, row in enumerate(ji.STATUS) if row.failure]
    ).any()
    expansion = out.impulse - first.impulse
    supplement = expansion - e * first.impulse
    side = out.tangential_impulse - first.tangential_impulse
    gamma = np.einsum("knm,kn->km", normals, out.velocity)
    slip = np.einsum("knm,kn->km", tangents, out.velocity + e_t * v)
    np.testing.assert_allclose(np.minimum(supplement, gamma), 0.0, atol=1e-12)
    assert (np.abs(side) <= mu * expansion + 1e-12).all()
    slides = np.abs(slip) > 1e-10
    np.testing.assert_allclose(
        (side + mu * expansion * np.sign(slip))[slides], 0.0, atol=1e-12
    )
    assert slides.any()
    assert not slides.all()


@pytest.mark.slow
def test_poisson_of_one_contact_in_space():
    """A sphere that does not roll: with e_t = 0 both phases together are Moreau's impact."""
    sphere = ji.Scene(np.ones(3), [[0.0], [0.0], [1.0]], tangents=np.eye(3)[:, :2])
    v = jnp.array([2.0, 0.5, -1.0])
    outcome = jax.jit(lambda law: ji.impact(law, sphere, v).velocity)
    for mu in (0.2, 5.0):
        expected = outcome(ji.Moreau(0.6, mu))
        np.testing.assert_allclose(outcome(ji.Poisson(0.6, mu)), expected, atol=1e-14)
    back = outcome(ji.Poisson(0.6, 5.0, 0.5))
    np.testing.assert_allclose(back, [-1.0, -0.25, 0.6], atol=1e-14)


# a chain whose v+ changes by 2 800 times as much as v-: its errors grow on the way
TOUCHY = (  # masses, e, k
    np.array([3.16708679, 2.57808882, 0.23471182, 4.50260497]),
    np.array([0.52428569, 0.10617625, 0.36288352]),
    np.array([0.028467902, 97.0572957, 37.9132260]),
)


@pytest.mark.parametrize(
    "dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)]
)
def test_ill_conditioned_is_reported_and_nothing_else_is(dtype):
    @jax.jit
    @jax.vmap
    def reported(masses, e, k, v):
        return ji.impact(
            ji.LZB(e, k, check_conditioning=True), ji.chain(masses), v
        ).status

    plain = [np.ones(4), np.full(3, 0.9), np.ones(3)]
    v = np.array([1.0, 0.0, 0.0, 0.0])
    args = [jnp.asarray(pair, dtype) for pair in zip((*TOUCHY, v), (*plain, v))]
    status = reported(*args)
    assert list(status) == [CODE["ill_conditioned"], CODE["ok"]]


@pytest.mark.release
def test_light_balls_with_gaps_and_knife_edges_are_right_or_reported():
    """Masses and stiffnesses over three decades behind gaps; gaps of 1e-8 that open and close."""
    rng, half = np.random.default_rng(0), 48
    masses = np.concatenate(
        [30.0 ** rng.uniform(-1, 1, (half, 4)), 3.0 ** rng.uniform(-1, 1, (half, 4))]
    )
    k = np.concatenate(
        [1e3 ** rng.uniform(-1, 1, (half, 3)), 10.0 ** rng.uniform(-1, 1, (half, 3))]
    )
    gaps = rng.choice([0.0, 1.0], (2 * half, 3)) * rng.uniform(0, 1, (2 * half, 3))
    gaps[:half] *= 0.5
    gaps[half:] *= 2e-8
    v = rng.normal(size=(2 * half, 4))

    def outcome(rtol, check):
        def one(masses, k, gaps, v):
            given = dict(rtol=rtol, max_steps=2000, check_conditioning=check)
            law = ji.Compliant(ji.LinearSpring(k), **given)
            return ji.impact(law, ji.chain(masses, gaps=gaps), v)

        return jax.jit(jax.vmap(one))(masses, k, gaps, v)

    got, exact = outcome(1e-8, True), outcome(1e-11, False)
    known = (got.status <= CODE["ill_conditioned"]) & (exact.status == 0)
    assert known.mean() > 0.9
    error = np.abs(got.velocity - exact.velocity).max(1) / np.abs(v).max(1)
    reported = got.status == CODE["ill_conditioned"]
    assert error[known & ~reported].max() < 10e-8
    assert reported.mean() < 0.05


@pytest.mark.slow
def test_derivatives_of_a_checked_outcome_are_those_of_the_plain_one():
    balls, v = ji.chain(np.ones(3)), jnp.array([1.0, 0.0, 0.0])

    def last(e, check):
        return ji.impact(ji.LZB(e, check_conditioning=check), balls, v).velocity[2]

    slopes = [
        jax.jit(jax.grad(lambda e, c=check: last(e, c))) for check in (False, True)
    ]
    plain, checked = (slope(jnp.array([0.9, 0.8])) for slope in slopes)
    np.testing.assert_allclose(plain, checked, rtol=1e-9)
