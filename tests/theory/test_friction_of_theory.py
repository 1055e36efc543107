"""Friction as theory states it, beside the laws."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import OPTIMIZED

import jimpact as ji

close = np.testing.assert_allclose
# (e, mu, e_t, k) -> law; e_t is of the kinematic laws, k of LZB
LAWS = {
    "newton": lambda e, mu, e_t, k: ji.Newton(
        e, friction=mu, tangential_restitution=e_t
    ),
    "moreau": lambda e, mu, e_t, k: ji.Moreau(
        e, friction=mu, tangential_restitution=e_t
    ),
    "matrix": lambda e, mu, e_t, k: ji.RestitutionMatrix(
        jnp.diag(e), friction=mu, tangential_restitution=e_t
    ),
    "binary": lambda e, mu, e_t, k: ji.Binary(
        e, "earliest", friction=mu, tangential_restitution=e_t
    ),
    "poisson": lambda e, mu, e_t, k: ji.Poisson(
        e, friction=mu, tangential_restitution=e_t
    ),
    "lzb": lambda e, mu, e_t, k: ji.LZB(e, k, 1.5, friction=mu, method="time"),
    "compliant": lambda e, mu, e_t, k: ji.Compliant(
        ji.Bistiffness(k, 1.5, e), friction=mu, method="time"
    ),
}


@functools.cache
def program(name):
    """Compiled once a shape: planar or in space."""

    def one(mass, normals, tangents, gaps, v, e, mu, e_t, k):
        scene = ji.Scene(mass, normals, tangents=tangents, gaps=gaps)
        out = ji.impact(LAWS[name](e, mu, e_t, k), scene, v)
        return out, ji.audit(out, scene, v)

    # long runs: what compiling well takes is saved
    options = OPTIMIZED if name in ("lzb", "compliant") else None
    return jax.jit(jax.vmap(one), compiler_options=options)


LANES = 64


def run(name, mass, normals, tangents, v, e, mu, e_t=0.0, k=1.0):
    """Outcomes of a batch; one contact is joined by an open one."""
    count, n, m = np.shape(normals)
    rows = np.shape(tangents)[2] // m
    mass = np.asarray(mass, float)
    mass = mass[:, :, None] * np.eye(n) if mass.ndim == 2 else mass
    idle = (4 if rows == 1 else 6) - n
    full = np.tile(np.eye(n + idle), (count, 1, 1))
    full[:, :n, :n] = mass
    mass = full
    normals, tangents = (
        np.pad(x, ((0, 0), (0, idle), (0, 0))) for x in (normals, tangents)
    )
    v = np.pad(v, ((0, 0), (0, idle)))
    if m == 1:
        normals, tangents = (
            np.concatenate([x, x[:, :, :rows]], 2) for x in (normals, tangents)
        )
    # far from closing while the other one is indented: `compliant` would feel it
    gaps = np.tile([0.0, 1e3 * (m == 1)], (count, 1))
    per = [
        np.broadcast_to(np.asarray(x, float).reshape(-1, *(1,) * (np.ndim(x) < 2), *np.shape(x)[1:]), (count, 2))
        for x in (e, mu, e_t, k)
    ]  # fmt: skip
    columns = [np.asarray(x, float) for x in (mass, normals, tangents, gaps, v, *per)]
    parts = []
    for begin in range(0, count, LANES):
        at = np.arange(begin, begin + LANES).clip(max=count - 1)
        part = program(name)(*(x[at] for x in columns))
        parts.append(jax.tree.map(lambda x, b=begin: np.asarray(x)[: count - b], part))
    out, found = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return dataclasses.replace(out, velocity=out.velocity[:, :n]), found


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
