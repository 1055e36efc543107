"""Poisson's law in the two-stage form of Pfeiffer and Glocker."""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.core.contact import Contact
from jimpact.core.law import Impulses, Law, OptionalValues, Values, option, parameter
from jimpact.laws.friction import friction_fields
from jimpact.numerics.dense import null_projector, unit_outside
from jimpact.numerics.friction import FrictionImpulses, solve
from jimpact.numerics.lcp import solve_lcp
from jimpact.numerics.tridiagonal import as_matrix, is_regular
from jimpact.tools.compiling import full_precision
from jimpact.tools.loops import any_lane, cond
from jimpact.tools.precision import precision, without_rounding
from jimpact.tools.status import CODE


class Poisson(Law):
    """Poisson's restitution of impulses: compression to rest, then expansion.

    Equation: compression `0 <= gamma_c = gamma- + W p_c  _|_  p_c >= 0`; expansion
    `p_e = e p_c + s`, `0 <= gamma+ = gamma_c + W p_e  _|_  s >= 0`; `p = p_c + p_e`.
    With friction (W_nt p_t added) `p_tc in -mu p_c Sgn(u_c)` and
    `p_te in -mu p_e Sgn(u+ + e_t u-)`.

    Args:
        restitution: kinetic coefficient e in [0, 1], scalar or one per contact (m,).
        friction: Coulomb's mu >= 0, scalar or (m,), for scenes with tangents; None: no
            friction.
        tangential_restitution: e_t in [-1, 1], scalar or (m,): sticking in expansion is
            `v_t+ = -e_t v_t-`, as far as the expansion's friction reaches.
        allow_above_one: let e exceed 1, which dispersion in a chain would need.

    Status: `impulse_not_unique` for redundant contacts; `several_outcomes` where v+
    depends on how they share p_c (the least one is taken): without friction where their
    e differ, with friction where another share expands to another v+ (up to 3 contacts:
    those with the least or most p_c of a contact are tried; of more contacts where
    their e differ); `energy_gain` where e above 1 creates energy. With friction also as
    in `Moreau`.

    Without friction it loses at least `(1 - e_max^2) p_c^T W p_c / 2`, whatever the e_j
    up to 1: of all s >= 0 the law takes that of least energy, and
    `s = (e_max - e_j) p_c` is one of them.

    Derivatives are one-sided where a contact is about to take part in either stage;
    where several are (a block that falls flat at e = 0, given per contact), those of
    one of the sides.

    Source: Pfeiffer and Glocker (1996); Brogliato, Nonsmooth Mechanics (2016),
    (6.76)-(6.79) with the errata of `docs/equations.md`; e_t as in the kinematic laws,
    (6.54).

    >>> import jimpact as ji
    >>> law = ji.Poisson([0.4, 1.0])
    >>> out = ji.impact(law, ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])
    >>> [round(float(v), 4) for v in out.velocity]
    [0.0667, 0.2667, 0.6667]
    """

    separable: ClassVar[bool] = True

    restitution: Values = parameter(low=0.0, high=1.0, high_unless="allow_above_one")
    friction: OptionalValues = parameter(low=0.0)
    tangential_restitution: OptionalValues = parameter(low=-1.0, high=1.0)
    allow_above_one: bool = option(default=False, converter=bool)

    def __init__(
        self,
        restitution: Any,
        friction: Any = None,
        tangential_restitution: Any = 0.0,
        *,
        allow_above_one: bool = False,
    ):
        """Set the fields; their declarations check them. Without friction e_t must be
        0.
        """
        self.restitution = restitution
        self.allow_above_one = allow_above_one
        self.friction, self.tangential_restitution = friction_fields(
            friction, tangential_restitution
        )

    @full_precision
    def impulses(self, contact: Contact) -> Impulses:
        """Impulses `p = (1 + e) p_c + s`, p_c and s each by a complementarity
        problem.
        """
        mu = self.friction
        e_t = self.tangential_restitution
        if mu is not None and e_t is not None:
            return self._with_friction(contact, mu, e_t)
        w = contact.delassus
        e = self.restitution

        # Eq. (6.76), t_c: 0 <= gamma_c = gamma- + W p_c  _|_  p_c >= 0
        compression = solve_lcp(w, contact.gap_velocity)
        p_c = compression.z
        gamma_c = compression.w

        # Eq. (6.77), t_f: 0 <= gamma+ = gamma_c + W (e p_c + s)  _|_  s >= 0
        returned = e * p_c
        expansion = solve_lcp(w, gamma_c + w @ returned)
        s = expansion.z

        code = jnp.maximum(compression.code, expansion.code)
        if e.ndim == 1 and not is_regular(w):
            free = _free_columns(as_matrix(w), p_c > 0)
            ambiguous = _depends_on_sharing(as_matrix(w), e, free)
            code = jnp.maximum(code, _several_where(ambiguous))
        return Impulses(p_c + returned + s, None, code)

    def _with_friction(
        self, contact: Contact, mu: jax.Array, e_t: jax.Array
    ) -> Impulses:
        """Impulses of compression and of expansion, each by a friction problem, see the
        class.

        Equation: `p = (1 + e) p_c + s`, `p_t = p_tc + p_te`.
        """
        assert contact.slip is not None  # see `check_law`
        a = contact.whole_delassus  # [[W, W_nt], [W_tn, W_tt]]
        gamma = contact.gap_velocity
        u = contact.slip
        mu = mu * jnp.ones_like(gamma)
        e = self.restitution * jnp.ones_like(gamma)
        e_t = jnp.repeat(e_t * jnp.ones_like(mu), contact.tangents)

        # Eq. (6.76), and p_tc in -mu p_c Sgn(u_c), u_c = u- + W_tn p_c + W_tt p_tc
        compression = solve(a, gamma, u, mu, complementary=True)
        p_c = compression.normal
        p_tc = compression.tangential

        # Eq. (6.77), and p_te in -mu (e p_c + s) Sgn(u+ + e_t u-)
        b = jnp.concatenate([gamma, (1 + e_t) * u])
        problem = _Expansion(a, b, mu, e)
        impulse = jnp.concatenate([p_c, p_tc])
        expansion, velocity = problem.after(impulse)
        s = expansion.normal
        p_te = expansion.tangential

        code = jnp.maximum(compression.status, expansion.status)
        ambiguous = jnp.asarray(False)
        if self.restitution.ndim == 1:
            returned = jnp.concatenate([e, jnp.zeros_like(u)])
            ambiguous = _depends_on_sharing(a, returned, compression.free)
        if compression.shares is not None:
            ambiguous = ambiguous | _expands_otherwise(
                problem, impulse, velocity, compression.shares
            )
        code = jnp.maximum(code, _several_where(ambiguous))
        return Impulses((1 + e) * p_c + s, p_tc + p_te, code)


