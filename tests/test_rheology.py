"""Contact forces one by one: restitution of a pair, bad input, calibration, material data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compliant_reference import viscous
from reference import chain_matrices
from scipy.optimize import brentq

from jimpact.impacts import impact
from jimpact.laws.calibration import calibrate, compare_rheologies, measured_restitution
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import (
    Bistiffness,
    Hertz,
    HuntCrossley,
    KelvinVoigt,
    KuwabaraKono,
    LinearSpring,
    UserForce,
)
from jimpact.laws.materials import hertz_stiffness, sphere_mass
from jimpact.plot.rheology import plot_rheologies
from jimpact.scene import chain
from jimpact.status import CODE

# name: (force of (k, damping), the same by numpy, its smooth sign)
FORCES = {
    "kelvin-voigt": (KelvinVoigt, lambda k, c: lambda x, u: k * x + c * u, None),
    "hunt-crossley": (
        HuntCrossley,
        lambda k, d: lambda x, u: k * np.maximum(x, 0) ** 1.5 * (1 + d * u),
        lambda k, d: lambda x, u: 1 + d * u,
    ),
    "kuwabara-kono": (
        KuwabaraKono,
        lambda k, a: lambda x, u: k * np.sqrt(np.maximum(x, 0)) * (x + 1.5 * a * u),
        lambda k, a: lambda x, u: x + 1.5 * a * u,
    ),
}
COMPILED = {}


def three(name):
    """(force of arrays, masses, v, gaps) -> outcome of three balls, compiled once a force."""

    def run(parameters, mass, v, gaps):
        out = impact(Compliant(FORCES[name][0](*parameters)), chain(mass, gaps=gaps), v)
        return out.velocity, out.energy_change, out.impulse, out.status

    return COMPILED.setdefault(name, jax.jit(jax.vmap(run)))


def draw(number=20, seed=1):
    rng = np.random.default_rng(seed)
    mass = 10 ** rng.uniform(-0.7, 0.7, (number, 3))
    v = np.sort(rng.normal(size=(number, 3)))[:, ::-1].copy()
    k, c = 10 ** rng.uniform(-1, 1, (number, 2)), 10 ** rng.uniform(-2, 0.5, (number, 2))
    closed = rng.uniform(size=(number, 2)) < 0.3
    gaps = np.where(closed, 0, 10 ** rng.uniform(-2, 1, (number, 2)))
    return k, c, mass, v, gaps


@pytest.mark.parametrize("name", FORCES)
def test_gapped_chains_against_scipy(name):
    """Forces that slacken at x > 0 and are loaded again, at any damping."""
    k, c, mass, v, gaps = draw()
    got, change, impulse, status = three(name)((jnp.array(k), jnp.array(c)), mass, v, gaps)
    _, force, onset = FORCES[name]
    for i in range(len(k)):
        expected = viscous(
            *chain_matrices(mass[i]),
            v[i],
            force(k[i], c[i]),
            gaps[i],
            onset=onset and onset(k[i], c[i]),
        )
        np.testing.assert_allclose(got[i], expected, atol=1e-6 * np.abs(v[i]).max())
    assert (np.asarray(status) == 0).all()
    assert (np.asarray(change) <= 0).all()  # energy is never gained
    assert (np.asarray(impulse) >= 0).all()  # and no contact pulls


def test_kelvin_voigt_in_closed_form():
    """Two undercritical regimes, the critical one and beyond, as a chain's own integration."""
    k, m = 2.0, 0.7
    zeta = np.array([0.01, 0.3, 0.65, 0.8, 0.99995, 1.0, 1.2, 3.0])
    c = 2 * zeta * np.sqrt(k * m)
    closed = measured_restitution(KelvinVoigt(k, c), m, 1.0)

    def integrated(c):
        out = impact(Compliant(KelvinVoigt(k, c), rtol=1e-11), chain([m], wall=True), [1.0])
        return -out.velocity[0]

    np.testing.assert_allclose(closed, jax.vmap(integrated)(c), atol=1e-9)
    beta, w0 = c[1] / 2 / m, np.sqrt(k / m)
    w = np.sqrt(w0**2 - beta**2)
    schwager = np.exp(-beta / w * (np.pi - np.arctan(2 * beta * w / (w**2 - beta**2))))
    assert float(closed[1]) == pytest.approx(schwager, rel=1e-13)
    assert float(closed[5]) == pytest.approx(np.exp(-2), rel=1e-13)


@pytest.mark.parametrize("e", [0.95, 0.5, 0.1])
def test_hunt_crossley_implicit_relation(e):
    """`d v (1 + e) = ln((1 + d v) / (1 - d e v))`, whatever the stiffness, exponent and mass."""

    def relation(a):
        return a * (1 + e) - np.log1p(a) + np.log1p(-a * e)

    a = brentq(relation, 1e-3, (1 - 1e-13) / e)
    speed = 2.5
    got = measured_restitution(HuntCrossley(3.0, a / speed), [0.2, 4.0], speed)
    np.testing.assert_allclose(got, e, atol=1e-9)
    assert float(calibrate(HuntCrossley(3.0, 0.0), e, 0.2, speed).damping) == pytest.approx(
        a / speed, rel=1e-7
    )


