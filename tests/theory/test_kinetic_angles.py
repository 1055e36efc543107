"""Normalized quantities and kinetic angles of scenes and bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji


def dense(matrix):
    return np.asarray(matrix.as_matrix() if hasattr(matrix, "as_matrix") else matrix)


def test_normalized_quantities_and_kinetic_angles():
    chain = ji.chain([1.0, 2.0, 3.0])
    assert dense(ji.theory.normalized_delassus(chain))[0, 1] == pytest.approx(
        -1 / 5**0.5, abs=1e-15
    )
    assert float(ji.theory.kinetic_angles(chain)[0, 1]) == pytest.approx(
        1.1071487177940905, abs=1e-14
    )
    qn = ji.theory.normalized_gap_velocity(ji.chain([2.0] * 4), [0.3, -0.2, 0.5, 0.7])
    np.testing.assert_allclose(qn, [-0.5, 0.7, 0.2], atol=1e-15)


def test_constraints_reduce_and_distort():
    """(6.35): the Schur complement of G over the constraints; welded balls are one."""
    rng = np.random.default_rng(4)
    x = rng.normal(size=(5, 5))
    mass, normals, h = (
        x @ x.T + np.eye(5),
        rng.normal(size=(5, 2)),
        rng.normal(size=(5, 2)),
    )
    every = np.hstack([h, normals])
    free = every.T @ np.linalg.solve(mass, every)
    free = free / np.sqrt(np.outer(np.diag(free), np.diag(free)))
    bb, bu, uu = free[:2, :2], free[:2, 2:], free[2:, 2:]
    g = ji.theory.normalized_delassus(ji.Scene(mass, normals, constraints=h))
    np.testing.assert_allclose(g, uu - bu.T @ np.linalg.solve(bb, bu), atol=1e-12)
    assert (np.diag(g) < 1).all()


def built(make, *given, at=(), **options):
    """Scene of a body, touching at this angle, .., made in one program."""

    def scene():
        body = make(*given, **options)
        return body.scene(body.touching(*at)) if isinstance(body, ji.Body) else body

    return jax.jit(scene)()


def around_a_disc(phi, masses, m0, radius=1.0, radii=(1.0,) * 3, gaps=(0.0,) * 3):
    """Balls around a disc, contact i with ball i."""
    balls = [ji.Disc(r, m, 0.4 * m * r**2) for r, m in zip(radii, masses)]
    pairs = [(i + 1, 0) for i in range(len(phi))]
    bodies = ji.Bodies([ji.Disc(radius, m0), *balls], planes=[], pairs=pairs)
    far = [radius + r + gap for r, gap in zip(radii, gaps)]
    q = [[x * np.cos(a), x * np.sin(a), 0.0] for x, a in zip(far, phi)]
    return bodies.scene(np.ravel([[0.0] * 3, *q]))


BLOCKS = {  # aspect: kinetic angle, 40-digit values
    1e-9: np.pi / 3,
    0.5: 1.14640661820171004,
    1.0: 1.36943840600456583,
    np.sqrt(2.0): np.pi / 2,
    2.0: 1.82347658193697527,
    3.0: 2.13940662705907887,
}
DIMERS = {
    0.0: 1.44546849562683122,
    5 / 24: 1.42420445174657522,
    1e12: 1.53630673083321779,
}


@pytest.mark.slow
def test_kinetic_angles_of_bodies():
    @jax.jit
    def angles(aspects, ratios):
        block = jax.vmap(
            lambda a: ji.theory.kinetic_angles(
                ji.Block(2.0, 2 * a, 3.0, corners="base").scene()
            )[0, 1]
        )
        dimer = jax.vmap(
            lambda r: ji.theory.kinetic_angles(ji.Dimer(2 * r, 2.0).scene())[0, 1]
        )
        together = ji.theory.kinetic_angles(ji.Dimer(2.0, 0.0).scene())[0, 1]
        cosine = jax.grad(
            lambda r: ji.theory.normalized_delassus(ji.Dimer(r, 1.0).scene())[0, 1]
        )
        return (
            block(aspects),
            dimer(ratios),
            together,
            jax.vmap(cosine)(jnp.array([0.2, 5 / 24, 0.22])),
        )

    block, dimer, together, slope = angles(np.array([*BLOCKS]), np.array([*DIMERS]))
    np.testing.assert_allclose(block, [*BLOCKS.values()], atol=1e-10)
    np.testing.assert_allclose(dimer, [*DIMERS.values()], atol=1e-10)
    np.testing.assert_allclose(together, 1.53630673083321779, atol=1e-14)
    # least angle at R / L = 5/24: the slope vanishes and rises
    assert abs(float(slope[1])) < 1e-12
    assert float(slope[0]) < -1e-3 < 1e-3 < float(slope[2])
    corner = jax.jit(
        jax.vmap(lambda a: ji.theory.kinetic_angles(ji.Corner(a, 2.0).scene())[0, 1])
    )
    np.testing.assert_allclose(
        corner(np.array([0.1, 1.2, 3.0])), [0.1, 1.2, 3.0], atol=1e-14
    )
    phi, masses, m0 = np.array([0.3, 1.9, -2.0]), np.array([0.5, 0.7, 2.0]), 1.5
    disc = built(around_a_disc, phi, masses, m0, 0.3, [0.1, 0.2, 0.1])
    g = np.cos(phi[:, None] - phi) / np.sqrt(
        (1 + m0 / masses)[:, None] * (1 + m0 / masses)
    )
    away = ~np.eye(3, dtype=bool)
    found = dense(jax.jit(ji.theory.normalized_delassus)(disc))
    np.testing.assert_allclose(found[away], g[away], atol=1e-14)