def _several_where(ambiguous: jax.Array) -> jax.Array:
    """The status `several_outcomes` where v+ is ambiguous, else `ok`."""
    return jnp.where(ambiguous, CODE["several_outcomes"], CODE["ok"])


class _Expansion(NamedTuple):
    """The friction problem of expansion, posed by the impulses of compression."""

    matrix: jax.Array  # [[W, W_nt], [W_tn, W_tt]] (m + t, m + t)
    b: jax.Array  # gamma- and (1 + e_t) u- (m + t,)
    friction: jax.Array  # mu (m,)
    restitution: jax.Array  # e (m,)

    def after(self, compression: jax.Array) -> tuple[FrictionImpulses, jax.Array]:
        """Impulses (s, p_te) of expansion after (p_c, p_tc) of `compression` (m + t,).

        Also returns the velocities `gamma+` and `u+ + e_t u-` (m + t,) to which they
        lead.
        """
        m = len(self.friction)
        zero = precision(self.b.dtype)
        p_c = compression[:m]
        returned = self.restitution * p_c
        impulse = compression + jnp.pad(returned, (0, len(compression) - m))
        size = jnp.abs(self.b) + jnp.abs(self.matrix) @ jnp.abs(impulse)
        # rounding must not move contacts that compression has brought to rest
        velocity = self.b + self.matrix @ impulse
        velocity = without_rounding(velocity, zero.accumulated * size)
        # e p_c loads friction; eps^2 p_c keeps its slope in e at e = 0
        load = returned + zero.eps**2 * p_c
        x = solve(
            self.matrix,
            velocity[:m],
            velocity[m:],
            self.friction,
            complementary=True,
            load=load,
        )
        return x, velocity + self.matrix @ jnp.concatenate([x.normal, x.tangential])


