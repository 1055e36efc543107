"""Scenes of bodies: kinetic angles, gaps and tangents against mechanics, chains, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.theory.rocking import housner_restitution, rocking_matrix

# kinetic angle of two contacts: 40-digit values
BLOCK_ANGLES = {
    1e-9: np.pi / 3,
    0.5: 1.14640661820171004,
    1.0: 1.36943840600456583,
    np.sqrt(2.0): np.pi / 2,
    2.0: 1.82347658193697527,
    3.0: 2.13940662705907887,
}
DIMER_ANGLES = {
    0.0: 1.44546849562683122,
    5 / 24: 1.42420445174657522,
    1e12: 1.53630673083321779,
}


def angle_of(scene):
    return float(ji.kinetic_angles(scene)[0, 1])


def dense(scene):
    mass = np.asarray(scene.mass)
    return np.diag(mass) if mass.ndim == 1 else mass


# ------------------------------------------------------------------------------ kinetic angles


def test_kinetic_angles_of_blocks():
    for aspect, angle in BLOCK_ANGLES.items():
        scene = ji.rocking_block(width=2.0, height=2 * aspect, mass=3.0)
        g = float(ji.normalized_delassus(scene)[0, 1])
        assert abs(g - (aspect**2 - 2) / (aspect**2 + 4)) < 1e-14
        assert abs(angle_of(scene) - angle) < 1e-10
        assert np.array_equal(scene.gaps, [0.0, 0.0])


def test_kinetic_angles_of_dimers():
    for ratio, angle in DIMER_ANGLES.items():
        assert abs(angle_of(ji.dimer(radius=2 * ratio, length=2.0)) - angle) < 1e-10
    scene = ji.dimer(radius=5 / 24, length=1.0)
    assert abs(float(ji.normalized_delassus(scene)[0, 1]) + 13 / 89) < 1e-14

    def cosine(ratio):
        return ji.normalized_delassus(ji.dimer(ratio, 1.0))[0, 1]  # -cos(theta_12)

    # least angle at R / L = 5/24: the slope vanishes and rises
    slope = jax.jit(jax.vmap(jax.grad(cosine)))(jnp.array([0.2, 5 / 24, 0.22]))
    assert abs(float(slope[1])) < 1e-12
    assert float(slope[0]) < -1e-3 < 1e-3 < float(slope[2])


def test_kinetic_angle_of_a_corner_is_its_angle():
    for angle in (0.1, 1.2, 3.0):
        assert abs(angle_of(ji.corner(angle, mass=2.0)) - angle) < 1e-14


def test_kinetic_angles_around_a_disk():
    phi, masses, m0 = np.array([0.3, 1.9, -2.0]), np.array([0.5, 0.7, 2.0]), 1.5
    scene = ji.disk_balls(phi, masses, m0, disk_radius=0.3, ball_radius=[0.1, 0.2, 0.1])
    g = np.cos(phi[:, None] - phi) / np.sqrt((1 + m0 / masses)[:, None] * (1 + m0 / masses))
    away = ~np.eye(3, dtype=bool)
    np.testing.assert_allclose(np.asarray(ji.normalized_delassus(scene))[away], g[away], atol=1e-14)


def test_opposite_balls_are_a_chain():
    scene, chain = ji.disk_balls([np.pi, 0.0], [1.0, 3.0], 2.0), ji.chain([1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        ji.delassus_matrix(scene), ji.delassus_matrix(chain).as_matrix(), atol=1e-14
    )
    off = ji.disk_balls([np.pi, 0.0], gaps=[0.0, 0.25])
    np.testing.assert_allclose(off.gaps, [0.0, 0.25], atol=1e-12)
    assert off.closed.tolist() == [True, False]


# ---------------------------------------------------------------- gaps and tangents of the block


def test_block_away_from_rest():
    """Equation of moments: each corner's lever arms, at an angle."""
    width, height, angle = 1.5, 2.0, 0.3
    scene = ji.rocking_block(width, height, mass=2.0, angle=angle)
    s, c = np.sin(angle), np.cos(angle)
    np.testing.assert_allclose(scene.gaps, [width * s, 0.0], atol=1e-15)
    normals = [[0, 0], [1, 1], [height / 2 * s + width / 2 * c, height / 2 * s - width / 2 * c]]
    tangents = [[1, 1], [0, 0], [height / 2 * c - width / 2 * s, height / 2 * c + width / 2 * s]]
    np.testing.assert_allclose(scene.normals, normals, atol=1e-15)
    np.testing.assert_allclose(scene.tangents, tangents, atol=1e-15)
    np.testing.assert_allclose(scene.mass, [2.0, 2.0, 2 * (4 + 2.25) / 12])
    w = np.asarray(ji.delassus_matrix(scene))
    np.testing.assert_allclose(np.linalg.det(w), width**2 * c**2 / (2 * scene.mass[2]), rtol=1e-13)
    left = ji.rocking_block(width, height, angle=-angle)
    np.testing.assert_allclose(left.gaps, [0.0, width * s], atol=1e-15)


