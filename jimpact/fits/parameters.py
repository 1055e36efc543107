"""Which entries of a law are free, their names, bounds and natural scales."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from jimpact._checks import ABBREVIATIONS, suggestion
from jimpact.fits.ties import Ties, entry_of, places, tied_places
from jimpact.law import Law, free_parameters_of, parameters_of, with_parameter

AnyLaw = TypeVar("AnyLaw", bound=Law)  # what goes in as LZB comes out as LZB
DEFAULT_FREE = ("restitution", "stiffness")  # or a matrix, or what else a law has
OF_SPEED = ("speed_exponent", "yield_speed")  # a law has them only if requested

# What is fitted in its logarithm, a stiffness, may without bounds move this far from its start:
# beyond, the softer contact has no further influence that a measurement could see.
LOG_RANGE = 1e4


@dataclasses.dataclass(frozen=True)
class Parameters:
    """P free parameters. Each moves one or several of the Q entries of the named fields.

    Entries are numbered through the flattened fields, in the order of `fields`; entries in no
    group are fixed. (All entries are listed so that a compiled fit does not depend on the groups.)
    """

    labels: dict[str, np.ndarray]  # of each field: 0 is fixed, equal numbers share a value
    names: tuple[str, ...]
    groups: tuple[tuple[int, ...], ...]
    entry_fields: tuple[str, ...]  # of each entry
    log: np.ndarray  # (Q,) entries that are fitted in their logarithm

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields."""
        return tuple(self.labels)

    @property
    def first(self) -> list[int]:
        """The first entry of every group: it stands for the parameter."""
        return [group[0] for group in self.groups]

    def field_of(self, parameter: int) -> str:
        """The field that a parameter belongs to."""
        return self.entry_fields[self.groups[parameter][0]]


def value_of(law: Law, field: str) -> Any:
    """A parameter of a law, or of its parts (the force of a compliant one); None if it has none."""
    parameter = parameters_of(law).get(field)
    return None if parameter is None else parameter.value


def entries(law: Law, fields: tuple[str, ...]) -> np.ndarray:
    """All entries (Q,) of these fields of a law."""
    return np.concatenate([np.ravel(np.asarray(value_of(law, f), float)) for f in fields])


def with_entries(law: AnyLaw, fields: tuple[str, ...], values: Any) -> AnyLaw:
    """The law with these entries (Q,)."""
    start = 0
    for field in fields:
        old = value_of(law, field)
        new = values[start : start + old.size].reshape(old.shape).astype(old.dtype)
        law = with_parameter(law, field, jnp.asarray(new))
        start += old.size
    return law


def free_parameters(
    law: Law, free: Any, absolute: bool = False, ties: Ties = ()
) -> tuple[Parameters, list[str]]:
    """The parameters that `free` names, but for what is tied, and notes on what was fixed instead.

    `absolute`: forces or times were measured, which show a common factor of all stiffnesses.
    """
    known = free_parameters_of(law)
    labels, fixed = {}, ""
    if free is DEFAULT_FREE:
        free = default_free(law, absolute)
        if "stiffness" in known and "stiffness" not in free:
            fixed = "stiffness"
    choices = dict(free) if isinstance(free, Mapping) else dict.fromkeys(_as_names(free), True)
    for name, choice in choices.items():
        field, entry = entry_of(name)
        if field not in known:
            raise ValueError(_unknown_field(law, name, list(known)))
        shape = np.shape(value_of(law, field))
        if entry is None:
            labels[field] = _as_labels(field, choice, shape)
        else:
            label = labels.setdefault(field, np.zeros(shape, int))
            at = places("free", name, entry, shape)
            label.flat[at] = (label.max() + 1) * _as_flag(name, choice)
    ratios = not absolute and _only_ratios(law, labels)
    if ratios and "stiffness" in labels and labels["stiffness"].all():
        shared = labels["stiffness"] == labels["stiffness"].flat[0]
        if shared.all():
            raise ValueError(
                "Argument `free` must not hold a scalar `stiffness` (or one for all contacts): "
                "with equal exponents a common factor of all stiffnesses changes nothing, so the "
                "data cannot determine it. Give the law one stiffness per contact to fit their "
                "ratios, or free only `restitution`."
            )
        labels["stiffness"][shared] = 0
        fixed = "stiffness[1]"
    notes = []
    if fixed:
        notes = [
            f"{fixed} is fixed at its start: with equal exponents only stiffness ratios matter."
        ]
    for name, at in tied_places(law, ties).items():
        field, _ = entry_of(name)
        if field in labels:
            labels[field].flat[at] = 0
    names, groups, start = [], [], 0
    for field, label in labels.items():
        for value in dict.fromkeys(label[label > 0].tolist()):
            members = np.argwhere(label == value)
            names.append(_name(field, members, label.size))
            groups.append(tuple((start + np.flatnonzero(label == value)).tolist()))
        start += label.size
    if not names:
        raise ValueError("Argument `free` must name a parameter to fit, but leaves none free.")
    owners = tuple(field for field, label in labels.items() for _ in range(label.size))
    log = np.array([parameters_of(law)[field].domain.log for field in owners])
    return Parameters(labels, tuple(names), tuple(groups), owners, log), notes


