"""The impulses of one implicit step: friction in discs, and normal impulses that
unloading cuts.

A step looks for impulses q = (f, y), normal (m) and tangential (t), at which the
velocities `w = b + K q` after it satisfy

    friction    y_j in the disc of radius mu_j f_j, against u_j: at its rim where u_j is
                not 0
    normal      f_j = F_j - a_j max(gamma_j, 0), not below 0

with the force F_j that the indentation at the beginning of the step gives, and the part
a_j gamma_j of it that a fast unloading takes away within the step (0: none). With F_j
and the radii known this is a convex problem; projected gradients, extrapolated by
Anderson's method, solve it from the impulses of the step before, scaled to the new
load. Which contacts stick, which slip and where to, and who carries what where contacts
are redundant, comes out of the minimum: no modes, nothing to be compiled for each
contact. Nesterov's momentum (`many_contacts.py`), which knows no unloading, takes 2 to
9 times as long in 256 lanes of 2 to 8 contacts.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.numerics.dense import regularized
from jimpact.numerics.discs import in_disc
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import precision

# Sweeps of one solve at most; 1 to 4 are usual. What is left then is an error of the
# step, which becomes shorter. Batches wait for their slowest solve: twice as many
# already take half as long again for boxes that are nearly flat, in as many steps.
SWEEPS = 8
# Added to the diagonal of the tangent equations, which are singular where contacts
# stick redundantly. Velocities do not depend on it. Ten times more: derivatives err by
# ten times the rounding that it amplifies.
RIDGE = 1e-10


class StepProblem(NamedTuple):
    """Data of the problem above for the impulses q of a step, n = m + t rows."""

    coupling: Any  # K (n, n, B), whose `times` multiplies and `dense` writes it out
    velocity: Float[Array, "n B"]  # b, the velocities without the impulses
    load: Float[Array, "m B"]  # F, the largest normal impulses
    unloading: Float[Array, "m B"]  # a >= 0
    friction: Float[Array, "m B"]  # mu
    # lengths of the steps of descent, see `descent_lengths`
    descent: Float[Array, "n B"]

    def projected(self, tried: Float[Array, "n B"]) -> Float[Array, "n B"]:
        """The admissible impulses next to those `tried` by a step of descent of length
        d.

        Normal: `(a f + d F) / (a + d)` in [0, F], or F where a = 0; tangential: in the
        disc mu f.
        """
        m = len(self.load)
        step = self.descent[: len(self.load)]
        target = self.unloading * tried[:m] + step * self.load
        cut = target / (self.unloading + step)
        unloaded = jnp.clip(cut, 0.0, self.load)
        normal = jnp.where(self.unloading > 0, unloaded, self.load)
        lanes = tried.shape[-1]
        side = tried[m:].reshape(m, -1, lanes)
        side = in_disc(side, self.friction * normal)
        tangential = side.reshape(tried[m:].shape)
        return jnp.concatenate([normal, tangential])

    def velocities(self, impulses: Float[Array, "n B"]) -> Float[Array, "n B"]:
        """`w = b + K q` after the impulses q."""
        return self.velocity + self.coupling.times(impulses)

    def derivative(self, impulses: Float[Array, "n B"]) -> Float[Array, "n n B"]:
        """Jacobian in q of the residual `q - projected(q - d w(q))`.

        A contact's projection depends on its own rows only: one direction for each kind
        of row.
        """
        n = len(impulses)
        m = len(self.load)
        kinds = n // m
        tangents = m + np.arange(n - m).reshape(m, -1)
        rows = np.concatenate([np.arange(m)[:, None], tangents], axis=1)
        owner = np.argsort(rows.ravel()) // kinds  # the contact of each row
        tried = impulses - self.descent * self.velocities(impulses)
        one = jnp.eye(n, dtype=tried.dtype)[..., None]
        coupling = self.coupling.dense(n)
        moved = one - self.descent[:, None] * coupling  # d (q - d w) / dq
        matrix = jnp.broadcast_to(one, moved.shape)
        for kind in range(kinds):  # the normals, the first tangents, the second ones
            kind_rows = rows[:, kind]
            direction = jnp.zeros_like(tried).at[kind_rows].set(1.0)
            _, slope = jax.jvp(self.projected, (tried,), (direction,))
            matrix = matrix - slope[:, None] * moved[rows[owner, kind]]
        return matrix


def descent_lengths(
    coupling: Float[Array, "n n B"], contacts: int, friction_only: bool = False
) -> Float[Array, "n B"]:
    """Lengths d with which descent converges: diag(1/d) - K is positive semidefinite.

    Rows are scaled to a diagonal of at most 1, both tangents of a contact alike; the
    largest eigenvalue is then at most the largest sum of a row, and the fourth root of
    the Frobenius norm of the fourth power. `coupling` K has the normals of the contacts
    first, then the tangents of one contact after another; rows of diagonal 0 count as
    of size 1. `friction_only`: normal impulses are known, so their rows do not count.

    Equation: `1 / d_i = size_i min(max_j sum_k |S_jk|, |S^4|^(1/4))` with the scaled
    matrix S.
    """
    n = len(coupling)
    size = coupling[jnp.arange(n), jnp.arange(n)]
    lanes = size.shape[-1]
    side = size[contacts:].reshape(contacts, -1, lanes)
    tangents = side.shape[1]  # of a contact
    if tangents:
        of_contacts = jnp.max(side, axis=1)
        of_tangents = jnp.repeat(of_contacts, tangents, axis=0)
        size = jnp.concatenate([size[:contacts], of_tangents])
    size = jnp.where(size > 0, size, 1.0)
    root = jnp.sqrt(size)
    scaled = coupling / (root[:, None] * root[None])
    if friction_only:
        without_rows = scaled.at[:contacts].set(0.0)
        scaled = without_rows.at[:, :contacts].set(0.0)
    of_rows = jnp.sum(jnp.abs(scaled), axis=1)
    row_sum = jnp.max(of_rows, axis=0, keepdims=True)
    square = jnp.einsum("ij...,jk...->ik...", scaled, scaled)
    fourth = jnp.einsum("ij...,jk...->ik...", square, square)
    eighth_power = jnp.sum(fourth**2, axis=(0, 1))[None]
    norm = eighth_power ** (1 / 8)
    bound = size * jnp.minimum(row_sum, norm)  # of the eigenvalues
    return 1 / jnp.where(bound > 0, bound, 1.0)


class Move(NamedTuple):
    """Impulses that a step of descent reaches, and its way to them: reached minus
    start.
    """

    reached: Float[Array, "n B"]
    way: Float[Array, "n B"]


def extrapolated(
    now: Move, change: Move, before: Move, weight: Float[Array, "n B"]
) -> Float[Array, "n B"]:
    """Impulses from which descent would have no way to go, by Anderson's method of
    depth 2.

    `change`, `before`: by how much moves differed now and a sweep ago. The numbers c
    that make `way - c_1 change.way - c_2 before.way` least, in a metric with the
    weights, give the impulses `reached - c_1 change.reached - c_2 before.reached`.
    """

    def dot(a: Float[Array, "n B"], b: Float[Array, "n B"]) -> Float[Array, "1 B"]:
        """Scalar products `sum_i weight_i a_i b_i` over the rows."""
        return jnp.sum(weight * a * b, axis=0, keepdims=True)

    # normal equations [aa ab; ab bb] c = [a; b]; only c_1 where both changes are
    # parallel
    aa = dot(change.way, change.way)
    ab = dot(change.way, before.way)
    bb = dot(before.way, before.way)
    parallel = precision(weight.dtype).eps * aa * bb
    both = aa * bb - ab**2 > parallel
    aa = jnp.where(aa > 0, aa, 1.0)
    bb = jnp.where(both, bb, 1.0)
    ab = jnp.where(both, ab, 0.0)
    a = dot(change.way, now.way)
    of_before = dot(before.way, now.way)
    b = jnp.where(both, of_before, 0.0)
    determinant = aa * bb - ab**2
    first = (a * bb - b * ab) / determinant
    second = (b * aa - a * ab) / determinant
    return now.reached - first * change.reached - second * before.reached


@jax.custom_jvp
def solve(
    problem: StepProblem, start: Float[Array, "n B"], tolerance: Float[Array, "1 B"]
) -> tuple[Float[Array, "n B"], Float[Array, "1 B"]]:
    """Impulses q that leave velocities right to `tolerance`, from a guess `start`.

    And by how much the last sweep still changed velocities. Tangents solve the tangent
    equations of the problem, with one matrix for all directions.
    """

    class Sweep(NamedTuple):
        """State of the iteration."""

        ahead: Float[Array, "n B"]  # impulses that the sweep starts from
        # there; kept, as XLA would compute them in each use
        velocities: Float[Array, "n B"]
        last: Move  # of the sweep before
        change: Move  # its difference from the move before it
        impulses: Float[Array, "n B"]  # admissible ones
        error: Float[Array, "1 B"]  # of their velocities
        done: Int[Array, ""]  # sweeps

    weight = 1 / problem.descent

    def going(s: Sweep) -> Bool[Array, ""]:
        """True while a lane of the batch is not yet right and sweeps are left."""
        return (s.done < SWEEPS) & jnp.any(s.error > tolerance)

    def sweep(s: Sweep) -> Sweep:
        """State after one step of descent, and the extrapolation from it and the two
        before it.
        """
        reached = problem.projected(s.ahead - problem.descent * s.velocities)
        now = Move(reached, reached - s.ahead)
        goes_on = s.done > 0
        changes = jax.tree.map(lambda a, b: jnp.where(goes_on, a - b, 0.0), now, s.last)
        ahead = extrapolated(now, changes, s.change, weight)
        moved = jnp.abs(weight * now.way)
        error = jnp.max(moved, axis=0, keepdims=True)
        right = s.error <= tolerance  # such lanes keep what they have
        impulses = jnp.where(right, s.impulses, reached)
        error = jnp.where(right, s.error, error)
        velocities = problem.velocities(ahead)
        return Sweep(ahead, velocities, now, changes, impulses, error, s.done + 1)

    none = Move(*[jnp.zeros_like(start)] * 2)
    wrong = jnp.full_like(tolerance, jnp.inf)
    at_start = problem.velocities(start)
    first = Sweep(start, at_start, none, none, start, wrong, jnp.asarray(0))
    end = jax.lax.while_loop(going, sweep, first)
    return end.impulses, end.error


@solve.defjvp
@full_precision
def _solve_tangent(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Tangent dq of the impulses, from `R(q) = q - projected(q - d w(q)) = 0`: R_q dq =
    -dR.

    The error that is left has no tangent, as start and tolerance have none.
    """
    problem = primals[0]
    change, _, _ = tangents
    impulses, left = solve(*primals)

    def reached(problem: StepProblem) -> Float[Array, "n B"]:
        """`projected(q - d w(q))` of the problem at the impulses q of the solution."""
        return problem.projected(
            impulses - problem.descent * problem.velocities(impulses)
        )

    _, right = jax.jvp(reached, (problem,), (change,))
    ridge = jnp.full_like(impulses, RIDGE)
    # `without_null`: a direction of one contact's slip alone, which redundant contacts
    # do not have, would be taken up by impulses of 1 / RIDGE
    matrix = problem.derivative(impulses)
    rate = regularized(matrix, right, ridge, 1, without_null=True)
    return (impulses, left), (rate, jnp.zeros_like(left))
