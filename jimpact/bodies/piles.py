"""Piles: many discs between walls, each contact between two of them or with a wall."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, as_whole, check_values
from jimpact.bodies.base import (
    PLANAR,
    ActivePairs,
    Body,
    LinearPotential,
    numbered,
    planar_directions,
    planar_weight,
    positives,
    wheel,
)

# Contacts per disc that may be closed by default: equal discs have 3, and walls. Ten times more
# takes ten times the time.
ROOM = 4


class Discs(Body):
    """Discs in a plane between straight walls; q = (x, y, turn) of each in turn.

    Equation: `f = |c_i - c_j| - R_i - R_j`, and `f = n_w . c_i - d_w - R_i` at wall w; sliding
    `(v_i - v_j) . t - R_i omega_i - R_j omega_j`, t = n turned by a quarter counter-clockwise.
    Inertia `m R^2 / 2`. As a `Scene` it has a contact for every pair, those of disc 1 first, and
    for each disc and wall, disc by disc. Motions of many discs are those of
    `simulate(method="time_stepping")`, which looks at closed contacts only.

    Args:
        masses: > 0, scalar or (k,) [kg].
        radii: > 0 (k,) [m].
        walls: rows (n_x, n_y, d): the half plane `n . x >= d` is free; n is made a unit vector.
        room: largest number of closed contacts at once in time stepping; None: 4 per disc.

    >>> import jimpact as ji
    >>> discs = ji.Discs(1.0, [0.1, 0.1], walls=[[0.0, 1.0, 0.0]])
    >>> [round(float(f), 6) for f in discs.gap_function(discs.at([[0.0, 0.1], [0.5, 0.1]]))]
    [0.3, 0.0, 0.0]
    """

    masses: jax.Array
    radii: jax.Array
    walls: jax.Array
    room: int = eqx.field(static=True)

    def __init__(self, masses: Any, radii: Any, walls: Any = (), room: int | None = None):
        self.radii = positives("radii", radii)
        if not len(self.radii):
            raise ValueError("Argument `radii` must hold a disc, but is empty.")
        self.masses = positives("masses", masses, self.radii.shape[0])
        rows = as_float_array("walls", np.reshape(walls, (-1, 3)) if len(walls) == 0 else walls)
        if rows.ndim != 2 or rows.shape[1] != 3:
            raise ValueError(f"Argument `walls` must have shape (w, 3), but has {rows.shape}.")
        check_values("walls", rows)
        length = jnp.sqrt(jnp.sum(rows[:, :2] ** 2, axis=1))
        check_values("walls", length, low=0.0, open_low=True)
        scale = jnp.stack([length, length, jnp.ones_like(length)], axis=1)
        self.walls = (rows / scale).astype(self.radii.dtype)
        self.room = ROOM * len(self.radii) if room is None else as_whole("room", room, 1)

    @property
    def count(self) -> int:
        """Number of discs."""
        return self.radii.shape[0]

    @property
    def mass(self) -> jax.Array:
        """M, its diagonal (n,)."""
        turning = 0.5 * self.masses * self.radii**2
        return jnp.stack([self.masses, self.masses, turning], axis=1).reshape(-1)

    def at(self, centres: Any) -> jax.Array:
        """q (n,) with the discs, not turned, at these centres (k, 2) [m]."""
        places = as_float_array("centres", centres)
        if places.shape != (self.count, 2):
            raise ValueError(
                f"Argument `centres` must have shape ({self.count}, 2), but has {places.shape}."
            )
        return jnp.pad(places, ((0, 0), (0, 1))).reshape(-1)

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = g sum m_i y_i`."""
        return planar_weight(self.mass, acceleration)

    @property
    def base_directions(self) -> jax.Array:
        """The walls move in x and y (n, 2)."""
        return planar_directions(self.mass)

    # ---- all contacts

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps of all pairs, then of each disc with every wall."""
        first, second, gaps = *self._pairs(), self._all_gaps(q)
        return jnp.concatenate([gaps[first, second], gaps[:, self.count :].reshape(-1)])

    def tangent_function(self, q: jax.Array) -> jax.Array:
        """Ways that the discs slide on each other and along the walls."""
        at = q.reshape(-1, 3)
        first, second = self._pairs()
        way = at[first, :2] - at[second, :2]
        rolled = self.radii * at[:, 2]
        both = self.radii[first] + self.radii[second]
        around = both * jnp.arctan2(way[:, 1], way[:, 0]) - rolled[first] - rolled[second]
        slid = at[:, :2] @ jnp.stack([-self.walls[:, 1], self.walls[:, 0]]) - rolled[:, None]
        return jnp.concatenate([around, slid.reshape(-1)])

    def _pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """First and second disc of every pair."""
        return np.triu_indices(self.count, 1)

    def _all_gaps(self, q: jax.Array) -> jax.Array:
        """(k, k + w), of which pairs count once, above the diagonal; elsewhere inf."""
        centres = q.reshape(-1, 3)[:, :2]
        once = np.triu(np.ones((self.count, self.count), bool), 1)
        squares = jnp.sum((centres[:, None] - centres[None]) ** 2, axis=2)
        apart = jnp.sqrt(jnp.where(once, squares, 1.0)) - self.radii[:, None] - self.radii[None]
        to_walls = centres @ self.walls[:, :2].T - self.walls[None, :, 2] - self.radii[:, None]
        return jnp.concatenate([jnp.where(once, apart, jnp.inf), to_walls], axis=1)

    # ---- closed contacts only

    @property
    def pair_count(self) -> int:
        """Every pair (i, j), in both orders, and every disc with every wall."""
        return self.count * (self.count + len(self.walls))

    def active_pairs(self, q: jax.Array, later: jax.Array, below: jax.Array) -> ActivePairs:
        """The contacts, at q, with gaps up to `below` at q or `later`."""
        gaps = jnp.minimum(self._all_gaps(q), self._all_gaps(later))
        none, columns = gaps.size, gaps.shape[1]
        closed = gaps.reshape(-1) <= below
        number = jnp.nonzero(closed, size=self.room, fill_value=none)[0]
        used = number < none
        i, j = jnp.where(used, number, 0) // columns, jnp.where(used, number, 0) % columns
        wall = j >= self.count
        at, radius = q.reshape(-1, 3), self.radii
        other = jnp.minimum(j, self.count - 1)
        way = at[i, :2] - at[other, :2]
        length = jnp.sqrt(jnp.sum(way**2, axis=1, keepdims=True))
        normal = way / jnp.where(length > 0, length, 1.0)
        if len(self.walls):
            row = self.walls[jnp.maximum(j - self.count, 0)]
            normal = jnp.where(wall[:, None], row[:, :2], normal)
        zero = jnp.zeros_like(normal[:, 0])
        x, y = normal.T
        arms = -radius[i], -jnp.where(wall, 0.0, radius[other])
        first = jnp.stack([jnp.stack([x, y, zero], 1), jnp.stack([-y, x, arms[0]], 1)], axis=1)
        second = jnp.stack([jnp.stack([-x, -y, zero], 1), jnp.stack([y, -x, arms[1]], 1)], axis=1)
        directions = jnp.stack([first, second], axis=2)
        return ActivePairs(
            number,
            used,
            jnp.stack([i, jnp.where(wall, self.count, other)], axis=1),
            jnp.where(used[:, None, None, None], directions, 0.0),
            jnp.sum(closed) > self.room,
            jnp.min(radius),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """x, y, angle of each disc."""
        return numbered(PLANAR, self.count)

    @property
    def floors(self) -> list[tuple[float, float]]:
        """The walls."""
        return [(float(np.arctan2(-x, y)), float(d)) for x, y, d in np.asarray(self.walls)]

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Circles, each with the radius that shows how far it has turned."""
        return [wheel(r, at) for r, at in zip(self.radii, q.reshape(-1, 3))]
