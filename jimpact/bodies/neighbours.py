"""Pairs of points that are near each other, of thousands, by a grid of cells."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# Cells along each axis, about the middle of the points: their numbers fit in 32 bits.
# Points beyond count as in the last cell, so ten times fewer are too few for what flies
# apart.
_CELLS = {2: 40_000, 3: 1_200}

# Part by which a cell is longer than the distance, so that rounding of its number
# misses no pair. Ten times more only makes cells larger.
_SLACK = 1e-6


class Candidates(NamedTuple):
    """Pairs of points that may be near each other: each pair of near ones once, and
    others.
    """

    first: jax.Array  # (C,) of points, the smaller number
    second: jax.Array  # (C,)
    used: jax.Array  # (C,) whether the row is a pair
    overflows: jax.Array  # () whether a row of cells held more points than `crowd`


def all_pairs(count: int) -> Candidates:
    """Every pair of `count` points."""
    every_pair = np.triu_indices(count, 1)
    first, second = (jnp.asarray(x, jnp.int32) for x in every_pair)
    used = jnp.ones_like(first, bool)
    return Candidates(first, second, used, jnp.asarray(False))


def near_pairs(points: jax.Array, distance: jax.Array, crowd: int) -> Candidates:
    """Pairs of points (k, d) [m], d = 2 or 3: all nearer than `distance` () [m], and
    others.

    Space is divided into square or cubic cells of this length, and the points are
    sorted by the numbers of their cells, which are consecutive along the last axis.
    Each point is paired with the points after it in its own row of three cells (the
    cell before, its own, the next one along the last axis), and with those of half of
    the rows around: the other half pairs with it. A row may hold `crowd` points, else
    the result `overflows`.

    Source: Ericson, Real-Time Collision Detection (2005), ch. 7.1.
    """
    count, d = points.shape
    side = distance * (1 + _SLACK)
    middle = jnp.sort(points.T)[:, count // 2]  # a median: some may have flown away
    cell = jnp.floor((points - middle[None]) / side)
    half = _CELLS[d] // 2
    cell = jnp.clip(cell, -half, half).astype(jnp.int32)
    # room for a neighbour on both sides
    cell = cell - jnp.min(cell, axis=0, keepdims=True) + 1
    lengths = jnp.max(cell, axis=0) + 2  # number of cells along each axis

    def number(indices: jax.Array) -> jax.Array:
        """Numbers (k,) of cells with indices (k, d): `(i_1 L_2 + i_2) L_3 + i_3`, L =
        lengths.
        """
        result = indices[:, 0]
        for axis in range(1, d):
            result = result * lengths[axis] + indices[:, axis]
        return result

    own = number(cell)
    order = jnp.argsort(own).astype(jnp.int32)
    numbers = own[order]
    # place of each point in this order
    ranks = jnp.arange(count, dtype=jnp.int32)
    place = jnp.zeros(count, jnp.int32).at[order].set(ranks)
    begin = []
    end = []
    rows_around = itertools.product((-1, 0, 1), repeat=d - 1)
    for row in rows_around:
        if row < (0,) * (d - 1):
            continue  # points of these rows are paired with those of this one
        shifts = (np.array([[*row, last]], np.int32) for last in (-1, 1))
        low, high = (number(cell + shift) for shift in shifts)
        own_row = not any(row)
        begin.append(
            place + 1 if own_row else jnp.searchsorted(numbers, low, side="left")
        )
        end.append(jnp.searchsorted(numbers, high, side="right"))
    # (k, rows)
    starts = jnp.stack(begin, axis=1)
    ends = jnp.stack(end, axis=1)
    # (k, rows, crowd)
    offset = np.arange(crowd, dtype=np.int32)
    at = starts[:, :, None] + offset[None, None]
    used = at < ends[:, :, None]
    other = order[jnp.minimum(at, count - 1)]
    own_number = np.arange(count, dtype=np.int32)[:, None, None]
    point = jnp.broadcast_to(own_number, other.shape)
    first = jnp.minimum(point, other).reshape(-1)
    second = jnp.maximum(point, other).reshape(-1)
    overflows = jnp.any(ends - starts > crowd)
    return Candidates(first, second, used.reshape(-1), overflows)


def crowd_of(least: float, largest: float, d: int) -> int:
    """Most discs (d = 2) or balls that have centres in a row of three cells and do not
    overlap.

    Equation: with radii from `least` to `largest` [m], s = 2 `least` and cells of
    length a = 2 `largest`, `N = D (3 a + s) (a + s)^(d - 1) / V + 1`, V the volume of a
    ball of diameter s, D = .9069 (d = 2) and .7405 the share of the densest packing;
    one more for bodies that overlap a little.
    """
    ratio = largest / least
    densities = {2: np.sqrt(4 / 3), 3: np.sqrt(2)}
    density = densities[d]  # D s^d / V
    of_rows = density * (3 * ratio + 1)
    return int(of_rows * (ratio + 1) ** (d - 1)) + 1
