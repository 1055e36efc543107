"""Contact space: the arguments of an impact law, and the groups of coupled contacts.

A scene of n coordinates and m contacts is reduced to W, gamma- and, where it has
tangents, the tangential rows: everything that an impact law may depend on.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.scene import Scene, gap_velocity, solve_mass, without_constraints
from jimpact.numerics.dense import solve_definite
from jimpact.numerics.sparse import Sparse, components
from jimpact.numerics.tangential import TangentialBlock
from jimpact.numerics.tridiagonal import (
    Structure,
    Symmetric,
    Tridiagonal,
    as_matrix,
    diagonal,
    scaled,
    structure_of,
)
from jimpact.tools.checks import as_float_array, is_traced, suggesting_names
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import precision, without_rounding

# Groups of unequal size are padded to the largest of them, because compiling another
# program takes longer than many impacts. A second program for the smaller groups must
# save this factor of the entries of W. Ten times more: one large group would make every
# small one as expensive.
WORTH_A_PROGRAM = 4

# Contact indices (count, size), one array for each program. A smaller group is padded
# by m plus the index of its first contact, so that the padding has the group's scale of
# stored energy. The indices are data, not structure: scenes whose groups differ only in
# their members share the compiled impact.
Groups = tuple[np.ndarray, ...]


@suggesting_names(W="normal_delassus", w="normal_delassus", gamma="gap_velocity")
class Contact(eqx.Module):
    """All that a law may depend on in an impact, with derived quantities.

    Equation: `gamma+ = gamma- + W p + W_nt p_t`, `u+ = u- + W_tn p + W_tt p_t`, with
    normals N, tangents H, W = N^T M^-1 N, W_nt = N^T M^-1 H = W_tn^T, W_tt = H^T M^-1
    H, slip velocities u = H^T v, normal impulses p and tangential impulses p_t.

    Open contacts are decoupled (their rows of W are 0 off the diagonal, gamma- = 0, no
    stored energy), unless the law uses gaps, and so are contacts that bilateral
    constraints hold; gap velocities within `noise` are 0. `impact` always calls
    `impulses`. If no contact approaches or stores energy, it passes gamma- = -1 and
    discards the result, so that gradients stay finite.

    Args:
        delassus: W (m, m) [1/kg], or a `Tridiagonal` (a chain) or `Sparse` (a packing).
        gap_velocity: gamma- (m,) [m/s], < 0 on approach.
        closed: (m,) contacts without a gap; None: all.
        gaps: (m,) [m]; None: 0.
        stored: energy (m,) [J] in the contacts before the impact (precompression);
            None: 0.
        norm: (m,) sqrt(grad f_j^T M^-1 grad f_j), f_j the gap function, ignoring
            bilateral constraints; None: sqrt(W_jj), equal if there are none.
        noise: (m,) [m/s] uncertainty of gamma- by the rounding of v-; None: 0.
        tangential_block: (W_nt (m, t), W_tt (t, t), u- (t,) [m/s]), None without
            tangents; t = m in the plane, 2 m in space, contact by contact.
        rtol: tolerance () for laws that have none of their own; None: their default.

    Source: Brogliato, Nonsmooth Mechanics (3rd ed., 2016), (6.22)-(6.35).

    >>> import jimpact as ji
    >>> contact = ji.Contact([[2.0, -1.0], [-1.0, 2.0]], [-1.0, 0.0])
    >>> ji.Newton(0.5).impulses(contact).normal.round(6).tolist()
    [1.0, 0.5]
    """

    delassus: Symmetric
    gap_velocity: jax.Array
    closed: jax.Array
    gaps: jax.Array
    stored: jax.Array
    norm: jax.Array
    noise: jax.Array
    tangential_block: TangentialBlock | None
    rtol: jax.Array | None

    def __init__(
        self,
        delassus: Any,
        gap_velocity: Any,
        *,
        closed: Any = None,
        gaps: Any = None,
        stored: Any = None,
        norm: Any = None,
        noise: Any = None,
        tangential_block: Any = None,
        rtol: Any = None,
    ):
        """Set the fields, arrays of floats; what is None becomes its default, see the
        class.
        """
        structured = isinstance(delassus, (Tridiagonal, Sparse))
        if structured:
            self.delassus = delassus
        else:
            self.delassus = as_float_array("delassus", delassus)
        self.gap_velocity = as_float_array("gap_velocity", gap_velocity)
        zero = jnp.zeros_like(self.gap_velocity)
        if closed is None:
            self.closed = zero == 0
        else:
            self.closed = jnp.asarray(closed, bool)
        if gaps is None:
            self.gaps = zero
        else:
            self.gaps = gaps
        if stored is None:
            self.stored = zero
        else:
            self.stored = stored
        if norm is None:
            self.norm = jnp.sqrt(diagonal(self.delassus))
        else:
            self.norm = norm
        if noise is None:
            self.noise = zero
        else:
            self.noise = noise
        self.tangential_block = None
        if tangential_block is not None:
            self.tangential_block = TangentialBlock(*map(jnp.asarray, tangential_block))
        self.rtol = rtol

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        return self.gap_velocity.shape[0]

    @property
    def tangents(self) -> int:
        """Tangents of each contact: 0, 1 (planar) or 2."""
        if self.slip is None:
            return 0
        return self.slip.shape[0] // self.contacts

    @property
    def cross(self) -> jax.Array | None:
        """W_nt (m, t) [1/kg]; None without tangents."""
        if self.tangential_block is None:
            return None
        return self.tangential_block.normal_tangent

    @property
    def tangential(self) -> jax.Array | None:
        """W_tt (t, t) [1/kg]; None without tangents."""
        if self.tangential_block is None:
            return None
        return self.tangential_block.tangent

    @property
    def slip(self) -> jax.Array | None:
        """u- (t,) [m/s]; None without tangents."""
        if self.tangential_block is None:
            return None
        return self.tangential_block.slip

    @property
    def structure(self) -> Structure:
        """Structure of W: dense, tridiagonal or sparse."""
        return structure_of(self.delassus)

    @property
    def normalized_delassus(self) -> Symmetric:
        """G = W between unit normals: `G_ij = W_ij / (|grad f_i| |grad f_j|)`."""
        return scaled(self.delassus, 1 / self.norm)

    @property
    def normalized_gap_velocity(self) -> jax.Array:
        """qn- = gamma- / |grad f| (m,) [sqrt(J)]."""
        return self.gap_velocity / self.norm

    @property
    def normal_delassus(self) -> jax.Array:
        """W (m, m) [1/kg] as an array, of a chain too."""
        return as_matrix(self.delassus)

    @property
    def whole_delassus(self) -> jax.Array:
        """[[W, W_nt], [W_tn, W_tt]] (m + t, m + t); W where there are no tangents."""
        w = self.normal_delassus
        if self.tangential_block is None:
            return w
        cross, tangent, _ = self.tangential_block
        return jnp.block([[w, cross], [cross.T, tangent]])

    @property
    def size(self) -> jax.Array:
        """Energy scale () [sqrt(J)]: root of twice the energy of approach plus the
        stored one.
        """
        root = jnp.sqrt(diagonal(self.delassus))
        approach = jnp.sum((jnp.minimum(self.gap_velocity, 0.0) / root) ** 2)
        return jnp.sqrt(approach + 2 * jnp.sum(self.stored))

    @property
    def happens(self) -> jax.Array:
        """True () if there is an impact: a contact approaches, stores energy or is not
        finite.
        """
        gamma = self.gap_velocity
        approaches = jnp.any(gamma < 0)
        stores = jnp.any(self.stored > 0)
        finite = jnp.all(jnp.isfinite(gamma))
        return approaches | stores | ~finite

    def within(self, noise: jax.Array) -> "Contact":
        """The contact with gap velocities up to `noise` () [m/s] set to 0, as within
        rounding.
        """
        gamma = without_rounding(self.gap_velocity, noise)
        noise = jnp.maximum(self.noise, noise)
        return eqx.tree_at(
            lambda contact: (contact.gap_velocity, contact.noise), self, (gamma, noise)
        )

    def approaching(self, speed: jax.Array) -> "Contact":
        """The contact with all gap velocities lower by `speed` () [m/s]."""
        return eqx.tree_at(
            lambda contact: contact.gap_velocity, self, self.gap_velocity - speed
        )

    def integrated_to(self, rtol: jax.Array) -> "Contact":
        """The contact whose laws integrate to `rtol` () where they have none of their
        own.
        """
        rtol = jnp.broadcast_to(rtol, self.gap_velocity.shape[:-1])
        return eqx.tree_at(
            lambda contact: contact.rtol, self, rtol, is_leaf=lambda x: x is None
        )

    @full_precision
    def gap_velocity_after(
        self, normal: jax.Array, tangential: jax.Array | None
    ) -> jax.Array:
        """gamma+ (m,) [m/s] after impulses, `normal` p (m,) and `tangential` p_t (t,)
        [N s].

        Equation: `gamma+ = gamma- + W p + W_nt p_t`.
        """
        after = self.gap_velocity + self.delassus @ normal
        if self.tangential_block is None or tangential is None:
            return after
        return after + self.tangential_block.normal_tangent @ tangential

    @full_precision
    def slip_after(self, normal: jax.Array, tangential: jax.Array) -> jax.Array:
        """u+ (t,) [m/s] after impulses, `normal` p (m,) and `tangential` p_t (t,) [N
        s].

        Equation: `u+ = u- + W_tn p + W_tt p_t`; only where there are tangents.
        """
        assert self.tangential_block is not None
        w_nt, w_tt, u = self.tangential_block
        return u + w_nt.T @ normal + w_tt @ tangential

    @full_precision
    def energy_change(
        self, normal: jax.Array, tangential: jax.Array | None = None
    ) -> jax.Array:
        """T+ - T- () [J], the work of impulses, `normal` p (m,) and `tangential` p_t
        (t,) [N s].

        Equation: `(gamma- + gamma+) . p / 2 + (u- + u+) . p_t / 2`.
        """
        gamma_after = self.gap_velocity_after(normal, tangential)
        mean = 0.5 * (self.gap_velocity + gamma_after)
        work = mean @ normal
        if tangential is None or self.slip is None:
            return work
        mean_slip = 0.5 * (self.slip + self.slip_after(normal, tangential))
        return work + mean_slip @ tangential

    @property
    def kinetic_angles(self) -> jax.Array:
        """Angles (m, m) [rad] between contacts; pi/2: they are decoupled."""
        return _angles(self.delassus)

    @full_precision
    def rounding(self, normal: jax.Array, tangential: jax.Array | None) -> jax.Array:
        """Rounding (m,) [m/s] of gamma+ after `normal` p (m,) and `tangential` p_t (t,)
        [N s].

        Equation: `noise + eps (|gamma-| + |W| |p| + |W_nt| |p_t|)`, eps that of one
        sum; terms of W p may cancel, their rounding remains.
        """
        w = self.delassus
        size: jax.Array = abs(w) @ jnp.abs(normal)  # type: ignore[operator]
        if self.cross is not None and tangential is not None:
            size = size + jnp.abs(self.cross) @ jnp.abs(tangential)
        rounding = precision(size.dtype).rounding
        return self.noise + rounding * (jnp.abs(self.gap_velocity) + size)


@full_precision
def contact_of(
    scene: Scene,
    velocity: jax.Array,
    stored: jax.Array | None = None,
    uses_gaps: bool = False,
) -> Contact:
    """The contacts of a scene at a velocity v- (n,) [m/s].

    Equation: `W = N^T M^-1 N`, `gamma- = N^T v-`; with tangents `W_nt = N^T M^-1 H`,
    `W_tt = H^T M^-1 H`, `u- = H^T v-`.

    `stored` is the energy in the contacts, () or (m,) [J]; None: 0. With `uses_gaps`
    open contacts take part, but those with an infinite gap never do.
    """
    gamma, noise = rounded_gap_velocity(scene, velocity)
    w = delassus_matrix(scene)
    block = None
    if scene.tangents is not None:
        moved = solve_mass(scene, scene.tangents)  # M^-1 H
        w_nt = scene.normals.T @ moved
        w_tt = scene.tangents.T @ moved
        slip = scene.tangents.T @ velocity
        block = TangentialBlock(w_nt, w_tt, slip)
    if stored is None:
        stored = jnp.zeros_like(gamma)
    else:
        stored = jnp.broadcast_to(stored, gamma.shape)
    if scene.constraints is None:
        norm = jnp.sqrt(diagonal(w))
    else:
        norm = kinetic_norm(scene)
    contact = Contact(
        w,
        gamma,
        closed=scene.closed,
        gaps=scene.gaps,
        stored=jnp.where(scene.closed, stored, 0.0).astype(gamma.dtype),
        norm=norm,
        noise=noise,
        tangential_block=block,
    )
    if scene.constraints is not None:
        contact = _without_held(contact, held_by_constraints(scene))
    if scene.gaps is None:
        return contact
    if uses_gaps:
        return _taking_part(contact, scene.gaps < jnp.inf)
    return _taking_part(contact, contact.closed)


@full_precision
def held_by_constraints(scene: Scene) -> jax.Array:
    """True (m,) for contacts whose normal is a combination of bilateral constraints:
    they are held.

    Equation: `r^T M^-1 r` is rounding beside `N_j^T M^-1 N_j`, of the residual
    `r = N_j - h (h^T M^-1 h)^-1 h^T M^-1 N_j`, the part of the normal that no reactions
    of the constraints h balance. (W_jj, a small difference of large numbers, does not
    show it.)
    """
    free = without_constraints(scene)
    h = scene.constraints
    assert h is not None  # asked only of scenes with constraints
    m_inv_h = solve_mass(free, h)
    reactions = solve_definite(h.T @ m_inv_h, m_inv_h.T @ scene.normals)
    residual = scene.normals - h @ reactions
    square = jnp.sum(residual * solve_mass(free, residual), axis=0)
    return square <= precision(square.dtype).noise * kinetic_norm(scene) ** 2


def _without_held(contact: Contact, held: jax.Array) -> Contact:
    """The contacts where those `held` (m,) by constraints take no part, as if open.

    Their diagonal entry of W becomes that of the bodies without constraints, |grad
    f_j|^2.
    """
    of_diagonal = jnp.where(held, contact.norm**2, diagonal(contact.delassus))
    on_diagonal = jnp.eye(held.shape[0], dtype=bool)
    w = jnp.where(on_diagonal, jnp.diag(of_diagonal), contact.normal_delassus)
    closed = contact.closed & ~held
    stored = jnp.where(held, 0.0, contact.stored)
    contact = dataclasses.replace(contact, delassus=w, closed=closed, stored=stored)
    return _taking_part(contact, ~held)


def _taking_part(contact: Contact, part: jax.Array) -> Contact:
    """The contacts where those outside `part` (m,) are decoupled, at rest, and at a gap
    of 1 m.
    """
    w = decoupled(contact.delassus, part)
    block = contact.tangential_block
    if block is not None:
        tangents = block.slip.shape[0] // part.shape[0]  # of a contact
        rows = jnp.repeat(part, tangents)
        # a row that takes no part keeps a diagonal entry of the size of W's
        of_diagonal = jnp.where(rows, 0.0, jnp.repeat(diagonal(w), tangents))
        decoupled_rows = jnp.diag(of_diagonal)
        across = part[:, None] & rows[None, :]
        along = rows[:, None] & rows[None, :]
        block = TangentialBlock(
            normal_tangent=jnp.where(across, block.normal_tangent, 0.0),
            tangent=jnp.where(along, block.tangent, decoupled_rows),
            slip=jnp.where(rows, block.slip, 0.0),
        )
    gamma = jnp.where(part, contact.gap_velocity, 0.0)
    gaps = jnp.where(part, contact.gaps, 1.0)
    return dataclasses.replace(
        contact, delassus=w, gap_velocity=gamma, gaps=gaps, tangential_block=block
    )


@full_precision
def rounded_gap_velocity(
    scene: Scene, velocity: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """gamma- (m,) [m/s], 0 where it is within the rounding of v- (n,), and that
    rounding (m,).

    Equation: `gamma- = N^T v-`, its rounding `eps |N|^T |v-|`, eps that of one sum. The
    derivative of gamma- remains that of N^T v- where its value is set to 0.
    """
    gamma = gap_velocity(scene, velocity)
    speed = jax.lax.stop_gradient(jnp.abs(velocity))
    if scene.pairs is not None:
        size = jax.tree.map(jnp.abs, scene.pairs).rates(speed)
    elif scene.walls is None:
        size = jnp.abs(scene.normals).T @ speed
    else:
        left, right = scene.walls
        padded = jnp.pad(speed, (int(left), int(right)))
        size = _sums_of_neighbours(padded)
    noise = jax.lax.stop_gradient(precision(speed.dtype).rounding * size)
    return without_rounding(gamma, noise), noise


@full_precision
def delassus_matrix(scene: Scene) -> Symmetric:
    """`W = N^T M^-1 N` [1/kg]: (m, m), or `Tridiagonal` for a chain.

    Args:
        scene: n coordinates, m contacts.

    Returns:
        W (m, m) [1/kg], symmetric; indexed like an array where it is `Tridiagonal`.

    Source: Brogliato (2016), (6.35) where bilateral constraints are present.

    >>> import jimpact as ji
    >>> ji.delassus_matrix(ji.chain([1.0, 2.0, 2.0])).diagonal.tolist()
    [1.5, 1.0]
    """
    if scene.pairs is not None:
        return scene.pairs.delassus(scene.mass)
    if scene.walls is None:
        return scene.normals.T @ solve_mass(scene, scene.normals)
    left, right = scene.walls
    inverse = 1 / scene.mass
    padded = jnp.pad(inverse, (int(left), int(right)))
    shared = inverse[int(not left) : scene.size - int(not right)]
    regular = scene.contacts <= scene.size
    return Tridiagonal(_sums_of_neighbours(padded), -shared, regular)


def _sums_of_neighbours(x: jax.Array) -> jax.Array:
    """`x_j + x_j+1` of a chain's bodies, one for each contact between two of them."""
    return x[:-1] + x[1:]


