"""The contacts of a MuJoCo model (MJCF or URDF) as a scene; extra `mujoco`."""

import copy
import warnings
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.scene import Scene, gap_velocity
from jimpact.tools.checks import as_float_array, check_values, needed
from jimpact.tools.records import Column, Table, counted, plain

HOW = "pip install 'jimpact[mujoco]'"

# Penetration over the smaller body's radius beyond which a warning is given. Steps of a
# simulation leave a hundredth; ten times more would let a sphere sink in to its centre
# in silence.
_DEEP = 0.1

# Angle [rad] of a hinge or ball joint, or distance over the model's extent of others,
# beyond a limit, from which a warning is given. Steps of a simulation leave a tenth of
# it; ten times more would pass six degrees in silence.
_BEYOND = 0.01

# Inverse mass in a direction, over the largest one, below which nothing can slide
# there: rounding leaves 1e-32. Ten times more would still be 3e-9 of the sliding
# elsewhere.
_IMMOBILE = 1e-18

# Singular values over the largest one, below which a bilateral constraint repeats
# others. Ten times more would still take closed linkages that are 1e-8 from a singular
# position for what they are.
_REPEATED = 1e-9

# Part of the velocity, in the metric of the mass, that constraints may take away before
# a warning. MuJoCo's soft constraints leave 1e-4 to 1e-3; ten times more would hide a
# tenth of the speed.
_DRIFT = 1e-2

# Distance of bodies that touch but for rounding, over the model's extent: balls at 0,
# .1, .2, .3 m have gaps of 1e-17 m. Ten times more closes gaps of 10 nm in a model of a
# metre.
_TOUCHING = 1e-9

# By so much of the model's extent its bounding volumes grow: before version 3.14 MuJoCo
# compares them in single precision, and sees no contact of balls in a row that touch.
# Ten times more, and pairs that are apart are looked at in vain.
_BOUNDING = 1e-6

# MuJoCo's names of constraints that are no contacts of geoms, of their objects; words
# for them.
_EQUALITIES = "mjCNSTR_EQUALITY"
_LIMITS = (
    ("mjCNSTR_LIMIT_JOINT", "mjOBJ_JOINT", "joint"),
    ("mjCNSTR_LIMIT_TENDON", "mjOBJ_TENDON", "tendon"),
)

# `contact.exclude`: a contact of bodies that are one, or that cannot move
_LEFT_OUT = (2, 3)


class MujocoScene(NamedTuple):
    """A scene with the coordinates of `data.qvel`, and its velocity.

    Equation: `gamma = N^T v`, v as `data.qvel`; `v+` of an impact goes back by
    `data.qvel[:] = out.velocity`.

    Args:
        scene: mass, normals, tangents, gaps and constraints.
        velocity: v (n,), `data.qvel` [m/s, rad/s], that obeys the constraints of the
            scene.
        friction: mu (m,), sliding friction of each contact; None where the scene has no
            tangents.
        names: the two geoms of each contact, as in "floor, box"; its normal points from
            the first one to the second one. Then "limit of joint knee" of each limit
            that is reached.

    >>> import jimpact as ji
    >>> from jimpact.bodies.mujoco_scene import MujocoScene
    >>> world = MujocoScene(ji.chain([1.0, 1.0]), [1.0, 0.0], None, ("left, right",))
    >>> ji.impact(ji.Newton(1.0), world.scene, world.velocity).velocity.tolist()
    [0.0, 1.0]
    """

    scene: Scene
    velocity: jax.Array
    friction: jax.Array | None
    names: tuple[str, ...]

    def __str__(self) -> str:
        """A table with a row for each contact: gap f [m], gap velocity gamma [m/s],
        friction mu.
        """
        scene = self.scene
        gamma = gap_velocity(self.scene, self.velocity)
        zeros = np.zeros(scene.contacts)
        if scene.gaps is None:
            gaps = zeros
        else:
            gaps = np.asarray(scene.gaps)
        if self.friction is None:
            friction = [None] * len(zeros)
        else:
            friction = self.friction.tolist()
        columns = (
            Column("contact"),
            Column("geoms"),
            Column("gap_m", ".3g", "gap", "m"),
            Column("gap_velocity_m_per_s", ".4g", "gap velocity", "m/s"),
            Column("friction", ".3g"),
        )
        rows = [
            [j + 1, name, gap, plain(speed), mu]
            for j, (name, gap, speed, mu) in enumerate(
                zip(self.names, gaps.tolist(), np.asarray(gamma).tolist(), friction)
            )
        ]
        size = f"{counted(scene.size, 'coordinate')} (as data.qvel)"
        return str(
            Table(
                columns, rows, head=[f"{size}, {counted(len(rows), 'contact')}"], keys=2
            )
        )