def _name(field: str, members: np.ndarray, size: int) -> str:
    """restitution (one value for all), restitution[2], restitution[1=3] (shared), matrix[1,2]."""
    if len(members) == size and (size > 1 or members.shape[1] == 0):
        return field
    return f"{field}[{'='.join(','.join(str(i + 1) for i in index) for index in members)}]"


def _as_flag(name: str, choice: Any) -> bool:
    """Whether a single entry is free."""
    if not isinstance(choice, (bool, np.bool_)):
        raise ValueError(
            f"Argument `free` must map `{name}` to True or False, but has value {choice!r}."
        )
    return bool(choice)


def _as_names(free: Any) -> tuple[str, ...]:
    """The names of one or several fields."""
    return (free,) if isinstance(free, str) else tuple(free)


def default_free(law: Law, absolute: bool = False) -> tuple[str, ...]:
    """The fields that are fitted by default: how the contacts bounce, or else all.

    A single stiffness of which only ratios matter is left out; `absolute`: see `free_parameters`.
    """
    known = free_parameters_of(law)
    fields = [name for name in (*DEFAULT_FREE, "matrix", *OF_SPEED) if name in known] or list(known)
    single = "stiffness" in fields and np.size(value_of(law, "stiffness")) == 1
    if single and not absolute and _only_ratios(law, {}):
        fields.remove("stiffness")
    return tuple(fields)


def _unknown_field(law: Law, field: str, known: list[str]) -> str:
    """What is wrong with a field that is not free."""
    name = type(law).__name__
    if isinstance(value_of(law, field), (float, tuple)):
        return (
            f"Argument `free` must not hold `{field}`: it is a fixed number of this {name}; "
            f"give {field}=jnp.asarray(...) to the law to make it a parameter."
        )
    return (
        f"Argument `free` must name parameters of {name}, one of {', '.join(known)}, "
        f"but has {field!r}.{suggestion(field, known, ABBREVIATIONS)}"
    )