def decoupled(delassus: Symmetric, closed: jax.Array) -> Symmetric:
    """The Delassus matrix with rows and columns of open contacts 0 but for their
    diagonal entry.

    `closed` (m,) is True for contacts that stay coupled.
    """
    if isinstance(delassus, Sparse):
        return delassus.within(closed)
    if isinstance(delassus, Tridiagonal):
        of_both = closed[:-1] & closed[1:]
        off = jnp.where(of_both, delassus.off_diagonal, 0.0)
        return Tridiagonal(delassus.diagonal, off, delassus.regular)
    of_both = closed[:, None] & closed[None, :]
    on_diagonal = jnp.eye(closed.shape[0], dtype=bool)
    return jnp.where(of_both | on_diagonal, delassus, 0.0)


def kinetic_norm(scene: Scene) -> jax.Array:
    """`|grad f_j| = sqrt(N_j^T M^-1 N_j)` (m,) [1 / sqrt(kg)], without bilateral
    constraints.
    """
    if scene.walls is not None or scene.pairs is not None:
        return jnp.sqrt(diagonal(delassus_matrix(scene)))
    moved = solve_mass(without_constraints(scene), scene.normals)
    return jnp.sqrt(jnp.sum(scene.normals * moved, axis=0))


@full_precision
def normalized_delassus(scene: Scene) -> Symmetric:
    """`G = W` between unit normals: unit diagonal, `G_ij = -cos(theta_ij)`.

    Bilateral constraints distort it, its diagonal included: Brogliato (2016), (6.35).

    Args:
        scene: n coordinates, m contacts.

    Returns:
        G (m, m), or `Tridiagonal` for a chain.

    >>> import jimpact as ji
    >>> ji.theory.normalized_delassus(ji.chain([1.0, 1.0, 1.0])).off_diagonal.round(
    ...     3
    ... ).tolist()
    [-0.5]
    """
    return scaled(delassus_matrix(scene), 1 / kinetic_norm(scene))