def from_mujoco(model: Any, data: Any, margin: float = 0.0) -> MujocoScene:
    """The contacts of a MuJoCo model where `data` is, as a scene with its velocity.

    Equation: `N = J^T n`, `H = J^T (t1, t2)`, with `J = J2 - J1` the Jacobian of the
    relative velocity at the contact point, and MuJoCo's contact frame n, t1, t2; M is
    MuJoCo's inertia matrix. MuJoCo finds the contacts: for `data.qpos` as it is, on a
    copy, so that `mj_forward` need not have been called; a positive distance is a gap,
    a negative one is taken for 0, as is what rounding leaves of bodies that touch.
    `solref` and `solimp` play no part: the impact law decides. Equality constraints of
    the model are bilateral constraints of the scene; those that repeat others are left
    out. Limits of joints and tendons are contacts that do not slide. Where each contact
    slides in one direction (a planar model) the scene is planar, where none does it has
    no tangents. `data.qvel[:] = out.velocity` is the way back.

    Args:
        model: `mujoco.MjModel` with n velocities, of any MJCF or URDF.
        data: `mujoco.MjData` of this model; not changed.
        margin: distance >= 0 [m] up to which bodies that do not touch are contacts with
            a gap, beyond the `margin` of the model's geoms.

    Returns:
        `MujocoScene`: scene, velocity (n,) [m/s, rad/s], friction (m,), names of m
            contacts. The velocity is `data.qvel`, projected on the constraints, in the
            metric of M, where it breaks them.

    Raises:
        ImportError: mujoco is missing; the extra is named.
        TypeError: not a model and its data.
        ValueError: data of another model, a negative margin, no contact, a deformable
            body.

    Warns:
        UserWarning: bodies that overlap, exceeded limits, unequal, torsional or rolling
            friction that is left out, a velocity that breaks constraints.

    Limits: contacts of flexible bodies, adhesion.

    Source: Todorov, Erez & Tassa (2012), IROS, 5026-5033; MuJoCo documentation,
    Computation.

    >>> import jimpact as ji, mujoco
    >>> model = mujoco.MjModel.from_xml_string(
    ...     "<mujoco><worldbody><geom name='floor' type='plane' size='1 1 1'/>"
    ...     "<body pos='0 0 .1'><freejoint/><geom name='ball' size='.1' mass='2'/>"
    ...     "</body></worldbody></mujoco>"
    ... )
    >>> data = mujoco.MjData(model)
    >>> data.qvel[2] = -1.0
    >>> world = ji.from_mujoco(model, data)
    >>> world.names
    ('floor, ball',)
    >>> out = ji.impact(ji.Newton(0.8), world.scene, world.velocity)
    >>> round(float(out.velocity[2]), 12)
    0.8
    """
    mujoco = needed("mujoco", HOW)
    _check_arguments(mujoco, model, data)
    check_values("margin", as_float_array("margin", margin), low=0.0)
    touching = _TOUCHING * model.stat.extent
    model, data = _with_margin(mujoco, model, data, margin + touching)
    mass = _mass(mujoco, model, data)
    root = np.linalg.cholesky(mass)
    contacts, jacobians = _contacts(mujoco, model, data)
    limit_names, limit_normals, distances = _limits(mujoco, model, data)
    if not contacts and not limit_names:
        raise ValueError(
            "Argument `data` must have a contact that can move, but has none: no geoms "
            "touch at data.qpos. Argument `margin` finds contacts before they close."
        )
    names = tuple(
        (
            f"{_geom_name(mujoco, model, c.geom[0])}, "
            f"{_geom_name(mujoco, model, c.geom[1])}"
        )
        for c in contacts
    )
    _warn_of_overlap(model, contacts, names)
    _warn_of_exceeded_limits(mujoco, model, data, limit_names)
    normals_alone = np.pad(limit_normals[:, None], ((0, 0), (0, 2), (0, 0)))
    jacobians = np.concatenate([jacobians, normals_alone])
    _, gradients = _rows_of(mujoco, model, data, _EQUALITIES)
    constraints = _independent(root, gradients.T)
    gaps = np.concatenate([[c.dist for c in contacts], distances])
    gaps = np.where(gaps > touching, gaps, 0.0)
    tangents = _tangents(root, jacobians[:, 1:])
    of_contacts = _friction(contacts, names)
    sliding = np.pad(of_contacts, (0, len(limit_names)))
    if tangents is None:
        friction = None
    else:
        friction = jnp.asarray(sliding)
    diagonal = np.diag(mass)
    with warnings.catch_warnings():  # tangents of 0, where nothing slides, are meant
        warnings.filterwarnings("ignore", "The normal and tangents of contact")
        scene = Scene(
            mass=diagonal if np.array_equal(mass, np.diag(diagonal)) else mass,
            normals=jacobians[:, 0].T,
            tangents=tangents,
            gaps=gaps if gaps.any() else None,
            constraints=constraints if constraints.size else None,
        )
    measured = np.array(data.qvel)
    velocity = jnp.asarray(_admissible(root, constraints, measured))
    return MujocoScene(scene, velocity, friction, names + limit_names)


