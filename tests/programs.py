"""One canonical shape: 4 coordinates, 3 contacts, all parameters arrays; one program a law.

A smaller system is padded with balls that leave a wall of their own, at a distance: open,
separating, decoupled. So all held values, edges and random states of a law are lanes of a single
compiled batch of `LANES`, and what is padded tests that open contacts take no part.
"""

import functools
import re
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from reference import chain_matrices

import jimpact as ji

COORDINATES, CONTACTS, LANES = 4, 3, 64
PASSES = 20_000  # of an integrator: a lane that never ends must not hold up the batch
AWAY = 1.0  # gap [m] of a contact that only pads


# ------------------------------------------------------------------------------------- laws


@dataclass(frozen=True)
class Row:
    """How a law is made of one restitution and one stiffness a contact, and how right it is."""

    registered: str
    make: Any  # (e (3,), k (3,), eta (3,), stored (3,)) -> law
    accuracy: float = 1e-12  # of v+, relative to the largest speed
    slope: float = 1e-10  # of forward against reverse derivatives
    by_order: bool = False  # the order of the contacts is part of the law
    reverse: bool = (
        True  # whether reverse derivatives are compiled as well; else its code is LZB's
    )
    through_w: bool = True  # whether contacts influence each other through W only
    flagged: float = (
        0.05  # most of the contract's random states that may be flagged as failures
    )


LAWS = {
    "newton": Row("newton", lambda e, k, eta, stored: ji.Newton(e), flagged=0.8),
    "moreau": Row("moreau", lambda e, k, eta, stored: ji.Moreau(e), flagged=0.5),
    "poisson": Row(
        "poisson",
        lambda e, k, eta, stored: ji.Poisson(e, allow_above_one=True),
        flagged=0.25,
    ),
    "matrix": Row(
        "restitution_matrix",
        lambda e, k, eta, stored: ji.RestitutionMatrix(jnp.diag(e)),
        flagged=0.8,
    ),
    "velocity": Row(
        "velocity_dependent",
        lambda e, k, eta, stored: ji.VelocityDependent(
            ji.Moreau(e), speed_exponent=0.25, yield_speed=0.0, reference_speed=1.5
        ),
        flagged=0.5,
    ),
    "binary": Row("binary", lambda e, k, eta, stored: ji.Binary(e)),
    "binary-earliest": Row(
        "binary", lambda e, k, eta, stored: ji.Binary(e, order="earliest")
    ),
    "binary-left": Row(
        "binary",
        lambda e, k, eta, stored: ji.Binary(e, order="left_to_right"),
        by_order=True,
    ),
    "correlation": Row(
        "impulse_correlation",
        lambda e, k, eta, stored: ji.ImpulseCorrelation(e, 0.6),
        1e-11,
        flagged=0.35,
    ),
    "routh": Row(
        "routh", lambda e, k, eta, stored: ji.Routh(e), through_w=False, flagged=0.5
    ),
    "lzb": Row(
        "lzb",
        lambda e, k, eta, stored: ji.LZB(e, k, eta, stored, max_steps=PASSES),
        1e-7,
        1e-9,
    ),
    "compliant": Row(
        "compliant",
        lambda e, k, eta, stored: ji.Compliant(
            ji.Bistiffness(k, eta, e), max_steps=PASSES
        ),
        1e-7,
        1e-9,
        reverse=False,
    ),
}
SEQUENTIAL = ("binary", "binary-earliest", "binary-left")
SLOW_SLOPES = (  # LZB's, Binary's and Moreau's code again
    *("compliant", "binary-earliest", "binary-left", "routh", "velocity"),
)


# ----------------------------------------------------------------------------------- states


@dataclass
class State:
    """A system before its impact, and what is known of it afterwards."""

    mass: Any
    normals: Any
    velocity: Any
    e: Any = 1.0
    k: Any = 1.0
    eta: Any = 1.5
    stored: Any = 0.0
    gaps: Any = 0.0
    after: Any = None
    impulse: Any = None
    status: str | None = "ok"
    name: str = ""

    @property
    def size(self):
        return np.shape(self.normals)


def chain(masses, velocity, wall=False, **given):
    """A row of balls; `name=`, `e=`, `k=`, `after=`... as of `State`."""
    mass, normals = chain_matrices(masses, wall)
    return State(mass, normals, velocity, **given)


def scene_state(scene, velocity, **given):
    """Of a `ji.Scene`."""
    mass = np.asarray(scene.mass)
    mass = np.diag(mass) if mass.ndim == 1 else mass
    return State(mass, np.asarray(scene.normals), velocity, **given)


def padded(state):
    """(mass, normals, gaps, v, e, k, eta, stored) of the canonical shape."""
    n, m = state.size
    more = CONTACTS - m
    if more < 0 or n + more > COORDINATES:
        raise ValueError(f"{state.name}: {n} coordinates, {m} contacts do not fit")
    v = np.asarray(state.velocity, float)
    speed = np.abs(v).max() or 1.0
    mass = np.eye(COORDINATES) * np.mean(np.diag(np.asarray(state.mass, float)))
    mass[:n, :n] = state.mass
    normals = np.zeros((COORDINATES, CONTACTS))
    normals[:n, :m] = state.normals
    normals[n + np.arange(more), m + np.arange(more)] = 1.0
    velocity = np.zeros(COORDINATES)
    velocity[:n], velocity[n : n + more] = v, speed
    gaps = np.full(CONTACTS, AWAY)
    gaps[:m] = state.gaps

    def each(x, rest):
        out = np.full(CONTACTS, rest, float)
        out[:m] = x
        return out

    first = float(np.ravel(state.k)[0])
    return (
        mass,
        normals,
        gaps,
        velocity,
        each(state.e, 0.5),
        each(state.k, first),
        each(state.eta, 1.5),
        each(state.stored, 0.0),
    )