@full_precision
def normalized_gap_velocity(scene: Scene, velocity: Any) -> jax.Array:
    """`gamma_j / |grad f_j|` (m,) [sqrt(J)], the normal quasi-velocities.

    Args:
        scene: n coordinates, m contacts.
        velocity: (n,) [m/s].

    Returns:
        qn (m,) [sqrt(J)], < 0 on approach.

    Raises:
        ValueError: not one velocity per coordinate.

    Source: Brogliato (2016), (6.23).

    >>> import jimpact as ji
    >>> ji.theory.normalized_gap_velocity(ji.chain([0.5, 0.5]), [1.0, 0.0]).tolist()
    [-0.5]
    """
    return gap_velocity(scene, velocity) / kinetic_norm(scene)


@full_precision
def kinetic_angles(scene: Scene) -> jax.Array:
    """Angles `pi - arccos(G_ij)` (m, m) [rad] between contacts; pi/2: decoupled.

    Args:
        scene: n coordinates, m contacts.

    Returns:
        Angles (m, m) [rad], pi on the diagonal.

    G is the normalized `delassus_matrix`, so bilateral constraints count: contacts of
    bodies that a constraint ties together are coupled. (6.66) takes the masses alone,
    where they are decoupled: that is the angle of `Scene(scene.mass, scene.normals)`.

    Not differentiable on its diagonal (theta_jj = pi) nor for redundant contacts.
    Source: Brogliato (2016), (6.66), with the W of the constrained bodies.

    >>> import jimpact as ji
    >>> float(ji.theory.kinetic_angles(ji.chain([1.0, 2.0, 3.0]))[0, 1].round(4))
    1.1071
    """
    return _angles(delassus_matrix(scene))