def _grow_bounding_volumes(model: Any, by: float) -> None:
    """Enlarge, by a length [m], spheres and boxes by which MuJoCo finds pairs that may
    touch.
    """
    model.geom_rbound += by * (model.geom_rbound > 0)  # 0 means without bound
    for boxes in (model.geom_aabb, model.bvh_aabb):
        boxes[:, 3:] += by  # their half sizes


def _mass(mujoco: ModuleType, model: Any, data: Any) -> np.ndarray:
    """Mass matrix M (n, n), column by column: arguments of `mj_fullM` differ among
    versions.
    """
    columns = np.eye(model.nv)
    mass = np.empty_like(columns)
    for column, product in zip(columns, mass):
        mujoco.mj_mulM(model, data, product, column)
    return mass


def _check_arguments(mujoco: ModuleType, model: Any, data: Any) -> None:
    """Raise unless `data` is of this model, with finite positions and velocities."""
    if not isinstance(model, mujoco.MjModel) or not isinstance(data, mujoco.MjData):
        raise TypeError(
            f"Arguments `model` and `data` must be a mujoco.MjModel and its MjData, "
            f"but are of types {type(model).__name__} and {type(data).__name__}."
        )
    shapes = data.qpos.shape, data.qvel.shape
    if shapes != ((model.nq,), (model.nv,)):
        raise ValueError(
            f"Argument `data` must be of this model, with {model.nq} positions and "
            f"{model.nv} velocities, but has {data.qpos.size} and {data.qvel.size}."
        )
    check_values("data.qpos", data.qpos)
    check_values("data.qvel", data.qvel)


def _with_margin(
    mujoco: ModuleType, model: Any, data: Any, margin: float
) -> tuple[Any, Any]:
    """Copies of a model and its data; contacts and limits begin `margin` [m] off."""
    model = copy.copy(model)
    data = copy.copy(data)
    model.geom_margin += margin
    model.pair_margin += margin
    for margins in (model.jnt_margin, model.tendon_margin):
        margins += margin
    _grow_bounding_volumes(model, _BOUNDING * model.stat.extent)
    mujoco.mj_fwdPosition(model, data)
    return model, data


