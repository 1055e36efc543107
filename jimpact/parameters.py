"""Which entries of a law are free, their names, bounds and natural scales."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.laws.base import Law
from jimpact.laws.lzb import LZB

DEFAULT_FREE = ("restitution", "stiffness")

# Where a field's values may lie, by name; other fields are unbounded.
DOMAIN = {
    "restitution": (0.0, 1.0),
    "stiffness": (0.0, np.inf),
    "exponent": (1.0, np.inf),
    "initial_energy": (0.0, np.inf),
    "friction": (0.0, np.inf),
}
LOGARITHMIC = ("stiffness",)  # fitted in their logarithm: only ratios of them have a meaning

# A stiffness without bounds may move this far from its start: beyond, the softer contact has
# no further influence that a measurement could see.
STIFFNESS_RANGE = 1e4


class Parameters(eqx.Module):
    """The P free entries of a law, in the order of `names`; indices count flattened entries."""

    fields: tuple[str, ...] = eqx.field(static=True)
    indices: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    def of(self, law: Law) -> np.ndarray:
        """Values (P,) in a law."""
        return np.concatenate(
            [np.ravel(getattr(law, f))[list(i)] for f, i in zip(self.fields, self.indices)]
        ).astype(float)

    def put(self, law: Law, values: jax.Array) -> Law:
        """The law with these values (P,)."""
        start = 0
        for field, index in zip(self.fields, self.indices):
            old = getattr(law, field)
            new = values[start : start + len(index)].astype(old.dtype)
            new = old.reshape(-1).at[jnp.asarray(index)].set(new).reshape(old.shape)
            law = eqx.tree_at(lambda tree, f=field: getattr(tree, f), law, new)
            start += len(index)
        return law

    def each(self) -> Iterator[tuple[int, str, int]]:
        """(position, field, index in the field) of every parameter."""
        pairs = [(f, i) for f, index in zip(self.fields, self.indices) for i in index]
        for position, (field, i) in enumerate(pairs):
            yield position, field, i


def free_parameters(law: Law, contacts: int, free: Any) -> tuple[Parameters, list[str]]:
    """The parameters that `free` names, and notes on what was held instead."""
    known = _array_fields(law)
    masks, notes = {}, []
    for field, choice in _as_mapping(free, known).items():
        if field not in known:
            raise ValueError(_unknown_field(law, field, known))
        mask = _as_mask(field, choice, np.shape(getattr(law, field)))
        if mask.any():
            masks[field] = mask
    if "stiffness" in masks and masks["stiffness"].all() and _only_ratios(law, masks):
        if masks["stiffness"].size == 1:
            raise ValueError(
                "Argument `free` must not hold a scalar `stiffness`: with equal exponents a common "
                "factor of all stiffnesses changes nothing, so the data cannot determine it. Give "
                "the law one stiffness per contact to fit their ratios, or free only `restitution`."
            )
        masks["stiffness"][0] = False
        notes.append(
            "stiffness[1] is held at its start: with equal exponents only stiffness ratios matter."
        )
    if not masks:
        raise ValueError("Argument `free` must name a parameter to fit, but leaves none free.")
    names = [
        field + (f"[{','.join(str(i + 1) for i in index)}]" if index else "")
        for field, mask in masks.items()
        for index in np.argwhere(mask).tolist()
    ]
    indices = tuple(tuple(np.flatnonzero(mask).tolist()) for mask in masks.values())
    return Parameters(tuple(masks), indices, tuple(names)), notes


def _array_fields(law: Law) -> list[str]:
    """Public names of the law's float arrays (`exponent_array` is reached as `exponent`)."""
    fields = [f.name for f in dataclasses.fields(law) if eqx.is_inexact_array(getattr(law, f.name))]
    return [name.removesuffix("_array") for name in fields]


def _as_mapping(free: Any, known: list[str]) -> dict[str, Any]:
    if isinstance(free, Mapping):
        return dict(free)
    names = (free,) if isinstance(free, str) else tuple(free)
    if names == DEFAULT_FREE and "restitution" in known:  # the default serves laws without k too
        names = tuple(name for name in names if name in known)
    return dict.fromkeys(names, True)


