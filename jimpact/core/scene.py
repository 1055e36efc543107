"""Scenes: mass matrix, contact normals and gaps of a mechanical system at one instant.

# notation, used in every file:
#   n, m             velocity coordinates, contacts
#   M                mass matrix (n, n)                          [kg]
#   N = grad f       normals (n, m), one column a contact
#   gamma = N^T v    gap velocities (m,); < 0 on approach        [m/s]
#   p                contact impulses (m,), >= 0                 [N s];  v+ = v- + M^-1
N p
#   W = N^T M^-1 N   Delassus matrix (m, m);  gamma+ = gamma- + W p
#   G                W scaled to a unit diagonal;  cos(theta_ij) = -G_ij (kinetic
angles)
#   T = v^T M v / 2  kinetic energy                              [J]
"""

import dataclasses
import operator
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.numerics.dense import solve_definite, solve_mass_matrix
from jimpact.numerics.sparse import Neighbours, Sparse
from jimpact.tools.checks import (
    as_float_array,
    check_choice,
    check_kind,
    check_shape,
    check_values,
    in_numbers,
    is_traced,
)
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import precision
from jimpact.tools.records import counted

# Asymmetry of M, relative to its largest entry, that rounding causes in float32. Ten
# times more would accept a mass matrix with a wrong fourth digit.
_SYMMETRY_TOLERANCE = 1e-6

# Part of the length of a normal by which tangents may miss right angles, or its length,
# before a warning. Ten times more would pass a tilt of half a degree.
_ORTHONORMAL_WITHIN = 1e-3

# Least eigenvalue of the products of a contact's directions, of length 1 in the metric
# of the mass, below which they depend on each other. Ten times more reports bodies that
# turn very easily.
_DEPENDENT = 1e-13

# Gaps smaller than this [m], of either sign, are the rounding of the positions that
# they were computed from, and closed: it is a hundredth of an atom, and positions of up
# to 1 km are rounded by less. Ten times more would still be less than an atom.
GAP_ROUNDING = 1e-12

_CONSTRAINTS = operator.attrgetter("constraints")
WALLS = {
    False: (False, False),
    True: (False, True),
    "right": (False, True),
    "left": (True, False),
    "both": (True, True),
}


