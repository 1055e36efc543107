"""Products of matrices have the precision of their numbers, whatever JAX's default is.

On accelerators JAX multiplies float32 matrices with 10 bits by default. Without one, the lowered
program still says which precision a product asks for: of laws and motions in both modes and of small
functions here, of fits, batches, Monte Carlo, comparisons and tracks in test_programs.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import below_highest

import jimpact as ji

BODY = ji.Scene(
    np.diag([1.3, 1.2, 1.1]) + 0.1,
    np.array([[1.0, 0.2, 0.1], [0.1, 1.0, 0.3], [0.2, 0.1, 1.0]]),
)
PLANAR = ji.Block(0.3, 0.4, 1.3).scene([0.0, 0.2, 0.0])
BOX = ji.Box([0.3, 0.4, 0.5], mass=1.3)
VELOCITY = jnp.array([-1.0, -0.4, -0.7])
IN_SPACE = jnp.array([0.3, 0.2, -1.0, 1.2, -0.4, 0.7])

LAWS = {
    "newton": lambda e: ji.Newton(e),
    "moreau": lambda e: ji.Moreau(e),
    "poisson": lambda e: ji.Poisson(e),
    "routh": lambda e: ji.Routh(e),
    "binary": lambda e: ji.Binary(e),
    "correlation": lambda e: ji.ImpulseCorrelation(e, ratio=0.1),
    "matrix": lambda e: ji.RestitutionMatrix(e * jnp.eye(3)),
    "velocity": lambda e: ji.VelocityDependent(ji.Moreau(e), speed_exponent=0.25),
    "lzb": lambda e: ji.LZB(e, [1.0, 2.0, 3.0]),
    "compliant": lambda e: ji.Compliant(ji.Bistiffness([1e4, 2e4, 3e4], 1.5, e)),
}
WITH_SLOPES = ("newton", "poisson", "matrix", "lzb")  # their code is that of the others
WITH_FRICTION = {
    "moreau": lambda e: ji.Moreau(e, friction=0.3),
    "poisson": lambda e: ji.Poisson(e, friction=0.3),
    "lzb": lambda e: ji.LZB(e, 1.0, friction=0.3),
}


def coarse_products(function, *args):
    """The products of a lowered program that ask for less than the highest precision."""
    return list(below_highest(jax.jit(function).lower(*args).as_text()))


def after(law, scene):
    def velocity(e, v):
        return ji.impact(law(e), scene, v).velocity

    return velocity


def slopes(function):
    """Values, and derivatives in both modes."""

    def all_three(e, v):
        return function(e, v), jax.jacfwd(function)(e, v), jax.jacrev(function, 1)(e, v)

    return all_three


def test_a_coarse_product_is_seen():
    assert coarse_products(lambda a: a @ a, jnp.eye(3))


@pytest.mark.parametrize("name", LAWS)
def test_laws(name):
    function = after(LAWS[name], BODY)
    whole = slopes(function) if name in WITH_SLOPES else function
    assert not coarse_products(whole, jnp.array(0.6), VELOCITY)


@pytest.mark.release
@pytest.mark.parametrize(
    ("name", "scene"),
    [("poisson", "plane"), ("lzb", "plane"), ("moreau", "space"), ("lzb", "space")],
)
def test_laws_with_friction(name, scene):
    at, v = (
        (PLANAR, VELOCITY)
        if scene == "plane"
        else (BOX.scene(BOX.touching()), IN_SPACE)
    )
    assert not coarse_products(
        slopes(after(WITH_FRICTION[name], at)), jnp.array(0.6), v
    )


MOTIONS = {
    "events": (ji.LZB, {"method": "events"}),
    "time_stepping": (ji.Moreau, {"method": "time_stepping", "step": 0.01}),
    "contact_forces": (
        lambda e, friction: ji.Compliant(
            ji.Bistiffness(1e4, 1.5, e), friction=friction
        ),
        {"method": "contact_forces"},
    ),
}


@pytest.mark.parametrize(
    "method",
    [
        pytest.param("events", marks=pytest.mark.release),
        "time_stepping",
        pytest.param("contact_forces", marks=pytest.mark.release),
    ],
)
def test_motions(method):
    law, options = MOTIONS[method]
    block = ji.Block(0.3, 0.4, 1.3)
    system = ji.System(block, gravity=True)

    def end(e, v):
        motion = ji.simulate(
            system, law(e, friction=0.3), [0.0, 0.3, 0.1], v, 0.2, samples=2, **options
        )
        return motion.q[-1]

    if method == "time_stepping":
        assert not coarse_products(end, jnp.array(0.6), VELOCITY)
    else:
        assert not coarse_products(
            lambda e, v: jax.jvp(end, (e, v), (e, v)), jnp.array(0.6), VELOCITY
        )


def test_what_surrounds_an_impact():
    def all_of(v):
        out = ji.impact(ji.Moreau(0.5), BODY, v)
        return (
            ji.kinetic_energy(BODY, v),
            ji.momentum(BODY, v),
            ji.velocity_change(BODY, out.impulse),
            ji.delassus_matrix(BODY),
            ji.theory.normalized_gap_velocity(BODY, v),
            ji.history(ji.LZB(0.6, 1.0), BODY, v).force,
            ji.theory.to_quasi_velocities(BODY, v),
        )

    assert not coarse_products(all_of, VELOCITY)


def test_bodies():
    def all_of(q, v):
        return BOX.gap_function(q), BOX.scene(q).normals, BOX.scene(q).tangents

    assert not coarse_products(all_of, BOX.touching(), IN_SPACE)