def _unknown_field(law: Law, field: str, known: list[str]) -> str:
    name = type(law).__name__
    if isinstance(getattr(law, field, None), (float, tuple)):
        return (
            f"Argument `free` must not hold `{field}`: it is a fixed number of this {name}; "
            f"give {field}=jnp.asarray(...) to the law to make it a parameter."
        )
    return (
        f"Argument `free` must name parameters of {name}, one of {', '.join(known)}, "
        f"but has {field!r}."
    )


def _as_mask(field: str, choice: Any, shape: tuple[int, ...]) -> np.ndarray:
    mask = np.asarray(choice)
    if mask.dtype != bool:
        raise ValueError(
            f"Argument `free` must map `{field}` to True, False or a boolean mask, "
            f"but has value {choice!r}."
        )
    if mask.shape not in ((), shape):
        tied = "one value for all contacts (tied)" if shape == () else f"of shape {shape}"
        raise ValueError(
            f"Argument `free` must have a mask of shape {shape} for `{field}`, which is {tied} "
            f"in this law, but has a mask of shape {mask.shape}."
        )
    return np.broadcast_to(mask, shape).copy()


def _only_ratios(law: Law, masks: Mapping[str, np.ndarray]) -> bool:
    """Whether a common factor of all stiffnesses is invisible: LZB with equal exponents."""
    if not isinstance(law, LZB):
        return False
    exponents = np.unique(np.asarray(law.exponent, dtype=float))
    tied = np.ndim(law.exponent) == 0 or "exponent" not in masks
    return len(exponents) == 1 and tied


def bounds_of(
    parameters: Parameters, law: Law, bounds: Mapping[str, Any] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds (P,): the user's, or else the field's domain."""
    start, known = parameters.of(law), set(parameters.fields)
    low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    given = dict(bounds or {})
    for field in given:
        if field not in known:
            raise ValueError(
                f"Argument `bounds` must name free parameters, {', '.join(sorted(known))}, "
                f"but has {field!r}."
            )
    pairs = {field: _bound_pair(field, given[field], law) for field in given}
    for i, field, index in parameters.each():
        low[i], high[i] = DOMAIN.get(field, (-np.inf, np.inf))
        if field in pairs:
            low[i], high[i] = (side[index] for side in pairs[field])
        elif field in LOGARITHMIC:
            low[i], high[i] = start[i] / STIFFNESS_RANGE, start[i] * STIFFNESS_RANGE
        if not low[i] <= start[i] <= high[i]:
            raise ValueError(
                f"Argument `bounds` must include the start of `{parameters.names[i]}`, "
                f"{start[i]:g}, but is [{low[i]:g}, {high[i]:g}]."
            )
    return low, high


def _bound_pair(field: str, pair: Any, law: Law) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of a field, flattened; each end is a scalar or shaped like the field."""
    shape = np.shape(getattr(law, field))
    try:
        low, high = (np.broadcast_to(np.asarray(end, float), shape).ravel() for end in pair)
    except (TypeError, ValueError):
        raise ValueError(
            f"Argument `bounds` must map `{field}` to (low, high), each a number or of shape "
            f"{shape}, but has {pair!r}."
        ) from None
    smallest, largest = DOMAIN.get(field, (-np.inf, np.inf))
    if not (low < high).all():
        raise ValueError(
            f"Argument `bounds` must have low < high for `{field}`, but has {pair!r}."
        )
    if (low < smallest).any() or (high > largest).any():
        raise ValueError(
            f"Argument `bounds` must lie in [{smallest:g}, {largest:g}] for `{field}`, "
            f"but has {pair!r}."
        )
    if field in LOGARITHMIC and (low <= 0).any():
        raise ValueError(f"Argument `bounds` must be > 0 for `{field}`, but has {pair!r}.")
    return low, high
