"""What is fitted of a law and its scene: names, entries, bounds, priors, ties."""

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact
from jimpact.core.law import (
    AnyLaw,
    Domain,
    Impulses,
    Law,
    OptionalValues,
    declarations_of,
    entries,
    forwards_to_law,
    free_parameters_of,
    parameter,
    parameters_of,
    value_of,
    with_parameter,
)
from jimpact.core.scene import Scene, with_gaps
from jimpact.fits.parts_of_motion import LawInMotion
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.tools.checks import ABBREVIATIONS, check_kind, suggestion

Limits = tuple[np.ndarray, np.ndarray]  # lowest and highest values (P,)
DEFAULT_FREE = ("restitution", "stiffness")  # or a matrix, or what else a law has
OF_SPEED = ("speed_exponent", "yield_speed")  # a law has them only if requested
# parts of a scene that a fit may have as parameters
OF_A_SCENE = ("mass", "gaps", "tilt")

# What is fitted in its logarithm, a stiffness, may without bounds move this far from
# its start: beyond, the softer contact has no further influence that a measurement
# could see.
LOG_RANGE = 1e4
# A part of a scene is searched up to so many standard deviations of its prior away.
# With ten times more, random starts would lie where the prior makes a fit hopeless.
REACH = 10.0

# a name with entries, from 1
_ENTRY = re.compile(r"(\w+)\[([1-9]\d*(?:[,=][1-9]\d*)*)\]")


# ---------------------------------------------------------------------------- names and
# entries


def entry_of(name: str) -> tuple[str, str | None]:
    """The field of a name as in `Parameters.names`, and what is in its brackets.

    >>> from jimpact.fits.parameters import entry_of
    >>> entry_of("restitution"), entry_of("restitution[1=3]")
    (('restitution', None), ('restitution', '1=3'))
    """
    match = _ENTRY.fullmatch(name)
    if match:
        return (match[1], match[2])
    return (name, None)


def places(argument: str, name: str, shape: tuple[int, ...]) -> list[int]:
    """Indices (from 0) of a name's entries in the flattened field, which has this
    shape.

    `field` names all of them, `field[2]` the second one, `field[1,2]` that of row 1 and
    column 2, `field[1,2=2,1]` entries that are one parameter. Raise a ValueError for an
    entry that the field does not have.
    """
    _, entry = entry_of(name)
    if entry is None:
        return list(range(int(np.prod(shape, dtype=int))))
    members = [tuple(int(i) - 1 for i in part.split(",")) for part in entry.split("=")]
    for index in members:
        inside = len(index) == len(shape) and all(
            0 <= i < n for i, n in zip(index, shape)
        )
        if not inside:
            if shape:
                kind = f"of shape {shape}"
            else:
                kind = "one value for all contacts"
            raise ValueError(
                f"Argument `{argument}` must name entries that the field has, counted "
                f"from 1, but has {name!r} of a field that is {kind}."
            )
    return [int(np.ravel_multi_index(index, shape)) for index in members]


def domain_of(law: Law, field: str) -> Domain:
    """The range of values that a parameter of the law may have."""
    return parameters_of(law)[field].domain


def scaled(x: Any, scale: Any, log: Any, xp: Any = np) -> Any:
    """Scaled variables y of values x: `x / scale`, or `log(x)`; `xp` is NumPy or
    jax.numpy.
    """
    with np.errstate(divide="ignore"):
        return xp.where(log, xp.log(xp.where(log, x, 1.0)), x / scale)


def unscaled(y: Any, scale: Any, log: Any, xp: Any = np) -> Any:
    """Values x of scaled variables y: `scale y`, or `exp(y)`; `xp` is NumPy or
    jax.numpy.
    """
    return xp.where(log, xp.exp(xp.where(log, y, 0.0)), y * scale)


@dataclasses.dataclass(frozen=True)
class Parameters:
    """P free parameters. Each moves one or several of the Q entries of the named
    fields.

    Entries are numbered through the flattened fields, in the order of `fields`; entries
    in no group are fixed. (All entries are listed so that a compiled fit does not
    depend on the groups.)
    """

    fields: tuple[str, ...]
    names: tuple[str, ...]
    # for each parameter, the entries that share its value
    groups: tuple[tuple[int, ...], ...]
    log: np.ndarray  # (P,) True where a parameter is fitted in its logarithm
    # True where the stiffness of contact 1 is held: only ratios matter
    ratios: bool = False

    @property
    def first(self) -> list[int]:
        """The first entry of every group: it stands for the parameter."""
        return [group[0] for group in self.groups]

    @property
    def of_fields(self) -> list[str]:
        """(P,) the field that each parameter belongs to."""
        return [entry_of(name)[0] for name in self.names]


