"""Friction as theory states it, beside the laws."""

import jax
import numpy as np
import pytest
from friction_programs import run

import jimpact as ji

close = np.testing.assert_allclose
FLAT = ji.Block(1.5, 1.0, 2.0, corners="base").scene()


def of_scene(scene, count):
    mass = np.diag(np.asarray(scene.mass))
    arrays = (mass, np.asarray(scene.normals), np.asarray(scene.tangents))
    return [np.tile(x, (count, 1, 1)) for x in arrays]


@pytest.mark.slow
def test_given_slip_agrees_with_the_law():
    """(6.54)-(6.57) with xi = 1: the law finds that slip by itself, and the same impulses."""
    e, mu, fast = np.array([[0.5, 0.1], [0.2, 0.3]]), 0.2, np.array([2.0, -0.6, -0.3])
    out = ji.impact(ji.RestitutionMatrix(e, friction=mu), FLAT, fast)
    p, side = ji.theory.friction_impulses(FLAT, e, mu, 1.0, fast)
    assert (
        float((FLAT.tangents.T @ out.velocity)[0]) > 0
    )  # still sliding: xi = 1 was right
    close(out.impulse, p, rtol=1e-12)
    close(out.tangential_impulse, side, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["moreau", "lzb"])
def test_uneven_load_is_shared_as_friction_allows(name):
    """Corner A takes nothing, so that B alone holds the block: rolling over to B is Housner's."""
    scene, rate = ji.Block(1.0, 3.0, corners="base").scene(), -1.0
    v = rate * np.array([[-1.5, 0.5, 1.0]])
    out, _ = run(name, *of_scene(scene, 1), v, np.zeros(1), np.full(1, 5.0))
    off = 1e-13 if name == "moreau" else 1e-6
    close(out.impulse[0, 1], 0, atol=off)
    close(out.tangential_impulse[0, 1], 0, atol=off)
    close(np.asarray(scene.tangents)[:, 0] @ out.velocity[0], 0, atol=off)
    close(out.velocity[0, 2], rate * ji.theory.housner_restitution(3.0), rtol=10 * off)


def count(jaxpr):
    """Operations of a program, loops and branches included."""
    inner = [x for e in jaxpr.eqns for x in jax.tree.leaves(list(e.params.values()))]
    return len(jaxpr.eqns) + sum(
        count(getattr(x, "jaxpr", x)) for x in inner if hasattr(x, "jaxpr")
    )