class PairNormals(eqx.Module):
    """Normals of contacts between two bodies of d velocities each: `directions` (m, 2,
    d).

    The other entries of `grad f` are 0 and not stored. Body -1 is none: it has the
    direction 0.
    """

    directions: jax.Array
    neighbours: Neighbours = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number n of velocity coordinates."""
        return self.neighbours.count * self.directions.shape[2]

    def _at_bodies(self, v: jax.Array) -> jax.Array:
        """Entries (m, 2, d) of v (n,) that belong to the two bodies of each contact."""
        return v.reshape(self.neighbours.count, -1)[self.neighbours.bodies]

    def rates(self, v: jax.Array) -> jax.Array:
        """Gap velocities `N^T v` (m,) [m/s] of v (n,)."""
        return jnp.sum(self.directions * self._at_bodies(v), axis=(1, 2))

    def push(self, p: jax.Array) -> jax.Array:
        """Generalized impulses `N p` (n,) of contact impulses p (m,) [N s]."""
        d = self.directions.shape[2]
        forces = (self.directions * p[:, None, None]).reshape(-1, d)
        bodies = self.neighbours.bodies.reshape(-1)
        return (
            jnp.zeros((self.neighbours.count, d), forces.dtype)
            .at[bodies]
            .add(forces)
            .reshape(-1)
        )

    @full_precision
    def delassus(self, mass: jax.Array) -> Sparse:
        """W = N^T M^-1 N [1/kg] for a diagonal M = `mass` (n,).

        Equation: `W_jk = sum d_js . d_kt / m` over bodies s of contact j that are body
        t of contact k, d_js the direction of contact j at its body s.
        """
        moved = self.directions / self._at_bodies(mass)  # M^-1 N
        table = self.neighbours.of_contacts
        shared = self.neighbours.shared
        # (contact, neighbour, own body, the neighbour's body)
        products = jnp.einsum("msd,mktd->mkst", moved, self.directions[table])
        entries = jnp.sum(jnp.where(shared, products, 0.0), axis=(2, 3))
        return Sparse(
            jnp.sum(moved * self.directions, axis=(1, 2)), entries, self.neighbours
        )

    def dense(self) -> jax.Array:
        """N (n, m)."""
        return jax.vmap(self.push)(
            jnp.eye(len(self.directions), dtype=self.directions.dtype)
        ).T


class Scene(eqx.Module):
    """Mass matrix, contact normals and gaps of a mechanical system at one instant.

    Equation: `gamma = N^T v`, `W = N^T M^-1 N` with `N = grad f(q)`.

    Args:
        mass: `(n, n)` symmetric positive definite, or `(n,)` its diagonal [kg, kg m^2,
            ...].
        normals: `(n, m)`, column j is the gradient of gap function j.
        tangents: `(n, m)` planar or `(n, 2 m)`, contact-major; None: no friction
            possible.
        gaps: `(m,)` >= 0 [m]; a contact with gap > 0 is open. Sizes below 1e-12 m, of
            either sign, are the rounding of positions and become 0. None: all closed.
        constraints: `(n, b)` gradients of bilateral constraints h(q) = 0, or None.

    Raises:
        ValueError: wrong shapes, NaN, mass not symmetric or not positive, negative gap,
            a normal that is zero. A warning says where the directions of a contact
            depend on each other, and, where the mass shows it, are not at right angles
            and of one length.

    Source: Brogliato, Nonsmooth Mechanics (3rd ed., 2016), (6.22)-(6.35).

    >>> import jimpact as ji
    >>> scene = ji.Scene(mass=[2.0, 1.0], normals=[[-1.0], [1.0]])
    >>> float(ji.gap_velocity(scene, [1.0, 0.0])[0])
    -1.0
    """

    mass: jax.Array
    tangents: jax.Array | None
    gaps: jax.Array | None
    constraints: jax.Array | None
    _normals: jax.Array | PairNormals | None
    walls: tuple[bool, bool] | None = eqx.field(static=True)  # of a chain (left, right)

    def __init__(
        self,
        mass: Any,
        normals: Any,
        tangents: Any = None,
        gaps: Any = None,
        constraints: Any = None,
    ):
        """Set the fields, arrays of floats, and check shapes and values."""
        self.mass = as_float_array("mass", mass)
        self._normals = as_float_array("normals", normals)
        if tangents is None:
            self.tangents = None
        else:
            self.tangents = as_float_array("tangents", tangents)
        if gaps is None:
            self.gaps = None
        else:
            self.gaps = rounded_gaps(gaps)
        if constraints is None:
            self.constraints = None
        else:
            self.constraints = as_float_array("constraints", constraints)
        self.walls = None
        _check_scene(self)

    @staticmethod
    def _instead_of(value: Any) -> str:
        """Advice for a value that is no scene, ending the message of `check_kind`."""
        body = callable(getattr(value, "scene", None))
        if body:
            return " A body has a scene at each configuration: `.scene(q)`."
        return ""

    def __str__(self) -> str:
        """Lines with the kind, the sizes n and m, masses, the first six normals (none
        of a chain or of pairs), and gaps if given.
        """
        kind = "scene"
        if self.walls is not None:
            kind = "chain"
        if self.walls is not None and any(self.walls):
            walls = next(name for name, sides in WALLS.items() if sides == self.walls)
            kind = f"chain (wall: {walls})"
        size = counted(self.size, "velocity", "velocities")
        lines = [f"{kind} of {size} and {counted(self.contacts, 'contact')}"]
        if self.mass.ndim == 1:
            lines.append(f"mass     {in_numbers(self.mass)}")
        else:
            diagonal = jnp.diagonal(self.mass, axis1=-2, axis2=-1)
            lines.append(f"mass     {in_numbers(diagonal)} (diagonal)")
        if self.walls is None and self.pairs is None:
            lines += [
                f"normal {j + 1} {in_numbers(n)}"
                for j, n in enumerate(self.normals.T[:6])
            ]
        if self.gaps is not None:
            lines.append(f"gaps     {in_numbers(self.gaps)} m")
        return "\n".join(lines)

    @property
    def size(self) -> int:
        """Number n of velocity coordinates."""
        return self.mass.shape[0]

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        if self.walls is not None:
            return self.size - 1 + sum(self.walls)
        if self.pairs:
            return len(self.pairs.directions)
        return self.normals.shape[1]

    @property
    def pairs(self) -> PairNormals | None:
        """Its normals, where only those of two bodies each are stored
        (`sparse_scene`).
        """
        if isinstance(self._normals, PairNormals):
            return self._normals
        return None

    @property
    def normals(self) -> jax.Array:
        """`N = grad f` (n, m); a chain and a packing build it on demand."""
        if isinstance(self._normals, PairNormals):
            return self._normals.dense()
        if self._normals is not None:
            return self._normals
        assert self.walls is not None
        left, _ = self.walls
        body = np.arange(self.size)[:, None]
        # body on the contact's left
        first = np.arange(self.contacts)[None, :] - int(left)
        dtype = self.mass.dtype
        return jnp.asarray(
            (body == first + 1).astype(dtype) - (body == first).astype(dtype)
        )

    @property
    def closed(self) -> jax.Array:
        """Boolean (m,): contacts without a gap."""
        if self.gaps is None:
            return jnp.asarray(np.ones(self.contacts, bool))
        return self.gaps <= 0


def chain(masses: Any, wall: bool | str = False, gaps: Any = None) -> Scene:
    """A row of bodies along +x; contact j joins bodies j and j+1.

    Equation: `gamma_j = v_{j+1} - v_j`; at a wall on the right `gamma_m = -v_n`, on the
    left `gamma_1 = v_1`. The Delassus matrix is tridiagonal and never formed densely.

    Args:
        masses: (n,) > 0 [kg].
        wall: False; True or 'right': last contact; 'left': first contact; 'both'.
        gaps: (m,) >= 0 [m]; sizes below 1e-12 m, of either sign, are the rounding of
            positions and become 0. None: all closed.

    Returns:
        `Scene` of n coordinates; m = n - 1 contacts, and one for each wall.

    Raises:
        ValueError: masses or gaps out of range or of wrong shape, unknown wall, no
            contact.

    >>> import jimpact as ji
    >>> ji.chain([1.0, 1.0, 1.0], wall=True).contacts
    3
    """
    check_choice("wall", wall, tuple(WALLS))
    mass = as_float_array("masses", masses)
    if mass.ndim != 1:
        raise ValueError(
            f"Argument `masses` must have shape (n,), but has shape {mass.shape}."
        )
    check_values("masses", mass, low=0.0, open_low=True)
    left, right = WALLS[wall]
    contacts = mass.shape[0] - 1 + left + right
    if contacts < 1:
        raise ValueError(
            f"Argument `masses` must give at least one contact, "
            f"but {mass.shape[0]} body and wall={wall!r} give none."
        )
    if gaps is not None:
        gaps = rounded_gaps(gaps)
        check_shape("gaps", gaps, (contacts,), "one gap per contact")
        check_values("gaps", gaps, low=0.0)
    return chain_scene(mass, (left, right), gaps)


def rounded_gaps(gaps: Any) -> jax.Array:
    """Gaps (m,) [m]; those smaller than `GAP_ROUNDING` become 0, and keep the slope 1.

    >>> from jimpact.core.scene import rounded_gaps
    >>> rounded_gaps([1e-6, 2.8e-17, -5.6e-17]).tolist() == [1e-6, 0.0, 0.0]
    True
    """
    gaps = as_float_array("gaps", gaps)
    if not is_traced(gaps):  # also inside jit, where known gaps stay known
        known = np.asarray(gaps)
        small = np.abs(known) < GAP_ROUNDING
        if small.any():
            return jnp.asarray(np.where(small, known.dtype.type(0), known))
        return gaps
    rounding = jnp.where(jnp.abs(gaps) < GAP_ROUNDING, gaps, 0.0)
    return gaps - jax.lax.stop_gradient(rounding)


def with_gaps(scene: Scene, gaps: jax.Array) -> Scene:
    """The scene with these gaps (m,) [m]; those below `GAP_ROUNDING` become 0."""
    gaps = rounded_gaps(gaps)
    return eqx.tree_at(lambda tree: tree.gaps, scene, gaps, is_leaf=lambda x: x is None)


def _columns(matrix: jax.Array | None) -> int:
    """Number of columns of a matrix (n, k), 0 of None."""
    if matrix is None:
        return 0
    return matrix.shape[1]


def stackable(scenes: Sequence[Scene]) -> tuple[list[Scene], int]:
    """The scenes padded to one number of contacts and of coordinates, and how many are
    added.

    Scenes with fewer contacts than the largest one get open contacts, each with
    coordinates of its own at the end: where these move at unit speed, the contact
    separates. Equal ones stay as they are.

    Raises:
        ValueError: tangents in some scenes only, planar and spatial ones, or other
            numbers of coordinates or constraints.
    """
    structures = set()
    for scene in scenes:
        leaves, tree = jax.tree.flatten(scene)
        structures.add((tree, tuple(map(np.shape, leaves))))
    if len(structures) == 1:
        return list(scenes), 0
    tangents = {_columns(s.tangents) // s.contacts for s in scenes}
    constraints = {_columns(s.constraints) for s in scenes}
    sizes = {s.size for s in scenes}
    for what, numbers in (
        ("tangents a contact", tangents),
        ("constraints", constraints),
        ("bodies", sizes),
    ):
        if len(numbers) > 1:
            raise ValueError(
                f"Argument `scenes` must have equally many {what} in all shots, but "
                f"have {' and '.join(map(str, sorted(numbers)))}."
            )
    (tangents_each,) = tangents  # of a contact
    counts = [s.contacts for s in scenes]
    contacts = max(counts)
    # a coordinate for each direction
    extra = (contacts - min(counts)) * (1 + tangents_each)
    dense = any(s.mass.ndim == 2 for s in scenes)
    padded = [_with_open_contacts(s, contacts, s.size + extra, dense) for s in scenes]
    return padded, extra


def _with_open_contacts(
    scene: Scene, contacts: int, size: int, dense_mass: bool
) -> Scene:
    """The scene padded on the host to a number of `contacts` and of coordinates
    (`size`).

    The contacts that are added come last and are open. Each has a coordinate of its own
    for each direction, of mass 1; their W_jj is that of the last contact (without
    constraints), so that they do not change units and tolerances. With `dense_mass` M
    is (n, n) in any case.
    """
    n = scene.size
    m = scene.contacts
    missing = contacts - scene.contacts
    mass = np.asarray(scene.mass)
    normals = np.asarray(scene.normals)
    last = normals[:, -1]
    if mass.ndim == 1:
        moved = last / mass
    else:
        moved = np.linalg.solve(mass, last)
    # added directions
    columns = np.sqrt(last @ moved) * np.eye(size, dtype=mass.dtype)[:, n:]
    if dense_mass or mass.ndim == 2:
        padded_mass = np.eye(size, dtype=mass.dtype)
        if mass.ndim == 1:
            padded_mass[:n, :n] = np.diag(mass)
        else:
            padded_mass[:n, :n] = mass
    else:
        padded_mass = np.pad(mass, (0, size - n), constant_values=1)

    def padded(matrix: Any, first: int, count: int) -> np.ndarray:
        """A matrix (n, k) with rows of 0 below, and `count` added directions from
        `first` on.
        """
        above = np.pad(np.asarray(matrix), ((0, size - n), (0, 0)))
        return np.concatenate([above, columns[:, first : first + count]], axis=1)

    tangents = scene.tangents
    constraints = scene.constraints
    if tangents is None:
        tangents_missing = 0
    else:
        tangents_missing = missing * (tangents.shape[1] // m)
    return _unchecked(
        mass=padded_mass,
        _normals=padded(scene.normals, 0, missing),
        tangents=None
        if tangents is None
        else padded(tangents, missing, tangents_missing),
        gaps=_padded_gaps(scene, missing),
        constraints=None if constraints is None else padded(constraints, 0, 0),
    )


def _padded_gaps(scene: Scene, missing: int) -> Any:
    """Gaps of the scene, and of 1 m at `missing` contacts after them."""
    gaps = np.ones(scene.contacts + missing, scene.mass.dtype)
    if scene.gaps is None:
        gaps[: scene.contacts] = 0.0
    else:
        gaps[: scene.contacts] = scene.gaps
    return gaps


class PaddedScene(NamedTuple):
    """A scene with open contacts added."""

    scene: Scene
    coordinates: slice  # of its own coordinates among all
    contacts: slice  # of its own contacts among all
    copied: Any  # array (contacts,), own contact whose parameters each contact takes


def pad_scene(scene: Scene, contacts: int) -> PaddedScene:
    """The scene with a number of `contacts`, on the host: scenes of many sizes share
    programs.

    A chain stays a chain, with bodies added at one end that repeat its masses there;
    other scenes get coordinates of their own for the contacts that are added.
    """
    n = scene.size
    m = scene.contacts
    missing = contacts - m
    copied = np.minimum(np.arange(contacts), m - 1)
    if scene.walls is None:
        # a multiple: few shapes, few programs
        size = -(-(n + missing) // contacts) * contacts
        padded = _with_open_contacts(scene, contacts, size, dense_mass=False)
        return PaddedScene(padded, slice(n), slice(m), copied)
    mass: Any = np.asarray(scene.mass)
    gaps = _padded_gaps(scene, missing)
    # bodies are added on the left, as the chain must end at its right wall
    _, right = scene.walls
    if right:
        mass = np.concatenate([np.resize(mass[1::-1], missing)[::-1], mass])
        padded = chain_scene(mass, scene.walls, np.roll(gaps, missing))
        inside = slice(missing, None)
        return PaddedScene(padded, inside, inside, m - 1 - copied[::-1])
    mass = np.concatenate([mass, np.resize(mass[-2:], missing)])
    return PaddedScene(chain_scene(mass, scene.walls, gaps), slice(n), slice(m), copied)


def as_velocity(scene: Scene, velocity: Any, finite: bool = False) -> jax.Array:
    """`velocity` as an array; raise a ValueError unless it has one (finite) entry a
    coordinate.
    """
    check_kind("scene", scene, Scene)
    v = as_float_array("velocity", velocity)
    meaning = "one per coordinate of the scene"
    if v.ndim == 2 and v.shape[1] == scene.size:
        meaning += "; of a batch jax.vmap takes one row after another"
    check_shape("velocity", v, (scene.size,), meaning)
    if finite:
        check_values("velocity", v)
    return v


def velocity_unit(scene: Scene) -> str:
    """Unit of the velocities: m/s of a chain; those of other scenes may be angular,
    too.

    >>> import jimpact as ji
    >>> from jimpact.core import velocity_unit
    >>> velocity_unit(ji.chain([1.0, 1.0])), velocity_unit(ji.Block(0.2, 0.6).scene())
    ('m/s', 'm/s, or rad/s of an angle')
    """
    if scene.walls is not None:
        return "m/s"
    return "m/s, or rad/s of an angle"


@full_precision
def gap_velocity(scene: Scene, velocity: Any) -> jax.Array:
    """Gap velocities `gamma = N^T v` (m,) [m/s]; negative on approach.

    Args:
        scene: n coordinates, m contacts.
        velocity: (n,) [m/s].

    Returns:
        gamma (m,) [m/s].

    Raises:
        ValueError: not one velocity per coordinate.

    Source: Brogliato (2016), (6.23) before normalization.

    >>> import jimpact as ji
    >>> ji.gap_velocity(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.5]).tolist()
    [-1.0, 0.5]
    """
    v = as_velocity(scene, velocity)
    if scene.pairs is not None:
        return scene.pairs.rates(v)
    if scene.walls is None:
        return scene.normals.T @ v
    left, right = scene.walls
    return jnp.diff(jnp.pad(v, (int(left), int(right))))


@full_precision
def momentum(scene: Scene, velocity: Any) -> jax.Array:
    """Generalized momenta `M v` (n,); for a chain without walls their sum is conserved.

    Args:
        scene: n coordinates, m contacts.
        velocity: (n,) [m/s].

    Returns:
        M v (n,) [kg m/s] (of angles [kg m^2/s]).

    Raises:
        ValueError: not one velocity per coordinate.

    >>> import jimpact as ji
    >>> ji.momentum(ji.chain([1.0, 2.0]), [1.0, 0.5]).tolist()
    [1.0, 1.0]
    """
    v = as_velocity(scene, velocity)
    if scene.mass.ndim == 1:
        return scene.mass * v
    return scene.mass @ v


@full_precision
def kinetic_energy(scene: Scene, velocity: Any) -> jax.Array:
    """Kinetic energy `T = v^T M v / 2` [J] of velocities (n,).

    Args:
        scene: n coordinates, m contacts.
        velocity: (n,) [m/s].

    Returns:
        T () [J].

    Raises:
        ValueError: not one velocity per coordinate.

    >>> import jimpact as ji
    >>> float(ji.kinetic_energy(ji.chain([1.0, 2.0]), [1.0, 0.5]))
    0.75
    """
    v = as_velocity(scene, velocity)
    return 0.5 * v @ momentum(scene, v)


def dense_mass(scene: Scene) -> np.ndarray:
    """M (n, n) on the host, in double precision."""
    mass = np.asarray(scene.mass, float)
    if mass.ndim == 1:
        return np.diag(mass)
    return mass


@full_precision
def solve_mass(scene: Scene, right: jax.Array) -> jax.Array:
    """`M^-1 b` of `right` b (n,) or (n, k), with the reactions of bilateral
    constraints.

    Equation: `y = x - M^-1 h (h^T M^-1 h)^-1 h^T x`, `x = M^-1 b`, with constraints h:
    `h^T y = 0`.
    """
    free = solve_mass_matrix(scene.mass, right)
    if scene.constraints is None:
        return free
    h = scene.constraints
    m_inv_h = solve_mass(without_constraints(scene), h)
    return free - m_inv_h @ solve_definite(h.T @ m_inv_h, h.T @ free)


@full_precision
def velocity_change(scene: Scene, impulse: Any, tangential: Any = None) -> jax.Array:
    """Velocity change by contact impulses: `v+ - v- = M^-1 (N p + H p_t)` (n,) [m/s].

    Args:
        scene: n coordinates, m contacts.
        impulse: p (m,) [N s].
        tangential: p_t, one per tangent of the scene [N s]; None: 0. Not used where the
            scene has no tangents.

    Returns:
        The change of v (n,) [m/s].

    Raises:
        ValueError: not one impulse per contact, or per tangent.

    >>> import jimpact as ji
    >>> ji.velocity_change(ji.chain([1.0, 2.0]), [1.0]).tolist()
    [-1.0, 0.5]
    """
    impulse = as_float_array("impulse", impulse)
    check_shape("impulse", impulse, (scene.contacts,), "one per contact")
    if tangential is not None and scene.tangents is not None:
        tangential = as_float_array("tangential", tangential)
        check_shape(
            "tangential", tangential, scene.tangents.shape[1:], "one per tangent"
        )
    if scene.pairs is not None:  # normals of many bodies, without tangents
        return solve_mass(scene, scene.pairs.push(impulse))
    if scene.walls is None:  # any scene
        push = scene.normals @ impulse
        if scene.tangents is not None and tangential is not None:
            push = push + scene.tangents @ tangential
        return solve_mass(scene, push)
    left, right = scene.walls  # a chain: a body takes the impulses on both sides
    padded = jnp.pad(impulse, (int(not left), int(not right)))
    return -jnp.diff(padded) / scene.mass


def without_constraints(scene: Scene) -> Scene:
    """The scene without its bilateral constraints."""
    if scene.constraints is None:
        return scene
    return eqx.tree_at(_CONSTRAINTS, scene, None)


def chain_scene(
    masses: jax.Array, walls: tuple[bool, bool], gaps: jax.Array | None
) -> Scene:
    """A chain: its normals stay implicit, its Delassus matrix tridiagonal (see
    `ji.chain`).
    """
    return _unchecked(mass=masses, walls=walls, gaps=gaps)


def sparse_scene(
    mass: jax.Array, directions: jax.Array, bodies: np.ndarray, count: int
) -> Scene:
    """A packing: m frictionless contacts between two of `count` bodies each.

    `mass` (n,), `directions` (m, 2, n / count) of `bodies` (m, 2), where -1 is none (a
    wall): its direction is 0. Only these entries of the normals are stored, and its
    Delassus matrix is sparse.
    """
    return _unchecked(
        mass=mass, _normals=PairNormals(directions, Neighbours(bodies, count))
    )


def _unchecked(**fields: Any) -> Scene:
    """A scene of these fields without checks; fields that are left out are None."""
    scene = object.__new__(Scene)
    for field in dataclasses.fields(Scene):
        object.__setattr__(scene, field.name, fields.get(field.name))
    return scene


def _check_scene(scene: Scene) -> None:
    """Raise a ValueError unless shapes and values are those that `Scene` documents."""
    mass = scene.mass
    normals = scene.normals
    if mass.ndim not in (1, 2) or (mass.ndim == 2 and mass.shape[0] != mass.shape[1]):
        raise ValueError(
            f"Argument `mass` must have shape (n,) or (n, n), but has shape "
            f"{mass.shape}."
        )
    n = mass.shape[0]
    if normals.ndim != 2 or normals.shape[0] != n or normals.shape[1] == 0:
        raise ValueError(
            f"Argument `normals` must have shape (n, m) with n = {n} as in `mass` and "
            f"m >= 1, but has shape {normals.shape}."
        )
    m = normals.shape[1]
    check_values("normals", normals)
    if not is_traced(normals) and not _has_body(np.asarray(normals)).all():
        contact = int(np.argmin(_has_body(np.asarray(normals)))) + 1
        raise ValueError(
            f"Argument `normals` must have no zero column: such a contact has no body, "
            f"but that of contact {contact} is zero."
        )
    check_mass(mass)
    if scene.gaps is not None:
        check_shape("gaps", scene.gaps, (m,), "one gap per contact")
        check_values("gaps", scene.gaps, low=0.0)
    if scene.tangents is not None:
        if scene.tangents.shape not in ((n, m), (n, 2 * m)):
            raise ValueError(
                f"Argument `tangents` must have shape ({n}, {m}) or ({n}, {2 * m}), "
                f"but has shape {scene.tangents.shape}."
            )
        check_values("tangents", scene.tangents)
        _check_directions(scene)
    if scene.constraints is not None:
        if scene.constraints.ndim != 2 or scene.constraints.shape[0] != n:
            raise ValueError(
                f"Argument `constraints` must have shape ({n}, b), "
                f"but has shape {scene.constraints.shape}."
            )
        check_values("constraints", scene.constraints)
        _check_independent(scene.constraints)


def _check_directions(scene: Scene) -> None:
    """Warn where the normal and tangents D_i (n, d) of a contact are dependent, or
    oblique.

    Equation: dependent where the least eigenvalue of `D_i^T M^-1 D_i`, scaled to a
    diagonal of 1, is below `_DEPENDENT`; oblique as of `_is_oblique`.
    """
    if is_traced((scene.mass, scene.normals, scene.tangents)):
        return
    n = scene.size
    m = scene.contacts
    mass = np.asarray(scene.mass, float)
    tangents = np.asarray(scene.tangents, float).reshape(n, m, -1)
    directions = np.concatenate(
        [np.asarray(scene.normals, float)[:, :, None], tangents], axis=2
    )
    columns = directions.reshape(n, -1)
    if mass.ndim == 1:
        kinetic = columns.T / np.sqrt(mass)
    else:  # M = L L^T: the rows `D^T L^-T` have the products of `D^T M^-1 D`
        kinetic = np.linalg.solve(np.linalg.cholesky(mass), columns).T
    length = np.linalg.norm(kinetic, axis=1, keepdims=True)
    unit = (kinetic / np.where(length > 0, length, 1.0)).reshape(m, -1, n)
    smallest = np.linalg.eigvalsh(unit @ np.swapaxes(unit, 1, 2))[:, 0]
    # more directions than coordinates always depend on each other
    dependent = (smallest < _DEPENDENT) & (n >= unit.shape[1])
    oblique = _is_oblique(dense_mass(scene), np.moveaxis(directions, 1, 0))
    if dependent.any():
        warnings.warn(
            f"The normal and tangents of contact {int(np.argmax(dependent)) + 1} "
            f"depend on each other: this is right only if its bodies cannot move in "
            f"all of these directions.",
            stacklevel=2,
        )
    elif oblique.any():
        warnings.warn(
            f"The tangents of contact {int(np.argmax(oblique)) + 1} are not at right "
            f"angles to its normal and to each other, and of its length, where the "
            f"mass matrix looks like that of a body's position: slip velocities and "
            f"Coulomb's cone are then distorted.",
            stacklevel=2,
        )


def _is_oblique(mass: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """True (m,) for contacts whose directions (m, n, d) are not orthonormal in bodies'
    positions.

    A scene does not say which coordinates are positions. The candidates are the
    uncoupled coordinates of one and the same mass. Let D be the rows of the d
    directions for them, b the square of the normal in D, and k how many rows are not 0.
    Positions of b bodies (1 or 2) have a unit normal each and d coordinates each: where
    `k = d b` they are taken for positions, and the directions are oblique unless
    `D^T D = b I`. Rotations fit this by chance only.
    """
    masses = np.diag(mass)
    count = directions.shape[2]
    moves: np.ndarray = np.any(directions, axis=2)
    uncoupled = np.count_nonzero(mass, axis=1) == 1
    oblique = np.zeros(len(directions), bool)
    for value in np.unique(masses[uncoupled]):
        position = np.flatnonzero(uncoupled & (masses == value))
        part = directions[:, position]
        gram = np.swapaxes(part, 1, 2) @ part
        # b, of unit normals
        bodies = gram[:, 0, 0]
        moved = moves[:, position].sum(axis=1)
        are_positions = np.isclose(moved, count * bodies, rtol=_ORTHONORMAL_WITHIN) & (
            bodies > 0
        )
        error = np.abs(gram - bodies[:, None, None] * np.eye(count)).max(axis=(1, 2))
        oblique |= are_positions & (error > _ORTHONORMAL_WITHIN * bodies)
    return oblique


def _has_body(normals: Any) -> Any:
    """True (m,) for contacts whose normal, a column of `normals` (n, m), is not
    zero.
    """
    return (normals != 0).any(axis=0)


def _is_symmetric(mass: Any) -> Any:
    """True () if M (n, n) is symmetric but for rounding."""
    return abs(mass - mass.T).max() <= _SYMMETRY_TOLERANCE * abs(mass).max()


def is_allowed(scene: Scene) -> jax.Array:
    """True () if the values of a traced scene are those that `Scene` allows on the
    host.

    NaN is not looked for; a dense M that is not positive definite gives energies
    without a value, a normal that is zero gives a contact without a scale.
    """
    if scene.mass.ndim == 1:
        allowed = [jnp.all(scene.mass > 0)]
    else:
        allowed = [_is_symmetric(scene.mass)]
    if scene.gaps is not None:
        allowed.append(jnp.all(scene.gaps >= 0))
    return jnp.all(jnp.asarray(allowed))


def _check_independent(constraints: jax.Array) -> None:
    """Raise a ValueError where columns of the constraints depend on each other."""
    if is_traced(constraints):
        return
    rank = np.linalg.matrix_rank(np.asarray(constraints))
    b = constraints.shape[1]
    if rank < b:
        raise ValueError(
            f"Argument `constraints` must have independent columns, but {b} columns "
            f"have rank {rank}."
        )


def check_mass(mass: jax.Array) -> None:
    """Raise a ValueError unless M is (n,) > 0, or (n, n) symmetric positive
    definite.
    """
    if mass.ndim == 1:
        check_values("mass", mass, low=0.0, open_low=True)
        return
    check_values("mass", mass)
    if is_traced(mass):
        return
    host = np.asarray(mass, dtype=float)
    if not _is_symmetric(host):
        raise ValueError("Argument `mass` must be symmetric, but M - M^T is not zero.")
    smallest = np.linalg.eigvalsh(host)[0]
    if smallest <= precision(mass.dtype).eps * len(host) * np.abs(host).max():
        raise ValueError(
            "Argument `mass` must be positive definite, "
            f"but its smallest eigenvalue is {smallest:.3g}."
        )
