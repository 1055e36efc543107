"""Fits of a restitution matrix: the region in which it is consistent for every approach."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linprog

from jimpact.contact import decoupled, delassus_matrix, kinetic_norm
from jimpact.fits.matrix_region import AdmissibleMatrices
from jimpact.law import Law
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.scene import Scene
from jimpact.solvers.tridiagonal import as_matrix, scaled

# Every support of m contacts gives a condition on the energy, 2^m - 1 in all.
LARGEST = 6

# Conditions may be broken by rounding, in units of the entries of G^-1.
_ROUNDING = {"float64": 1e-9, "float32": 1e-4}
_REDUNDANT = 100.0  # G with an eigenvalue below this multiple of m eps has no inverse
_HALVINGS = 40  # from a start on the boundary towards the inside
_FACES = ("E >= 0", "G^-1 (I + E) >= 0", "G^-1 - E^T G^-1 E copositive (energy)")


def matrix_region(
    law: Law, scenes: list[Scene], origin: np.ndarray, mix: np.ndarray, bounds: np.ndarray
) -> AdmissibleMatrices | None:
    """The region of a fit of an (m, m) `RestitutionMatrix`; None for other laws and forms.

    Args:
        law: holds the start matrix.
        scenes: of the shots; E must be admissible in each.
        origin: (Q,) entries of E where y = 0.
        mix: (Q, Q) derivatives of the entries with respect to y.
        bounds: (2, Q) of y.

    Raises:
        ValueError: redundant contacts, too many contacts, a start that is not admissible, held
            entries that leave no room.
    """
    if not encloses(law, scenes[0]):
        return None
    assert isinstance(law, RestitutionMatrix)
    m, dtype = scenes[0].contacts, law.matrix.dtype
    if m > LARGEST:
        raise ValueError(
            f"Argument `law` must have at most {LARGEST} contacts to keep its matrix admissible, "
            f"but has {m}. RestitutionMatrix(matrix, admissible=False) is fitted without that."
        )
    found = np.unique([_inverse(scene) for scene in scenes], axis=0)
    inverse, closed = found[:, :m], found[:, m]
    used = np.any(mix != 0, axis=0)
    ends = bounds if np.isfinite(bounds[:, used]).any() else None
    arrays = [None if a is None else jnp.asarray(a, dtype) for a in (inverse, closed, ends)]
    start = jnp.asarray(_start(law.matrix, origin, mix), dtype)
    every = jnp.ones((1 + len(inverse)) * m * m + (0 if ends is None else ends.size), bool)
    affine = (jnp.asarray(origin, dtype), jnp.asarray(mix, dtype))
    region = AdmissibleMatrices(*affine, *arrays, start, every)
    slack, rows = _host_conditions(region, start)
    _check_start(region, slack)
    moving = np.any(rows[:, used] != 0, axis=1) & np.isfinite(slack)
    region = eqx.tree_at(lambda r: r.moving, region, jnp.asarray(moving[: len(every)]))
    return eqx.tree_at(lambda r: r.center, region, _center(region, slack, rows, moving))


def encloses(law: Law, scene: Scene) -> bool:
    """Whether a fit keeps this law's matrix admissible."""
    return (
        isinstance(law, RestitutionMatrix)
        and law.admissible
        and law.matrix.shape[0] == scene.contacts
    )


def _inverse(scene: Scene) -> np.ndarray:
    """G^-1 with a further row that marks closed contacts."""
    w = decoupled(delassus_matrix(scene), scene.closed)
    g = np.asarray(as_matrix(scaled(w, 1 / kinetic_norm(scene))))
    smallest = np.linalg.eigvalsh(g)[0]
    if smallest < _REDUNDANT * len(g) * np.finfo(g.dtype).eps:
        raise ValueError(
            "Argument `scene` must have no redundant contacts to keep a restitution matrix "
            f"admissible, but the smallest eigenvalue of G is {smallest:.3g}. "
            "RestitutionMatrix(matrix, admissible=False) is fitted without that."
        )
    return np.vstack([np.linalg.inv(g), np.asarray(scene.closed, g.dtype)])


def _start(entries: Any, origin: Any, mix: Any) -> np.ndarray:
    """y of these entries of E (0 for what is not free)."""
    rest = np.ravel(np.asarray(entries, float)) - np.asarray(origin, float)
    return np.asarray(np.linalg.lstsq(np.asarray(mix, float), rest, rcond=None)[0])


@eqx.filter_jit
def _all_conditions(region: AdmissibleMatrices, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    return region.conditions(y)


def _host_conditions(region: AdmissibleMatrices, y: Any) -> tuple[np.ndarray, np.ndarray]:
    slack, rows = _all_conditions(region, jnp.asarray(y, region.center.dtype))
    return np.asarray(slack, float), np.asarray(rows, float)


def _kinds(region: AdmissibleMatrices) -> tuple[slice, slice, slice]:
    """Where the conditions named in `_FACES` are in a list of all."""
    entries, elementwise = len(region.origin), len(region.moving)
    impulses = entries * (1 + len(region.inverse))
    return slice(entries), slice(entries, impulses), slice(elementwise, None)


def _rounding(region: AdmissibleMatrices) -> float:
    return _ROUNDING[str(region.center.dtype)] * float(np.abs(np.asarray(region.inverse)).max())


def _check_start(region: AdmissibleMatrices, slack: np.ndarray) -> None:
    """Raise a ValueError that names the condition the start matrix breaks."""
    for name, kind in zip(_FACES, _kinds(region)):
        if slack[kind].min() < -_rounding(region):
            raise ValueError(
                "Argument `law` must start from an admissible matrix, consistent for all approach "
                f"velocities, but {name} fails by {-slack[kind].min():.3g}. "
                "RestitutionMatrix(matrix, admissible=False) is fitted without that."
            )


def _center(
    region: AdmissibleMatrices, slack: np.ndarray, rows: np.ndarray, moving: np.ndarray
) -> jax.Array:
    """A point strictly inside: from the start, in the direction that all conditions like best."""
    start = np.asarray(region.center, float)
    used = np.any(rows[moving] != 0, axis=0)
    found = linprog(
        np.append(np.zeros(len(start)), -1.0),  # the least slack after the step is to be large
        A_ub=np.hstack([-rows, np.ones((len(rows), 1))])[moving],
        b_ub=slack[moving],
        bounds=[*((-int(free), int(free)) for free in used), (None, 1.0)],
    )
    move = found.x[:-1] if found.success else np.zeros(len(start))
    for halving in range(_HALVINGS):
        center = start + 0.5**halving * move
        if _host_conditions(region, center)[0][moving].min() > _rounding(region):
            return jnp.asarray(center, region.center.dtype)
    raise ValueError(
        "Argument `free` must leave room for an admissible matrix: with the held entries every "
        "free entry is at the edge already."
    )


def boundary(region: Any, entries: np.ndarray) -> tuple[str, ...]:
    """The conditions that a fitted E is at the edge of (other than by held entries), in words."""
    if not isinstance(region, AdmissibleMatrices):
        return ()
    slack, rows = _host_conditions(region, _start(entries, region.origin, region.map))
    at = (slack < _rounding(region)) & np.any(rows != 0, axis=1)
    return tuple(name for name, kind in zip(_FACES, _kinds(region)) if at[kind].any())