def free_parameters(
    law: Law, free: Any, absolute: bool = False, ties: "Ties" = ()
) -> tuple[Parameters, list[str]]:
    """The parameters that `free` names, but for what is tied, and notes on what was
    fixed instead.

    `absolute`: forces or times were measured, which show a common factor of all
    stiffnesses.
    """
    # `fixed`: the stiffness that the note is about
    available = free_parameters_of(law)
    fixed = ""
    if free is DEFAULT_FREE:
        free = default_free(law, absolute)
        if "stiffness" in available and "stiffness" not in free:
            fixed = "stiffness"
    labels = _labels(law, free)  # by field: 0 is fixed, equal numbers share one value
    if (
        not absolute
        and _only_ratios(law, labels)
        and labels.get("stiffness", np.zeros(1)).all()
    ):
        shared = labels["stiffness"] == labels["stiffness"].flat[0]
        if shared.all():
            raise ValueError(
                "Argument `free` must not hold a scalar `stiffness` (or one for all "
                "contacts): with equal exponents a common factor of all stiffnesses "
                "changes nothing, so the data cannot determine it. Give the law one "
                "stiffness per contact to fit their ratios, or free only `restitution`."
            )
        labels["stiffness"][shared] = 0
        fixed = "stiffness[1]"
    for tie in ties:
        if tie.field in labels:
            labels[tie.field].flat[list(tie.at)] = 0
    # start: the number of the first entry of a field
    names = []
    groups = []
    start = 0
    for field, label in labels.items():
        for value in dict.fromkeys(label[label > 0].tolist()):
            names.append(_name(field, np.argwhere(label == value), label.size))
            groups.append(tuple((start + np.flatnonzero(label == value)).tolist()))
        start += label.size
    if not names:
        raise ValueError(
            "Argument `free` must name a parameter to fit, but leaves none free."
        )
    log = np.array([domain_of(law, entry_of(name)[0]).log for name in names])
    note = (
        f"{fixed} is fixed at its start: with equal exponents only stiffness ratios "
        f"matter."
    )
    ratios = fixed == "stiffness[1]"
    parameters = Parameters(tuple(labels), tuple(names), tuple(groups), log, ratios)
    return parameters, [note] if fixed else []


def _labels(law: Law, free: Any) -> dict[str, np.ndarray]:
    """Labels by field, shaped like it: 0 for fixed entries, equal numbers for a shared
    value.
    """
    available = free_parameters_of(law)
    labels = {}
    if isinstance(free, Mapping):
        choices = free
    else:
        choices = dict.fromkeys(as_names("free", free), True)
    for name, choice in choices.items():
        field, entry = entry_of(name)
        if field not in available:
            raise ValueError(_unknown_field(law, name, list(available)))
        shape = np.shape(value_of(law, field))
        if entry is None:
            labels[field] = _as_labels(field, choice, shape)
            continue
        if not isinstance(choice, (bool, np.bool_)):
            raise ValueError(
                f"Argument `free` must map `{name}` to True or False, but has value "
                f"{choice!r}."
            )
        label = labels.setdefault(field, np.zeros(shape, int))
        label.flat[places("free", name, shape)] = (label.max() + 1) * choice
    return labels


def _name(field: str, members: np.ndarray, size: int) -> str:
    """A name: restitution (all entries), restitution[2], restitution[1=3] (shared),
    matrix[1,2].
    """
    if len(members) == size and (size > 1 or members.shape[1] == 0):
        return field
    return (
        f"{field}[{'='.join(','.join(str(i + 1) for i in index) for index in members)}]"
    )


def as_names(argument: str, names: Any) -> tuple[str, ...]:
    """One or several names; a TypeError for anything else."""
    if isinstance(names, str):
        return (names,)
    check_kind(argument, names, Iterable)
    return tuple(names)


