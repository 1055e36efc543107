"""Pairs of points that are near each other, of thousands, by a grid of cells."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# Cells along each axis, about the middle of the points: their numbers fit in 32 bits. Points beyond
# count as in the last cell, so ten times fewer are too few for what flies apart.
_CELLS = {2: 40_000, 3: 1_200}

# Part by which a cell is longer than the distance, so that rounding of its number misses no pair.
# Ten times more only makes cells larger.
_SLACK = 1e-6


class Candidates(NamedTuple):
    """Pairs of points that may be near each other: each pair of near ones once, and others."""

    first: jax.Array  # (C,) of points, the smaller number
    second: jax.Array  # (C,)
    used: jax.Array  # (C,) whether the row is a pair
    overflows: jax.Array  # () whether a row of cells held more points than `crowd`


def all_pairs(count: int) -> Candidates:
    """Every pair of `count` points."""
    first, second = (jnp.asarray(x, jnp.int32) for x in np.triu_indices(count, 1))
    return Candidates(first, second, jnp.ones_like(first, bool), jnp.asarray(False))


def near_pairs(points: jax.Array, distance: jax.Array, crowd: int) -> Candidates:
    """Pairs of points (k, d), d = 2 or 3, among which are all that are nearer than `distance` ().

    Points are sorted by cells of this size, those of neighbouring cells along the last axis next
    to each other. So each point looks at the next ones of its own row of three cells, and at half
    of the rows around it: a pair is met from one side only. A row may hold `crowd` points.

    Source: Ericson, Real-Time Collision Detection (2005), ch. 7.1.
    """
    count, d = points.shape
    side = distance * (1 + _SLACK)
    middle = jnp.sort(points.T)[:, count // 2]  # a median: some may have flown away
    cell = jnp.floor((points - middle[None]) / side)
    half = _CELLS[d] // 2
    cell = jnp.clip(cell, -half, half).astype(jnp.int32)
    cell = cell - jnp.min(cell, axis=0, keepdims=True) + 1  # room for a neighbour on both sides
    lengths = jnp.max(cell, axis=0) + 2

    def number(at: jax.Array) -> jax.Array:
        """The number of a cell, consecutive along the last axis."""
        result = at[:, 0]
        for axis in range(1, d):
            result = result * lengths[axis] + at[:, axis]
        return result

    own = number(cell)
    order = jnp.argsort(own).astype(jnp.int32)
    numbers = own[order]
    place = jnp.zeros(count, jnp.int32).at[order].set(jnp.arange(count, dtype=jnp.int32))
    begin, end = [], []
    for row in itertools.product((-1, 0, 1), repeat=d - 1):
        if row < (0,) * (d - 1):
            continue  # from there they are met
        low, high = (number(cell + np.array([[*row, last]], np.int32)) for last in (-1, 1))
        alone = not any(row)
        begin.append(place + 1 if alone else jnp.searchsorted(numbers, low, side="left"))
        end.append(jnp.searchsorted(numbers, high, side="right"))
    starts, ends = jnp.stack(begin, axis=1), jnp.stack(end, axis=1)  # (k, rows)
    at = starts[:, :, None] + np.arange(crowd, dtype=np.int32)[None, None]
    used = at < ends[:, :, None]
    other = order[jnp.minimum(at, count - 1)]
    point = jnp.broadcast_to(np.arange(count, dtype=np.int32)[:, None, None], other.shape)
    return Candidates(
        jnp.minimum(point, other).reshape(-1),
        jnp.maximum(point, other).reshape(-1),
        used.reshape(-1),
        jnp.any(ends - starts > crowd),
    )


def crowd_of(least: float, largest: float, d: int) -> int:
    """The most discs (d = 2) or balls with a centre in a row of three cells, if none overlap.

    Equation: with s = 2 `least` and cells of length a = 2 `largest`, balls of diameter s fill at
    most the share D of `(3 a + s) (a + s)^(d - 1)`, D = .9069 and .7405 of the densest packings;
    one more for bodies that overlap a little.
    """
    ratio = largest / least
    of_one = {2: np.sqrt(4 / 3), 3: np.sqrt(2)}[d]  # D over the share of a ball in its cube
    return int(of_one * (3 * ratio + 1) * (ratio + 1) ** (d - 1)) + 1
