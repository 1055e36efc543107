"""`stability_map`: where a method of integration is right, flagged, wrong, or worse."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jimpact._checks import check_values
from jimpact.methods.contenders import METHODS
from jimpact.methods.contenders.base import Method
from jimpact.methods.stability_points import (
    AXES,
    CLASSES,
    DEFAULT,
    FALLS,
    FINER,
    FIXED_STEP_RIGHT,
    FLAGGED,
    HONEST,
    STALLS,
    WRONG,
    checked_axes,
    checked_base,
    classify,
    error_of,
    refused,
    sample_points,
    setting_of,
    slice_points,
    threshold,
)
from jimpact.methods.stability_references import (
    CAUSES,
    CONFIRMED,
    REFERENCE_RTOL,
    Confirmation,
    Runners,
    cause_of,
    groups,
    references,
)
from jimpact.progress import sample_bar
from jimpact.status import CODE

NAMES = ("default", "rk4", "verlet", "impulse_euler")
SLICES = ("one", "pairs")


class Slice(NamedTuple):
    """Classes and errors over one axis (K,) or two (K1, K2); index of CLASSES, of CAUSES."""

    axes: tuple[str, ...]
    codes: np.ndarray
    error: np.ndarray
    cause: np.ndarray


@dataclass(frozen=True, eq=False)
class StabilityMap:
    """What `stability_map` found; `print` gives shares and causes.

    Attributes:
        methods: the names.
        axes, base: values along every axis; the base point of the slices.
        slices: by method, first those over one axis, then pairs.
        samples: Latin-hypercube points (S, 6), columns `jimpact.methods.stability_points.AXES`.
        sampled: by method, a `Slice` over the samples.
        confirmation: of the reference, by an integrator that shares no code with it.
        max_steps: of every run.
    """

    methods: tuple[str, ...]
    axes: dict[str, np.ndarray]
    base: dict[str, float]
    slices: dict[str, tuple[Slice, ...]]
    samples: np.ndarray
    sampled: dict[str, Slice]
    confirmation: Confirmation
    max_steps: int

    def counts(self, method: str) -> dict[str, int]:
        """Points of each class, over all slices and samples."""
        codes = np.concatenate([s.codes.ravel() for s in self._all_slices(method)])
        return dict(zip(CLASSES, np.bincount(codes, minlength=len(CLASSES)).tolist()))

    def silent(self, method: str) -> int:
        """Points that are not right without a word: wrong or stalled."""
        found = self.counts(method)
        return found["wrong"] + found["stalls"]

    def causes(self, method: str) -> dict[str, int]:
        """Points that are not right, by cause."""
        found = np.concatenate([s.cause.ravel() for s in self._all_slices(method)])
        counts = np.bincount(found[found >= 0], minlength=len(CAUSES)).tolist()
        return {cause.name: count for cause, count in zip(CAUSES, counts) if count}

    def _all_slices(self, method: str) -> tuple[Slice, ...]:
        return (*self.slices[method], self.sampled[method])

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it."""

        def as_data(found: Slice) -> dict[str, Any]:
            error = np.where(np.isfinite(found.error), found.error, -1.0)  # JSON has no NaN
            return {
                "axes": list(found.axes),
                "codes": found.codes.tolist(),
                "error": error.tolist(),
                "cause": found.cause.tolist(),
            }

        return {
            "classes": list(CLASSES),
            "causes": [cause.name for cause in CAUSES],
            "axes": {name: values.tolist() for name, values in self.axes.items()},
            "base": self.base,
            "max_steps": self.max_steps,
            "confirmation": self.confirmation._asdict(),
            "samples": self.samples.tolist(),
            "methods": {
                name: {
                    "counts": self.counts(name),
                    "causes": self.causes(name),
                    "slices": [as_data(each) for each in self.slices[name]],
                    "sampled": as_data(self.sampled[name]),
                }
                for name in self.methods
            },
        }

    def __str__(self) -> str:
        base = ", ".join(f"{name.replace('_', ' ')} {x:g}" for name, x in self.base.items())
        found = self.confirmation
        lines = [
            f"base: {base}; at most {self.max_steps:,} steps",
            f"reference: {found.points} points at rtol {REFERENCE_RTOL:g}; of {found.tried} "
            f"solved by scipy, too, {found.confirmed} agree to {CONFIRMED:g} (largest "
            f"difference {found.difference:.1g})",
            f"right: error in v+ within {HONEST:g} rtol, or {FIXED_STEP_RIGHT:g} for fixed steps, "
            "of the largest |v-|",
            "",
            f"{'points':14s}" + "".join(f"{name:>15s}" for name in CLASSES),
        ]
        for name in self.methods:
            row = "".join(f"{count or '':>15}" for count in self.counts(name).values())
            lines.append(f"{name:14s}{row}")
        lines += ["", "causes where not right"]
        for name in self.methods:
            for cause, count in self.causes(name).items():
                lines.append(f"{name:14s}{count:6d}  {cause}")
        return "\n".join(lines)


