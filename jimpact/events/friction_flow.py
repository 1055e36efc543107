"""Contacts with Coulomb friction: the flow of `contact_flow.py` with slip, planar.

    p' = F,   u' = K_tn F + K_tt lambda,   gamma' = G F + K_nt lambda,
    slip:   lambda_j = -mu_j F_j u_j / |u_j|
    stick:  lambda such that u_j' = 0, while |lambda_j| <= mu_j F_j

Who slips and who sticks is frozen in the modes (rows: phase, closings, slip: 0 sticks, else the
sign of u); margins are, beside those of the normal flow, the speed of slip and the room inside the
friction cone. The normal forces follow from the indentations, so that lambda exists and u' is
unique whatever mu is: there is no Painleve paradox. Where K_tt is singular (both corners of a
block lying flat) lambda is shared among the contacts that stick in proportion to mu F: they then
break loose together.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jimpact.events.contact_flow import (
    COMPRESSION,
    EXPANSION,
    OPEN,
    SNAP,
    ContactFlow,
    Frozen,
    Measured,
    as_pytree,
    times,
    unit,
)
from jimpact.events.stepper import any_of
from jimpact.solvers.friction import distribute

AHEAD = 1e-6  # of the unit of time: at the first touch there are no forces yet to decide by
# Forces of sticking minimize sum lambda^2 / (mu F) with this weight beside K_tt: it decides where
# K_tt is singular only, and refinements remove what it changes elsewhere.
SHARING = 1e-7
REFINEMENTS = 2
LEFT = 0.1  # of the tolerance: a loaded contact with less energy ends the impact all the same


def solve(matrix: jax.Array, *right: jax.Array) -> list[jax.Array]:
    """`matrix^-1 right` of (n, n, B) and right sides (n, B), entry by entry.

    Gauss-Jordan without pivots, which what is similar to a positive definite matrix does not need.
    """
    n = len(matrix)
    rows = [[*matrix[i], *(b[i] for b in right)] for i in range(n)]
    for k in range(n):
        pivot = 1 / rows[k][k]
        rows[k] = [x * pivot if j > k else x for j, x in enumerate(rows[k])]
        for i in range(n):
            if i != k:
                pairs = zip(rows[i], rows[k])
                factor = rows[i][k]
                rows[i] = [x - factor * y if j > k else x for j, (x, y) in enumerate(pairs)]
    return [jnp.stack([row[n + c] for row in rows]) for c in range(len(right))]


def inverse(matrix: jax.Array) -> jax.Array:
    """The inverse (n, n, B)."""
    eye = jnp.broadcast_to(unit(matrix), matrix.shape)
    return jnp.stack(solve(matrix, *(eye[:, j] for j in range(len(matrix)))), axis=1)


@as_pytree
@dataclasses.dataclass(kw_only=True)
class FrictionFlow(ContactFlow):
    """Contacts with planar friction, an instance of the protocol of `stepper.py`."""

    across: jax.Array  # K_nt (m, m, B)
    along: jax.Array  # K_tt (m, m, B)
    friction: jax.Array  # mu (m, B)

    # ---- the state: x, g, p, slip u, its impulse, time

    def slip(self, y: jax.Array) -> jax.Array:
        m = self.contacts
        return y[3 * m : 4 * m]

    def start_with(
        self, gamma: jax.Array, x: jax.Array, u: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Modes and state before the impact."""
        m = self.contacts
        modes, y = self.start(gamma, x)
        modes = jnp.concatenate([modes, jnp.sign(u).astype(jnp.int32)])
        y = jnp.concatenate([y[: 3 * m], u, jnp.zeros_like(u), y[3 * m :]])
        closed = modes[:m] != OPEN
        return self.decided(modes, y, jnp.zeros_like(closed), closed)

    # ---- the protocol

    def loaded(self, modes: jax.Array) -> jax.Array:
        phase = modes[: self.contacts]
        return (phase == COMPRESSION) | (phase == EXPANSION)

    def forces(
        self, const: Frozen, modes: jax.Array, y: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """F, lambda, who sticks, and the room of those in their cone."""
        m = self.contacts
        x, g, _ = self.rows(y)
        f = self.force(const, x, g)
        most = self.friction * f
        stick = (modes[2 * m :] == 0) & self.loaded(modes)
        sliding = jnp.where(stick, 0.0, -modes[2 * m :].astype(most.dtype) * most)
        missing = times(jnp.swapaxes(self.across, 0, 1), f) + times(self.along, sliding)
        holding, room = self.holding(jnp.where(stick, -missing, 0.0), stick, most)
        return f, jnp.where(stick, holding, sliding), stick, room

    def holding(
        self, right: jax.Array, stick: jax.Array, most: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """`K_tt lambda = right` on the rows that stick, shared in proportion to `most`.

        And the room in the cone: 1 where nothing is held, 0 on the cone, as parts of the forces:
        those of a contact that opens vanish, and so would the difference of theirs.
        """
        largest = jax.lax.stop_gradient(jnp.max(most, axis=0, keepdims=True))
        weight = most / jnp.where(largest > 0, largest, 1.0)
        # z = lambda / weight has a limit where weight is 0
        k = jnp.where(stick[:, None] & stick[None], self.along, 0.0) * weight[None]
        inverted = inverse(k + unit(k) * jnp.where(stick, SHARING, 1.0)[:, None])
        z = times(inverted, right)
        for _ in range(REFINEMENTS):
            z = z + times(inverted, right - times(k, z))
        held = jnp.abs(z)
        some = stick & (largest + held > 0)
        room = jnp.where(some, (largest - held) / jnp.where(some, largest + held, 1.0), 1.0)
        return weight * z, room

    def field(self, const: Any, modes: jax.Array, y: jax.Array) -> jax.Array:
        _, g, _ = self.rows(y)
        f, side, stick, _ = self.forces(const, modes, y)
        pull = self.coupling.times(f) + times(self.across, side)
        slip = times(jnp.swapaxes(self.across, 0, 1), f) + times(self.along, side)
        return jnp.concatenate(
            [
                const.closing * g,
                const.ratio * pull,
                const.unit * f,
                const.unit * jnp.where(stick, 0.0, slip),
                const.unit * side,
                const.unit,
            ]
        )

    def margins(self, const: Any, modes: jax.Array, y: jax.Array) -> jax.Array:
        m = self.contacts
        _, _, stick, room = self.forces(const, modes, y)
        slides = ~stick & self.loaded(modes)
        return jnp.concatenate(
            [
                super().margins(const, modes, y),
                jnp.where(slides, modes[2 * m :].astype(y.dtype) * self.slip(y), 1.0),
                room,
            ]
        )

    def rooted(self, modes: jax.Array) -> jax.Array:
        rooted = super().rooted(modes)
        return jnp.concatenate([rooted, jnp.zeros_like(rooted)])

    def switch(
        self, modes: jax.Array, y: jax.Array, which: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        m = self.contacts
        stopped, broke = which[2 * m : 3 * m], which[3 * m :]
        _, side, *_ = self.forces(self.constants(modes), modes, y)
        turned = jnp.where(broke, -jnp.sign(side).astype(modes.dtype), modes[2 * m :])
        after, y = super().switch(modes, y, which[: 2 * m])
        after = jnp.concatenate([after[: 2 * m], turned])
        closed = after[m : 2 * m] > modes[m : 2 * m]
        return self.decided(after, y, stopped, closed)

    def decided(
        self, modes: jax.Array, y: jax.Array, stopped: jax.Array, closed: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Who sticks and who slides where to, once contacts have stopped to slip or have closed."""
        m = self.contacts
        u, slip, loaded = self.slip(y), modes[2 * m :], self.loaded(modes)
        rests = jnp.abs(u) <= SNAP * self.tolerance
        slip = jnp.where(closed & ~rests, jnp.sign(u).astype(slip.dtype), slip)
        resting = loaded & rests & ((slip != 0) | closed)
        ask = any_of(stopped | (closed & resting))
        asked = ask & loaded & (stopped | resting | (slip == 0))
        u = jnp.where(asked, 0.0, u)
        still = jax.lax.stop_gradient(self)
        const = still.constants(modes)
        x, g, _ = jax.lax.stop_gradient(self.rows(y))
        soon = jnp.maximum(x + AHEAD * const.closing * g, 0.0)
        f = still.force(const, soon, g)
        top = jnp.max(f, axis=0, keepdims=True)
        f = f / jnp.where(top > 0, top, 1.0)
        most = still.friction * f
        slides = jnp.where(asked | ~loaded, 0.0, -slip.astype(u.dtype) * most)
        b = times(jnp.swapaxes(still.across, 0, 1), f) + times(still.along, slides)
        stick, towards = distribute(still.along, b, most, asked)
        towards = jnp.where(stick, 0, jnp.sign(towards).astype(slip.dtype))
        slip = jnp.where(asked, towards, slip)
        return jnp.concatenate([modes[: 2 * m], slip]), jnp.concatenate([y[: 3 * m], u, y[4 * m :]])

    def measured(self, modes: jax.Array, y: jax.Array) -> Measured:
        m, side = self.contacts, self.forces(self.constants(modes), modes, y)[1]
        return (
            super()
            .measured(modes, y)
            ._replace(tangential_force=side, tangential_impulse=y[4 * m : 5 * m], slip=self.slip(y))
        )

    def change(self, y: jax.Array) -> jax.Array:
        """What the impulses of a state change of the gap velocities, tangential ones, too."""
        side = y[-1 - self.across.shape[1] : -1]
        return super().change(y) + times(self.across, side)

    # ---- the end: a contact with friction is never alone, and no multiple of another state

    def pauses(self, before: jax.Array, after: jax.Array, passes: jax.Array) -> jax.Array | None:
        return None

    def over(self, modes: jax.Array, y: jax.Array, passes: jax.Array) -> jax.Array:
        works, *_ = self.at_work(modes, y, LEFT * self.patience(passes))
        return ~any_of(works)

    def finish(self, modes: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        m = self.contacts
        x = jnp.zeros_like(y[:m])
        return modes, jnp.concatenate([x, y[m:]])
