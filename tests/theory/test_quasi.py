"""Kinetic quasi-velocities: check values, identities on random scenes, contact-force power."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import kinetic_norm
from refusals import argument

import jimpact as ji
from jimpact.theory import (
    contact_power,
    from_quasi_velocities,
    kinetic_energy_split,
    quasi_basis,
    to_quasi_velocities,
)

basis = jax.jit(quasi_basis)
to_quasi = jax.jit(to_quasi_velocities)
from_quasi = jax.jit(from_quasi_velocities)
split = jax.jit(kinetic_energy_split)
power = jax.jit(contact_power)


def block(mass=2.0, height=1.0, width=1.5):
    """Planar block lying flat: q = (x, y, theta), contact 1 the right corner."""
    inertia = mass * (height**2 + width**2) / 12
    h, w = height / 2, width / 2
    return ji.Scene(
        mass=[mass, mass, inertia],
        normals=[[0.0, 0.0], [1.0, 1.0], [w, -w]],
        tangents=[[1.0, 1.0], [0.0, 0.0], [h, h]],
    )


def random_scene(constraints=1, seed=3, n=6, m=2):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    return ji.Scene(
        mass=root @ root.T + np.eye(n),
        normals=rng.normal(size=(n, m)),
        tangents=rng.normal(size=(n, m)),
        constraints=rng.normal(size=(n, constraints)) if constraints else None,
    )


def compatible(scene, seed=0):
    """A random velocity that satisfies the constraints."""
    v = np.random.default_rng(seed).normal(size=scene.size)
    if scene.constraints is None:
        return v
    h = np.asarray(scene.constraints)
    return v - h @ np.linalg.solve(h.T @ h, h.T @ v)


@pytest.mark.slow
def test_four_balls():
    scene, v = ji.chain([2.0] * 4), jnp.array([0.3, -0.2, 0.5, 0.7])
    qn, qt = to_quasi(scene, v)
    np.testing.assert_allclose(qn, [-0.5, 0.7, 0.2], atol=1e-15)
    np.testing.assert_allclose(qt, [0.919238815542511782], atol=1e-15)
    np.testing.assert_allclose(sum(split(scene, v)), 0.87, atol=1e-15)
    np.testing.assert_allclose(from_quasi(scene, qn, qt), v, atol=1e-15)


def test_three_balls():
    scene = ji.chain([1.0, 2.0, 3.0])
    normal, tangent = basis(scene)
    gram = normal.T @ (scene.mass[:, None] * normal)
    np.testing.assert_allclose(gram, [[1, -(5**-0.5)], [-(5**-0.5), 1]], atol=1e-15)
    np.testing.assert_allclose(tangent[:, 0], np.ones(3) / np.sqrt(6), atol=1e-15)
    # the tangential energy of a chain is that of its centre of mass
    v = jnp.array([1.0, -0.4, 0.3])
    np.testing.assert_allclose(split(scene, v)[1], 0.5 * 6 * (1.1 / 6) ** 2, atol=1e-15)


def test_flat_block():
    normal, tangent = basis(block())
    np.testing.assert_allclose(tangent[:, 0], [2**-0.5, 0, 0], atol=1e-15)
    # G_12 = (a^2 - 2) / (a^2 + 4), a = height / width
    a = 1 / 1.5
    metric = np.asarray(block().mass)[:, None]
    np.testing.assert_allclose(
        (normal.T @ (metric * normal))[0, 1], (a**2 - 2) / (a**2 + 4)
    )


@pytest.mark.slow
def test_friction_block():
    """Sliding block with given normal and tangential impulses: v+ in quasi-velocities."""
    scene = block()
    qn, qt = jnp.array([-1.0, -0.3]), jnp.array([0.7])
    pbar = jnp.array([2.06916698558489603, 1.19237147595356551])
    side = jnp.array([-0.333643151241107629, 0.115358474050281735])
    p, v = pbar / kinetic_norm(scene), from_quasi(scene, qn, qt)
    after = v + ji.velocity_change(scene, p, side)
    qn_after, qt_after = to_quasi(scene, after)
    e = np.array([[0.5, 0.1], [0.2, 0.3]])
    np.testing.assert_allclose(qn_after, -e @ qn, atol=1e-14)
    np.testing.assert_allclose(qt_after, [0.545649424529250514], atol=1e-14)
    np.testing.assert_allclose(
        (scene.tangents.T @ v)[0], 0.205560366122430203, atol=1e-14
    )
    # the work of the impulses is their power at the mean velocity
    work = power(scene, 0.5 * (v + after), p, side)
    np.testing.assert_allclose(work.total, -0.567592042214138333, atol=1e-14)
    mean_qn = 0.5 * (qn + qn_after)
    np.testing.assert_allclose(work.normal, mean_qn @ pbar, atol=1e-14)
    change = sum(split(scene, after)) - sum(split(scene, v))
    np.testing.assert_allclose(work.total, change, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("constraints", [0, 1])
def test_identities_of_random_scenes(constraints):
    scene = random_scene(constraints)
    v = compatible(scene)
    normal, tangent = map(np.asarray, basis(scene))
    mass = np.asarray(scene.mass)
    assert tangent.shape == (6, 4 - constraints)
    np.testing.assert_allclose(
        tangent.T @ mass @ tangent, np.eye(4 - constraints), atol=1e-12
    )
    np.testing.assert_allclose(tangent.T @ mass @ normal, 0, atol=1e-12)
    if constraints:
        np.testing.assert_allclose(
            tangent.T @ np.asarray(scene.constraints), 0, atol=1e-12
        )
    qn, qt = to_quasi(scene, v)
    np.testing.assert_allclose(
        qn, ji.theory.normalized_gap_velocity(scene, v), atol=1e-13
    )
    np.testing.assert_allclose(qn, normal.T @ mass @ v, atol=1e-12)
    np.testing.assert_allclose(from_quasi(scene, qn, qt), v, atol=1e-12)
    parts = split(scene, v)
    np.testing.assert_allclose(sum(parts), 0.5 * v @ mass @ v, atol=1e-12)
    assert min(map(float, parts)) > 0
    # a frictionless impulse leaves qt alone
    jump = ji.velocity_change(scene, jnp.array([0.4, 1.3]))
    np.testing.assert_allclose(to_quasi(scene, jump)[1], 0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("constraints", [0, 1])
def test_power_of_contact_forces(constraints):
    scene = random_scene(constraints)
    v, force, side = compatible(scene), jnp.array([0.7, 0.2]), jnp.array([-0.3, 0.5])
    found = power(scene, v, force, side)
    np.testing.assert_allclose(found.normal, force @ (scene.normals.T @ v), atol=1e-12)
    local = side @ (scene.tangents.T @ v)  # (6.41)
    np.testing.assert_allclose(found.coupling + found.tangential, local, atol=1e-12)
    np.testing.assert_allclose(found.total, found.normal + local, atol=1e-12)
    # (6.39): no coupling where the contacts are at rest
    at_rest = from_quasi(scene, jnp.zeros(2), to_quasi(scene, v)[1])
    np.testing.assert_allclose(
        power(scene, at_rest, force, side).coupling, 0, atol=1e-12
    )
    assert abs(float(found.coupling)) > 1e-3
    frictionless = power(scene, v, force)
    np.testing.assert_allclose(frictionless.total, found.normal, atol=1e-15)
    assert float(frictionless.coupling) == float(frictionless.tangential) == 0


def test_particle_has_no_coupling():
    """A particle on a plane: n_q^T H = 0."""
    plane = ji.Scene([2.0, 2.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]])
    found = contact_power(plane, [3.0, -1.0], [4.0], [-0.5])
    parts = [float(x) for x in (found.normal, found.coupling, found.tangential)]
    np.testing.assert_allclose(parts, [-4, 0, -1.5], atol=1e-15)


@pytest.mark.slow
def test_basis_is_smooth_in_the_scene():
    """The derivative is that of the value: v(qn, qt) for given quasi-velocities."""
    scene = random_scene(1)
    qn, qt = jnp.array([-1.0, 0.3]), jnp.array([0.5, -0.2, 0.8])
    turn = jnp.asarray(np.random.default_rng(5).normal(size=(6, 2)))

    def moved(s):
        at = ji.Scene(
            scene.mass * (1 + s),
            scene.normals + s * turn,
            None,
            None,
            scene.constraints,
        )
        return from_quasi_velocities(at, qn, qt)

    forward = jax.jit(jax.jacfwd(moved))(0.0)
    reverse = jax.jit(jax.jacrev(moved))(0.0)
    value, step = jax.jit(moved), 1e-5
    slope = (value(step) - value(-step)) / (2 * step)
    np.testing.assert_allclose(forward, slope, atol=1e-9)
    np.testing.assert_allclose(reverse, forward, atol=1e-13)


def test_basis_does_not_depend_on_rounding():
    """Equal coordinates: float32 and float64 choose the same ones."""
    scene = ji.Scene(jnp.ones(5), jnp.asarray([[1.0], [-1.0], [1.0], [-1.0], [1.0]]))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), scene)
    tangent = quasi_basis(single)[1]
    assert tangent.dtype == jnp.float32
    np.testing.assert_allclose(tangent, quasi_basis(scene)[1], atol=1e-6)


def test_redundant_contacts_are_refused():
    with pytest.raises(ValueError, match=argument("scene")):
        quasi_basis(ji.Scene([1.0, 1.0], [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]))
    with pytest.raises(ValueError, match=argument("scene")):
        quasi_basis(ji.Scene([1.0, 1.0], [[1.0, 1.0], [0.0, 0.0]]))
    with pytest.raises(
        ValueError, match=argument("scene")
    ):  # a contact that a constraint holds
        quasi_basis(
            ji.Scene(
                jnp.ones(3), [[1.0], [0.0], [0.0]], constraints=[[2.0], [0.0], [0.0]]
            )
        )


def test_bad_input():
    with pytest.raises(ValueError, match=argument("velocity")):
        to_quasi_velocities(block(), [1.0, 2.0])
    with pytest.raises(ValueError, match=argument("tangential")):
        from_quasi_velocities(block(), [1.0, 2.0], [1.0, 2.0])
    with pytest.raises(ValueError, match=argument("scene")):
        contact_power(ji.chain([1.0, 1.0]), [1.0, 0.0], [1.0], [1.0])
    with pytest.raises(ValueError, match=argument("force")):
        contact_power(block(), [1.0, 0.0, 0.0], [1.0])