def test_block_inertia_and_float32():
    assert float(ji.rocking_block(1.0, 1.0, inertia=0.7).mass[2]) == 0.7
    scene = ji.rocking_block(jnp.float32(1.3), jnp.float32(0.7), jnp.float32(1.0), jnp.float32(0.1))
    assert scene.normals.dtype == jnp.float32
    assert scene.closed.tolist() == [False, True]


@pytest.mark.parametrize("aspect", [1.0, 2.0, 3.0])
def test_rocking_with_housner_restitution(aspect):
    """Turning about A and hitting with B: then about B, at e_theta times the rate."""
    e = float(housner_restitution(aspect))
    assert abs(e - {1.0: 0.25, 2.0: 0.7, 3.0: 0.85}[aspect]) < 1e-15
    scene, rate = ji.rocking_block(width=1.0, height=aspect), -0.8
    v = rate * np.array([-aspect / 2, 0.5, 1.0])
    np.testing.assert_allclose(scene.tangents.T @ v, 0, atol=1e-15)  # A does not slide
    out = ji.impact(ji.RestitutionMatrix(rocking_matrix(e)), scene, v)
    after = e * rate * np.array([-aspect / 2, -0.5, 1.0])  # about B
    np.testing.assert_allclose(out.velocity, after, atol=1e-14)
    np.testing.assert_allclose(out.impulse[1], 0, atol=1e-14)  # angular momentum about B
    assert int(out.status) == 0


# ---------------------------------------------------------------------------------- dimers


def test_dimer_tangents_are_the_slip_of_the_lowest_points():
    radius, length, angle = 0.3, 1.1, 0.4
    scene = ji.dimer(radius, length, sphere_mass=2.0, rod_mass=0.5, angle=angle)
    arm = length / 2 + radius
    for contact, side in enumerate((arm, -arm)):
        lever = np.array([side * np.cos(angle), side * np.sin(angle) - radius])
        slip = np.array([1.0, 0.0, -lever[1]])  # v + omega x lever, along x
        np.testing.assert_allclose(scene.tangents[:, contact], slip, atol=1e-14)
        np.testing.assert_allclose(scene.normals[:, contact], [0, 1, lever[0]], atol=1e-14)
    inertia = 2 * 2.0 * (0.4 * radius**2 + arm**2) + 0.5 * length**2 / 12
    np.testing.assert_allclose(scene.mass, [4.5, 4.5, inertia])


def test_dimer_in_space():
    """M and H_t against rigid-body mechanics: angular velocity from the rates of the angles."""
    body = ji.SpatialDimer(0.3, 1.1, sphere_mass=2.0, rod_mass=0.5)
    pitch, yaw = 0.4, 1.1
    scene = body.scene(body.touching(pitch, yaw))
    axis = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    up = np.array([0.0, 0.0, 1.0])
    across = np.array([np.sin(yaw), -np.cos(yaw), 0.0])  # about it a positive pitch rate turns
    turning = np.stack([up, across, axis], axis=1)
    planar = body.planar
    about = 0.8 * 2.0 * 0.3**2
    inertia = float(planar.inertia) * (np.eye(3) - np.outer(axis, axis))
    inertia += about * np.outer(axis, axis)
    expected = np.zeros((6, 6))
    expected[:3, :3], expected[3:, 3:] = 4.5 * np.eye(3), turning.T @ inertia @ turning
    np.testing.assert_allclose(dense(scene), expected, atol=1e-14)
    arm = float(planar.arm)
    for contact, side in enumerate((arm, -arm)):
        lever = side * axis - 0.3 * up
        velocity = np.concatenate([np.eye(3), np.cross(turning.T, lever).T], axis=1)
        np.testing.assert_allclose(scene.normals[:, contact], velocity[2], atol=1e-14)
        own = scene.tangents[:, 2 * contact : 2 * contact + 2]
        np.testing.assert_allclose(own, velocity[:2].T, atol=1e-14)
    np.testing.assert_allclose(scene.gaps, [2 * arm * np.sin(pitch), 0.0], atol=1e-14)


# ---------------------------------------------------------------------------------- pendulums