def test_kuwabara_kono_series():
    """`1 - e = 1.15344 a - 0.79827 a^2 + ...` with a = (3/2) A (k/m)^(2/5) v^(1/5), for small A.

    Ramirez, Poeschel, Brilliantov and Schwager (1999).
    """
    k, m, v = 3.0, 0.4, 2.0
    small = 1e-3
    damping = small / 1.5 / ((k / m) ** 0.4 * v**0.2)
    e = float(measured_restitution(KuwabaraKono(k, damping), m, v))
    assert 1 - e == pytest.approx(1.15344 * small - 0.79827 * small**2, rel=3e-5)


@pytest.mark.slow
def test_calibration_gives_what_it_was_asked_for():
    e = jnp.array([1.0, 0.97, 0.6, 0.08])
    for force in (KelvinVoigt(1e6, 0.0), HuntCrossley(1e9, 0.0), KuwabaraKono(1e9, 0.0)):
        found = calibrate(force, e, 2e-3, 0.3)
        assert type(found) is type(force)
        assert found.damping.shape == (4,)
        np.testing.assert_allclose(measured_restitution(found, 2e-3, 0.3), e, atol=1e-9)
    found = calibrate(Hertz(1.0), 0.4, 1.0, 1.0)
    assert float(found.restitution) == 0.4
    # a force measured at another speed has another coefficient: only the bistiffness keeps it
    slow = calibrate(KuwabaraKono(1e9, 0.0), 0.6, 2e-3, 0.3)
    assert float(measured_restitution(slow, 2e-3, 0.003)) > 0.75


@pytest.mark.parametrize(
    "force", [KelvinVoigt(2.0, 0.0), pytest.param(KuwabaraKono(2.0, 0.0), marks=pytest.mark.slow)]
)
def test_calibration_is_differentiable(force):
    def damping(e, m, v):
        return calibrate(force, e, m, v).damping

    at, h = (0.7, 1.3, 0.8), 1e-4
    forward = jax.jit(jax.jacfwd(damping, (0, 1, 2)))(*at)
    reverse = jax.jit(jax.jacrev(damping, (0, 1, 2)))(*at)
    value = jax.jit(damping)
    for i in range(3):
        up, down = ([z + s * h * (j == i) for j, z in enumerate(at)] for s in (1, -1))
        slope = (value(*up) - value(*down)) / (2 * h)
        assert float(forward[i]) == pytest.approx(float(slope), rel=1e-5, abs=1e-7)
        assert float(reverse[i]) == pytest.approx(float(forward[i]), rel=1e-9, abs=1e-12)


@pytest.mark.slow
def test_same_pair_restitution_other_chain():
    """e = 0.9 at every pair; the outcomes differ by a tenth of the striker's speed."""
    scene, v = chain(jnp.ones(3)), jnp.array([1.0, 0.0, 0.0])
    found = compare_rheologies(scene, v, 0.9)
    outcome = {name: np.asarray(e.outcome.velocity) for name, e in found.entries.items()}
    lzb = (-0.0086153561548806457087, 0.10414279851550412011, 0.9044725576393765256)
    np.testing.assert_allclose(outcome["Hertz, bistiffness"], lzb, atol=1e-7)
    lzb = (-0.06530458667907737467, 0.1671929515716750074, 0.89811163510740236727)
    np.testing.assert_allclose(outcome["linear, bistiffness"], lzb, atol=1e-7)
    spread = np.ptp(list(outcome.values()), axis=0)
    assert spread[0] > 0.08
    for e in found.entries.values():
        assert int(e.outcome.status) == 0
    figure = plot_rheologies(found)
    assert len(figure.axes) == 2
    assert len(figure.axes[0].lines) == 5


@pytest.mark.slow
def test_user_force_is_the_built_in_one():
    gaps = jnp.array([0.0, 0.2])
    user = UserForce(lambda x, rate, p: p["k"] * x + p["c"] * rate, {"k": 1.0, "c": 0.3})
    outcomes = [
        impact(Compliant(force), chain(jnp.ones(3), gaps=gaps), jnp.array([1.0, 0.0, 0.0]))
        for force in (user, KelvinVoigt(1.0, 0.3))
    ]
    np.testing.assert_allclose(outcomes[0].velocity, outcomes[1].velocity, atol=1e-8)


def test_forces_without_damping_are_elastic():
    v, gaps = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.1])
    args = (jnp.ones((1, 2)), jnp.zeros((1, 2))), jnp.ones((1, 3)), v[None], gaps[None]
    wanted = impact(Compliant(Hertz(1.0)), chain(jnp.ones(3), gaps=gaps), v).velocity
    for name in ("hunt-crossley", "kuwabara-kono"):
        args_of = jax.tree.map(lambda z: jnp.tile(z, (20, 1)), args)
        np.testing.assert_allclose(three(name)(*args_of)[0][0], wanted, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORCES)