def _as_labels(field: str, choice: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Integers shaped like the field: 0 is fixed, entries with equal numbers share one value."""
    mask = np.asarray(choice)
    if mask.dtype.kind not in "biu" or (mask < 0).any():
        raise ValueError(
            f"Argument `free` must map `{field}` to True, False, a boolean mask or numbers of "
            f"groups (0 is fixed), but has value {choice!r}."
        )
    if mask.shape not in ((), shape):
        kind = "one value for all contacts" if shape == () else f"of shape {shape}"
        raise ValueError(
            f"Argument `free` must have a mask of shape {shape} for `{field}`, which is {kind} "
            f"in this law, but has a mask of shape {mask.shape}."
        )
    if mask.dtype == bool:  # each free entry is a group of its own
        count = np.arange(1, np.prod(shape, dtype=int) + 1).reshape(shape)
        return np.where(mask, count, 0)
    return np.array(np.broadcast_to(mask, shape), dtype=int)


def _only_ratios(law: Law, labels: Mapping[str, np.ndarray]) -> bool:
    """Whether a common factor of all stiffnesses is invisible, in the fit too."""
    stay_equal = "exponent" not in labels or len(set(labels["exponent"].flat)) == 1
    return law.only_stiffness_ratios and stay_equal


def bounds_of(
    parameters: Parameters, law: Law, bounds: Mapping[str, Any] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds (P,): the user's, or else the field's domain."""
    chosen = dict(bounds or {})
    known = {parameters.field_of(i) for i in range(len(parameters.names))}
    for field in chosen:
        if entry_of(field)[0] not in known:
            raise ValueError(
                f"Argument `bounds` must name free parameters, {', '.join(sorted(known))}, "
                f"but has {field!r}."
            )
    values = entries(law, parameters.fields)
    ends = np.empty((2, len(values)))
    for field in parameters.fields:
        inside = np.array([owner == field for owner in parameters.entry_fields])
        if field in chosen:
            ends[:, inside] = _bound_pair(field, chosen[field], law)
        elif parameters_of(law)[field].domain.log:
            ends[:, inside] = values[inside] / LOG_RANGE, values[inside] * LOG_RANGE
        else:
            domain = parameters_of(law)[field].domain
            ends[:, inside] = np.array(domain.bounds)[:, None]
            searched = np.maximum(values[inside], domain.searched_high)
            ends[1, inside] = np.minimum(ends[1, inside], searched)
    for name, pair in chosen.items():
        field, entry = entry_of(name)
        if entry is not None:
            at = places("bounds", name, entry, np.shape(value_of(law, field)))
            first = parameters.entry_fields.index(field)
            ends[:, first + np.array(at)] = np.array(_bound_pair(field, pair, law))[:, at]
    low = np.array([ends[0, list(group)].max() for group in parameters.groups])
    high = np.array([ends[1, list(group)].min() for group in parameters.groups])
    for name, start, a, b in zip(parameters.names, values[parameters.first], low, high):
        if not a <= start <= b:
            raise ValueError(
                f"Argument `bounds` must include the start of `{name}`, {start:g}, "
                f"but is [{a:g}, {b:g}]."
            )
    return low, high


class Prior(NamedTuple):
    """What is known of a parameter (by its number) besides the data: normally distributed."""

    parameter: int
    mean: float
    std: float


def priors_of(
    parameters: Parameters, limits: tuple[np.ndarray, np.ndarray], priors: Mapping[str, Any] | None
) -> tuple[Prior, ...]:
    """The user's priors, by name of a parameter or of a field for all that belong to it."""
    chosen = dict(priors or {})
    fields = [parameters.field_of(i) for i in range(len(parameters.names))]
    for name in chosen:
        if name not in (*parameters.names, *fields):
            raise ValueError(
                "Argument `priors` must name free parameters, "
                f"{', '.join(parameters.names)}, but has {name!r}."
            )
    found = []
    for i, (name, field, low, high) in enumerate(zip(parameters.names, fields, *limits)):
        pair = chosen.get(name, chosen.get(field))
        if pair is not None:
            found.append(Prior(i, *_mean_and_std(name, pair, low, high)))
    return tuple(found)


def _mean_and_std(name: str, pair: Any, low: float, high: float) -> tuple[float, float]:
    """The two numbers of a prior: (mean, std), or of a `ji.Normal`."""
    ends = (pair.mean, pair.std) if hasattr(pair, "std") and hasattr(pair, "mean") else pair
    try:
        mean, std = (float(end) for end in ends)
    except (TypeError, ValueError):
        raise ValueError(
            f"Argument `priors` must map `{name}` to (mean, standard deviation) or a ji.Normal, "
            f"but has {pair!r}."
        ) from None
    if not (0 < std < np.inf):
        raise ValueError(
            f"Argument `priors` must have a standard deviation > 0 for `{name}`, but has {pair!r}."
        )
    if not low <= mean <= high:
        raise ValueError(
            f"Argument `priors` must have its mean in [{low:g}, {high:g}] for `{name}`, but has "
            f"{pair!r}."
        )
    return mean, std


def _bound_pair(field: str, pair: Any, law: Law) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of a field, flattened; each end is a scalar or shaped like the field."""
    shape = np.shape(value_of(law, field))
    try:
        low, high = (np.broadcast_to(np.asarray(end, float), shape).ravel() for end in pair)
    except (TypeError, ValueError):
        raise ValueError(
            f"Argument `bounds` must map `{field}` to (low, high), each a number or of shape "
            f"{shape}, but has {pair!r}."
        ) from None
    domain = parameters_of(law)[field].domain
    smallest, largest = domain.bounds
    if not (low < high).all():
        raise ValueError(f"Argument `bounds` must have low < high for `{field}`, but has {pair!r}.")
    if (low < smallest).any() or (high > largest).any():
        raise ValueError(
            f"Argument `bounds` must lie in [{smallest:g}, {largest:g}] for `{field}`, "
            f"but has {pair!r}."
        )
    if domain.log and (low <= 0).any():
        raise ValueError(f"Argument `bounds` must be > 0 for `{field}`, but has {pair!r}.")
    return low, high