def stability_map(
    methods: Sequence[str] | None = None,
    axes: Mapping[str, Sequence[float]] | None = None,
    base: Mapping[str, float] | None = None,
    resolution: int = 9,
    slices: str = "one",
    samples: int = 0,
    *,
    max_steps: int = 10_000,
    seed: int = 0,
    progress: bool | None = None,
) -> StabilityMap:
    """Where methods integrate the LZB law rightly, and where they do not, over six axes.

    A point is a chain of N touching balls of which the first strikes the others: kappa is the
    stiffness ratio of its halves, mu the mass ratio of its middle ball (`chain_of`); and a
    setting of the method. Classes: `right` (error in v+ within 10 rtol; 1e-3 for fixed steps, of
    the largest |v-|), `flagged` (a failure status, or refused beforehand), `wrong` (silently),
    `gains energy`, `stalls` (silently wrong, and a ten times finer setting does not halve the
    error), `does not end` (in `max_steps`), `not finite`, `unchecked` (no reference ends).

    Args:
        methods: names in `jimpact.methods.contenders.METHODS` that JAX can batch, and 'default',
            what `impact` does; None: that, rk4, verlet and impulse_euler.
        axes: values by name, of `setting` (0 coarse .. 1 fine), `stiffness_ratio` 1e-8..1e8,
            `exponent` 1..5, `restitution` 0..1, `mass_ratio` 1e-6..1e6, `balls`; None: all.
        base: point from which slices start, by name; default three equal Hertz balls, e = 0.9.
        resolution: values along a default axis.
        slices: 'one' axis at a time, or 'pairs' of axes as well.
        samples: number of Latin-hypercube points over all axes besides.
        max_steps: of every run; batches wait for their slowest point.
        seed: of the samples.
        progress: a bar on stderr; None: on a terminal, for long runs.

    Returns:
        `StabilityMap`; in double precision (jax_enable_x64) only.

    Raises:
        ValueError: unknown names, values out of range, single precision.

    Source: docs/stability.md.

    >>> import jimpact as ji
    >>> found = ji.stability_map(["verlet"], {"setting": [0.0, 0.8]}, {"balls": 2, "exponent": 1})
    >>> found.counts("verlet")["right"]
    1
    """
    if slices not in SLICES:
        raise ValueError(f"Argument `slices` must be one of {SLICES}, but has value {slices!r}.")
    check_values("samples", samples, low=0)
    check_values("max_steps", max_steps, low=1)
    if not jnp.zeros(()).dtype == jnp.float64:
        raise ValueError("A stability map needs double precision: enable jax_enable_x64.")
    chosen, lines = _methods(methods), checked_axes(axes, int(resolution))
    start = checked_base(base)
    axis_sets: list[tuple[str, ...]] = [(name,) for name in lines]
    if slices == "pairs":
        axis_sets += list(combinations(lines, 2))
    parts = [slice_points(start, lines, names) for names in axis_sets]
    sampled = sample_points(start, lines, int(samples), seed)
    points = np.concatenate([*(part.reshape(-1, len(AXES)) for part in parts), sampled])
    total = len(points) * (len(chosen) + 1)
    with sample_bar(total, 0, progress) as advance:
        runners = Runners(int(max_steps), advance)
        exact, confirmation = references(points, runners)
        found = {method.name: classes_of(method, points, exact, runners) for method in chosen}
    cut = np.cumsum([len(part.reshape(-1, len(AXES))) for part in parts])

    def split(name: str) -> tuple[tuple[Slice, ...], Slice]:
        columns = [np.split(column, cut) for column in found[name]]
        cuts = [
            Slice(names, *(column[i].reshape(part.shape[:-1]) for column in columns))
            for i, (names, part) in enumerate(zip(axis_sets, parts))
        ]
        return tuple(cuts), Slice(("samples",), *(column[-1] for column in columns))

    both = {name: split(name) for name in found}
    return StabilityMap(
        methods=tuple(found),
        axes=lines,
        base=start,
        slices={name: first for name, (first, _) in both.items()},
        samples=sampled,
        sampled={name: last for name, (_, last) in both.items()},
        confirmation=confirmation,
        max_steps=max_steps,
    )


def _methods(names: Sequence[str] | None) -> list[Method]:
    known = {"default": DEFAULT} | {name: m for name, m in METHODS.items() if m.jax}
    names = NAMES if names is None else tuple(names)
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise ValueError(f"Argument `methods` must name some of {tuple(known)}, but has {unknown}.")
    return [known[name] for name in names]


def classes_of(
    method: Method, points: np.ndarray, exact: list[np.ndarray], runners: Runners
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Class, error and cause of every point."""
    codes = np.full(len(points), FLAGGED)
    errors, level = np.full(len(points), np.nan), points[:, AXES.index("setting")]
    setting = setting_of(method.setting, level)
    for group, balls, linear in groups(points):
        at = group[~refused(method, points[group], linear)]
        if len(at):
            truth, allowed = np.stack([exact[i] for i in at]), threshold(method, level[at])
            found = runners.run(method, balls, linear, points[at], setting[at])
            errors[at] = error_of(found, truth)
            codes[at] = classify(found, errors[at], allowed)
        wrong = at[codes[at] == WRONG]
        if len(wrong):
            finer = runners.run(method, balls, linear, points[wrong], FINER * setting[wrong])
            error = error_of(finer, np.stack([exact[i] for i in wrong]))
            stalls = (finer.code == CODE["ok"]) & ~(error < FALLS * errors[wrong])
            codes[wrong[stalls]] = STALLS
        runners.advance(len(group))
    return codes, errors, cause_of(method, points, codes, setting)