def _angles(w: Symmetric) -> jax.Array:
    """Kinetic angles (m, m) [rad] from a Delassus matrix."""
    cosine = as_matrix(scaled(w, 1 / jnp.sqrt(diagonal(w))))
    return jnp.pi - jnp.arccos(jnp.clip(cosine, -1.0, 1.0))


def coupled_groups(scene: Scene) -> Groups | None:
    """Groups of contacts between which the Delassus matrix is zero whatever its values.

    Groups follow from the zeros of M, N, tangents and constraints, never from rounded
    values of W: contacts of a group move a common coordinate, or coordinates joined by
    an entry of a dense M or by bilateral constraints. Open contacts are in no group
    (with traced gaps all contacts count as closed). The result is None where all
    contacts form one group, where the zeros are not known on the host, and for a chain
    or packing, whose W has only O(m) entries.

    >>> import jimpact as ji
    >>> from jimpact.core.contact import coupled_groups
    >>> two_pairs = ji.Scene([1.0] * 4, [[-1, 0], [1, 0], [0, -1], [0, 1]])  # o o  o o
    >>> [group.tolist() for group in coupled_groups(two_pairs)]
    [[[0], [1]]]
    """
    m = scene.contacts
    tangents = scene.tangents
    if scene.walls is not None or scene.pairs is not None or m == 1:
        return None
    if is_traced((scene.normals, tangents, scene.constraints)):
        return None
    if scene.mass.ndim == 2 and is_traced(scene.mass):
        return None
    known = scene.gaps is not None and not is_traced(scene.gaps)
    if known:
        members = np.flatnonzero(np.asarray(scene.gaps) <= 0)
    else:
        members = np.arange(m)
    if len(members) == 0:
        return None
    moves = np.asarray(scene.normals) != 0
    if tangents is not None:
        along = np.asarray(tangents) != 0
        moves |= along.reshape(len(moves), m, -1).any(axis=2)
    touched = [moves[:, members]]
    if scene.mass.ndim == 2:
        touched.append(np.asarray(scene.mass) != 0)
    if scene.constraints is not None:
        touched.append(np.asarray(scene.constraints) != 0)
    label = components(np.concatenate(touched, axis=1))[: len(members)]
    groups = [members[label == first] for first in np.unique(label)]
    if len(groups[0]) == m:
        return None
    return _by_size(groups, m)


