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
        normals = self.directions[:, :, 0]
        speeds = jnp.abs(v) @ jnp.abs(normals)
        return jnp.max(speeds)

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
        m, b, *_ = self.matrix.shape
        k = m * b
        square = self.matrix.reshape(k, k)
        diagonal = jnp.diagonal(square)
        return diagonal.reshape(m, b)

    def warm_start(self, last: Any) -> Float[Array, "m b"]:
        """Impulses of the last step, 0 of contacts that are open now."""
        closed = self.closed[:, None]
        return jnp.where(closed, last, 0.0)

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
        _, velocities = self.inverse.shape
        by_body = v.reshape(-1, velocities)
        of_bodies = jnp.pad(by_body, ((0, 1), (0, 0)))
        pairs = self.pairs

        def one(row: Int[Array, ""], rates: Float[Array, "m b"]) -> Float[Array, "m b"]:
            """Rates with those of one block of contacts, `D . v` of their two
            bodies.
            """
            bodies = block(pairs.bodies, row)
            directions = block(pairs.directions, row)
            rates_of_bodies = of_bodies[bodies][:, None]
            parts = directions * rates_of_bodies
            values = jnp.sum(parts, axis=(2, 3))
            return with_block(rates, values, row)

        m, b, *_ = pairs.directions.shape
        start = jnp.zeros((m, b), v.dtype)
        return over_blocks(pairs.filled, one, start)

    def fastest(self, v: Float[Array, " n"]) -> Float[Array, ""]:
        """Bound [m/s] of the gap velocities that speeds as in v could give."""
        fastest = jnp.max(jnp.abs(v))
        return 2 * fastest

    def velocity_change(self, x: Float[Array, "m b"]) -> Float[Array, " n"]:
        """Change of velocity `M^-1 D x` by impulses x [N s]."""
        inverse = self.inverse[:-1]
        impulse = self.generalized_impulse(x)
        return impulse * inverse.reshape(-1)

    def generalized_impulse(self, x: Float[Array, "m b"]) -> Float[Array, " n"]:
        """Generalized impulse `D x` of impulses x [N s]."""
        pairs = self.pairs

        def one(
            row: Int[Array, ""], impulses: Float[Array, "k u"]
        ) -> Float[Array, "k u"]:
            """Impulses `sum D x` on the bodies, with those of one block of contacts."""
            bodies = block(pairs.bodies, row)
            directions = block(pairs.directions, row)
            of_directions = block(x, row)[:, :, None, None]
            parts = directions * of_directions
            of_bodies = jnp.sum(parts, axis=1)
            return impulses.at[bodies].add(of_bodies)

        start = jnp.zeros_like(self.inverse)
        with_wall = over_blocks(pairs.filled, one, start)
        of_bodies = with_wall[:-1]
        return of_bodies.reshape(-1)

    def product(self, x: Float[Array, "m b"]) -> Float[Array, "m b"]:
        """Rates `D^T M^-1 D x` [m/s] that impulses x [N s] give."""
        dv = self.velocity_change(x)
        return self.rates(dv)

    @property
    def diagonal(self) -> Float[Array, "m b"]:
        """Diagonal of the Delassus matrix (m, b): `sum D^2 / M` over both bodies."""
        pairs = self.pairs

        def one(
            row: Int[Array, ""], diagonal: Float[Array, "m b"]
        ) -> Float[Array, "m b"]:
            """Diagonal of the Delassus matrix with that of one block of contacts:
            `sum D^2 / mass` over two bodies and their velocities.
            """
            bodies = block(pairs.bodies, row)
            directions = block(pairs.directions, row)
            inverse = self.inverse[bodies][:, None]
            squares = directions**2 * inverse
            of_block = jnp.sum(squares, axis=(2, 3))
            return with_block(diagonal, of_block, row)

        m, b, *_ = pairs.directions.shape
        start = jnp.zeros((m, b), self.inverse.dtype)
        return over_blocks(pairs.filled, one, start)

    def warm_start(self, last: Any) -> Float[Array, "m b"]:
        """Impulses of the last step at the same contacts, found by number; 0 of new
        ones.
        """
        number = self.pairs.number
        row = jnp.searchsorted(last.number, number)
        end = last.number.size - 1
        row = jnp.minimum(row, end)
        found = last.number[row] == number
        same = self.closed & found
        impulse = last.impulse[row]
        return jnp.where(same[:, None], impulse, 0.0)

    def kept(self, x: Float[Array, "m b"]) -> PileImpulses:
        """Impulses x in the form in which `warm_start` of the next step reads them."""
        number = self.pairs.number

        def in_order() -> PileImpulses:
            """Impulses by increasing number, so that the next step can search for
            them.
            """
            order = jnp.argsort(number)
            return PileImpulses(number[order], x[order])

        as_it_is = PileImpulses(number, x)
        some = self.pairs.filled > 0
        return jax.lax.cond(some, in_order, lambda: as_it_is)

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
    seen = seen_from_base(system, q, t)
    end = seen_from_base(system, q_end, t_end)
    mass = mass_at(system, q)
    if is_pile(system):
        pairs = system.body.active_pairs(seen, end, closed_below)
        directions = pairs.directions
        if not friction:
            normal = directions[:, :1]
            pairs = pairs._replace(directions=normal)
        velocities = directions.shape[-1]
        of_bodies = 1 / mass.reshape(-1, velocities)
        inverse = jnp.pad(of_bodies, ((0, 1), (0, 0)))
        return ActiveContacts(pairs, inverse)
    gap, normals, tangents = system.body.directions(seen, friction)
    n, m = normals.shape
    normals_or_nan = normals + 0 * gap[None]  # NaN where the gap is
    directions = normals_or_nan[:, :, None]
    if friction:
        assert tangents is not None
        by_contacts = tangents.reshape(n, m, -1)
        directions = jnp.concatenate([directions, by_contacts], axis=2)
    f_end = system.body.gap_function(end)
    gap_at_end = jnp.atleast_1d(f_end)
    smallest = jnp.minimum(gap, gap_at_end)
    closed = ~(smallest > closed_below)  # NaN does not pass for open
    directions = jnp.where(closed[:, None], directions, 0.0)
    columns = directions.reshape(n, -1)
    solution = solve_mass_matrix(mass, columns)
    moved = solution.reshape(directions.shape)
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
