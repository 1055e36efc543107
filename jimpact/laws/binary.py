"""Binary collisions: the contacts collide one after another, in a given order."""

import operator
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact
from jimpact.core.law import (
    Impulses,
    Law,
    OptionalValues,
    Values,
    check_law,
    option,
    parameter,
)
from jimpact.core.scene import Scene, as_velocity, velocity_change
from jimpact.laws import collisions
from jimpact.laws.friction import friction_fields
from jimpact.numerics.tridiagonal import Tridiagonal
from jimpact.tools.checks import as_whole, check_values, in_common_dtype
from jimpact.tools.compiling import full_precision, precise_jit

ORDERS = ("fastest", "earliest", "left_to_right")


def _is_index(j: Any) -> bool:
    """True for a whole number >= 0, which is no truth value."""
    return not isinstance(j, bool) and hasattr(j, "__index__") and j >= 0


def _checked_order(order: Any) -> str | tuple[int, ...]:
    """`order` as a name or a tuple of ints; raise a ValueError for any other value."""
    if isinstance(order, str) and order in ORDERS:
        return order
    if not isinstance(order, (tuple, list)) or not order:
        raise ValueError(
            f"Argument `order` must be one of {ORDERS} or a tuple of contact indices, "
            f"but has value {order!r}."
        )
    if not all(_is_index(j) for j in order):
        raise ValueError(
            f"Argument `order` must hold contact indices >= 0, but has value {order!r}."
        )
    return tuple(operator.index(j) for j in order)


