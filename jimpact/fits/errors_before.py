"""Errors of the velocities before an impact: the true v- of each shot is a nuisance of
the fit.

With x and y the measured v- and v+ of a shot, S the covariance of their errors, a its
true v- and f the law, the misfit is the least over a of
`(x - a, y - f(a)) S^-1 (x - a, y - f(a))^T`. Where f is linear, with `J = df/da`, the
nuisance is projected out:

    r = f(a) + J (x - a) - y,    C = A S A^T,    A = [-J, I],    misfit = r^T C^-1 r,
    a = x + (S A^T C^-1 r)_-,

where ( )_- are the first n entries, those of v-. Else f is linearized at the last a,
again and again, until a stays; the misfit and its gradient in parameters,
`2 r^T C^-1 df/dx` at fixed a, J and C, are then exact.

Where momentum was corrected, the projector P keeps what the correction has left of y: r
= P r, and A = P [-J, I].
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.fits.solve import AnyArray
from jimpact.shots.covariances import diagonal_blocks
from jimpact.shots.data import Experiments, kept_by_corrections


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class ErrorsBefore:
    """Errors of (v-, v+) of K shots in G groups that are independent of each other.

    A group is a shot, n velocities, or all shots, M = n K:
    `(v- of its shots, v+ of its shots)`.

    Attributes:
        covariance: S of each group.
        kept: P of each group.
        removed: `(I - P) S_++ (I - P)^T` of each group, which makes C invertible where
            r is 0.
    """

    covariance: Float[AnyArray, "G 2*M 2*M"]
    kept: Float[AnyArray, "G M M"]
    removed: Float[AnyArray, "G M M"]

    @classmethod
    def of(cls, data: Experiments, scene: Any) -> "ErrorsBefore":
        """The errors of shots that state those of v-.

        Args:
            data: K shots of n velocities.
            scene: of all shots; None: each has its own.
        """
        count, n = data.pre.shape
        joint = np.asarray(data.joint, float)
        kept = kept_by_corrections(data, scene)
        lost = np.eye(n) - kept
        after = diagonal_blocks(joint, 2 * n)[:, n:, n:]
        removed = lost @ after @ lost.swapaxes(1, 2)
        if joint.ndim == 3:
            return cls(joint, kept, removed)
        # (shot, - or +, velocity), twice
        parts = joint.reshape(count, 2, n, count, 2, n)
        side = 2 * n * count
        whole = parts.transpose(1, 0, 2, 4, 3, 5).reshape(1, side, side)
        kept_of_all = _block_diagonal(kept, 1, np)
        return cls(whole, kept_of_all, _block_diagonal(removed, 1, np))

    def filled(self, shots: Int[np.ndarray, " F"]) -> "ErrorsBefore":
        """F >= K shots by their indices: all K of them, then copies of the last one.

        In a group of all shots the copies have no errors and no correlations: their
        values have no weight.
        """
        groups = len(self.covariance)
        count = int(shots[-1]) + 1
        copies = len(shots) - count
        if not copies:
            return self
        if groups == count:
            of_shots = self.covariance[shots]
            return ErrorsBefore(of_shots, self.kept[shots], self.removed[shots])
        size = self.kept.shape[-1]
        more = copies * size // count
        halves = self.covariance.reshape(1, 2, size, 2, size)
        wider = ((0, 0), (0, 0), (0, more), (0, 0), (0, more))
        side = 2 * (size + more)
        covariance = np.pad(halves, wider).reshape(1, side, side)
        square = ((0, 0), (0, more), (0, more))
        wider_kept = np.pad(self.kept, square)
        return ErrorsBefore(covariance, wider_kept, np.pad(self.removed, square))

    def standard_errors(self, shape: tuple[int, ...]) -> Float[AnyArray, "K n"]:
        """Those of v-, in the shape (K, n) of the shots."""
        size = self.kept.shape[1]
        before = self.covariance[:, :size, :size]
        variances = before.diagonal(axis1=1, axis2=2)
        return (variances**0.5).reshape(shape)

    def drawn(
        self, rng: np.random.Generator, shape: tuple[int, int, int]
    ) -> tuple[Float[np.ndarray, "B K n"], Float[np.ndarray, "B K n"]]:
        """B sets of normally distributed errors of v- and of v+; `shape` is (B, K,
        n).
        """
        covariance = np.asarray(self.covariance, float)
        variances, directions = np.linalg.eigh(covariance)
        deviations = np.sqrt(np.maximum(variances, 0.0))
        scale = directions * deviations[:, None, :]
        groups, size = covariance.shape[:2]
        drawn = rng.normal(size=(shape[0], groups, size))
        errors = np.einsum("gij,bgj->bgi", scale, drawn)
        before, after = np.split(errors, 2, axis=2)
        return before.reshape(shape), after.reshape(shape)

    def corrected(
        self, pre: Float[np.ndarray, "B K n"], post: Float[np.ndarray, "B K n"]
    ) -> Float[np.ndarray, "B K n"]:
        """v+ with the momentum of v- where momentum was corrected:
        `P v+ + (I - P) v-`.
        """
        groups, size = self.kept.shape[:2]
        difference = (post - pre).reshape(-1, groups, size)
        projectors = np.asarray(self.kept, float)
        kept = np.einsum("gij,bgj->bgi", projectors, difference)
        return pre + kept.reshape(post.shape)

    def propagated(
        self, slope: Float[AnyArray, "K n n"], xp: Any = np
    ) -> tuple[Float[AnyArray, "G M 2*M"], Float[AnyArray, "G M M"]]:
        """A and C of each group, at these J (`slope`)."""
        groups, size = self.kept.shape[:2]
        slopes = _block_diagonal(slope, groups, xp)
        one = xp.eye(size, dtype=slopes.dtype)[None]
        identity = xp.broadcast_to(one, slopes.shape)
        both = xp.concatenate([-slopes, identity], axis=2)
        gain = self.kept @ both
        spread = gain @ self.covariance @ gain.swapaxes(1, 2)
        return gain, spread + self.removed

    def covariance_after(
        self, slope: Float[np.ndarray, "K n n"]
    ) -> Float[np.ndarray, "K n n"] | Float[np.ndarray, "K n K n"]:
        """C of each shot, or of all; J that are not finite count as the identity."""
        count, n = slope.shape[:2]
        covariance = np.asarray(self.propagated(_finite_slope(slope, np))[1])
        shape = (count, n, n) if len(covariance) == count else (count, n) * 2
        return covariance.reshape(shape)

    def covariance_of_true(
        self, slope: Float[np.ndarray, "K n n"]
    ) -> Float[np.ndarray, "K n n"]:
        """Covariance of the true v- of each shot:
        `S_-- - (S A^T)_- C^-1 (S A^T)_-^T`.
        """
        count, n = slope.shape[:2]
        gain, covariance = self.propagated(_finite_slope(slope, np))
        size = gain.shape[1]
        whole = np.asarray(self.covariance, float)
        cross = (whole @ gain.swapaxes(1, 2))[:, :size]
        solved = np.linalg.solve(covariance, cross.swapaxes(1, 2))
        explained = cross @ solved
        left = np.asarray(self.covariance, float)[:, :size, :size] - explained
        return diagonal_blocks(left if len(left) == count else left[0], n)

    def whitener(
        self, slope: Float[Array, "K n n"], used: Bool[Array, "K n"]
    ) -> "Whitener":
        """What makes the residuals r of the shots independent of each other, at these J
        (`slope`).

        Args:
            slope: J; where it is not finite, the identity.
            used: True for values of v+ that take part; the r of others must be 0.
        """
        groups, size = self.kept.shape[:2]
        gain, covariance = self.propagated(_finite_slope(slope, jnp), jnp)
        row = used.reshape(groups, size)
        takes_part = row[:, :, None] & row[:, None, :]
        identity = jnp.eye(size, dtype=covariance.dtype)[None]
        covariance = jnp.where(takes_part, covariance, identity)
        variances = jnp.diagonal(covariance, axis1=1, axis2=2)
        sigma = jnp.sqrt(variances)
        sizes = sigma[:, :, None] * sigma[:, None, :]
        factor = jnp.linalg.cholesky(covariance / sizes)
        product = self.covariance[:, :size] @ gain.swapaxes(1, 2)
        cross = product / sigma[:, None, :]
        return Whitener(sigma, factor, jnp.asarray(cross))


class Whitener(NamedTuple):
    """sigma and F of `C = diag(sigma) F F^T diag(sigma)`, and `(S A^T)_- / sigma`, by
    groups.
    """

    sigma: Float[Array, "G M"]
    factor: Float[Array, "G M M"]
    cross: Float[Array, "G M M"]

    def independent(self, error: Float[Array, "K n"]) -> Float[Array, "K n"]:
        """`F^-1 (r / sigma)`: errors r as independent ones of variance 1."""
        scaled = error.reshape(self.sigma.shape) / self.sigma
        return self._solved(scaled, transposed=False).reshape(error.shape)

    def shift(self, error: Float[Array, "K n"]) -> Float[Array, "K n"]:
        """`a - x = (S A^T C^-1 r)_-` of errors `r = predicted - measured`."""
        independent = self.independent(error).reshape(self.sigma.shape)
        force = self._solved(independent, transposed=True)
        moved = self.cross @ force[:, :, None]
        return moved[:, :, 0].reshape(error.shape)

    def _solved(
        self, right: Float[Array, "G M"], transposed: bool
    ) -> Float[Array, "G M"]:
        """`F^-1 right`, or `F^-T right`."""
        solve = jax.scipy.linalg.solve_triangular
        triangular = partial(solve, lower=True, trans=int(transposed))
        return jax.vmap(triangular)(self.factor, right)


def _finite_slope(slope: Float[AnyArray, "K n n"], xp: Any) -> Float[AnyArray, "K n n"]:
    """J of each shot; the identity where it has an entry that is not finite."""
    is_finite = xp.isfinite(slope)
    finite = is_finite.all(axis=(1, 2), keepdims=True)
    identity = xp.eye(slope.shape[1], dtype=slope.dtype)
    return xp.where(finite, slope, identity[None])


def _block_diagonal(
    blocks: Float[AnyArray, "K n n"], groups: int, xp: Any
) -> Float[AnyArray, "G M M"]:
    """Matrices (M, M) of G groups of K / G shots, with the shots' blocks on their
    diagonals.
    """
    count, n, _ = blocks.shape
    members = count // groups
    grouped = blocks.reshape(groups, members, n, 1, n)
    identity = xp.eye(members, dtype=blocks.dtype)
    same = identity[None, :, None, :, None]
    return (grouped * same).reshape(groups, members * n, members * n)