def default_free(law: Law, absolute: bool = False) -> tuple[str, ...]:
    """The fields that are fitted by default: restitution, stiffness, matrix, speed; or
    else all.

    A single stiffness of which only ratios matter is left out; `absolute`: see
    `free_parameters`.
    """
    available = free_parameters_of(law)
    first = [name for name in (*DEFAULT_FREE, "matrix", *OF_SPEED) if name in available]
    fields = first or list(available)
    single = "stiffness" in fields and np.size(value_of(law, "stiffness")) == 1
    if single and not absolute and _only_ratios(law, {}):
        fields.remove("stiffness")
    return tuple(fields)


def _unknown_field(law: Law, field: str, known: list[str]) -> str:
    """The error message for a name in `free` that is no free parameter of the law."""
    name = type(plain_law(law)).__name__
    if isinstance(value_of(law, field), (float, tuple)):
        return (
            f"Argument `free` must not hold `{field}`: it is a fixed number of this "
            f"{name}; give {field}=jnp.asarray(...) to the law to make it a parameter."
        )
    declared = declarations_of(type(law))
    if isinstance(declared.get(field), Domain):
        return (
            f"Argument `free` must not hold `{field}`, because this {name} has "
            f"none: give it one."
        )
    words = suggestion(field, declared, ABBREVIATIONS) or suggestion(field, known)
    return (
        f"Argument `free` must name parameters of {name}, one of {', '.join(known)}, "
        f"but has {field!r}.{words}"
    )