def _by_size(groups: list[np.ndarray], m: int) -> Groups:
    """The groups, of m contacts in all, in one padded array, or in one of small and one
    of large.

    The split is where W of all padded groups has the fewest entries, `c g^2` of c
    groups of g.
    """
    groups = sorted(groups, key=len)  # stable
    size = np.array([len(group) for group in groups])
    smaller = np.arange(len(groups))  # number of groups in the first array
    larger = len(groups) - smaller
    entries = smaller * size[smaller - 1] ** 2 + larger * size[-1] ** 2
    cut = 0
    if entries[0] > WORTH_A_PROGRAM * entries.min():
        cut = int(np.argmin(entries))

    def padded(part: list[np.ndarray]) -> np.ndarray:
        """Groups (c, g), each padded to the length g of the last one.

        The padding, m plus the first contact, is no index of a contact, and tells whose
        scale of energy it has, see `Groups`.
        """
        *_, longest = part
        rows = []
        for group in part:
            missing = len(longest) - len(group)
            padding = m + group[0]
            rows.append(np.pad(group, (0, missing), constant_values=padding))
        return np.stack(rows)

    return tuple(padded(part) for part in (groups[:cut], groups[cut:]) if part)


def contacts_of_groups(
    scene: Scene, velocity: jax.Array, stored: jax.Array, groups: Groups
) -> list[Contact]:
    """The contacts of each array of groups (c, g), with a leading axis (c,).

    `velocity` is v- (n,) [m/s], `stored` (m,) [J]. W of all contacts is never formed.
    An entry that only pads its group is like an open contact.
    """
    gamma, noise = rounded_gap_velocity(scene, velocity)
    m = scene.contacts
    norm = kinetic_norm(scene)
    if scene.gaps is None:
        gaps = jnp.zeros_like(gamma)
    else:
        gaps = scene.gaps
    tangents_each = 0  # of a contact
    columns = scene.normals  # (N, H)
    if scene.tangents is not None:
        tangents_each = scene.tangents.shape[1] // m
        columns = jnp.concatenate([columns, scene.tangents], axis=1)
        slip = scene.tangents.T @ velocity
    moved = solve_mass(scene, columns)  # M^-1 (N, H)
    held = None
    if scene.constraints is not None:
        held = held_by_constraints(scene)

    def contacts_of(padded: np.ndarray) -> Contact:
        """The contacts of padded groups (c, g), see `Groups`."""
        index = padded % m
        c, g = index.shape
        # columns of H of each group, then of (N, H)
        of_contact = jnp.arange(tangents_each)[None, None, :]
        tangents = tangents_each * index[:, :, None] + of_contact
        tangents = tangents.reshape(c, tangents_each * g)
        directions = jnp.concatenate([index, m + tangents], axis=1)
        part = jnp.asarray(padded < m) & scene.closed[index]
        # [[W, W_nt], [W_tn, W_tt]] of each group
        left = columns[:, directions]
        matrix = jnp.einsum("nca,ncb->cab", left, moved[:, directions])
        block = None
        if tangents_each:
            w_nt = matrix[:, :g, g:]
            w_tt = matrix[:, g:, g:]
            block = TangentialBlock(w_nt, w_tt, slip[tangents])
        contact = Contact(
            matrix[:, :g, :g],
            gamma[index],
            closed=part,
            gaps=gaps[index],
            stored=jnp.where(part, stored[index], 0.0),
            norm=norm[index],
            noise=noise[index],
            tangential_block=block,
        )
        if held is not None:
            contact = jax.vmap(_without_held)(contact, held[index])
        return jax.vmap(_taking_part)(contact, contact.closed)

    return [contacts_of(padded) for padded in groups]