# --------------------------------------------------------------------------------- programs


def one(make):
    """(canonical arrays) -> outcome and its audit."""

    def run(mass, normals, gaps, v, *parameters):
        scene = ji.Scene(mass, normals, gaps=gaps)
        out = ji.impact(make(*parameters), scene, v)
        return out, ji.audit(out, scene, v)

    return run


def both_ways(function):
    """x (n,) -> value (k,), Jacobian (k, n) forward and transposed, from one linearization."""

    @jax.jit
    def run(x):
        end, forward = jax.linearize(function, x)
        (reverse,) = jax.vmap(jax.linear_transpose(forward, x))(jnp.eye(len(end)))
        return end, jax.vmap(forward, out_axes=1)(jnp.eye(len(x))), reverse

    return run


OPTIMIZED = {
    "xla_backend_optimization_level": 3,
    "xla_llvm_disable_expensive_passes": False,
}


@functools.cache
def values(name):
    """`run(states) -> (Impact, Audit)` of a law, numpy arrays, in batches of one compiled shape."""
    program = jax.jit(jax.vmap(one(LAWS[name].make)), compiler_options=OPTIMIZED)

    def run(states):
        columns = [np.stack(column) for column in zip(*map(padded, states))]
        parts = []
        for begin in range(0, len(states), LANES):
            at = np.arange(begin, begin + LANES).clip(max=len(states) - 1)
            part = program(*(column[at] for column in columns))
            parts.append(
                jax.tree.map(lambda x, b=begin: np.asarray(x)[: len(states) - b], part)
            )
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)

    return run


FEW = 8  # lanes of a program of derivatives


@functools.cache
def derivatives(name):
    """`run(states) -> [forward, reverse]` of v+ by (v, e, k, eta), a tuple each."""

    def one_state(mass, normals, gaps, v, e, k, eta, stored):
        def after(x):
            v, e, k, eta = x
            scene = ji.Scene(mass, normals, gaps=gaps)
            return ji.impact(LAWS[name].make(e, k, eta, stored), scene, v).velocity

        modes = (jax.jacfwd, jax.jacrev) if LAWS[name].reverse else (jax.jacfwd,)
        return [mode(after)((v, e, k, eta)) for mode in modes]

    program = jax.jit(jax.vmap(one_state))

    def run(states):
        assert len(states) <= FEW
        columns = [np.stack(column) for column in zip(*map(padded, states))]
        full = [np.resize(column, (FEW, *column.shape[1:])) for column in columns]
        return jax.tree.map(lambda x: np.asarray(x)[: len(states)], program(*full))

    return run


# ------------------------------------------------------------------------------- assertions

CODE = {row.name: code for code, row in enumerate(ji.STATUS)}


def as_matrix(matrix):
    """A Delassus matrix in full; of a chain it is tridiagonal."""
    return matrix.as_matrix() if hasattr(matrix, "as_matrix") else matrix


def kinetic_norm(scene):
    """`|grad f_j|` (m,) in the metric of M^-1, constraints or not."""
    mass, n = np.asarray(scene.mass), np.asarray(scene.normals)
    mass = np.diag(mass) if mass.ndim == 1 else mass
    return np.sqrt(np.sum(n * np.linalg.solve(mass, n), axis=0))


def names(status):
    """Names of status codes."""
    return [ji.STATUS[code].name for code in np.ravel(status)]


def failed(status):
    """Where the status says that the outcome must not be used."""
    return np.array([row.failure for row in ji.STATUS])[np.asarray(status)]


def check_held(name, states, allowed=None):
    """Held outcomes, impulses and statuses of many states, all of them reported that fail."""
    out, _ = values(name)(states)
    wrong = []
    for i, state in enumerate(states):
        n, m = state.size
        speed = np.abs(np.asarray(state.velocity, float)).max() or 1.0
        size = (allowed or 10 * LAWS[name].accuracy) * speed
        reported = ji.STATUS[out.status[i]].name
        if state.status is not None and reported != state.status:
            wrong.append((state.name or i, reported, state.status))
        heavy = np.abs(np.asarray(state.mass, float)).max()
        for got, held, scale in (
            (out.velocity[i, :n], state.after, 1.0),
            (out.impulse[i, :m], state.impulse, heavy),
        ):
            if held is None:
                continue
            error = np.abs(got - np.asarray(held, float)).max()
            if not error <= size * scale:
                wrong.append((state.name or i, error, got))
    assert not wrong, wrong
    return out


def below_highest(text):
    """Lines of a StableHLO program with products that ask for less than the highest precision."""
    products = re.finditer(r"^.*\bstablehlo\.dot_general\b.*$", text, re.M)
    return [x[0].strip() for x in products if "HIGHEST, HIGHEST" not in x[0]]