def _contacts(
    mujoco: ModuleType, model: Any, data: Any
) -> tuple[list[Any], np.ndarray]:
    """MuJoCo's contacts that can open or close (m), and Jacobians (m, 3, n) of their
    velocities.

    Equation: `(v_n, v_t1, v_t2) = F (J2 - J1) qvel`, the velocity of the second body's
    contact point relative to the first body's; rows of F are the contact frame n, t1,
    t2, n towards body 2.
    """
    contacts: list[Any] = []
    jacobians = [np.zeros((0, 3, model.nv))]
    for contact in data.contact:
        if contact.exclude in _LEFT_OUT:
            continue
        if min(contact.geom) < 0:
            raise ValueError(
                "Argument `data` must have contacts of rigid bodies only, but has one "
                "of a flexible body (flex)."
            )
        first, second = (
            _point_jacobian(mujoco, model, data, contact, g) for g in contact.geom
        )
        jacobian = contact.frame.reshape(3, 3) @ (second - first)
        if jacobian[0].any():
            contacts.append(contact)
            jacobians.append(jacobian[None])
    return contacts, np.concatenate(jacobians)


def _point_jacobian(
    mujoco: ModuleType, model: Any, data: Any, contact: Any, geom: int
) -> np.ndarray:
    """Jacobian J (3, n): `J qvel` is the velocity of the point of a geom's body at the
    contact.
    """
    jacobian = np.zeros((3, model.nv))
    body = int(model.geom_bodyid[geom])
    mujoco.mj_jac(model, data, jacobian, None, contact.pos, body)
    return jacobian


def _tangents(root: np.ndarray, jacobians: np.ndarray) -> np.ndarray | None:
    """Tangents H (n, 2 m), or (n, m) where each contact slides along one line, or None
    where none.

    Equation: contact j slides along the eigenvectors of its mobility `J_j M^-1 J_j^T`
    (2, 2) with an eigenvalue that is not 0; `jacobians` J (m, 2, n) of (v_t1, v_t2);
    `root` L, `M = L L^T`.
    """
    columns = np.swapaxes(jacobians, 1, 2)
    scaled = np.linalg.solve(root, columns)  # L^-1 J^T (m, n, 2)
    # increasing
    delassus = np.swapaxes(scaled, 1, 2) @ scaled
    mobility, directions = np.linalg.eigh(delassus)
    least = _IMMOBILE * mobility.max()
    if not (mobility[:, 1] > least).any():
        return None
    if (mobility[:, 0] <= least).all():
        jacobians = np.einsum("mi,min->mn", directions[:, :, 1], jacobians)
    return jacobians.reshape(-1, jacobians.shape[-1]).T


def _friction(contacts: list[Any], names: tuple[str, ...]) -> np.ndarray:
    """Sliding friction mu (m,) of MuJoCo's contacts, 0 where a contact has none.

    Warns of friction that differs in two directions, and of torsional or rolling
    friction.
    """
    unequal = []
    turning = []
    for contact, name in zip(contacts, names):
        first, second, *others = contact.friction
        if contact.dim > 1 and first != second:
            unequal.append(f"{name!r}: {first:g} and {second:g}")
        if contact.dim > 3 and any(others):
            turning.append(repr(name))
    if unequal:
        warnings.warn(
            f"Friction differs in two directions, and the first one is taken for both, "
            f"at {_in_words(unequal)}.",
            stacklevel=3,
        )
    if turning:
        warnings.warn(
            f"Torsional or rolling friction is left out at {_in_words(turning)}.",
            stacklevel=3,
        )
    return np.array([c.friction[0] if c.dim > 1 else 0.0 for c in contacts])


