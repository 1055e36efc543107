"""Scenes, contact-space algebra, statuses, audit and summary."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

import jimpact as ji
from jimpact.solvers.tridiagonal import as_matrix
from jimpact.status import CODE


@pytest.mark.parametrize("wall", [False, True, "left", "right", "both"])
def test_chain_is_the_dense_scene(wall):
    masses, v, p = [1.0, 2.0, 3.0, 0.5], np.array([1.0, -2.0, 0.5, 0.3]), None
    chain = ji.chain(masses, wall=wall)
    mass, normals = reference.chain_matrices(masses, wall)
    dense = ji.Scene(mass, normals)
    np.testing.assert_array_equal(chain.normals, normals)
    assert chain.contacts == dense.contacts == normals.shape[1]
    p = np.linspace(0.1, 1.0, chain.contacts)
    np.testing.assert_allclose(
        as_matrix(ji.delassus_matrix(chain)), ji.delassus_matrix(dense), atol=1e-14
    )
    np.testing.assert_allclose(ji.gap_velocity(chain, v), normals.T @ v)
    np.testing.assert_allclose(ji.velocity_change(chain, p), np.linalg.solve(mass, normals @ p))
    np.testing.assert_allclose(ji.kinetic_energy(chain, v), 0.5 * v @ mass @ v)
    np.testing.assert_allclose(ji.momentum(chain, v), mass @ v)
    np.testing.assert_allclose(
        ji.delassus_matrix(chain) @ p, normals.T @ np.linalg.solve(mass, normals @ p)
    )


def test_normalized_quantities_and_kinetic_angles():
    chain = ji.chain([1.0, 2.0, 3.0])
    g = as_matrix(ji.normalized_delassus(chain))
    assert float(g[0, 1]) == pytest.approx(-1 / 5**0.5, abs=1e-15)
    assert float(ji.kinetic_angles(chain)[0, 1]) == pytest.approx(1.1071487177940905, abs=1e-14)
    four = ji.chain([2.0] * 4)
    qn = ji.normalized_gap_velocity(four, [0.3, -0.2, 0.5, 0.7])
    np.testing.assert_allclose(qn, [-0.5, 0.7, 0.2], atol=1e-15)


@pytest.mark.parametrize(
    ("a", "angle"),
    [(0.5, 1.14640661820171004), (1.0, 1.36943840600456583), (2.0, 1.82347658193697527)],
)
def test_kinetic_angle_of_a_block_from_its_gaps(a, angle):
    width, height = 1.0, a

    def gaps(q):  # q = (x, y, theta): corners of a block on the ground
        _, y, t = q
        return jnp.stack(
            [y - height / 2 * jnp.cos(t) + s * width / 2 * jnp.sin(t) for s in (1.0, -1.0)]
        )

    def mass(q):
        return jnp.diag(jnp.array([1.0, 1.0, (width**2 + height**2) / 12])) + 0 * q[0]

    scene = ji.scene_from_gaps(gaps, mass, [0.0, height / 2, 0.0])
    assert float(ji.kinetic_angles(scene)[0, 1]) == pytest.approx(angle, abs=1e-12)
    assert not np.asarray(scene.gaps).any()
    lifted = ji.scene_from_gaps(gaps, mass, [0.0, height / 2 + 1e-3, 0.0])
    np.testing.assert_allclose(lifted.gaps, 1e-3, rtol=1e-9)
    with pytest.raises(ValueError, match="penetration"):
        ji.scene_from_gaps(gaps, mass, [0.0, 0.4 * height, 0.0])
    grad = jax.grad(
        lambda t: ji.scene_from_gaps(gaps, mass, jnp.stack([0.0, 0.6, t])).normals[2, 0]
    )
    assert np.isfinite(float(grad(0.1)))


def test_bilateral_constraint_gives_the_reduced_system():
    # two carts on a rigid rod hit a wall like one cart of their total mass
    rod = ji.Scene([1.0, 2.0], [[0.0], [-1.0]], constraints=[[1.0], [-1.0]])
    out = ji.impact(ji.LZB(0.6), rod, [1.0, 1.0])
    np.testing.assert_allclose(out.velocity, -0.6, atol=1e-12)
    np.testing.assert_allclose(out.impulse, 3.0 * 1.6, atol=1e-12)
    assert bool(ji.audit(rod, [1.0, 1.0], out).consistent)


def test_newton_values():
    out = ji.impact(ji.Newton([0.8, 0.4]), ji.chain([1.0] * 3), [1.0, 0.0, -0.5])
    np.testing.assert_allclose(out.velocity, [-13 / 30, 11 / 30, 17 / 30], atol=1e-14)
    np.testing.assert_allclose(out.impulse, [43 / 30, 16 / 15], atol=1e-14)
    # slender block, kinetic angle above pi/2: the contact would have to pull
    g12 = 0.25
    normals = np.linalg.cholesky(np.array([[1, g12], [g12, 1]])).T
    out = ji.impact(
        ji.Newton(0.5), ji.Scene([1.0, 1.0], normals), np.linalg.solve(normals.T, [0, -1.0])
    )
    np.testing.assert_allclose(out.impulse, [-0.4, 1.6], atol=1e-12)
    assert ji.STATUS[int(out.status)].name == "negative_impulse"
    with pytest.raises(RuntimeError, match="negative_impulse"):
        ji.raise_on_failure(out)


def test_redundant_contacts():
    normals = [[1.0, 1.0], [0.0, 0.0]]
    twice = ji.Scene([1.0, 1.0], normals)
    out = ji.impact(ji.Newton(0.5), twice, [-1.0, 0.0])
    assert ji.STATUS[int(out.status)].name == "impulse_not_unique"
    np.testing.assert_allclose(out.velocity, [0.5, 0.0], atol=1e-12)
    out = ji.impact(ji.Newton([0.5, 0.8]), twice, [-1.0, 0.0])
    assert ji.STATUS[int(out.status)].name == "infeasible"
    out = ji.impact(ji.LZB([0.5, 0.8], [1.0, 3.0]), twice, [-1.0, 0.0])  # stiffness decides
    assert int(out.status) == 0
    assert 0.5 < float(out.velocity[0]) < 0.8
    np.testing.assert_allclose(out.impulse.sum(), 1 + out.velocity[0], atol=1e-8)
    gradient = jax.grad(lambda e: ji.impact(ji.Newton(e), twice, [-1.0, 0.0]).velocity[0])(0.5)
    assert float(gradient) == pytest.approx(1.0, abs=1e-10)


@pytest.mark.slow
def test_ball_between_two_walls_comes_to_rest():
    out = ji.impact(ji.LZB(0.5), ji.chain([1.0], wall="both"), [1.0])
    assert int(out.status) in (CODE["ok"], CODE["plastic_limit"])
    assert abs(float(out.velocity[0])) < 1e-7
    stuck = ji.impact(ji.LZB(1.0, max_steps=300), ji.chain([1.0], wall="both"), [1.0])
    assert ji.STATUS[int(stuck.status)].name == "max_steps"  # elastic: it never ends


def test_batch_with_one_bad_sample():
    v = jnp.array([[1.0, 0.0], [jnp.nan, 0.0], [0.0, 1.0]])
    out = jax.jit(jax.vmap(lambda v: ji.impact(ji.LZB(0.9), ji.chain(jnp.ones(2)), v)))(v)
    assert [ji.STATUS[int(s)].name for s in out.status] == ["ok", "not_finite", "ok"]
    np.testing.assert_allclose(out.velocity[0], [0.05, 0.95], atol=1e-12)
    with pytest.raises(RuntimeError, match=r"not_finite.*at 1"):
        ji.raise_on_failure(out)
    assert "not_finite" in ji.summary(out, ji.chain(jnp.ones(2)), v)


def test_audit_reads_measured_outcomes():
    scene, v = ji.chain([1.0] * 3), jnp.array([1.0, 0.0, 0.0])
    out = ji.impact(ji.LZB(1.0), scene, v)
    measured = jax.tree.map(lambda x: x, out)
    object.__setattr__(measured, "velocity", jnp.array([-0.0605, 0.1049, 0.9978]))
    found = ji.audit(scene, v, measured)
    assert not bool(found.momentum)
    assert not bool(found.energetic)
    assert not bool(found.consistent)


def test_summary_speaks():
    scene, v = ji.chain([1.0] * 3), [1.0, 0.0, 0.0]
    text = ji.summary(ji.impact(ji.LZB(0.9), scene, v), scene, v)
    assert "82.9 % kept" in text
    assert text.count("ok") >= 5


def test_public_names_are_functions_not_modules():
    import importlib

    for module in ("impacts", "histories", "fits", "experiments", "scene"):
        importlib.import_module(f"jimpact.{module}")
    for name in ji.__all__:
        assert type(getattr(ji, name)).__name__ != "module", name
    with pytest.raises(AttributeError, match="no attribute 'Lzb'"):
        _ = ji.Lzb


def test_constraints_distort_the_normalized_delassus_matrix():
    """(6.35): the Schur complement of G over the constraints, normals and gradients of norm 1."""
    rng = np.random.default_rng(4)
    x = rng.normal(size=(5, 5))
    mass, normals, h = x @ x.T + np.eye(5), rng.normal(size=(5, 2)), rng.normal(size=(5, 2))
    every = np.hstack([h, normals])
    free = every.T @ np.linalg.solve(mass, every)
    free = free / np.sqrt(np.outer(np.diag(free), np.diag(free)))
    bb, bu, uu = free[:2, :2], free[:2, 2:], free[2:, 2:]
    scene = ji.Scene(mass, normals, constraints=h)
    g = ji.normalized_delassus(scene)
    np.testing.assert_allclose(g, uu - bu.T @ np.linalg.solve(bb, bu), atol=1e-12)
    assert (np.diag(g) < 1).all()


def test_velocities_must_satisfy_the_constraints():
    welded = ji.Scene([1.0, 1.0, 1.0], [[-1.0], [1.0], [0.0]], constraints=[[0.0], [-1.0], [1.0]])
    with pytest.raises(
        ValueError, match=r"`velocity` must satisfy .*constraint 1 has the rate 0.5"
    ):
        ji.impact(ji.Newton(0.5), welded, [1.0, 0.0, 0.5])
    with pytest.raises(ValueError, match=r"`constraints` must have independent columns"):
        ji.Scene([1.0, 1.0], [[1.0], [0.0]], constraints=[[1.0, 2.0], [0.0, 0.0]])
