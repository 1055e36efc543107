"""The impulses of one implicit step: friction in discs, and normal impulses that unloading cuts.

A step looks for impulses q = (f, y), normal (m) and tangential (t), at which the velocities
`w = b + K q` after it satisfy

    friction    y_j in the disc of radius mu_j f_j, against u_j: at its rim where u_j is not 0
    normal      f_j = F_j - a_j max(gamma_j, 0), not below 0

with the force F_j that the indentation at the beginning of the step gives, and the part a_j gamma_j
of it that a fast unloading takes away within the step (0: none). With F_j and the radii known this
is a convex problem; projected gradients, extrapolated by Anderson's method, solve it from the
impulses of the step before, scaled to the new load. Which contacts stick, which slip and where to,
and who carries what where contacts are redundant, comes out of the minimum: no modes, nothing to be
compiled for each contact.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.numerics.dense import regularized
from jimpact.numerics.discs import in_disc
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import precision

# Sweeps of one solve at most; 1 to 4 are usual. What is left then is an error of the step, which
# becomes shorter. Batches wait for their slowest solve: twice as many already take half as long
# again for boxes that are nearly flat, in as many steps.
SWEEPS = 8
# Added to the diagonal of the tangent equations, which are singular where contacts stick
# redundantly. Velocities do not depend on it. Ten times more: derivatives err by ten times the
# rounding that it amplifies.
RIDGE = 1e-10


class StepProblem(NamedTuple):
    """What the impulses (n, B) of a step have to satisfy, n = m + t."""

    coupling: Any  # K (n, n, B), whose `times` multiplies and `dense` writes it out
    velocity: jax.Array  # b (n, B), the velocities without the impulses
    load: jax.Array  # F (m, B), the largest normal impulses
    unloading: jax.Array  # a >= 0 (m, B)
    friction: jax.Array  # mu (m, B)
    descent: jax.Array  # (n, B), lengths of the steps of descent, see `descent_lengths`

    def projected(self, tried: jax.Array) -> jax.Array:
        """The admissible impulses (n, B) next to those that a step of gradient descent tries."""
        m, step = len(self.load), self.descent[: len(self.load)]
        cut = (self.unloading * tried[:m] + step * self.load) / (self.unloading + step)
        normal = jnp.where(self.unloading > 0, jnp.clip(cut, 0.0, self.load), self.load)
        side = tried[m:].reshape(m, -1, tried.shape[-1])
        side = in_disc(side, self.friction * normal)
        return jnp.concatenate([normal, side.reshape(tried[m:].shape)])

    def velocities(self, impulses: jax.Array) -> jax.Array:
        """w (n, B) after the impulses."""
        return self.velocity + self.coupling.times(impulses)

    def derivative(self, impulses: jax.Array) -> jax.Array:
        """Of the residual `q - projected(q - d w(q))` in the impulses, (n, n, B).

        A contact's projection depends on its own rows only: one direction for each kind of row.
        """
        n, m = len(impulses), len(self.load)
        kinds = n // m
        rows = np.concatenate([np.arange(m)[:, None], m + np.arange(n - m).reshape(m, -1)], axis=1)
        owner = np.argsort(rows.ravel()) // kinds  # the contact of each row
        tried = impulses - self.descent * self.velocities(impulses)
        one = jnp.eye(n, dtype=tried.dtype)[..., None]
        moved = one - self.descent[:, None] * self.coupling.dense(n)
        matrix = jnp.broadcast_to(one, moved.shape)
        for kind in range(kinds):
            direction = jnp.zeros_like(tried).at[rows[:, kind]].set(1.0)
            _, slope = jax.jvp(self.projected, (tried,), (direction,))
            matrix = matrix - slope[:, None] * moved[rows[owner, kind]]
        return matrix


def descent_lengths(coupling: jax.Array, contacts: int, friction_only: bool = False) -> jax.Array:
    """Lengths d (n, B) with which descent converges: diag(1/d) - K is positive semidefinite.

    Rows are scaled to a diagonal of at most 1, both tangents of a contact alike; the largest
    eigenvalue is then at most the largest sum of a row, and the fourth root of the Frobenius norm
    of the fourth power. `friction_only`: normal impulses are known, so their rows do not count.
    """
    n = len(coupling)
    size = coupling[jnp.arange(n), jnp.arange(n)]
    side = size[contacts:].reshape(contacts, -1, size.shape[-1])
    rows = side.shape[1]
    if rows:
        largest = jnp.repeat(jnp.max(side, axis=1), rows, axis=0)
        size = jnp.concatenate([size[:contacts], largest])
    size = jnp.where(size > 0, size, 1.0)
    root = jnp.sqrt(size)
    scaled = coupling / (root[:, None] * root[None])
    if friction_only:
        scaled = scaled.at[:contacts].set(0.0).at[:, :contacts].set(0.0)
    row_sum = jnp.max(jnp.sum(jnp.abs(scaled), axis=1), axis=0, keepdims=True)
    square = jnp.einsum("ij...,jk...->ik...", scaled, scaled)
    fourth = jnp.einsum("ij...,jk...->ik...", square, square)
    norm = jnp.sum(fourth**2, axis=(0, 1))[None] ** (1 / 8)
    longest = size * jnp.minimum(row_sum, norm)
    return 1 / jnp.where(longest > 0, longest, 1.0)


class Move(NamedTuple):
    """The impulses (n, B) that a step of descent reaches, and its way to them."""

    reached: jax.Array
    way: jax.Array


def extrapolated(now: Move, change: Move, before: Move, weight: jax.Array) -> jax.Array:
    """Impulses (n, B) from which descent would have no way to go, by Anderson's method of depth 2.

    `change`, `before`: by how much moves differed now and a sweep ago. The combination of ways that
    is least, in a metric with the weights (n, B), is taken for that of the impulses, too.
    """

    def dot(a: jax.Array, b: jax.Array) -> jax.Array:
        """Products (1, B)."""
        return jnp.sum(weight * a * b, axis=0, keepdims=True)

    aa, ab, bb = (dot(*x) for x in ((change.way,) * 2, (change.way, before.way), (before.way,) * 2))
    both = aa * bb - ab**2 > precision(weight.dtype).eps * aa * bb
    aa, bb = jnp.where(aa > 0, aa, 1.0), jnp.where(both, bb, 1.0)
    ab = jnp.where(both, ab, 0.0)
    a, b = dot(change.way, now.way), jnp.where(both, dot(before.way, now.way), 0.0)
    determinant = aa * bb - ab**2
    first, second = (a * bb - b * ab) / determinant, (b * aa - a * ab) / determinant
    return now.reached - first * change.reached - second * before.reached


@jax.custom_jvp
def solve(
    problem: StepProblem, start: jax.Array, tolerance: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Impulses (n, B) that leave velocities right to `tolerance` (1, B), from a guess.

    And by how much (1, B) the last sweep still changed velocities. Tangents solve the tangent
    equations of the problem, with one matrix for all directions.
    """

    class Sweep(NamedTuple):
        """The point that a sweep starts from, velocities there, the last move, its difference from
        the one before it; impulses, their error, sweeps done."""

        ahead: jax.Array
        velocities: jax.Array  # kept here, they are computed once: XLA fuses them into each use
        last: Move
        change: Move
        impulses: jax.Array
        error: jax.Array
        done: jax.Array

    weight = 1 / problem.descent

    def going(s: Sweep) -> jax.Array:
        """Whether a lane of the batch is not yet right."""
        return (s.done < SWEEPS) & jnp.any(s.error > tolerance)

    def sweep(s: Sweep) -> Sweep:
        """One step of descent, and the extrapolation from it and the two before it."""
        reached = problem.projected(s.ahead - problem.descent * s.velocities)
        now = Move(reached, reached - s.ahead)
        changes = jax.tree.map(lambda a, b: jnp.where(s.done > 0, a - b, 0.0), now, s.last)
        ahead = extrapolated(now, changes, s.change, weight)
        error = jnp.max(jnp.abs(weight * now.way), axis=0, keepdims=True)
        right = s.error <= tolerance  # such lanes keep what they have
        impulses = jnp.where(right, s.impulses, reached)
        error = jnp.where(right, s.error, error)
        velocities = problem.velocities(ahead)
        return Sweep(ahead, velocities, now, changes, impulses, error, s.done + 1)

    none = Move(*[jnp.zeros_like(start)] * 2)
    wrong = jnp.full_like(tolerance, jnp.inf)
    first = Sweep(start, problem.velocities(start), none, none, start, wrong, jnp.asarray(0))
    end = jax.lax.while_loop(going, sweep, first)
    return end.impulses, end.error


@solve.defjvp
@full_precision
def _solve_tangent(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """The impulses change as the residual, which stays 0, asks for; what is left has no tangent."""
    problem, (change, _, _) = primals[0], tangents
    impulses, left = solve(*primals)

    def reached(problem: StepProblem) -> jax.Array:
        """Where descent from these impulses leads to."""
        return problem.projected(impulses - problem.descent * problem.velocities(impulses))

    _, right = jax.jvp(reached, (problem,), (change,))
    ridge = jnp.full_like(impulses, RIDGE)
    rate = regularized(problem.derivative(impulses), right, ridge, 1)
    return (impulses, left), (rate, jnp.zeros_like(left))
