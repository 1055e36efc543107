"""A symmetric matrix with few entries in each row, such as the Delassus matrix of a
packing.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jimpact.tools.compiling import full_precision
from jimpact.tools.loops import while_loop
from jimpact.tools.masks import quotient
from jimpact.tools.precision import precision

# Residual over the right side at which conjugate gradients end, in roundings, and the
# one from which on the system counts as having no solution, as a power of eps. Ten
# times more: derivatives lose a digit; systems without a solution pass.
_CONVERGED = 1e3
_NO_SOLUTION = 0.25
# Iterations per unknown that conjugate gradients take at most; a packing of 3000
# spheres takes .1. Ten times more: a singular system takes ten times longer to be
# found.
_MOST = 2


class Neighbours:
    """Contacts (m, 2) between two bodies each, and which contacts have a common body.

    Body -1 is none (a wall). It is part of the structure of a program, not of its data,
    so it is compared by its numbers.
    """

    def __init__(self, bodies: Any, count: int):
        self.bodies = np.ascontiguousarray(bodies, np.int32)
        self.count = count
        self._key = self.bodies.tobytes(), count

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Neighbours) and self._key == other._key

    @cached_property
    def of_contacts(self) -> np.ndarray:
        """Table (m, K) of the neighbours of each contact, itself where it has fewer
        than K.
        """
        bodies = range(self.count)
        of_body: list[list[int]] = [[] for _ in bodies]
        for contact, pair in enumerate(self.bodies):
            for body in pair[pair >= 0]:
                of_body[body].append(contact)
        rows = [
            sorted(
                {other for body in pair[pair >= 0] for other in of_body[body]}
                - {contact}
            )
            for contact, pair in enumerate(self.bodies)
        ]
        own = np.arange(len(rows))[:, None]
        most = max(1, *map(len, rows))
        table = np.tile(own, (1, most))
        for row, others in zip(table, rows):
            row[: len(others)] = others
        return table

    @cached_property
    def shared(self) -> np.ndarray:
        """Mask (m, K, 2, 2): body s of a contact is body t of its k-th neighbour."""
        own = self.bodies[:, None, :, None]
        other = self.bodies[self.of_contacts][:, :, None, :]
        contact = np.arange(len(self.bodies))
        real = self.of_contacts != contact[:, None]
        same = (own == other) & (own >= 0)
        return same & real[:, :, None, None]


class Sparse(eqx.Module):
    """Symmetric matrix: its diagonal, and the entries at the K neighbours of each
    row.
    """

    diagonal: Float[Array, " m"]
    entries: Float[Array, "m K"]
    neighbours: Neighbours = eqx.field(static=True)

    def __matmul__(self, vector: Float[ArrayLike, " m"]) -> Float[Array, " m"]:
        """Product `A x`."""
        vector = jnp.asarray(vector)
        return self.diagonal * vector + neighbour_sum(
            self.entries, vector, self.neighbours
        )

    def __abs__(self) -> "Sparse":
        """|A|, entry by entry."""
        entries = jnp.abs(self.entries)
        return Sparse(jnp.abs(self.diagonal), entries, self.neighbours)

    def as_matrix(self) -> Float[Array, "m m"]:
        """The dense matrix."""
        rows = np.arange(len(self.diagonal))
        dense = jnp.diag(self.diagonal)
        columns = self.neighbours.of_contacts
        return dense.at[rows[:, None], columns].add(self.entries)

    def scaled(self, scale: Float[Array, " m"]) -> "Sparse":
        """`diag(scale) A diag(scale)`."""
        of_columns = scale[self.neighbours.of_contacts]
        entries = self.entries * scale[:, None] * of_columns
        return Sparse(self.diagonal * scale**2, entries, self.neighbours)

    def within(self, part: Bool[Array, " m"]) -> "Sparse":
        """The matrix whose rows and columns outside the mask `part` hold their diagonal
        only.
        """
        both = part[:, None] & part[self.neighbours.of_contacts]
        entries = jnp.where(both, self.entries, 0.0)
        return Sparse(self.diagonal, entries, self.neighbours)


def neighbour_sum(
    entries: Float[Array, "m K *#B"],
    vector: Float[Array, "m *#B"],
    neighbours: Neighbours,
) -> Float[Array, "m *#B"]:
    """`sum_k a_jk x_n(j, k)` with n(j, k) the k-th neighbour of contact j."""
    return jnp.sum(entries * vector[neighbours.of_contacts], axis=1)


@full_precision
def conjugate_gradients(
    product: Callable[[jax.Array], jax.Array], right: Float[Array, " m"]
) -> Float[Array, " m"]:
    """`A^-1 right` by products with A symmetric, positive semidefinite, of diagonal 1.

    The solution of least norm where A is singular, NaN where there is none.
    Differentiable. Source: Hestenes and Stiefel (1952).

    >>> import jax.numpy as jnp
    >>> from jimpact.numerics.sparse import conjugate_gradients
    >>> halves = lambda x: 0.5 * x
    >>> conjugate_gradients(halves, jnp.array([1.0, 2.0])).tolist()
    [2.0, 4.0]
    """
    return jax.lax.custom_linear_solve(product, right, _iterated, symmetric=True)


# `jax.scipy.sparse.linalg.cg` with a check of what it leaves is as accurate, and later
# calls take as long (0.9 to 1.1 times), but first calls 1.0 to 1.6 times: values and
# both derivatives, one and 64 lanes, 180 and 760 contacts, float64 and float32.
def _iterated(
    product: Callable[[jax.Array], jax.Array], right: Float[Array, " m"]
) -> Float[Array, " m"]:
    """`A^-1 right` as `conjugate_gradients`, from x = 0; NaN where the residual does
    not vanish.
    """
    eps = precision(right.dtype).eps
    size = jnp.vdot(right, right)

    def going(state: tuple[Iterate, Int[Array, ""]]) -> Bool[Array, ""]:
        """True while the residual is too large and iterations are left."""
        at, done = state
        open_residual = at.square > (_CONVERGED * eps) ** 2 * size
        return open_residual & (done < _MOST * len(right) + 10)

    def iterate(
        state: tuple[Iterate, Int[Array, ""]],
    ) -> tuple[Iterate, Int[Array, ""]]:
        """State after one more step, and the number of steps."""
        at, done = state
        new, curved = conjugate_step(product, jnp.vdot, at)
        # a direction without curvature: A is singular, and no step reduces what is left
        stop = _MOST * len(right) + 10
        return new, jnp.where(curved, done + 1, stop)

    zero = jnp.zeros_like(right)
    start = Iterate(zero, right, right, size), jnp.int32(0)
    end, _ = while_loop(going, iterate, start)
    vanishes = end.square <= eps ** (2 * _NO_SOLUTION) * size
    return jnp.where(vanishes, end.x, jnp.nan)


class Iterate(NamedTuple):
    """State of conjugate gradients for one system A x = right, or for a batch in the
    last axis.
    """

    x: Float[Array, "m *B"]
    residual: Float[Array, "m *B"]  # r = right - A x
    direction: Float[Array, "m *B"]  # d
    square: Float[Array, "..."]  # r^T r, one number for each system


def conjugate_step(
    product: Callable[[jax.Array], jax.Array],
    dot: Callable[[jax.Array, jax.Array], jax.Array],
    at: Iterate,
) -> tuple[Iterate, Bool[Array, "..."]]:
    """State after a step of conjugate gradients, and whether A has curvature along its
    direction.

    Equation: `x + a d`, `r - a A d`, `r+ + b d` with `a = r^T r / d^T A d`,
    `b = r+^T r+ / r^T r`.

    Args:
        product: A times a vector.
        dot: scalar product of two vectors.
        at: the state before it.
    """
    x, residual, direction, square = at
    image = product(direction)
    curvature = dot(direction, image)
    curved = curvature > 0
    length = quotient(square, curvature, where=curved)
    x = x + length * direction
    residual = residual - length * image
    new = dot(residual, residual)
    ratio = quotient(new, square, where=square > 0)
    return Iterate(x, residual, residual + ratio * direction, new), curved


def components(touches: np.ndarray) -> np.ndarray:
    """Labels of the columns of a boolean matrix: the first column of their connected
    component.

    Columns with a common row are connected.
    """
    count = touches.shape[1]
    label = np.arange(count)
    while True:
        of_entries = np.where(touches, label[None, :], count)
        of_row = of_entries.min(axis=1)
        least = np.where(touches, of_row[:, None], count).min(axis=0)
        least = least[least]  # of the column it points to: long chains take few rounds
        if (least == label).all():
            return label
        label = least
