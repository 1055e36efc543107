"""`stability_map`: where a method of integration is right, flagged, wrong, or worse."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import combinations
from typing import Any

import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_whole, check_choice, check_values
from jimpact.methods.contenders import METHODS, Method
from jimpact.methods.stability_points import (
    AXES,
    CAUSES,
    CLASSES,
    CONFIRMED,
    DEFAULT,
    FIXED_STEP_RIGHT,
    HONEST,
    REFERENCE_RTOL,
    Confirmation,
    Slice,
    classes_of,
    references,
    runner,
)
from jimpact.progress import counting_bar
from jimpact.records import as_data, fields_as_data, table

NAMES = ("default", "rk4", "verlet", "impulse_euler")
SLICES = ("one", "pairs")
BASE = {  # three equal Hertz balls; rtol 1e-8, time step 0.05, impulse step 1e-3
    "setting": 0.6,
    "stiffness_ratio": 1.0,
    "exponent": 1.5,
    "restitution": 0.9,
    "mass_ratio": 1.0,
    "balls": 3.0,
}
BALLS = (2, 3, 5, 10, 30, 100)
_FEW_BALLS, _FEW = (2, 3, 10), 8  # every number of balls is compiled apart: few where it is coarse
_RANGES = {
    "setting": (0.0, 1.0),
    "stiffness_ratio": (1e-8, 1e8),
    "exponent": (1.0, 5.0),
    "restitution": (0.0, 1.0),
    "mass_ratio": (1e-6, 1e6),
    "balls": (2, 1000),
}


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

    def causes(self, method: str) -> dict[str, int]:
        """Points that are not right, by cause."""
        found = np.concatenate([s.cause.ravel() for s in self._all_slices(method)])
        counts = np.bincount(found[found >= 0], minlength=len(CAUSES)).tolist()
        return {cause: count for cause, count in zip(CAUSES, counts) if count}

    def _all_slices(self, method: str) -> tuple[Slice, ...]:
        return (*self.slices[method], self.sampled[method])

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it."""
        by_method = {
            name: {
                "counts": self.counts(name),
                "causes": self.causes(name),
                "slices": self.slices[name],
                "sampled": self.sampled[name],
            }
            for name in self.methods
        }
        known = {"classes": CLASSES, "causes": CAUSES, "methods": by_method}
        return fields_as_data(self, "slices", "sampled") | as_data(known)

    def __str__(self) -> str:
        base = ", ".join(f"{name.replace('_', ' ')} {x:g}" for name, x in self.base.items())
        found = self.confirmation
        counts = [[m, *(str(x or "") for x in self.counts(m).values())] for m in self.methods]
        causes = [[m, str(x), cause] for m in self.methods for cause, x in self.causes(m).items()]
        lines = [
            f"base: {base}; at most {self.max_steps:,} steps",
            f"reference: {found.points} points at rtol {REFERENCE_RTOL:g}; of {found.tried} "
            f"solved by scipy, too, {found.confirmed} agree to {CONFIRMED:g} (largest "
            f"difference {found.difference:.1g})",
            f"right: error in v+ within {HONEST:g} rtol, or {FIXED_STEP_RIGHT:g} for fixed steps, "
            "of the largest |v-|",
            "",
            *table(["method", *CLASSES], counts),
            "",
            *table(
                ["method", "points", "cause where not right"],
                causes,
                left=["cause where not right"],
            ),
        ]
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
    check_choice("slices", slices, SLICES)
    samples, max_steps = as_whole("samples", samples, 0), as_whole("max_steps", max_steps, 1)
    if not jnp.zeros(()).dtype == jnp.float64:
        raise ValueError("A stability map needs double precision: enable jax_enable_x64.")
    chosen, lines = _methods(methods), _axes(axes, as_whole("resolution", resolution, 2))
    start = BASE | {name: float(x) for name, x in _known("base", base or {}).items()}
    axis_sets: list[tuple[str, ...]] = [(name,) for name in lines]
    if slices == "pairs":
        axis_sets += list(combinations(lines, 2))
    parts = [_slice_points(start, lines, names) for names in axis_sets]
    sampled = _sample_points(start, lines, samples, seed)
    points = np.concatenate([*(part.reshape(-1, len(AXES)) for part in parts), sampled])
    runners = cache(partial(runner, max_steps))
    total = len(points) * (len(chosen) + 1)
    with counting_bar(total, "impacts", progress) as advance:
        exact, confirmation = references(points, runners, advance)
        found = {m.name: classes_of(m, points, exact, runners, advance) for m in chosen}
    cut = np.cumsum([part[..., 0].size for part in parts])
    own, last = {}, {}
    for name, results in found.items():
        columns = [np.split(column, cut) for column in results]
        own[name] = tuple(
            Slice(names, *(column[i].reshape(part.shape[:-1]) for column in columns))
            for i, (names, part) in enumerate(zip(axis_sets, parts))
        )
        last[name] = Slice(("samples",), *(column[-1] for column in columns))
    return StabilityMap(
        methods=tuple(found),
        axes=lines,
        base=start,
        slices=own,
        samples=sampled,
        sampled=last,
        confirmation=confirmation,
        max_steps=max_steps,
    )