def test_derivatives(name):
    """At a generic gapped state, in stiffness, damping, gaps and velocity; both modes."""
    k, c, mass, v, gaps = (jnp.asarray(z[3]) for z in draw())

    def velocity(theta):
        k, c, gaps, v = theta
        law = Compliant(FORCES[name][0](k, c), rtol=1e-10)
        return impact(law, chain(mass, gaps=gaps), v).velocity

    at = (k, c, gaps, v)
    rng = np.random.default_rng(0)
    along = jax.tree.map(lambda z: jnp.asarray(rng.normal(size=z.shape)) * jnp.abs(z), at)
    _, rate = jax.jit(lambda d: jax.jvp(velocity, (at,), (d,)))(along)
    f = jax.jit(lambda s: velocity(jax.tree.map(lambda z, d: z + s * d, at, along)))
    h = 1e-4
    np.testing.assert_allclose(rate, (f(h) - f(-h)) / (2 * h), atol=1e-5)
    weight = jnp.array([0.3, -1.0, 0.7])
    back = jax.jit(lambda: jax.vjp(velocity, at)[1](weight))()[0]
    total = sum(float(jnp.sum(a * b)) for a, b in zip(back, along))
    assert total == pytest.approx(float(weight @ rate), rel=1e-8)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, rate, _: x * jnp.nan,
        lambda x, rate, _: jnp.sqrt(0.1 - x),  # no value where the impact is deepest
    ],
)
def test_a_user_force_without_a_value_is_flagged(function):
    out = impact(Compliant(UserForce(function)), chain([1.0, 1.0]), [1.0, 0.0])
    assert int(out.status) == CODE["not_finite"]


def test_a_user_force_that_pulls_is_cut():
    """Adhesion is not offered: a force below 0 counts as 0, so that no impulse is negative."""
    sticky = UserForce(lambda x, rate, _: x - 0.05)
    out = impact(Compliant(sticky), chain([1.0, 1.0]), [1.0, 0.0])
    assert float(out.impulse[0]) > 0
    assert float(out.energy_change) == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: KelvinVoigt(1.0, -0.1), "damping"),
        (lambda: HuntCrossley(0.0, 0.1), "stiffness"),
        (lambda: KuwabaraKono(jnp.nan, 0.1), "stiffness"),
        (lambda: HuntCrossley(1.0, 0.1, 0.5), "exponent"),
        (lambda: Bistiffness(1.0, 0.9), "exponent"),
        (lambda: Bistiffness(1.0, 1.5, 1.2), "restitution"),
        (lambda: LinearSpring("hard"), "stiffness"),
        (lambda: UserForce(3.0), "function"),
        (lambda: UserForce(lambda x, rate, p: x, "hard"), "parameters"),
        (
            lambda: impact(Compliant(KelvinVoigt(1.0, [0.1, 0.2])), chain([1.0, 1.0]), [1.0, 0.0]),
            "damping",
        ),
        (lambda: calibrate(KelvinVoigt(1.0, 0.0), 0.01, 1.0, 1.0), "restitution"),
        (lambda: calibrate(KelvinVoigt(1.0, 0.0), 0.5, -1.0, 1.0), "mass"),
        (lambda: calibrate(UserForce(lambda x, rate, p: x), 0.5, 1.0, 1.0), "force"),
        (lambda: measured_restitution(Hertz(1.0), 1.0, 0.0), "speed"),
        (lambda: hertz_stiffness(-1.0, 0.3, 1.0), "modulus"),
        (lambda: hertz_stiffness(1.0, 0.6, 1.0), "poisson"),
        (lambda: hertz_stiffness(1.0, 0.3, 1.0, radius2=0.0), "radius2"),
    ],
)
def test_bad_input(make, name):
    with pytest.raises((ValueError, TypeError), match=f"`{name}"):
        make()


def test_hertz_stiffness_of_the_steel_beads():
    """8 mm beads, E = 216 GPa, nu = 0.276: the constants of the bead column within 0.02 %."""
    radius = 4e-3
    assert float(hertz_stiffness(21.6e10, 0.276, radius)) == pytest.approx(6.97089e9, rel=1e-6)
    assert float(hertz_stiffness(21.6e10, 0.276, radius)) == pytest.approx(6.9716e9, rel=2e-4)
    plane = hertz_stiffness(21.6e10, 0.276, radius, radius2=np.inf)
    assert float(plane) == pytest.approx(9.85833e9, rel=1e-6)
    rigid = hertz_stiffness(21.6e10, 0.276, radius, np.inf, 0.276, np.inf)
    assert float(rigid) == pytest.approx(2 * float(plane), rel=1e-12)
    assert float(sphere_mass(7650.0, radius)) == pytest.approx(2.05e-3, rel=1e-3)