def _rows_of(
    mujoco: ModuleType, model: Any, data: Any, kind: str
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (c,) of `data.efc_J` of active constraints of a `kind` (`mjtConstraint`), as
    (c, n).
    """
    rows = np.flatnonzero(data.efc_type == getattr(mujoco.mjtConstraint, kind))
    gradients = np.zeros((rows.size, model.nv))
    if not mujoco.mj_isSparse(model):
        dense = data.efc_J.reshape(-1, model.nv)
        gradients[:] = dense[rows]
        return rows, gradients
    for gradient, row in zip(gradients, rows):
        first = data.efc_J_rowadr[row]
        entries = slice(first, first + data.efc_J_rownnz[row])
        gradient[data.efc_J_colind[entries]] = data.efc_J[entries]
    return rows, gradients


def _limits(
    mujoco: ModuleType, model: Any, data: Any
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Joints and tendons at their limits, c in all, as contacts.

    Returns their names, the gradients (c, n) of their distances to the limits, and
    these distances (c,) [rad, m].
    """
    names: list[str] = []
    gradients = [np.zeros((0, model.nv))]
    distances = [np.zeros(0)]
    for kind, object_type, word in _LIMITS:
        rows, rows_of_kind = _rows_of(mujoco, model, data, kind)
        for row in rows:
            number = int(data.efc_id[row])
            kind_of_object = getattr(mujoco.mjtObj, object_type)
            name = mujoco.mj_id2name(model, kind_of_object, number) or number
            names.append(f"limit of {word} {name}")
        gradients.append(rows_of_kind)
        distances.append(data.efc_pos[rows])
    return tuple(names), np.concatenate(gradients), np.concatenate(distances)


def _independent(root: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    """A basis h (n, b) of the span of `gradients` G (n, c), with `h^T M^-1 h` the
    identity.

    Equation: `h = L U` with the singular vectors U of `L^-1 G = U S V^T`; `root` L,
    `M = L L^T`.
    """
    scaled = np.linalg.solve(root, gradients)
    vectors, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    return root @ vectors[:, sizes > _REPEATED * sizes.max(initial=0.0)]


def _admissible(
    root: np.ndarray, constraints: np.ndarray, velocity: np.ndarray
) -> np.ndarray:
    """The velocity (n,) without its part that breaks the constraints h (n, b), h^T M^-1
    h = I.

    Equation: `v - M^-1 h h^T v`, computed from `L^T v`, whose square is 2 T; `root` L,
    `M = L L^T`.
    """
    scaled = root.T @ velocity
    basis = np.linalg.solve(root, constraints)  # L^-1 h, orthonormal
    broken = basis @ (basis.T @ scaled)
    drift = np.linalg.norm(broken)
    if drift > _DRIFT * np.linalg.norm(scaled):
        warnings.warn(
            f"The velocity breaks equality constraints of the model; "
            f"{broken @ broken / (scaled @ scaled):.1%} of the kinetic energy is left "
            f"out.",
            stacklevel=3,
        )
    return np.linalg.solve(root.T, scaled - broken)


def _geom_name(mujoco: ModuleType, model: Any, geom: int) -> str:
    """The name of a geom, or of its body with the geom's number."""
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
    if name:
        return str(name)
    body = int(model.geom_bodyid[geom])
    body_name = (
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) or f"body {body}"
    )
    return f"{body_name} (geom {geom})"


def _warn_of_overlap(model: Any, contacts: list[Any], names: tuple[str, ...]) -> None:
    """Warn of contacts deeper than `_DEEP` of the smaller bounding radius: points are
    arbitrary.
    """
    deep = []
    for contact, name in zip(contacts, names):
        radii = [r for r in model.geom_rbound[contact.geom] if r > 0]  # a plane's is 0
        if radii and -contact.dist > _DEEP * min(radii):
            deep.append(f"{name!r} by {-contact.dist:.3g} m")
    if deep:
        warnings.warn(
            f"Bodies overlap, where points and normals mean little: {_in_words(deep)}.",
            stacklevel=3,
        )


def _warn_of_exceeded_limits(
    mujoco: ModuleType, model: Any, data: Any, limits: tuple[str, ...]
) -> None:
    """Warn of joints and tendons that exceed their limits by `_BEYOND`, taken as just
    reached.
    """
    turning = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL)
    of_kinds = [_rows_of(mujoco, model, data, kind)[0] for kind, _, _ in _LIMITS]
    rows = np.concatenate(of_kinds)
    beyond = []
    for row, name in zip(rows.astype(int), limits):
        is_joint = data.efc_type[row] == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
        is_angle = is_joint and model.jnt_type[data.efc_id[row]] in turning
        if is_angle:
            unit = "rad"
            allowed = _BEYOND
        else:
            unit = "m"
            allowed = _BEYOND * model.stat.extent
        if -data.efc_pos[row] > allowed:
            beyond.append(f"{name!r} by {-data.efc_pos[row]:.3g} {unit}")
    if beyond:
        warnings.warn(
            f"Limits are exceeded, and taken as just reached: {_in_words(beyond)}.",
            stacklevel=3,
        )


def _in_words(places: list[str]) -> str:
    """The places without repetition, one after the other."""
    return "; ".join(dict.fromkeys(places))
