"""Inputs that gave a wrong answer, with the right one. Each stands for its kind."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji


def status_of(out):
    return ji.STATUS[int(out.status)].name


def row_of_points(heights, columns):
    """A flat planar body (x, z, turn) on some columns; beside it points that only fall."""
    n = 3 + heights
    normals, tangents = (
        np.zeros((n, len(columns) + heights)),
        np.zeros((n, len(columns) + heights)),
    )
    for j, x in enumerate(columns):
        normals[:3, j], tangents[:3, j] = (0, 1, x), (1, 0, 0.1)
    for j in range(heights):
        normals[3 + j, len(columns) + j] = 1  # cannot slide: its tangent is 0
    return ji.Scene(np.r_[1, 1, 0.0067, np.ones(heights)], normals, tangents)


N_EDGE = np.array([[0, 0, 1, 0.2, -0.15, 0], [0, 0, 1, 0.2, 0.15, 0]]).T
H_EDGE = np.array(
    [[1, 0, 0, 0, -0.25, -0.2], [0, 1, 0, 0.25, 0, 0.15], [1, 0, 0, 0, -0.25, -0.2], [0, 1, 0, 0.25, 0, -0.15]]
).T  # fmt: skip
BRICK = np.array([1.3, 1.3, 1.3, 0.05, 0.04, 0.03])
THROWN = np.array([0.3, 0.2, -1, 1.2, -0.4, 0.7])


@pytest.mark.release
@pytest.mark.parametrize(
    "law", [ji.LZB(0.7, [1.0, 1.7]), ji.Compliant(ji.HuntCrossley([1e4, 1.7e4], 0.4))]
)
def test_tangents_without_friction_change_nothing(law):
    plain = ji.impact(law, ji.Scene(BRICK, N_EDGE), THROWN).velocity
    scene = ji.Scene(BRICK, N_EDGE, H_EDGE)
    np.testing.assert_allclose(ji.impact(law, scene, THROWN).velocity, plain, atol=2e-8)
    jax.hessian(lambda s: ji.impact(law, scene, s * THROWN).velocity[2])(1.0)


@pytest.mark.slow
def test_an_elastic_impact_on_four_corners_without_friction():
    """v+ = -v-: in closed form."""
    box = ji.Box([0.75] * 3, 3.0, [0.5] * 3)
    scene, v = box.scene(box.touching()), [0.0, 0, -2, 0, 0, 0]
    out = ji.impact(ji.LZB(1.0, 1.0), scene, v)
    np.testing.assert_allclose(out.velocity[2], 2.0, atol=2e-8)
    assert "VIOLATED" not in ji.summary(out, scene, v)


@pytest.mark.slow
def test_one_outcome_is_not_several():
    """A ball between the nose of a cushion and the cloth: 40 starts of an independent iteration agree."""
    m, r, up = 0.14, 0.026, 0.4
    side, inertia = np.sqrt(1 - up**2), 0.4 * m * r * r

    def rates(lever):
        x, y, z = lever
        return np.array(
            [[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]], float
        )

    nose, cloth = rates(r * np.array([0, side, up])), rates(r * np.array([0, 0, -1.0]))
    normals = np.stack(
        [np.array([0, -side, -up]) @ nose, np.array([0, 0, 1.0]) @ cloth], 1
    )
    along_nose = np.array([[1, 0, 0], [0, -up, side]]) @ nose
    tangents = np.concatenate([along_nose, np.eye(3)[:2] @ cloth]).T
    scene = ji.Scene([m, m, m, inertia, inertia, inertia], normals, tangents)
    v = np.array([1.2, 1.2, 0, -1.2 / r, 1.2 / r, 0])
    out = ji.impact(ji.Poisson([0.98, 0.0], friction=[0.14, 0.212]), scene, v)
    assert status_of(out) == "ok"


def test_restitution_of_a_force_whose_parameters_are_one_array():
    force = ji.UserForce(
        lambda x, rate, p: p[0] * x + p[1] * rate, jnp.array([1.0, 0.2])
    )
    assert float(ji.measured_restitution(force, 1.0, 1.0)) == pytest.approx(
        0.74408, abs=1e-5
    )


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: ji.Compliant(stiffness=1e9), "force"),
        (lambda: ji.LZB(e=0.9), "restitution"),
    ],
)
def test_arguments_that_a_law_does_not_take(make, word):
    with pytest.raises(TypeError, match=f"takes .*`{word}`"):
        make()


def test_programs_of_batches_call_no_lapack():
    """Their eliminations are written out: a batch runs alike on any number of cores."""
    scene = row_of_points(0, (-0.1, 0.1))
    law = ji.Moreau(0.5, friction=0.3)
    batch = jax.jit(jax.vmap(lambda v: ji.impact(law, scene, v).velocity))
    assert "lapack" not in batch.lower(np.ones((300, 3))).as_text()


def test_impulses_that_wedge_do_not_hide_their_errors():
    """Three bodies in the plane, five contacts, mu = 5: least impulses once grew to 1e11 N s."""
    mass = [1.94, 1.94, 0.4, 0.76, 0.76, 0.27, 1.9, 1.9, 0.52]
    normals = [
        [-0.62, 0, -1, 1, -0.59], [-0.78, 0, -0.01, 0.06, 0.81], [0.26, 0, 0.15, -0.49, -0.27],
        [0, 0.4, 0, 0, 0.59], [0, -0.92, 0, 0, -0.81], [0, 0.15, 0, 0, -0.27],
        [0.62, -0.4, 1, -1, 0], [0.78, 0.92, 0.01, -0.06, 0], [0.2, 0.06, -0.11, -0.39, 0],
    ]  # fmt: skip
    tangents = [
        [-0.78, 0, -0.01, 0.06, 0.81], [0.62, 0, 1, -1, 0.59], [0.13, 0, 0.09, 0.14, 0.09],
        [0, -0.92, 0, 0, -0.81], [0, -0.4, 0, 0, -0.59], [0, -0.38, 0, 0, -0.35],
        [0.78, 0.92, 0.01, -0.06, 0], [-0.62, 0.4, -1, 1, 0], [-0.34, 0.2, 0.42, -0.34, 0],
    ]  # fmt: skip
    scene = ji.Scene(mass, np.array(normals), tangents=np.array(tangents))
    v = [-0.94, -0.66, -0.41, 0.77, -0.79, 0.89, -0.26, -0.36, 1.29]
    out = ji.impact(ji.Moreau(0.0, friction=5.0), scene, v)
    assert ji.STATUS[int(out.status)].name == "impulse_not_unique"
    assert float(out.impulse.max()) < 10
    stick, rates = np.array([0, 2, 3]), np.array(normals).T @ out.velocity
    np.testing.assert_allclose(rates[stick], 0, atol=1e-12)
    np.testing.assert_allclose(
        (np.array(tangents).T @ out.velocity)[stick], 0, atol=1e-12
    )
    assert (rates[np.array([1, 4])] > 0.5).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene", [ji.Disc(0.1).scene(), ji.Box((1.0, 1.0, 1.0)).scene()]
)
def test_contacts_without_friction_do_not_stick(scene):
    """A friction of 0 holds nothing, also where nothing slips: the slope was that of sticking."""
    strike = -np.eye(scene.size)[{3: 1, 6: 2}[scene.size]]  # downwards
    slope = jax.jacfwd(lambda v: ji.impact(ji.Moreau(0.5, 0.0), scene, v).velocity)(
        strike
    )
    np.testing.assert_allclose(slope[0], np.eye(scene.size)[0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("levers", [[0.1], [0.1, -0.2]])
def test_restitution_of_poisson_begins_at_0(levers):
    """At e = 0 expansion acted on what rounding had left of compression: slopes of sliding."""
    m = len(levers)
    normals, tangents = (
        np.array([[0] * m, [1] * m, levers]),
        np.array([[1], [0], [-0.5]]),
    )
    scene = ji.Scene([1.0, 1.0, 0.2], normals, tangents=np.tile(tangents, (1, m)))

    def after(e):
        return ji.impact(ji.Poisson(e, friction=0.8), scene, [0.0, -1.0, 0.0]).velocity

    difference = (after(1e-6) - after(0.0)) / 1e-6
    np.testing.assert_allclose(jax.jacfwd(after)(0.0), difference, atol=1e-8)


@pytest.mark.slow
def test_friction_of_many_contacts_in_single_precision_batches():
    """Each lane is what it is by itself, and what double precision gives."""
    bodies = ji.Bodies([ji.Block(1.0, 1.0), ji.Block(1.0, 1.0)])
    double = bodies.scene([0.0, 0.5, 0.0, 0.1, 1.5, 0.0]), ji.Moreau(0.3, friction=0.4)
    velocities = np.random.default_rng(0).normal(size=(64, 6)).astype(np.float32)
    scene, law = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32) if eqx.is_inexact_array(x) else x, double
    )
    after = jax.vmap(lambda v: ji.impact(law, scene, v).velocity)(velocities)
    assert after.dtype == jnp.float32
    for v, lane in zip(velocities[:8], after):
        np.testing.assert_allclose(lane, ji.impact(law, scene, v).velocity, atol=1e-4)
        np.testing.assert_allclose(
            lane, ji.impact(double[1], double[0], v.astype(float)).velocity, atol=1e-4
        )


def test_contacts_of_no_restitution_that_turn_at_once_have_no_slopes():
    """They were those of one order of two: of no direction. Away from it they are right."""
    block = ji.Block(1.2, 1.7, corners="base").scene()
    law = ji.LZB([0.0, 0.0], [1.0, 1.0])

    def after(v):
        return ji.impact(law, block, v).velocity

    flat, tilting = jnp.array([0.2, -1.0, 0.0]), jnp.array([0.2, -1.0, 0.4])
    assert np.isfinite(after(flat)).all()
    slopes = jax.jit(jax.jacfwd(after))
    assert np.isnan(slopes(flat)).all()
    ahead = np.array([0.1, 0.3, -0.2])
    difference = (after(tilting + 1e-5 * ahead) - after(tilting - 1e-5 * ahead)) / 2e-5
    np.testing.assert_allclose(slopes(tilting) @ ahead, difference, atol=1e-6)


@pytest.mark.slow
def test_slopes_by_steps_of_contacts_that_share_one_tangent():
    """Directions in which only one of two redundant contacts slips were amplified."""
    block = ji.Block(1.0, 1.5, corners="base").scene()

    def slopes(method, rtol):
        def after(v):
            law = ji.LZB(0.4, [1.0, 1.3], friction=0.35, method=method, rtol=rtol)
            return ji.impact(law, block, v).velocity

        return jax.jacfwd(after)(jnp.array([0.1, -1.0, 0.0]))

    np.testing.assert_allclose(
        slopes("implicit", 1e-7), slopes("time", 1e-9), atol=2e-3
    )


def slopes_of_balls(force, gap, method="time"):
    """Slopes of v+ in a velocity of two balls of three, and their differences."""
    scene = ji.chain([1.0, 1.2, 0.9], gaps=[0.0, gap])

    def after(z):
        law = ji.Compliant(force, method=method)
        return ji.impact(law, scene, jnp.stack([1.0 + z, z, 0.0])).velocity

    return jax.jacfwd(after)(0.0), (after(1e-4) - after(-1e-4)) / 2e-4


def test_a_force_that_begins_with_a_jump_at_rest_has_no_slopes():
    """Whether the balls at rest part depends on the direction; behind a gap it does not."""
    jumps = ji.UserForce(lambda x, rate, k: k * x + 0.04, 1.0)
    slopes, difference = slopes_of_balls(jumps, 0.02)
    np.testing.assert_allclose(slopes, difference, atol=1e-6)
    assert np.isnan(slopes_of_balls(jumps, 0.0)[0]).all()


@pytest.mark.parametrize("force", [ji.KelvinVoigt(1.0, 0.3), ji.HuntCrossley(1.0, 0.3)])
def test_slopes_by_steps_across_a_jump_are_not_given(force):
    """Steps do not move with the instant of closing: slopes were off by some percent."""
    slopes, _ = slopes_of_balls(force, 0.02, "implicit")
    if isinstance(force, ji.KelvinVoigt):
        assert np.isnan(slopes).all()
    else:
        np.testing.assert_allclose(slopes, slopes_of_balls(force, 0.02)[0], atol=2e-3)