def _expands_otherwise(
    expansion: _Expansion,
    impulse: jax.Array,
    velocity: jax.Array,
    shares: jax.Array,
) -> jax.Array:
    """True () where other `shares` (k, m + t) of the impulses of compression lead to
    another v+.

    Redundant contacts can share the `impulse` (m + t,) of compression in several ways;
    `velocity` (m + t,) is that to which it expands, see `_Expansion.after`. Shares that
    return the same normal impulses e p_c expand alike: nothing is solved then. A share
    after which expansion has no solution does not count.
    """
    expansion, impulse, velocity, shares = jax.lax.stop_gradient(
        (expansion, impulse, velocity, shares)
    )
    m = len(expansion.friction)
    root = precision(impulse.dtype).root
    rounding = root * jnp.abs(expansion.b).max()
    changes = (shares - impulse[None])[:, :m]
    returned = expansion.restitution[None] * changes
    returns_another = jnp.any(jnp.abs(returned) > root * jnp.abs(impulse).max())

    def any_differs() -> jax.Array:
        """True () where velocities differ for any of these shares."""

        def differs(share: jax.Array) -> jax.Array:
            """True () where velocities differ after this share (m + t,), if it has a
            solution.
            """
            other, after = expansion.after(share)
            apart = jnp.abs(after - velocity) > rounding
            return jnp.any(apart) & _has_solution(other)

        return jnp.any(jax.lax.map(differs, shares))

    no = jnp.zeros_like(returns_another)
    differ = cond(any_lane(returns_another), any_differs, lambda: no)
    return returns_another & differ


def _has_solution(impulses: FrictionImpulses) -> jax.Array:
    """True () unless their friction problem has no solution: its status is `infeasible`
    then, or graver.
    """
    return impulses.status < CODE["infeasible"]


def _free_columns(w: jax.Array, loaded: jax.Array) -> jax.Array:
    """Columns (m, m) that span the changes of loaded impulses (m,) that leave W p as it
    is.

    Equation: `D^-1 P`, P the projector on the null space of `D^-1 W D^-1` between
    loaded contacts, `D = diag(sqrt(W_jj))`.
    """
    d = jax.lax.stop_gradient(jnp.sqrt(jnp.diagonal(w)))
    normalized = w / (d[:, None] * d[None, :])
    projector, _ = null_projector(unit_outside(normalized, loaded))
    return projector / d[:, None]


def _depends_on_sharing(w: jax.Array, e: jax.Array, free: jax.Array) -> jax.Array:
    """True () where `W diag(e) p_c` differs among p_c (m,) that differ by columns of
    `free` (m, m).

    Equation: an entry of `D^-1 W diag(e) free`, `D = diag(sqrt(W_jj))`, is more than
    rounding.
    """
    w, e = jax.lax.stop_gradient((w, e))
    d = jnp.sqrt(jnp.diagonal(w))
    returned = w @ (e[:, None] * free) / jnp.where(d > 0, d, 1.0)[:, None]
    return jnp.abs(returned).max() > precision(w.dtype).root
