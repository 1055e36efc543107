"""Impulse correlation ratios: a contact beside a collision gets a constant share of its
impulse.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact, delassus_matrix
from jimpact.core.law import Impulses, Law, Values, option, parameter
from jimpact.core.scene import Scene
from jimpact.laws import collisions
from jimpact.numerics.tridiagonal import as_matrix
from jimpact.tools.checks import is_traced
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import precision

# Relative excess of a ratio over an end of its interval that is rounding. Ten times
# more would still be far below what a measurement resolves.
ROUNDING = 1e-9


class ImpulseCorrelation(Law):
    """Collisions one after another; contacts beside one get a multiple of its impulse.

    Equation: contact i, the fastest, collides; contacts j that it presses and that do
    not separate have `dp_j = r_j dp_i` throughout. Contact j is compressed while
    `gamma_j < 0` and gives back e_j^2 of the work of compression (energetic
    restitution): with `p = s d`, d_i = 1, d_j = r_j, `a = W d`, the impulse ends at the
    larger root s of
    `d.a s^2 / 2 + d.gamma s + sum (1 - e_j^2) d_j gamma_j^2 / (2 a_j) = 0` (over
    contacts with gamma_j < 0). Then the next contact that approaches collides.

    The ratio is one of this scene and this kind of approach: it is measured or fitted.
    It is constant during the impact, where LZB's `dp_j / dp_i` begins at 0 and grows
    without bound.

    Args:
        restitution: energetic coefficient e in [0, 1], scalar or one per contact (m,).
        ratio: impulse correlation ratio r_j >= 0 of contact j beside any other, scalar
            or (m,), or a matrix (m, m): row i, column j of j beside i. Each must lie in
            `correlation_interval`, where contact i presses contact j.
        max_collisions: largest number of collisions before the law gives up.

    Raises:
        ValueError: by `impact`, a ratio outside `correlation_interval` (not inside
            jit).

    Status: `infeasible` where a ratio leads outside of what mechanics allows (a contact
    is left approaching, or more energy is lost than is there); `order_dependent`,
    `plastic_limit` and `max_steps` as in `Binary`.

    Derivatives, forward and reverse, at the order of collisions that occurs. At e = 0
    beside a contact at rest the slope in e is infinite, and 0 is returned.

    Source: Ceanga and Hurmuzlu, J. Appl. Mech. 68 (2001) 575; Brogliato (2016), 6.4.3.

    >>> import jimpact as ji
    >>> ji.impact(
    ...     ji.ImpulseCorrelation(0.9, ratio=1.0), ji.chain([1.0] * 3), [1.0, 0.0, 0.0]
    ... )
    Traceback (most recent call last):
    ...
    ValueError: Argument `ratio` must lie in [0.5, 0.948753] for contact 1 ...
    """

    separable: ClassVar[bool] = True

    restitution: Values = parameter(low=0.0, high=1.0)
    ratio: Values = parameter(low=0.0, matrix=True)
    max_collisions: int = option(10_000, low=1)

    def check(self, scene: Scene, dtype: jnp.dtype) -> None:
        """Raise a ValueError where a ratio of two closed contacts is outside its
        `interval`.
        """
        if is_traced((scene, self.restitution, self.ratio)):
            return
        m = scene.contacts
        # inside jit too, where all of these are known
        with jax.ensure_compile_time_eval():
            closed = np.asarray(scene.closed)
            low, high = interval(scene, self.restitution)
        ratio = np.broadcast_to(np.asarray(self.ratio, float), (m, m))
        both_closed = closed[:, None] & closed[None, :]
        pairs = np.argwhere(~np.isnan(low) & both_closed)
        for i, j in pairs:
            smallest = low[i, j] * (1 - ROUNDING)
            largest = high[i, j] * (1 + ROUNDING)
            if not smallest <= ratio[i, j] <= largest:
                raise ValueError(
                    f"Argument `ratio` must lie in [{low[i, j]:.6g}, {high[i, j]:.6g}] "
                    f"for contact {j} beside contact {i}, but has value "
                    f"{ratio[i, j]:.6g}."
                )

    @full_precision
    def impulses(self, contact: Contact) -> Impulses:
        """Sums p (m,) [N s] of the impulses of all collisions, and status."""
        p, _, end = collisions.solve(
            contact.delassus,
            contact.gap_velocity,
            self.restitution,
            gaps=None,
            cycle=None,
            max_collisions=self.max_collisions,
            ratio=self.ratio,
        )
        return Impulses(p, None, end.code)


def interval(scene: Scene, restitution: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest ratios r (m, m) of contact j beside contact i, on the host.

    Equation: `r >= -W_ij / W_jj`, so that j does not approach after the collision, and
    `W_jj r^2 + (1 - e_i^2) W_ij r - e_i^2 W_ii <= 0`, so that i does not. NaN where i
    does not press j (`W_ij >= 0`).
    """
    w = np.asarray(as_matrix(delassus_matrix(scene)), float)
    w_ii = np.diag(w)[:, None]
    w_jj = np.diag(w)[None, :]
    e = np.broadcast_to(np.asarray(restitution, float), (len(w),))[:, None]
    presses = w < -precision(float).noise * np.sqrt(w_ii * w_jj)
    w_ij = np.where(presses, w, np.nan)
    linear = (1 - e**2) * w_ij
    root = np.sqrt(linear**2 + 4 * w_jj * e**2 * w_ii)
    high = (-linear + root) / (2 * w_jj)
    return -w_ij / w_jj, high
