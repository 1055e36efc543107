"""Blocks: the rocking block in the plane."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import check_choice
from jimpact.bodies.base import positive
from jimpact.bodies.contacts import placed
from jimpact.bodies.polygons import Cornered


class Block(Cornered):
    """A rigid rectangle over the ground; q = (x, y, theta) of its centre, counter-clockwise.

    Equation: `f_{1,2} = y - (l/2) cos(theta) +/- (L/2) sin(theta)`, width L, height l; contact 1
    is the right lower corner B, contact 2 the left one A. Tangents are the corners' positions
    along the ground, `x + (l/2) sin(theta) +/- (L/2) cos(theta)`. Contacts 3 and 4 are the left
    and the right upper corner: overturned, the block lies on another side.

    Args:
        width: L > 0 [m].
        height: l > 0 [m].
        mass: m > 0 [kg].
        inertia: I about the centre [kg m^2]; None: homogeneous, `m (l^2 + L^2) / 12`.
        corners: 'all' four; or 'base', the lower two of the literature on rocking: then the gap
            function holds while no upper corner is below the ground, see `valid`.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.74).

    >>> import jimpact as ji
    >>> block = ji.Block(width=1.0, height=2.0, mass=3.0)
    >>> block.scene([0.0, 1.5, 0.0]).gaps.tolist()
    [0.5, 0.5, 2.5, 2.5]
    >>> ji.Block(1.0, 2.0, corners="base").gap_function(block.touching()).tolist()
    [0.0, 0.0]
    """

    range_in_words = "no upper corner below the ground: or give corners='all'"

    width: jax.Array
    height: jax.Array
    total_mass: jax.Array
    inertia: jax.Array
    contact_corners: str = eqx.field(static=True)
    ring: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        width: Any,
        height: Any,
        mass: Any = 1.0,
        inertia: Any = None,
        corners: str = "all",
    ):
        self.width, self.height = positive("width", width), positive("height", height)
        self.total_mass = positive("mass", mass)
        if inertia is None:
            inertia = self.total_mass * (self.height**2 + self.width**2) / 12
        self.inertia = positive("inertia", inertia)
        check_choice("corners", corners, ("all", "base"))
        self.contact_corners, self.ring = corners, (1, 0, 3, 2)

    @property
    def corners(self) -> jax.Array:
        """All four (4, 2) [m], right lower, left lower, left upper, right upper."""
        w, h = 0.5 * self.width, 0.5 * self.height
        return jnp.stack([jnp.stack([w, -w, -w, w]), jnp.stack([-h, -h, h, h])], axis=1)

    @property
    def points(self) -> jax.Array:
        """The corners that make contact."""
        return self.corners if self.contact_corners == "all" else self.corners[:2]

    def valid(self, q: jax.Array) -> jax.Array:
        """With the lower corners only: height () of the lower one of the upper corners [m]."""
        if self.contact_corners == "all":
            return super().valid(q)
        return jnp.min(placed(self.corners[2:], q[None])[:, 1])
