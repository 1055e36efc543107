"""Method 'implicit': impacts by steps without events, of `LZB` and `Compliant`."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from implicit_cases import pressed
from programs import CODE
from refusals import argument
from spatial_scenes import INPUTS, random_boxes

import jimpact as ji

# v+ by method 'time' at rtol 1e-11, k = 1, eta = 1.5, mu = .3, by name and e
EDGE = [
    0.7057231279,
    0.3448930544,
    0.0365790838,
    -2.9887916746,
    -0.3493685294,
    -0.0909271875,
]


FLAT = [
    0.6299348115,
    0.1993363367,
    0.2798615911,
    0.0212017465,
    -0.394785253,
    0.0517198202,
]


EVENT_BY_EVENT = {
    ("edge", 0.3): EDGE,
    ("edge", 0.0): [
        0.7669362833,
        0.3074755598,
        -0.2007867887,
        -2.4982569377,
        0.0,
        -0.1149629959,
    ],
    ("flat", 0.3): FLAT,
    ("flat", 0.0): [0.7126974225, 0.2149277049, 0.0, 0.0, 0.0, 0.0798893306],
}


# of a box on a corner at e = mu = .3: d v+ / d (e, mu)
CORNER_JACOBIAN = [
    [-0.15552754376, -0.85593442434],
    [0.01648494272, -0.01323109553],
    [0.52132917949, 0.65157966400],
    [-1.09477701996, -0.96566689232],
    [-1.59569569688, 3.48455862744],
    [-0.00642955078, -0.86463167619],
]


DEFAULT_RTOL = 1e-5  # of the method, in the fastest approach


TIGHT = 1e-6


@pytest.mark.release
def test_agrees_with_the_method_that_stops_at_every_event():
    """Two and four corners, e = 0 included: right to the tolerance asked for."""
    for (name, e), expected in EVENT_BY_EVENT.items():
        scene, v = pressed(name)
        law = ji.LZB(e, 1.0, 1.5, friction=0.3, method="implicit", rtol=TIGHT)
        out = ji.impact(law, scene, v)
        error = np.abs(np.asarray(out.velocity) - expected).max()
        assert out.status == 0
        assert error < 1.5 * TIGHT * np.abs(v).max(), (name, e, error)


SLIDES_OR_ROLLS = [(0.5, 0.1, False), (0.5, 1.0, True), (0.0, 0.3, True)]


@pytest.mark.parametrize(("e", "mu", "rolls"), SLIDES_OR_ROLLS)
def test_a_ball_slides_or_rolls(e, mu, rolls):
    """One contact whose friction does not change its normal force: closed forms."""
    arm = np.array([0.0, 0.0, -1.0])
    mass = np.diag([1.0, 1.0, 1.0, 0.4, 0.4, 0.4])
    rows = np.array([[*np.eye(3)[i], *np.cross(arm, np.eye(3)[i])] for i in range(3)])
    scene = ji.Scene(mass, rows[2:].T, rows[:2].T)
    law = ji.LZB(e, 2.0, 1.5, friction=mu, method="implicit")
    out = ji.impact(law, scene, [0.6, 0.8, -1.0, 0.0, 0.0, 0.0])
    speed = 5 / 7 if rolls else 1 - mu * (1 + e)
    expected = np.array([0.6 * speed, 0.8 * speed, e])
    np.testing.assert_allclose(out.velocity[:3], expected, atol=2 * DEFAULT_RTOL)
    assert out.energy_change < 0


@pytest.mark.slow
def test_forces_gaps_and_exponents():
    """Three balls with a gap: v+ by method 'time', for forces of each kind."""
    scene = ji.chain([1.0, 1.0, 1.0], gaps=[0.0, 0.1])
    cases = [
        (ji.Hertz(1.0), [-0.04134429, 0.04313068, 0.9982136]),
        (ji.KelvinVoigt(2.0, 0.5), [0.07501565, 0.27741732, 0.64756704]),
        (
            ji.Bistiffness(1.0, jnp.array([1.3, 1.7]), 0.6),
            [0.171364, 0.18514237, 0.64349363],
        ),
    ]
    for force, expected in cases:
        out = ji.impact(ji.Compliant(force, method="implicit"), scene, [1.0, 0.0, 0.0])
        np.testing.assert_allclose(out.velocity, expected, atol=1.5 * DEFAULT_RTOL)
        assert out.status == 0
    far = ji.chain([1.0, 1.0, 1.0], gaps=[0.0, 10.0])  # one pair after the other
    out = ji.impact(
        ji.Compliant(ji.Hertz(1.0), method="implicit"), far, [1.0, 0.0, 0.0]
    )
    np.testing.assert_allclose(out.velocity, [0.0, 0.0, 1.0], atol=1.5 * DEFAULT_RTOL)


def test_derivatives():
    """One contact, no friction: v+ = -e v-, also in e at e = 0. Second derivatives raise."""
    ball = ji.chain([1.0], wall=True)

    def after(e):
        return ji.impact(ji.LZB(e, 1.0, 1.5, method="implicit"), ball, [1.0]).velocity[
            0
        ]

    assert jax.jacfwd(after)(0.0) == pytest.approx(-1.0, abs=5e-4)
    with pytest.raises(NotImplementedError, match=argument("method", "'implicit'")):
        jax.hessian(after)(0.5)


@pytest.mark.slow
def test_derivatives_with_friction():
    """Those of the event-aligned method, for a box on a corner."""
    scene, v = pressed("corner")

    def after(parameters):
        e, mu = parameters
        law = ji.LZB(e, 1.0, 1.5, friction=mu, method="implicit")
        return ji.impact(law, scene, v).velocity

    forward = jax.jacfwd(after)(jnp.array([0.3, 0.3]))
    np.testing.assert_allclose(forward, CORNER_JACOBIAN, atol=5e-4)


@pytest.mark.release
def test_reverse_mode_is_the_forward_one():
    """Of a box on an edge, in its mass matrix: so many numbers that steps are walked back."""
    scene, v = pressed("edge")

    def total(mass):
        law = ji.LZB(0.3, 1.0, 1.5, friction=0.3, method="implicit")
        return ji.impact(
            law, ji.Scene(mass, scene.normals, scene.tangents), v
        ).velocity.sum()

    change = jnp.asarray(np.random.default_rng(0).normal(size=(6, 6)))
    change = change + change.T
    _, forward = jax.jit(lambda m: jax.jvp(total, (m,), (change,)))(scene.mass)
    gradient = jax.jit(jax.grad(total))(scene.mass)
    assert jnp.sum(gradient * change) == pytest.approx(float(forward), rel=1e-8)


@pytest.mark.release
@pytest.mark.parametrize("contacts", [1, 2, 4])
def test_agrees_with_an_independent_integration(contacts):
    """Boxes and the measured cube, mu up to 1, by regularized friction (see space_reference.py)."""
    path = Path(__file__).parents[1] / "held" / "friction_space.npz"
    with np.load(path) as file:
        held = {name[:-2]: file[name] for name in file if name.endswith(f"_{contacts}")}

    def one(mass, normals, tangents, v, e, mu, k):
        law = ji.LZB(e, k, 1.5, friction=mu, method="implicit", rtol=TIGHT)
        return ji.impact(law, ji.Scene(mass, normals, tangents), v)

    out = jax.jit(jax.vmap(one))(*(held[name] for name in INPUTS))
    assert not np.asarray(out.status).any()
    error = np.abs(out.velocity - held["after"]).max(axis=1)
    speed = np.abs(held["velocity"]).max(axis=1)
    assert (error <= 3 * TIGHT * speed + 3 * held["uncertainty"]).all(), error


@pytest.mark.slow
def test_history_is_that_of_the_other_method():
    """Force, indentation, duration and end of an impact of two contacts, frozen from 'time'."""
    law = ji.LZB([0.9, 0.8], [1.0, 0.5], 1.5, method="implicit", rtol=1e-7)
    h = ji.history(law, ji.chain([1.0, 2.0, 3.0]), [1.0, 0.0, 0.0], samples=6)
    np.testing.assert_allclose(h.maximum_force, [0.89726283, 0.54923729], rtol=1e-3)
    np.testing.assert_allclose(h.force[1:3, 0], [0.85873828, 0.17296348], rtol=2e-2)
    np.testing.assert_allclose(
        h.velocity[-1], [-0.27931205, -0.04382761, 0.45565576], atol=1e-6
    )
    assert h.status == 0
    assert h.force[-1, 0] == 0


@pytest.mark.slow
def test_random_boxes_end():
    """Boxes nearly flat on four corners, mu up to 1.5, e from 0 to 1: every impact ends, lossy."""
    draw = random_boxes("nearly flat", 16)

    def one(mass, normals, tangents, v, e, mu):
        law = ji.LZB(e, 1.0, 1.5, friction=mu, method="implicit", rtol=1e-4)
        return ji.impact(law, ji.Scene(mass, normals, tangents), v)

    out = jax.jit(jax.vmap(one))(*draw)
    assert not np.asarray(out.status).any()
    size = np.abs(draw.velocity).max(axis=1) ** 2
    assert (np.asarray(out.energy_change) < 1e-3 * size).all()


def test_what_does_not_end_says_so():
    """Too few steps: `max_steps`, which names the method that ends where contacts jam."""
    scene, v = pressed("edge")
    law = ji.LZB(0.3, 1.0, 1.5, friction=0.3, method="implicit", max_steps=5)
    out = ji.impact(law, scene, v)
    assert int(out.status) == CODE["max_steps"]
    with pytest.raises(RuntimeError, match="try method='implicit'"):
        ji.raise_on_failure(out)