def _as_labels(field: str, choice: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Integers shaped like the field: 0 is fixed, entries with equal numbers share one
    value.
    """
    mask = np.asarray(choice)
    if mask.dtype.kind not in "biu" or (mask < 0).any():
        raise ValueError(
            f"Argument `free` must map `{field}` to True, False, a boolean mask or "
            f"numbers of groups (0 is fixed), but has value {choice!r}."
        )
    if mask.shape not in ((), shape):
        kind = f"of shape {shape}"
        advice = ""
        if shape == ():
            kind = "one value for all contacts"
            advice = (
                f" For one value each, give the law {mask.size} of them, "
                f"`{field}=[...]`."
            )
        raise ValueError(
            f"Argument `free` must have a mask of shape {shape} for `{field}`, which "
            f"is {kind} in this law, but has a mask of shape {mask.shape}.{advice}"
        )
    if mask.dtype == bool:  # each free entry is a group of its own
        count = np.arange(1, np.prod(shape, dtype=int) + 1).reshape(shape)
        return np.where(mask, count, 0)
    return np.array(np.broadcast_to(mask, shape), dtype=int)


def _only_ratios(law: Law, labels: Mapping[str, np.ndarray]) -> bool:
    """True where a common factor of all stiffnesses changes nothing, whatever is fitted
    of them.
    """
    stay_equal = "exponent" not in labels or len(set(labels["exponent"].flat)) == 1
    return law.only_stiffness_ratios and stay_equal


# ---------------------------------------------------------------------------- bounds
# and priors


def _check_name(argument: str, name: str, known: Any) -> None:
    """Raise a ValueError unless this names free parameters."""
    if name not in known:
        names = tuple(dict.fromkeys(known))
        raise ValueError(
            f"Argument `{argument}` must name free parameters, {', '.join(names)}, "
            f"but has {name!r}.{suggestion(name, names)}"
        )


def bounds_of(
    parameters: Parameters, law: Law, bounds: Mapping[str, Any] | None
) -> Limits:
    """Bounds (P,), (P,): the user's, else the field's domain; the narrowest of a shared
    value.
    """
    chosen = dict(bounds or {})
    fields = sorted(set(parameters.of_fields))
    for name in chosen:
        _check_name("bounds", entry_of(name)[0], fields)
    ends = {field: _default_bounds(law, field) for field in parameters.fields}
    # fields first
    for name in sorted(chosen, key=lambda name: entry_of(name)[1] is not None):
        field, _ = entry_of(name)
        at = places("bounds", name, np.shape(value_of(law, field)))
        ends[field][:, at] = np.array(_bound_pair(field, chosen[name], law))[:, at]
    both = np.concatenate(list(ends.values()), axis=1)
    low = np.array([both[0, list(group)].max() for group in parameters.groups])
    high = np.array([both[1, list(group)].min() for group in parameters.groups])
    starts = entries(law, parameters.fields)[parameters.first]
    for name, start, a, b in zip(parameters.names, starts, low, high):
        if not a <= start <= b:
            raise ValueError(
                f"Argument `bounds` must include the start of `{name}`, {start:g}, "
                f"but is [{a:g}, {b:g}]."
            )
    return low, high


def _default_bounds(law: Law, field: str) -> np.ndarray:
    """Default bounds (2, size) of a field: its domain, of a stiffness `LOG_RANGE` to
    each side.
    """
    values = np.ravel(np.asarray(value_of(law, field), float))
    domain = domain_of(law, field)
    if domain.log:
        return np.stack([values / LOG_RANGE, values * LOG_RANGE])
    low, high = domain.bounds
    searched = np.maximum(values, domain.searched_high)
    return np.stack([np.full(len(values), low), np.minimum(high, searched)])


def _bound_pair(field: str, pair: Any, law: Law) -> Limits:
    """Bounds of a field, flattened; each end is a scalar or shaped like the field."""
    shape = np.shape(value_of(law, field))
    try:
        low, high = (
            np.broadcast_to(np.asarray(end, float), shape).ravel() for end in pair
        )
    except (TypeError, ValueError):
        raise ValueError(
            f"Argument `bounds` must map `{field}` to (low, high), each a number or of "
            f"shape {shape}, but has {pair!r}."
        ) from None
    domain = domain_of(law, field)
    smallest, largest = domain.bounds
    if not (low < high).all():
        raise ValueError(
            f"Argument `bounds` must have low < high for `{field}`, but has {pair!r}."
        )
    if (low < smallest).any() or (high > largest).any():
        raise ValueError(
            f"Argument `bounds` must lie in [{smallest:g}, {largest:g}] for `{field}`, "
            f"but has {pair!r}."
        )
    if domain.log and (low <= 0).any():
        raise ValueError(
            f"Argument `bounds` must be > 0 for `{field}`, but has {pair!r}."
        )
    return low, high


class Prior(NamedTuple):
    """A normal distribution of a parameter (by its index) that is known besides the
    data.
    """

    parameter: int
    mean: float
    std: float


def priors_of(
    parameters: Parameters, limits: Limits, priors: Mapping[str, Any] | None
) -> tuple[Prior, ...]:
    """The user's priors, by name of a parameter or of a field for all that belong to
    it.
    """
    chosen = dict(priors or {})
    fields = parameters.of_fields
    for name in chosen:
        _check_name("priors", name, (*parameters.names, *fields))
    pairs = [
        chosen.get(name, chosen.get(field))
        for name, field in zip(parameters.names, fields)
    ]
    each = enumerate(zip(parameters.names, pairs, *limits))
    return tuple(Prior(i, *mean_and_std(*row)) for i, row in each if row[1] is not None)


def mean_and_std(name: str, pair: Any, low: float, high: float) -> tuple[float, float]:
    """The two numbers of a prior: (mean, std), or of a `ji.Normal`."""
    if hasattr(pair, "std") and hasattr(pair, "mean"):
        ends = (pair.mean, pair.std)
    else:
        ends = pair
    try:
        mean, std = (float(end) for end in ends)
    except (TypeError, ValueError):
        raise ValueError(
            f"Argument `priors` must map `{name}` to (mean, standard deviation) or a "
            f"ji.Normal, but has {pair!r}."
        ) from None
    if not (0 < std < np.inf):
        raise ValueError(
            f"Argument `priors` must have a standard deviation > 0 for `{name}`, but "
            f"has {pair!r}."
        )
    if not low <= mean <= high:
        raise ValueError(
            f"Argument `priors` must have its mean in [{low:g}, {high:g}] for "
            f"`{name}`, but has {pair!r}."
        )
    return mean, std


# ---------------------------------------------------------------------------- ties


class Tie(NamedTuple):
    """A constraint: the entries `at` of a flattened field are a function of other
    values.
    """

    name: str
    field: str
    at: tuple[int, ...]
    function: Callable[["Values"], Any]

    def overlaps(self, field: str, at: Iterable[int]) -> bool:
        """True if it ties one of these entries of a field."""
        return self.field == field and not set(at).isdisjoint(self.at)


Ties = tuple[Tie, ...]


class Values:
    """The argument of a tie's function: values of a law by name, those that are tied
    included.
    """

    def __init__(self, law: Law, ties: Ties):
        self.law = law
        self.ties = ties
        # ties being evaluated, each needed by the one before
        self.waiting: list[str] = []

    def __getitem__(self, name: str) -> Any:
        """The value of an entry, or of a whole field in its shape."""
        field, entry = entry_of(name)
        value = _value(self.law, name)
        at = places("ties", name, value.shape)
        flat = value.ravel()
        for tie in self.ties:
            if tie.overlaps(field, at):
                flat = flat.at[np.array(tie.at)].set(self._follow(tie))
        if entry is None:
            return flat.reshape(value.shape)
        return flat[at[0]]

    def _follow(self, tie: Tie) -> Any:
        """The value of a tie's function, flattened; it evaluates other ties that it
        needs.
        """
        if tie.name in self.waiting:
            circle = [*self.waiting[self.waiting.index(tie.name) :], tie.name]
            way = f"{circle[0]} needs {', which needs '.join(circle[1:])}"
            raise ValueError(f"Argument `ties` must not go in a circle, but {way}.")
        self.waiting.append(tie.name)
        old = _value(self.law, tie.name)
        value = jnp.asarray(tie.function(self)).astype(old.dtype)
        self.waiting.pop()
        allowed = {(), old.shape if tie.name == tie.field else ()}
        if value.shape not in allowed:
            if len(allowed) > 1:
                or_shape = f" or shape {old.shape}"
            else:
                or_shape = ""
            raise ValueError(
                f"Argument `ties` must give one number for `{tie.name}`{or_shape}, "
                f"but its function gives shape {value.shape}."
            )
        if value.ndim:
            return value.ravel()
        return value


def tied(law: AnyLaw, ties: Ties) -> AnyLaw:
    """The law with its tied entries set to the values of their functions."""
    values = Values(law, ties)
    for field in dict.fromkeys(tie.field for tie in ties):
        law = with_parameter(law, field, values[field])
    return law


def checked_ties(law: Law, ties: Mapping[str, Any] | None) -> Ties:
    """The user's ties, checked, with their functions evaluated at the law's start
    values.
    """
    checked: Ties = ()
    for name, function in (ties or {}).items():
        if not callable(function):
            raise ValueError(
                f"Argument `ties` must map `{name}` to a function of the other values, "
                f"as in lambda p: 2 * p['restitution'], but has {function!r}."
            )
        at = tuple(places("ties", name, _value(law, name).shape))
        tie = Tie(name, entry_of(name)[0], at, function)
        for other in checked:
            if other.overlaps(tie.field, at):
                raise ValueError(
                    f"Argument `ties` must tie an entry once, but {other.name} and "
                    f"{name} overlap."
                )
        checked = (*checked, tie)
    start = tied(law, checked)
    for tie in checked:
        value = tied_value(start, tie)
        domain = domain_of(start, tie.field)
        if not bool(np.asarray(domain.holds(value))):
            low, high = domain.bounds
            raise ValueError(
                f"Argument `ties` must keep `{tie.name}` in [{low:g}, {high:g}], but "
                f"its function gives {value.tolist()} at the start."
            )
    return checked


def tied_value(law: Law, tie: Tie) -> jax.Array:
    """The tied entries of a law."""
    return jnp.ravel(value_of(law, tie.field))[np.array(tie.at)]


def tied_names(law: Law, ties: Ties) -> list[str]:
    """Names of the tied entries, one by one."""
    names = []
    for tie in ties:
        shape = np.shape(value_of(law, tie.field))
        is_array = tie.name == tie.field and shape  # of which each entry has a name
        if is_array:
            members = [np.array([np.unravel_index(i, shape)]) for i in tie.at]
        else:
            members = []
        names += [_name(tie.field, each, 0) for each in members] or [tie.name]
    return names


def _value(law: Law, name: str) -> Any:
    """The value of the field that `name` belongs to; a ValueError unless it is a
    parameter.
    """
    available = free_parameters_of(law)
    field, _ = entry_of(name)
    if field not in available:
        raise ValueError(
            f"Argument `ties` must use parameters of {type(law).__name__}, one of "
            f"{', '.join(available)}, but uses {name!r}.{suggestion(field, available)}"
        )
    return jnp.asarray(available[field].value)


# ---------------------------------------------------------------------------- parts of
# a scene


@forwards_to_law
class LawInScene(Law):
    """A law, and the parts of the scene that are fitted with it; None: as the scene has
    them.

    A tilt by a turns the contact: `N cos(a) + H sin(a)`, `H cos(a) - N sin(a)`.
    """

    law: Law
    mass: OptionalValues = parameter(
        low=0.0, open_low=True, per_contact=False, default=None
    )
    gaps: OptionalValues = parameter(low=0.0, default=None)
    tilt: OptionalValues = parameter(low=-np.pi, high=np.pi, default=None)

    def impulses(self, contact: Contact) -> Impulses:
        """Impulses of the law, in a contact of a scene with these parts."""
        return self.law.impulses(contact)

    def in_scene(self, scene: Scene) -> Scene:
        """The scene with these parts in the place of its own."""
        if self.mass is not None:
            scene = eqx.tree_at(lambda s: s.mass, scene, self.mass)
        if self.gaps is not None:
            scene = with_gaps(scene, self.gaps)
        if self.tilt is None:
            return scene
        normals = scene.normals
        tangents = scene.tangents
        assert tangents is not None
        cos = jnp.cos(self.tilt)[None, :]
        sin = jnp.sin(self.tilt)[None, :]
        turned = (normals * cos + tangents * sin, tangents * cos - normals * sin)
        return eqx.tree_at(lambda s: (s._normals, s.tangents), scene, turned)


def placed(law: Law, scenes: Scene) -> tuple[Law, Scene]:
    """The law itself, and the stacked scenes with the parts that are fitted with it."""
    if not isinstance(law, LawInScene):
        return law, scenes
    return law.law, jax.vmap(law.in_scene)(scenes)


def plain_law(law: Any) -> Any:
    """The law without parts of a scene or a motion."""
    if isinstance(law, LawInScene | LawInMotion):
        return law.law
    return law


def with_parts_of_scene(
    law: Law, scene: Scene | None, own_scenes: bool, free: Any
) -> Law:
    """The law with the parts of the scene that `free` names; `own_scenes`: each shot
    has its own.

    Raises:
        ValueError: parts that the scene does not have, or that the shots do not share.
    """
    wanted = {entry_of(name)[0] for name in as_names("free", free)} & set(OF_A_SCENE)
    parts = [
        name for name in OF_A_SCENE if name in wanted - set(free_parameters_of(law))
    ]
    if not parts or isinstance(law, LawInScene):
        return law
    if scene is None or own_scenes:
        raise ValueError(
            f"Argument `free` may name `{parts[0]}` only where all shots have one "
            f"`scene`, but they have scenes of their own."
        )
    if isinstance(law, RestitutionMatrix):
        raise ValueError(
            f"Argument `free` must not name `{parts[0]}` with a RestitutionMatrix, "
            f"which is admissible in one scene only."
        )
    planar = scene.tangents is not None and scene.tangents.shape == scene.normals.shape
    if planar:
        flat = jnp.zeros(scene.contacts, scene.mass.dtype)
    else:
        flat = None
    if scene.mass.ndim == 1:
        mass = scene.mass
    else:
        mass = None
    # the part of the scene, None: it has none that could be fitted; what it must have
    values = {
        "mass": (mass, "that of `scene` is (n,)"),
        "gaps": (scene.gaps, "`scene` has gaps"),
        "tilt": (flat, "`scene` has one tangent for each contact"),
    }
    for name in parts:
        value, where = values[name]
        if value is None:
            raise ValueError(f"Argument `free` may name `{name}` only where {where}.")
    return LawInScene(law, **{name: values[name][0] for name in parts})


def limits_with_scene(
    parameters: Parameters, law: LawInScene, limits: Limits, priors: tuple[Prior, ...]
) -> Limits:
    """Limits of all parameters; parts of the scene stay within `REACH` deviations of
    their priors.

    Raises:
        ValueError: a part of the scene without a prior, or far from it at the start.
    """
    prior_of = {prior.parameter: prior for prior in priors}
    low, high = (end.copy() for end in limits)
    start = entries(law, parameters.fields)[parameters.first]
    for i, (name, field) in enumerate(zip(parameters.names, parameters.of_fields)):
        if field not in OF_A_SCENE:
            continue
        if i not in prior_of:
            raise ValueError(
                f"Argument `priors` must have (mean, standard deviation) for `{name}`, "
                f"a part of the scene that is fitted with the law."
            )
        _, mean, std = prior_of[i]
        low[i], high[i] = (
            max(low[i], mean - REACH * std),
            min(high[i], mean + REACH * std),
        )
        if not low[i] <= start[i] <= high[i]:
            raise ValueError(
                f"Argument `priors` must have a mean for `{name}` within {REACH:g} "
                f"standard deviations of its value in the scene, {start[i]:g}, but has "
                f"{mean:g} ± {std:g}."
            )
    return low, high