def test_cradle_at_rest_is_the_chain():
    masses, length = [1.0, 2.0, 0.5], 0.3
    scene, chain = ji.pendulum_cradle(masses, length, radius=0.02), ji.chain(masses)
    np.testing.assert_allclose(scene.normals, length * chain.normals, atol=1e-15)
    np.testing.assert_allclose(
        ji.delassus_matrix(scene), ji.delassus_matrix(chain).as_matrix(), atol=1e-13
    )
    v = np.array([1.0, 0.2, -0.3])
    law = ji.Newton(0.6)
    np.testing.assert_allclose(
        length * ji.impact(law, scene, v / length).velocity,
        ji.impact(law, chain, v).velocity,
        atol=1e-13,
    )


def test_cradle_gaps():
    length, radius, gaps = 0.4, jnp.array([0.02, 0.03, 0.02]), [0.0, 1e-3]
    cradle = ji.PendulumCradle([1.0, 1.0, 1.0], length, radius, gaps)
    assert np.array_equal(cradle.gap_function(jnp.zeros(3)), jnp.array([0.0, 1e-3])) or (
        np.abs(cradle.gap_function(jnp.zeros(3)) - jnp.array(gaps)).max() < 1e-17
    )
    q = jnp.array([-0.7, 0.1, 0.4])
    at = np.array([0.0, 0.05, 0.101]) + length * np.sin(q)
    apart = np.hypot(np.diff(at), np.diff(length * np.cos(q))) - [0.05, 0.05]
    np.testing.assert_allclose(cradle.gap_function(q), apart, atol=1e-15)
    with pytest.raises(ValueError, match="penetration"):
        cradle.scene([0.2, 0.0, 0.0])


# ------------------------------------------------------------------- derivatives and arguments


def test_scenes_are_differentiable_in_their_arguments():
    """d/d(width, height, angle) of an impact on a tilted block, against differences."""

    def outcome(x):
        scene = ji.rocking_block(x[0], x[1], 1.3, angle=x[2])
        return ji.impact(ji.Newton(0.5), scene, jnp.array([0.3, -1.0, 0.2])).velocity[2]

    x = jnp.array([1.0, 1.7, 0.2])
    step = 1e-6 * jnp.eye(3)
    run = jax.jit(jax.vmap(outcome))
    differences = (run(x[None] + step) - run(x[None] - step)) / 2e-6
    np.testing.assert_allclose(jax.jit(jax.grad(outcome))(x), differences, rtol=1e-7, atol=1e-8)


BAD = {
    "width": (lambda: ji.rocking_block(-1.0, 1.0), "`width`"),
    "height": (lambda: ji.rocking_block(1.0, 0.0), "`height`"),
    "mass": (lambda: ji.rocking_block(1.0, 1.0, mass=np.nan), "`mass`"),
    "inertia": (lambda: ji.rocking_block(1.0, 1.0, inertia=-0.1), "`inertia`"),
    "angle": (lambda: ji.rocking_block(1.0, 1.0, angle=np.inf), "`angle`"),
    "scalar": (lambda: ji.rocking_block([1.0, 2.0], 1.0), "`width`.*one number"),
    "radius": (lambda: ji.dimer(-0.1, 1.0), "`radius`"),
    "length": (lambda: ji.dimer(0.1, 0.0), "`length`"),
    "rod": (lambda: ji.dimer(0.1, 1.0, rod_mass=-1.0), "`rod_mass`"),
    "point spheres": (lambda: ji.dimer_3d(0.0, 1.0), "`radius`"),
    "upright": (lambda: ji.dimer_3d(0.1, 1.0, angle=1.6), "`angle`"),
    "flat corner": (lambda: ji.corner(np.pi), "`angle`"),
    "no corner": (lambda: ji.corner(-0.1), "`angle`"),
    "disk": (lambda: ji.disk_balls([0.0], disk_mass=0.0), "`disk_mass`"),
    "balls": (lambda: ji.disk_balls([0.0, 1.0], [1.0, 1.0, 1.0]), "`ball_masses`.*shape"),
    "angles": (lambda: ji.disk_balls(0.0), "`angles`"),
    "gaps": (lambda: ji.disk_balls([0.0], gaps=[-1.0]), "`gaps`"),
    "one ball": (lambda: ji.pendulum_cradle([1.0], 1.0, 0.1), "two balls"),
    "strings": (lambda: ji.pendulum_cradle([1.0, 1.0], -1.0, 0.1), "`length`"),
    "radii": (lambda: ji.pendulum_cradle([1.0, 1.0], 1.0, [0.1] * 3), "`radius`"),
    "cradle gaps": (lambda: ji.pendulum_cradle([1.0, 1.0], 1.0, 0.1, [0.1, 0.1]), "`gaps`"),
    "cradle q": (lambda: ji.pendulum_cradle([1.0, 1.0], 1.0, 0.1, angles=[0.0] * 3), "`q`"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments(name):
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        call()
