"""The closed contacts of many bodies: the first rows of arrays of fixed length, in
blocks.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.scene import Scene, sparse_scene

# Contacts of a pile that are computed at once; rows without contacts are left out in
# such blocks. Ten times more: few contacts among many bodies take as long as all of
# them.
BLOCK = 128

Carry = TypeVar("Carry")


def over_blocks(
    count: jax.Array, one: Callable[[jax.Array, Carry], Carry], start: Carry
) -> Carry:
    """Result of a loop over blocks of `BLOCK` rows, as many as hold the first `count`
    () rows.

    Equation: `carry = one(first_row, carry)` for each block, from `carry = start` on.
    """
    blocks = (count + BLOCK - 1) // BLOCK
    return jax.lax.fori_loop(
        jnp.int32(0), blocks, lambda i, carry: one(i * BLOCK, carry), start
    )


def block(x: jax.Array, row: jax.Array) -> jax.Array:
    """The `BLOCK` rows of x (K, ...) from this one on."""
    return jax.lax.dynamic_slice_in_dim(x, row, BLOCK)


def with_block(x: jax.Array, values: jax.Array, row: jax.Array) -> jax.Array:
    """x (K, ...) with these values from this row on."""
    in_dtype = values.astype(x.dtype)
    return jax.lax.dynamic_update_slice_in_dim(x, in_dtype, row, 0)


class ActivePairs(NamedTuple):
    """The closed contacts of many bodies in the first of K rows, a multiple of `BLOCK`.

    Rows that are not used are 0.
    """

    # (K,) of the contact among all of them; `pair_count` in unused rows
    number: jax.Array
    closed: jax.Array  # (K,) whether the row is used
    filled: jax.Array  # () number of rows that are used
    bodies: jax.Array  # (K, 2); the number of bodies stands for a wall
    # (K, d, 2, velocities): normal and tangents, of both bodies, by the velocities of
    # each: x, y and turn in a plane, x, y, z and three turns in space
    directions: jax.Array
    overflows: jax.Array  # () whether more are closed than there are rows
    reach: jax.Array  # () [m]: bodies that move farther in one step may pass each other


class ListedPairs(NamedTuple):
    """The m closed contacts of many bodies on the host: those of two bodies first, then
    walls.
    """

    rows: np.ndarray  # (m,) of `ActivePairs`
    bodies: np.ndarray  # (m, 2), -1 for a wall
    directions: np.ndarray  # (m, d, 2, velocities) as of `ActivePairs`, 0 for a wall
    scene: Scene  # the contacts without friction


def listed_pairs(pairs: ActivePairs, mass: jax.Array) -> ListedPairs:
    """The closed contacts of bodies with masses (n,), on the host and in order, as a
    scene.
    """
    velocities = pairs.directions.shape[3]  # of a body
    count = len(mass) // velocities
    with_walls = np.where(pairs.bodies == count, -1, pairs.bodies)
    bodies = with_walls[: int(pairs.filled)]
    number = pairs.number[: len(bodies)]
    order = np.lexsort((number, bodies[:, 1] < 0))
    bodies = bodies[order]
    directions = np.array(pairs.directions)[order]
    moves = bodies[:, -1] >= 0  # walls do not
    directions[:, :, -1] *= moves[:, None, None]
    normals = jnp.asarray(directions[:, 0])
    scene = sparse_scene(mass, normals, bodies, count)
    return ListedPairs(order, bodies, directions, scene)


def chosen_rows(
    so_far: jax.Array, first: jax.Array, count: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """True (BLOCK,) for the rows from `first` on that are below `count` (), and their
    candidates.

    Equation: row k holds candidate `min {c: so_far_c = k + 1}` (BLOCK,), where `so_far`
    (C,) is the number of chosen ones among the candidates 0 to c.
    """
    row = first + np.arange(BLOCK, dtype=np.int32)
    found = jnp.searchsorted(so_far, row + 1)
    place = jnp.minimum(found, so_far.size - 1)
    return row < count, place
