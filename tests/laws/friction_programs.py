"""Laws with Coulomb friction, and their impacts as lanes of two compiled programs.

Two canonical shapes: planar, 4 coordinates and 2 contacts; in space 6 and 2. Fewer coordinates are
joined by idle ones, a scene of one contact by a second one, open.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from programs import OPTIMIZED

import jimpact as ji

LANES = 64  # impacts of one call

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


def run(name, mass, normals, tangents, v, e, mu, e_t=0.0, k=1.0):
    """Outcomes of a batch of impacts by the law `name`, and their audits; all arguments by lanes."""
    count, n, m = np.shape(normals)
    directions = (
        np.shape(tangents)[2] // m
    )  # of a contact: one in the plane, two in space
    idle = (4 if directions == 1 else 6) - n
    behind = ((0, 0), (0, idle), (0, 0))
    normals = np.pad(normals, behind)
    tangents = np.pad(tangents, behind)
    if m == 1:  # a second contact, like the first one, but open
        normals = np.concatenate([normals, normals], 2)
        tangents = np.concatenate([tangents, tangents], 2)
    # far from closing while the other one is indented: `compliant` would feel it
    gaps = np.tile([0.0, 1e3 * (m == 1)], (count, 1))
    scene = (with_idle(mass, n, idle), normals, tangents, gaps)
    v = np.pad(v, ((0, 0), (0, idle)))
    parameters = [of_two_contacts(x, count) for x in (e, mu, e_t, k)]
    columns = [np.asarray(x, float) for x in (*scene, v, *parameters)]
    parts = []
    for begin in range(0, count, LANES):
        at = np.arange(begin, begin + LANES).clip(max=count - 1)
        part = program(name)(*(x[at] for x in columns))
        parts.append(jax.tree.map(lambda x, b=begin: np.asarray(x)[: count - b], part))
    out, found = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return dataclasses.replace(out, velocity=out.velocity[:, :n]), found


def with_idle(mass, n, idle):
    """Masses (count, n + idle, n + idle) of masses (count, n) or (count, n, n): 1 of idle coordinates."""
    mass = np.asarray(mass, float)
    whole = np.tile(np.eye(n + idle), (len(mass), 1, 1))
    if mass.ndim == 2:
        mass = mass[:, :, None] * np.eye(n)
    whole[:, :n, :n] = mass
    return whole


def of_two_contacts(value, count):
    """A parameter (count, 2) from a number, from one for each lane, or from one for each contact."""
    value = np.asarray(value, float)
    if value.ndim < 2:
        value = value.reshape(-1, 1)
    return np.broadcast_to(value, (count, 2))
