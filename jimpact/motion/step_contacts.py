"""The contacts of one step of time stepping: products with their directions, dense or
of a pile.

Both classes have the same methods. Each of m contacts has b directions: its normal,
then with friction its tangents (1 in the plane, 2 in space). Of a pile (`Bodies` with
`room`) only contacts that are closed are stored, and products go over the pairs of
bodies, block by block.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.bodies.closed_pairs import ActivePairs, block, over_blocks, with_block
from jimpact.core.law import Law
from jimpact.motion.dynamics import is_pile, mass_at, seen_from_base
from jimpact.motion.system import System
from jimpact.numerics.dense import solve_mass_matrix
from jimpact.tools.checks import check_per_contact, check_shape


class AllContacts(NamedTuple):
    """All contacts of a body in one step; those that are open are 0."""

    gap: Float[Array, " m"]  # [m] of open contacts, too
    normals: Float[Array, "n m"]  # of open contacts, too
    closed: Bool[Array, " m"]
    directions: Float[Array, "n m b"]  # D, 0 of open contacts
    moved: Float[Array, "n m b"]  # M^-1 D
    matrix: Float[Array, "m b m b"]  # Delassus matrix D^T M^-1 D

    def rates(self, v: Float[Array, " n"]) -> Float[Array, "m b"]:
        """Gap velocities and slips `D^T v` [m/s]."""
        return jnp.tensordot(v, self.directions, axes=1)

    def fastest(self, v: Float[Array, " n"]) -> Float[Array, ""]:
        """Bound [m/s] of the gap velocities that speeds as in v could give."""
        normals = jnp.abs(self.directions[:, :, 0])
        return jnp.max(jnp.abs(v) @ normals)

    def velocity_change(self, x: Float[Array, "m b"]) -> Float[Array, " n"]:
        """Change of velocity `M^-1 D x` by impulses x [N s]."""
        return jnp.tensordot(self.moved, x, axes=2)

    def generalized_impulse(self, x: Float[Array, "m b"]) -> Float[Array, " n"]:
        """Generalized impulse `D x` of impulses x [N s]."""
        return jnp.tensordot(self.directions, x, axes=2)

    def product(self, x: Float[Array, "m b"]) -> Float[Array, "m b"]:
        """Rates `D^T M^-1 D x` [m/s] that impulses x [N s] give."""
        return jnp.tensordot(self.matrix, x, axes=2)

    @property
    def diagonal(self) -> Float[Array, "m b"]:
        """Diagonal of the Delassus matrix."""
        m, b = self.matrix.shape[:2]
        square = self.matrix.reshape(m * b, m * b)
        return jnp.diagonal(square).reshape(m, b)

    def warm_start(self, last: Any) -> Float[Array, "m b"]:
        """Impulses of the last step, 0 of contacts that are open now."""
        return jnp.where(self.closed[:, None], last, 0.0)

    def kept(self, x: Float[Array, "m b"]) -> Float[Array, "m b"]:
        """Impulses x in the form in which `warm_start` of the next step reads them."""
        return x

    def recorded(self, values: Float[Array, "*d"]) -> Float[Array, "*e"]:
        """Values of contacts (.., m) as the record holds them."""
        return values


class PileImpulses(NamedTuple):
    """Impulses of the closed contacts of a pile, by increasing numbers of the
    contacts.
    """

    number: Int[Array, " m"]
    impulse: Float[Array, "m b"]  # [N s]


class ActiveContacts(NamedTuple):
    """The closed contacts of a pile in one step; methods as those of `AllContacts`."""

    pairs: ActivePairs
    # 1 / M of each body, 0 for walls (the last row)
    inverse: Float[Array, "bodies+1 velocities"]

    @property
    def closed(self) -> Bool[Array, " m"]:
        """True for closed contacts, false for room that is left."""
        return self.pairs.closed

    def rates(self, v: Float[Array, " n"]) -> Float[Array, "m b"]:
        """Gap velocities and slips `D^T v` [m/s]."""
        by_body = v.reshape(-1, self.inverse.shape[1])
        of_bodies = jnp.pad(by_body, ((0, 1), (0, 0)))

        def one(row: Int[Array, ""], rates: Float[Array, "m b"]) -> Float[Array, "m b"]:
            """Rates with those of one block of contacts, `D . v` of their two
            bodies.
            """
            bodies = block(self.pairs.bodies, row)
            directions = block(self.pairs.directions, row)
            rates_of_bodies = of_bodies[bodies][:, None]
            values = jnp.sum(directions * rates_of_bodies, axis=(2, 3))
            return with_block(rates, values, row)

        shape = self.pairs.directions.shape[:2]
        start = jnp.zeros(shape, v.dtype)
        return over_blocks(self.pairs.filled, one, start)

    def fastest(self, v: Float[Array, " n"]) -> Float[Array, ""]:
        """Bound [m/s] of the gap velocities that speeds as in v could give."""
        return 2 * jnp.max(jnp.abs(v))

    def velocity_change(self, x: Float[Array, "m b"]) -> Float[Array, " n"]:
        """Change of velocity `M^-1 D x` by impulses x [N s]."""
        inverse = self.inverse[:-1].reshape(-1)
        return self.generalized_impulse(x) * inverse

    def generalized_impulse(self, x: Float[Array, "m b"]) -> Float[Array, " n"]:
        """Generalized impulse `D x` of impulses x [N s]."""

        def one(
            row: Int[Array, ""], impulses: Float[Array, "k u"]
        ) -> Float[Array, "k u"]:
            """Impulses `sum D x` on the bodies, with those of one block of contacts."""
            bodies = block(self.pairs.bodies, row)
            directions = block(self.pairs.directions, row)
            of_directions = block(x, row)[:, :, None, None]
            each = jnp.sum(directions * of_directions, axis=1)
            return impulses.at[bodies].add(each)

        start = jnp.zeros_like(self.inverse)
        with_wall = over_blocks(self.pairs.filled, one, start)
        return with_wall[:-1].reshape(-1)

    def product(self, x: Float[Array, "m b"]) -> Float[Array, "m b"]:
        """Rates `D^T M^-1 D x` [m/s] that impulses x [N s] give."""
        return self.rates(self.velocity_change(x))

    @property
    def diagonal(self) -> Float[Array, "m b"]:
        """Diagonal of the Delassus matrix (m, b): `sum D^2 / M` over both bodies."""

        def one(
            row: Int[Array, ""], diagonal: Float[Array, "m b"]
        ) -> Float[Array, "m b"]:
            """Diagonal with the part of one block of contacts."""
            bodies = block(self.pairs.bodies, row)
            directions = block(self.pairs.directions, row)
            squares = directions**2 * self.inverse[bodies][:, None]
            of_block = jnp.sum(squares, axis=(2, 3))
            return with_block(diagonal, of_block, row)

        shape = self.pairs.directions.shape[:2]
        start = jnp.zeros(shape, self.inverse.dtype)
        return over_blocks(self.pairs.filled, one, start)

    def warm_start(self, last: Any) -> Float[Array, "m b"]:
        """Impulses of the last step at the same contacts, found by number; 0 of new
        ones.
        """
        row = jnp.searchsorted(last.number, self.pairs.number)
        row = jnp.minimum(row, last.number.size - 1)
        same = self.closed & (last.number[row] == self.pairs.number)
        impulse = last.impulse[row]
        return jnp.where(same[:, None], impulse, 0.0)

    def kept(self, x: Float[Array, "m b"]) -> PileImpulses:
        """Impulses x in the form in which `warm_start` of the next step reads them."""

        def in_order() -> PileImpulses:
            """Impulses by increasing number, so that the next step can search for
            them.
            """
            order = jnp.argsort(self.pairs.number)
            return PileImpulses(self.pairs.number[order], x[order])

        as_it_is = PileImpulses(self.pairs.number, x)
        return jax.lax.cond(self.pairs.filled > 0, in_order, lambda: as_it_is)

    def recorded(self, values: Float[Array, "*d"]) -> Float[Array, "*e"]:
        """Values of contacts (.., m) as the record holds them: their sum (.., 1)."""
        return jnp.sum(values, axis=-1, keepdims=True)


def contacts_of_step(
    system: System,
    q: Float[Array, " nq"],
    t: Float[Array, ""],
    q_end: Float[Array, " nq"],
    t_end: Float[Array, ""],
    closed_below: Float[Array, ""],
    friction: bool,
) -> AllContacts | ActiveContacts:
    """Contacts of a step whose middle is at (q, t), and its end, without contacts, at
    q_end.

    Closed are those with a gap of at most `closed_below` [m] at one of these;
    directions and mass are those in the middle.
    """
    at = seen_from_base(system, q, t)
    end = seen_from_base(system, q_end, t_end)
    mass = mass_at(system, q)
    if is_pile(system):
        pairs = system.body.active_pairs(at, end, closed_below)
        if not friction:
            pairs = pairs._replace(directions=pairs.directions[:, :1])
        of_bodies = 1 / mass.reshape(-1, pairs.directions.shape[-1])
        inverse = jnp.pad(of_bodies, ((0, 1), (0, 0)))
        return ActiveContacts(pairs, inverse)
    gap, normals, tangents = system.body.directions(at, friction)
    n, m = normals.shape
    directions = (normals + 0 * gap[None])[:, :, None]  # NaN where the gap is
    if friction:
        assert tangents is not None
        by_contacts = tangents.reshape(n, m, -1)
        directions = jnp.concatenate([directions, by_contacts], axis=2)
    gap_at_end = jnp.atleast_1d(system.body.gap_function(end))
    least = jnp.minimum(gap, gap_at_end)
    closed = ~(least > closed_below)  # NaN does not pass for open
    directions = jnp.where(closed[:, None], directions, 0.0)
    columns = directions.reshape(n, -1)
    moved = solve_mass_matrix(mass, columns).reshape(directions.shape)
    matrix = jnp.tensordot(directions, moved, axes=([0], [0]))
    return AllContacts(gap, normals, closed, directions, moved, matrix)


def check_stepped_law(system: System, law: Law, contacts: int, joint: bool) -> None:
    """Raise unless time stepping of the system can use the law; `joint` as in
    `time_stepping`.

    A pile needs a joint law with one number for all contacts; other joint laws have one
    for all or for each contact. Laws that are not joint suit all other systems.
    """
    if not joint:
        if is_pile(system):
            raise ValueError(
                "Argument `law` must be Moreau's, with its own `friction` and without "
                "a matrix, "
                f"for the many contacts of {type(system.body).__name__}, but is "
                f"{law!r}."
            )
        return
    for name in ("restitution", "tangential_restitution"):
        value = getattr(law, name)
        if is_pile(system):
            check_shape(name, value, (), "one for all contacts of a pile")
        elif value is not None:
            check_per_contact(name, value, contacts)