def _methods(names: Sequence[str] | None) -> list[Method]:
    known = {"default": DEFAULT} | {name: m for name, m in METHODS.items() if m.jax}
    names = NAMES if names is None else tuple(names)
    for name in names or ("",):
        check_choice("methods", name, known)
    return [known[name] for name in names]


def _known(argument: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Values by axis, checked."""
    for name, value in values.items():
        check_choice(argument, name, AXES)
        low, high = _RANGES[name]
        check_values(f"{argument}[{name!r}]", value, low=low, high=high)
    return values


def _axes(axes: Mapping[str, Sequence[float]] | None, r: int) -> dict[str, np.ndarray]:
    """The axes to map: those given, or r values of each (number of balls: at most six)."""
    if axes is None:
        return {
            "setting": np.linspace(0, 1, r),
            "stiffness_ratio": np.logspace(-8, 8, r),
            "exponent": np.linspace(1, 5, r),
            "restitution": np.append(0.0, np.logspace(-3, 0, r - 1)),
            "mass_ratio": np.logspace(-6, 6, r),
            "balls": np.array(BALLS if r >= _FEW else _FEW_BALLS, float),
        }
    axes = _known("axes", axes or {"": ()})
    found = {name: np.unique(np.asarray(x, float)) for name, x in axes.items()}
    balls = found.get("balls", np.zeros(0))
    if (balls != np.round(balls)).any():
        raise ValueError(f"Argument `axes['balls']` must hold whole numbers, but has {balls}.")
    return {name: found[name] for name in AXES if name in found}


def _slice_points(
    base: Mapping[str, float], axes: Mapping[str, np.ndarray], varied: tuple[str, ...]
) -> np.ndarray:
    """Points (K_1 .. K_d, 6) in which the axes `varied` run over their values."""
    columns = [axes[name] if name in varied else np.array([base[name]]) for name in AXES]
    grid = np.stack(np.meshgrid(*columns, indexing="ij"), axis=-1)
    return grid.reshape(*(len(axes[name]) for name in varied), len(AXES))


def _sample_points(
    base: Mapping[str, float], axes: Mapping[str, np.ndarray], samples: int, seed: int
) -> np.ndarray:
    """Latin-hypercube points (samples, 6), between the values of `axes`; others from `base`."""
    from scipy.stats import qmc  # late: slow to import

    found = np.tile([base[name] for name in AXES], (samples, 1))
    unit = qmc.LatinHypercube(len(axes), rng=np.random.default_rng(seed)).random(samples)
    for column, (name, values) in zip(unit.T, axes.items()):
        place = column * (len(values) - 1)
        if name == "balls":
            found[:, AXES.index(name)] = values[np.round(place).astype(int)]
            continue
        powers = bool((values > 0).all()) and name != "exponent"
        scaled = np.log(values) if powers else values
        between = np.interp(place, np.arange(len(values)), scaled)
        found[:, AXES.index(name)] = np.exp(between) if powers else between
    return found