class Binary(Law):
    """Sequential pair collisions until no contact approaches.

    Equation, at one contact after another: `p_j = -(1 + e_j) gamma_j / W_jj`,
    `gamma += W[:, j] p_j`, hence `gamma_j+ = -e_j gamma_j` there.

    Args:
        restitution: kinematic coefficient e in [0, 1], scalar or one per contact (m,).
        order: 'fastest': the contact with the largest approach speed [m/s];
            'earliest': the one that closes first (gap / approach speed), gaps change in
            free flight between collisions (None: all closed), ties are decided by
            'fastest'; 'left_to_right': contacts 0 .. m-1 in turn, again and again;
            a tuple of all contact indices (0-based, repeats allowed): in turn,
            likewise. Contacts that do not approach are skipped.
        max_collisions: largest number of collisions before the law gives up.
        friction: Coulomb's mu >= 0, scalar or (m,), for scenes with tangents; None: no
            friction.
        tangential_restitution: e_t in [-1, 1], scalar or (m,): sticking is
            `u+ = -e_t u-`.

    With friction each collision is one contact's: `p_t in -mu p Sgn(u+ + e_t u-)`, u
    its slip velocity; it may set its neighbours in motion, along and across. In every
    order but 'earliest' gap sizes do not matter: open contacts that approach collide
    too.

    Status: `order_dependent` where two coupled contacts were equally fast (early)
    within rounding (the lower index went first); `plastic_limit` where collisions go on
    forever: for two contacts exactly iff z >= 1 and the state is in the invariant cone,
    gamma+ = 0 then; for more where approach speeds decay below rounding without ending;
    `max_steps` at `max_collisions`.

    Derivatives, forward and reverse, in restitution, W and gamma-, at the order of
    collisions that occurs. v+ is continuous where the number of collisions changes,
    with one-sided derivatives; it jumps where the order of coupled contacts changes.
    Derivatives in gaps are zero.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.3), (6.4), (6.13) corrected,
    (6.17)-(6.21); Towne and Hadlock, Am. J. Phys. 45 (1977) 255 (number of collisions).

    >>> import jimpact as ji
    >>> out = ji.impact(
    ...     ji.Binary([0.9, 0.8]), ji.chain([1.0, 2.0, 3.0]), [1.0, 0.0, 0.0]
    ... )
    >>> [round(float(v), 6) for v in out.velocity]
    [-0.266667, -0.050667, 0.456]
    """

    uses_gaps: ClassVar[bool] = True

    restitution: Values = parameter(low=0.0, high=1.0)
    order: str | tuple[int, ...] = option(
        "fastest", converter=_checked_order, kw_only=False
    )
    max_collisions: int = option(
        10_000, converter=lambda n: as_whole("max_collisions", n, 1)
    )
    friction: OptionalValues = parameter(low=0.0)
    tangential_restitution: OptionalValues = parameter(low=-1.0, high=1.0)

    def __init__(
        self,
        restitution: Any,
        order: Any = "fastest",
        *,
        max_collisions: int = 10_000,
        friction: Any = None,
        tangential_restitution: Any = 0.0,
    ):
        """Set the fields; their declarations check them. Without friction e_t must be
        0.
        """
        self.restitution = restitution
        self.order = order
        self.max_collisions = max_collisions
        self.friction, self.tangential_restitution = friction_fields(
            friction, tangential_restitution
        )

    def check(self, scene: Scene, dtype: jnp.dtype) -> None:
        """Raise a ValueError for an `order` with contacts that do not exist, are
        missing or repeat.

        A contact may be named several times, but not twice in a row: it separates at
        once.
        """
        if isinstance(self.order, str):
            return
        m = scene.contacts
        if max(self.order) >= m:
            raise ValueError(
                f"Argument `order` must hold contact indices 0 to {m - 1}, "
                f"but has value {self.order!r}."
            )
        missing = sorted(set(range(m)) - set(self.order))
        if missing:
            raise ValueError(
                f"Argument `order` must name every contact, but contact {missing[0]} "
                f"is missing in {self.order!r} and could approach forever."
            )
        first, *others = self.order
        following = (*others, first)
        twice = any(j == k for j, k in zip(self.order, following))
        if m > 1 and twice:
            raise ValueError(
                f"Argument `order` must not name a contact twice in a row (the last "
                f"and the first follow each other), but has value {self.order!r}: it "
                f"separates at once."
            )

    @full_precision
    def impulses(self, contact: Contact) -> Impulses:
        """Sums p (m,), p_t (t,) [N s] of the impulses of all collisions, and status."""
        p, tangential, end = self._solve(contact)
        return Impulses(p, tangential, end.code)

    def _cycle(self, m: int) -> tuple[int, ...] | None:
        """Indices of the m contacts in cyclic order; None: the fastest or earliest one
        is next.
        """
        if isinstance(self.order, tuple):
            return self.order
        if self.order == "left_to_right":
            return tuple(range(m))
        return None

    def _gaps_that_order(
        self, gaps: jax.Array | None, gamma: jax.Array
    ) -> jax.Array | None:
        """Gaps (m,) [m] in the order 'earliest', 0 where none are given; None in other
        orders.
        """
        if self.order != "earliest":
            return None
        if gaps is None:
            return jnp.zeros_like(gamma)
        return gaps

    def _friction(self, contact: Contact) -> collisions.CoulombFriction | None:
        """The tangential block with mu and e_t (m,); None without friction."""
        mu = self.friction
        e_t = self.tangential_restitution
        if mu is None or e_t is None:
            return None
        assert contact.tangential_block is not None  # see `check_law`
        ones = jnp.ones_like(contact.gap_velocity)
        return collisions.CoulombFriction(
            contact.tangential_block, mu * ones, e_t * ones
        )

    def _solve(
        self, contact: Contact
    ) -> tuple[jax.Array, jax.Array | None, collisions.SequenceEnd]:
        """Impulses p (m,), p_t (t,) [N s] (None without friction) of one collision
        after the other, in the order of the law; how they ended.
        """
        gamma = contact.gap_velocity
        return collisions.solve(
            contact.delassus,
            gamma,
            self.restitution,
            gaps=self._gaps_that_order(contact.gaps, gamma),
            cycle=self._cycle(gamma.shape[0]),
            max_collisions=self.max_collisions,
            friction=self._friction(contact),
        )

    def collisions(self, scene: Scene, velocity: Any) -> jax.Array:
        """Number of collisions () int32 of a scene and velocity v- (n,) [m/s]; -1:
        endless.

        `max_collisions` where the law gave up. Approaches slower than rounding do not
        count.

        Source: Brogliato (2016), (6.19), (6.20) with ceil for floor: three balls, v- =
        (v, 0, 0), have `N = ceil(pi / arccos z) - 1`.

        >>> import jimpact as ji
        >>> int(ji.Binary(0.5).collisions(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]))
        3
        """
        law, scene, v = self._prepared(scene, velocity)
        return _count(law, scene, v)

    def sequence(
        self, scene: Scene, velocity: Any, limit: int = 100
    ) -> list[tuple[int, float | None, np.ndarray]]:
        """The first `limit` collisions: contact, time [s] ('earliest', else None),
        velocities.

        Args:
            scene: n coordinates, m contacts.
            velocity: v- (n,) [m/s].
            limit: the most collisions that are listed.

        Runs on the host, to look at a sequence; it does not stop at a plastic limit.

        >>> import jimpact as ji
        >>> balls = ji.chain([1.0, 1.0, 1.0])
        >>> for contact, _, v in ji.Binary(0.5).sequence(balls, [1.0, 0.0, 0.0]):
        ...     print(contact, v.round(6))
        0 [0.25 0.75 0.  ]
        1 [0.25   0.1875 0.5625]
        0 [0.203125 0.234375 0.5625  ]
        """
        law, scene, v = self._prepared(scene, velocity)
        contact = law.contact(scene, v)
        w = contact.delassus
        gamma = contact.gap_velocity
        gaps = law._gaps_that_order(contact.gaps, gamma)
        friction = law._friction(contact)
        inputs = collisions.to_inputs(w, gamma, law.restitution, gaps, friction)
        options = collisions.Options(
            cycle=law._cycle(scene.contacts),
            max_collisions=self.max_collisions,
            chain=isinstance(w, Tridiagonal),
        )
        g = collisions.coupling_matrix(inputs, options)
        now = collisions.begin(inputs)
        steps: list[tuple[int, float | None, np.ndarray]] = []
        limit = min(limit, self.max_collisions)
        while len(steps) < limit and collisions.approaches(inputs, now):
            after = _collide(inputs, options, g, now)
            j = int(jnp.argmax(after.p - now.p))  # only this contact gained an impulse
            time = None
            if law.order == "earliest":
                time = float(after.time)
            p, p_t = collisions.impulses_of(after.p, after.tangential, inputs.root)
            velocity = v + velocity_change(scene, p, p_t)
            steps.append((j, time, np.asarray(velocity)))
            now = after
        return steps

    def _prepared(
        self, scene: Scene, velocity: Any
    ) -> tuple["Binary", Scene, jax.Array]:
        """The law, the scene and v- (n,) [m/s], checked and in one floating-point
        type.
        """
        v = as_velocity(scene, velocity)
        check_values("velocity", v)
        law, scene, v = in_common_dtype(self, scene, v)
        check_law(law, scene, v.dtype)
        assert isinstance(law, Binary)
        return law, scene, v


@precise_jit
def _count(law: Binary, scene: Scene, velocity: jax.Array) -> jax.Array:
    """Number of collisions () int32; -1: endless."""
    _, _, end = law._solve(law.contact(scene, velocity))
    return end.number


_collide = precise_jit(collisions.collide)
