"""`stability_map`: where a method of integration is right, flagged, wrong, or worse.

# notation: a point is a row (7,) of AXES
#   setting           0 coarse .. 1 fine, log-linear in what the method takes
(`setting_of`)
#   stiffness_ratio   kappa: stiffness of the right half of the contacts; the left half
has 1
#   exponent          eta of all contacts
#   restitution       e of all contacts
#   mass_ratio        mu: mass of the middle ball; all others have 1
#   balls             N, a touching chain without walls; v- = (1, 0, .., 0)
#   friction          mu of all contacts of a given scene, which has no mass_ratio and
no balls

One function is compiled for each method and number of balls; it runs on batches of
points, which wait for their slowest point, so the number of steps is bounded.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import combinations
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.audits import audit
from jimpact.core.scene import Scene, as_velocity, chain
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders import CONTENDERS, Contender, contenders_of, solved
from jimpact.methods.points import (
    Outcomes,
    at_points,
    in_batches,
    left_out_notes,
    relative_error,
)
from jimpact.tools.checks import (
    as_axis,
    as_whole,
    check_choice,
    check_kind,
    check_values,
)
from jimpact.tools.compiling import full_precision, quick_jit
from jimpact.tools.progress import counting_bar
from jimpact.tools.records import Column, Table, Tabular, as_data, fields_as_data
from jimpact.tools.status import CODE

BALLS = (2, 3, 5, 10, 30, 100)  # numbers of balls, of the axis N of the maps
# Each number of balls is compiled by itself: below this resolution only a few.
_FEW_BALLS = (2, 3, 10)
_FEW = 8


class Axis(NamedTuple):
    """Value of an axis at the base point of the slices, and the ends of its range.

    `least` is the smallest value above 0 of an axis by powers; 0: it is linear.
    """

    base: float
    low: float
    high: float
    least: float = 0.0

    def values(self, count: int) -> np.ndarray:
        """`count` values from `low` to `high`: evenly spaced, or geometric if `least` >
        0.
        """
        if not self.least:
            return np.linspace(self.low, self.high, count)
        if self.low:
            zero = []
        else:
            zero = [0.0]
        geometric = np.geomspace(self.least, self.high, count - len(zero))
        return np.append(zero, geometric)


_AXES = {  # base: three equal Hertz balls; rtol 1e-8, time step 0.05, impulse step 1e-3
    "setting": Axis(0.6, 0.0, 1.0),
    "stiffness_ratio": Axis(1.0, 1e-8, 1e8, 1e-8),
    "exponent": Axis(1.5, 1.0, 5.0),
    "restitution": Axis(0.9, 0.0, 1.0, 1e-3),
    "mass_ratio": Axis(1.0, 1e-6, 1e6, 1e-6),
    "balls": Axis(3.0, 2.0, 1000.0),
    "friction": Axis(0.3, 0.0, 10.0, 0.03),
}
AXES = tuple(_AXES)
# kind of setting (see `jimpact.methods.contenders.Contender`): value at level 0 and at
# level 1
SETTINGS = {"rtol": (1e-2, 1e-12), "step": (3.0, 3e-3), "impulse step": (0.3, 3e-5)}

(RIGHT, FLAGGED, WRONG, GAINS_ENERGY, STALLS, ENDLESS, NOT_FINITE, UNCHECKED) = range(8)
CLASSES: tuple[str, ...] = (
    "right",
    "flagged",
    "wrong",
    "gains energy",
    "stalls",
    "does not end",
)
CLASSES += ("not finite", "unchecked")
HONEST = 10.0  # a result is right up to this error over its rtol
# methods with a step: right up to this error of v+ over the largest |v-|
FIXED_STEP_RIGHT = 1e-3
FINER = 0.1  # a wrong result is tried again at this part of its setting,
FALLS = 0.5  # and stalls unless its error falls below this part
BATCH = 32  # points computed together

REFERENCE_RTOL = 1e-12  # of the default method, the reference of all others
CHECK_RTOL = 1e-11  # of the run by scipy,
# and the most evaluations that it may take; ten times more only waits longer
CHECK_STEPS = 100_000
CONFIRMED = 1e-7  # the reference is confirmed up to this difference of v+ from scipy's
CHECKED = 12  # points solved by scipy, at most
# The same two where contacts have friction: scipy regularizes it below a slip of the
# tolerance. Ten times finer takes scipy many times longer where contacts stick.
FRICTION_RTOL = 1e-8
FRICTION_CONFIRMED = 1e-6
# scipy solves a point soon up to this ratio of frequencies, to the slowest contact's,
# and number of balls.
QUICK_RATIO = 1e3
QUICK_BALLS = 10

RECLOSING = 0.1  # below this e three balls re-close (nearly) without end
NAMES = ("time", "rk4", "verlet", "impulse_euler")
FRICTION_NAMES = ("time", "implicit", "verlet")  # those of them that there are
SLICES = ("one", "pairs")


class Slice(NamedTuple):
    """Classes (indices of CLASSES) and errors over one axis (K,) or two (K1, K2)."""

    axes: tuple[str, ...]
    codes: np.ndarray
    error: np.ndarray


class Confirmation(NamedTuple):
    """Check of reference velocities v+ by another integrator."""

    points: int  # with a reference
    tried: int  # solved by the other integrator, too
    confirmed: int  # of them: v+ differs by at most `within`
    difference: float  # the largest one
    within: float = CONFIRMED


@dataclass(frozen=True, eq=False)
class StabilityMap(Tabular):
    """The result of `stability_map`; `print` gives numbers of points.

    Attributes:
        methods: the names.
        axes: values along every axis.
        base: the point that the slices go through.
        slices: by method, first those over one axis, then pairs.
        samples: Latin-hypercube points (S, 7), columns
            `jimpact.methods.stability.AXES`.
        sampled: by method, a `Slice` over the samples.
        confirmation: of the reference, by an integrator that shares no code with it.
        max_steps: of every run.
        left_out: why a method is missing: it raised.
    """

    methods: tuple[str, ...]
    axes: dict[str, np.ndarray]
    base: dict[str, float]
    slices: dict[str, tuple[Slice, ...]]
    samples: np.ndarray
    sampled: dict[str, Slice]
    confirmation: Confirmation
    max_steps: int
    left_out: dict[str, str] = field(default_factory=dict)

    picture = "stability_map"

    def counts(self, method: str) -> dict[str, int]:
        """Number of points in each class, over all slices and samples of a `method` (a
        name).
        """
        slices = *self.slices[method], self.sampled[method]
        codes = np.concatenate([each.codes.ravel() for each in slices])
        numbers = np.bincount(codes, minlength=len(CLASSES))
        return dict(zip(CLASSES, numbers.tolist()))

    def to_dict(self) -> dict[str, Any]:
        """Axes, classes, errors and counts of classes by method, as a JSON file can
        hold them.
        """
        by_method = {
            name: {
                "counts": self.counts(name),
                "slices": self.slices[name],
                "sampled": sampled,
            }
            for name, sampled in self.sampled.items()
        }
        words = {"classes": CLASSES, "methods": by_method}
        return fields_as_data(self, "slices", "sampled") | as_data(words)

    @property
    def table(self) -> Table:
        """Table: number of points in each class by method; docs/stability.md says why
        they fail.
        """
        base = ", ".join(
            f"{name.replace('_', ' ')} {x:g}" for name, x in self.base.items()
        )
        checked = self.confirmation
        others = ""
        if checked.confirmed < checked.tried:
            others = (
                f"; v+ of the others differs by up to {checked.difference:.1g} of "
                f"|v-|: scipy "
            )
            others += "may end an impact too early (docs/stability.md)"
        head = [
            f"base: {base}; at most {self.max_steps:,} steps",
            f"reference: {checked.points} points at rtol {REFERENCE_RTOL:g}; of "
            f"{checked.tried} solved by scipy, too, {checked.confirmed} agree to "
            f"{checked.within:g}{others}",
            f"right: error in v+ within {HONEST:g} rtol, or {FIXED_STEP_RIGHT:g} for "
            f"fixed steps, of the largest |v-|",
            "",
        ]
        counts = [Column(name, lambda count: str(count or "")) for name in CLASSES]
        rows = [[name, *self.counts(name).values()] for name in self.methods]
        columns = [Column("method"), *counts]
        return Table(columns, rows, head, left_out_notes(self.left_out))


@full_precision
def stability_map(
    methods: Sequence[str] | None = None,
    axes: Mapping[str, Sequence[float]] | None = None,
    base: Mapping[str, float] | None = None,
    resolution: int = 9,
    slices: str = "one",
    samples: int = 0,
    *,
    scene: Scene | None = None,
    velocity: Any = None,
    max_steps: int = 10_000,
    seed: int = 0,
    progress: float | None = None,
) -> StabilityMap:
    """Map of points where methods integrate the LZB law correctly, or fail.

    A point is a chain of N touching balls of which the first strikes the others: kappa
    is the stiffness ratio of its halves, mu the mass ratio of its middle ball
    (`chain_of`); and a setting of the method. A `scene` takes the place of the chains:
    its axes are `setting`, `stiffness_ratio` (two contacts and more), `exponent`,
    `restitution` and, with tangents, `friction`. Classes: `right` (error in v+ within
    10 rtol; 1e-3 for fixed steps, of the largest |v-|), `flagged` (a failure status, or
    refused beforehand), `wrong` (silently), `gains energy`, `stalls` (silently wrong,
    and a ten times finer setting does not halve the error), `does not end` (in
    `max_steps`), `not finite`, `unchecked` (no reference ends).

    Args:
        methods: names in `jimpact.methods.contenders.CONTENDERS` that JAX can batch;
            None: 'time' (what `impact` does), 'rk4', 'verlet' and 'impulse_euler'. With
            friction: those that have it.
        axes: values by name, of `setting` (0 coarse .. 1 fine), `stiffness_ratio`
            1e-8..1e8, `exponent` 1..5, `restitution` 0..1, `mass_ratio` 1e-6..1e6,
            `balls`, `friction` 0..10; None: all.
        base: point from which slices start, by name; default three equal Hertz balls, e
            = 0.9 (of a scene: Hertz contacts of equal stiffness, e = 0.9, mu = 0.3).
        resolution: values along a default axis.
        slices: 'one' axis at a time, or 'pairs' of axes as well.
        samples: number of Latin-hypercube points over all axes besides.
        scene: one scene in place of chains, planar or in space; None: chains.
        velocity: its v- (n,) [m/s], of which only the ratios matter.
        max_steps: of every run; batches wait for their slowest point.
        seed: of the samples.
        progress: a bar on stderr; None: on a terminal, for long runs.

    Returns:
        `StabilityMap`; in double precision (jax_enable_x64) only.

    Raises:
        ValueError: unknown names, a known name for a contender of your own, values out
            of range, single precision, a scene without a velocity, nothing approaches,
            methods without friction for a scene that has it.

    Source: docs/stability.md.

    >>> import jimpact as ji
    >>> result = ji.stability_map(
    ...     ["verlet"], {"setting": [0.0, 0.8]}, {"balls": 2, "exponent": 1}
    ... )
    >>> result.counts("verlet")["right"]
    1
    """
    check_choice("slices", slices, SLICES)
    samples = as_whole("samples", samples, 0)
    max_steps = as_whole("max_steps", max_steps, 1)
    if not jnp.zeros(()).dtype == jnp.float64:
        raise ValueError(
            "A stability map needs double precision: enable jax_enable_x64."
        )
    setup = _checked_setup(scene, velocity)
    chosen = _methods(methods, setup)
    values = _axis_values(axes, as_whole("resolution", resolution, 2), setup.axes)
    start = {name: axis.base for name, axis in _AXES.items()}
    given = _checked("base", base or {}, setup.axes)
    start |= {name: float(x) for name, x in given.items()}
    axis_sets: list[tuple[str, ...]] = [(name,) for name in values]
    if slices == "pairs":
        axis_sets += list(combinations(values, 2))
    parts = [_slice_points(start, values, names) for names in axis_sets]
    sampled = _sample_points(start, values, samples, seed)
    of_slices = (part.reshape(-1, len(AXES)) for part in parts)
    points = np.concatenate([*of_slices, sampled])
    runners = cache(partial(runner, max_steps, setup))
    total = len(points) * (len(chosen) + 1)
    with counting_bar(total, "impacts", progress) as advance:
        exact, confirmation = references(points, setup, runners, advance)
        classes = {
            m.name: partial(classes_of, m, setup, exact, runners, advance)
            for m in chosen
        }
        classified, left_out = at_points(classes, points)
    shapes = [part.shape[:-1] for part in parts]
    by_slice = {}
    by_sample = {}
    for name, (codes, errors) in classified.items():
        by_slice[name], by_sample[name] = _as_slices(axis_sets, shapes, codes, errors)
    return StabilityMap(
        methods=tuple(by_slice),
        axes=values,
        base={name: start[name] for name in setup.axes},
        slices=by_slice,
        samples=sampled,
        sampled=by_sample,
        confirmation=confirmation,
        max_steps=max_steps,
        left_out=left_out,
    )


def _as_slices(
    axis_sets: Sequence[tuple[str, ...]],
    shapes: Sequence[tuple[int, ...]],
    codes: np.ndarray,
    errors: np.ndarray,
) -> tuple[tuple[Slice, ...], Slice]:
    """The slices of these axes and shapes, and that of the samples, which come last,
    from the classes and errors (P,) of all points.
    """
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    *codes_of_slices, sampled = np.split(codes, ends)
    *errors_of_slices, errors_of_samples = np.split(errors, ends)
    parts = zip(axis_sets, shapes, codes_of_slices, errors_of_slices)
    slices = tuple(
        Slice(names, code.reshape(shape), error.reshape(shape))
        for names, shape, code, error in parts
    )
    return slices, Slice(("samples",), sampled, errors_of_samples)


class Setup(NamedTuple):
    """Scene of all points at v- (n,), the largest |v-| 1; None: chains whose first ball
    strikes.

    A point is a row (7,) of numbers in the order of `AXES`.
    """

    scene: Scene | None = None
    velocity: Any = None

    @property
    def friction(self) -> bool:
        """True if contacts have friction: a scene with tangents."""
        return self.scene is not None and self.scene.tangents is not None

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes that count: a scene has no masses and balls, a chain no
        friction.
        """
        if self.scene is None:
            return tuple(name for name in AXES if name != "friction")
        missing = {"mass_ratio", "balls"} | (set() if self.friction else {"friction"})
        if self.scene.contacts > 1:
            missing |= set()
        else:
            missing |= {"stiffness_ratio"}
        return tuple(name for name in AXES if name not in missing)

    def size(self, balls: int) -> int:
        """Number n of velocities."""
        if self.scene is None:
            return balls
        return self.scene.size

    def impact_at(
        self, point: Any, balls: int, max_steps: int
    ) -> tuple[LZB, Scene, jax.Array]:
        """Law, scene and v- (n,) of a point (7,), without its setting; `balls` is N of
        a chain.
        """
        _, kappa, eta, e, mass_ratio, _, friction = point
        if self.scene is None:
            mass, stiffness = chain_of(kappa, mass_ratio, balls)
            v = jnp.zeros_like(mass).at[0].set(1.0)
            return LZB(e, stiffness, eta, max_steps=max_steps), chain(mass), v
        stiffness = stiffness_of(kappa, self.scene.contacts)
        if self.friction:
            mu = friction
        else:
            mu = None
        law = LZB(e, stiffness, eta, friction=mu, max_steps=max_steps)
        return law, self.scene, self.velocity

    def groups(self, points: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
        """Groups of points (P, 7) with equal numbers of balls: indices (L,), and N (0:
        a scene).

        One function is compiled for each group.
        """
        if self.scene is None:
            balls = points[:, AXES.index("balls")]
        else:
            balls = np.zeros(len(points))
        for n in np.unique(balls):
            yield np.flatnonzero(balls == n), int(n)


def _checked_setup(scene: Scene | None, velocity: Any) -> Setup:
    """The scene with its v-, scaled to 1 as the largest and checked; without a scene,
    chains.
    """
    if scene is None:
        if velocity is not None:
            raise ValueError("Argument `velocity` must be None without a `scene`.")
        return Setup()
    if velocity is None:
        raise ValueError(
            "Argument `velocity` must be given with a `scene`, but is None."
        )
    v = as_velocity(scene, velocity, finite=True)
    if not bool(LZB(1.0).contact(scene, v).happens):
        raise ValueError("Argument `velocity` must let a closed contact approach.")
    return Setup(scene, v / jnp.max(jnp.abs(v)))


def _methods(
    methods: Sequence[str | Contender] | None, setup: Setup
) -> list[Contender]:
    """Contenders to map, by name or a user's own; None: the default ones, with friction
    if needed.

    Only those that JAX can batch are known.
    """
    batched = (m for m in CONTENDERS.values() if m.jax)
    able = [m for m in batched if m.friction or not setup.friction]
    known = {m.name: m for m in able}
    defaults = FRICTION_NAMES if setup.friction else NAMES
    return contenders_of("methods", defaults if methods is None else methods, known)


def _checked(
    argument: str, values: Mapping[str, Any], names: tuple[str, ...]
) -> Mapping[str, Any]:
    """Values by axis, checked: names among `names`, numbers in the range of their
    axis.
    """
    check_kind(argument, values, Mapping)
    for name, value in values.items():
        check_choice(argument, name, names)
        axis = _AXES[name]
        of_axis = f"{argument}[{name!r}]"
        numbers = as_axis(of_axis, value)
        check_values(of_axis, numbers, low=axis.low, high=axis.high)
        if name == "balls" and (np.asarray(value) % 1).any():
            raise ValueError(
                f"Argument `{of_axis}` must hold whole numbers, but has {value}."
            )
    return values


def default_axes(
    r: int, names: tuple[str, ...] = Setup().axes
) -> dict[str, np.ndarray]:
    """`r` values of each axis by name (numbers of balls: six, or three below
    `_FEW`).
    """
    balls = np.array(BALLS if r >= _FEW else _FEW_BALLS, float)
    return {name: balls if name == "balls" else _AXES[name].values(r) for name in names}


def _axis_values(
    axes: Mapping[str, Sequence[float]] | None, r: int, names: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Values of the axes to map by name: `axes`, sorted, or by default r values of
    all; a ValueError for no axis.
    """
    if axes is None:
        return default_axes(r, names)
    if not axes:
        raise ValueError(
            f"Argument `axes` must name one of {', '.join(names)} or more."
        )
    axes = _checked("axes", axes, names)
    return {
        name: np.unique(np.asarray(axes[name], float)) for name in AXES if name in axes
    }


def _slice_points(
    base: Mapping[str, float], axes: Mapping[str, np.ndarray], varied: tuple[str, ...]
) -> np.ndarray:
    """Points (K_1 .. K_d, 7) over the values of the d axes `varied`, elsewhere at the
    base.
    """
    columns = []
    for name in AXES:
        if name in varied:
            columns.append(axes[name])
        else:
            columns.append(np.array([base[name]]))
    of_axes = np.meshgrid(*columns, indexing="ij")
    grid = np.stack(of_axes, axis=-1)
    shape = (len(axes[name]) for name in varied)
    return grid.reshape(*shape, len(AXES))


def _sample_points(
    base: Mapping[str, float], axes: Mapping[str, np.ndarray], samples: int, seed: int
) -> np.ndarray:
    """Latin-hypercube points (samples, 7), between the values of `axes`; others from
    `base`.

    Uniform in the index of an axis' values, between two values linear, or in the
    logarithm where all are positive (but for the exponent). Numbers of balls are those
    of the axis.
    """
    from scipy.stats import qmc  # late: slow to import

    points = np.tile([base[name] for name in AXES], (samples, 1))
    generator = np.random.default_rng(seed)
    cube = qmc.LatinHypercube(len(axes), rng=generator)
    unit = cube.random(samples)
    for column, (name, values) in zip(unit.T, axes.items()):
        index = column * (len(values) - 1)
        if name == "balls":
            nearest = np.round(index).astype(int)
            points[:, AXES.index(name)] = values[nearest]
            continue
        powers = bool((values > 0).all()) and name != "exponent"
        if powers:
            scaled = np.log(values)
        else:
            scaled = values
        between = np.interp(index, np.arange(len(values)), scaled)
        if powers:
            points[:, AXES.index(name)] = np.exp(between)
        else:
            points[:, AXES.index(name)] = between
    return points


# --------------------------------------------------------------------------- running
# methods


def setting_of(kind: str, level: Any) -> Any:
    """Setting of a method at `level` in [0, 1] from coarse to fine.

    Equation: `coarse (fine / coarse)^level`, the ends as in `SETTINGS`.

    >>> from jimpact.methods.stability import setting_of
    >>> round(float(setting_of("rtol", 0.6)), 12)
    1e-08
    """
    coarse, fine = SETTINGS[kind]
    return coarse * (fine / coarse) ** level


def chain_of(kappa: Any, mu: Any, balls: int) -> tuple[jax.Array, jax.Array]:
    """Masses (N,) [kg] and stiffnesses (N - 1,) of a point.

    Contact j = 1..N-1 belongs to the right half where j > N // 2; ball N // 2 + 1 is
    the middle.

    >>> from jimpact.methods.stability import chain_of
    >>> [values.tolist() for values in chain_of(10.0, 0.5, 4)]
    [[1.0, 1.0, 0.5, 1.0], [1.0, 1.0, 10.0]]
    """
    kappa = jnp.asarray(kappa, float)
    mu = jnp.asarray(mu, float)
    is_middle = jnp.arange(balls) == balls // 2
    mass = jnp.where(is_middle, mu, jnp.ones_like(mu))
    return mass, stiffness_of(kappa, balls - 1)


def stiffness_of(kappa: Any, contacts: int) -> jax.Array:
    """Stiffnesses (m,): kappa in the right half, which has no more contacts than the
    left one.

    >>> from jimpact.methods.stability import stiffness_of
    >>> stiffness_of(10.0, 3).tolist()
    [1.0, 1.0, 10.0]
    """
    kappa = jnp.asarray(kappa, float)
    right = jnp.arange(contacts) >= (contacts + 1) // 2
    return jnp.where(right, kappa, jnp.ones_like(kappa))


# Of points (L, 7) and settings () or (L,): outcomes (L,), and the energy gained (L,)
# over T-
Runner = Callable[[np.ndarray, Any], tuple[Outcomes, np.ndarray]]
Runners = Callable[[Contender, int], Runner]


def runner(max_steps: int, setup: Setup, method: Contender, balls: int) -> Runner:
    """Function of points (L, 7) and settings that runs one method on chains of N balls
    or a scene.

    It returns outcomes (L,) and gains of energy over T- (L,).
    """

    def one(point: jax.Array, setting: jax.Array) -> tuple[Outcomes, jax.Array]:
        """Outcome at one point (7,), and the energy gained over T-."""
        law, scene, v = setup.impact_at(point, balls, max_steps)
        out, compared = solved(method, law, scene, v, setting)
        return compared, audit(out, scene, v).energy_gain

    batch = quick_jit(jax.vmap(one))

    def run(points: np.ndarray, settings: Any) -> tuple[Outcomes, np.ndarray]:
        """Outcomes and gains of energy at all points (L, 7), a batch at a time."""
        rows = points, np.broadcast_to(settings, len(points))
        return in_batches(lambda part: batch(*part), rows, BATCH)

    return run


# --------------------------------------------------------------------------- the
# references


def references(
    points: np.ndarray, setup: Setup, runners: Runners, advance: Callable[[int], None]
) -> tuple[np.ndarray, Confirmation]:
    """Reference v+ of the points (P, largest n), NaN if no run ends, and its check by
    scipy.

    Runs of 'time' at `REFERENCE_RTOL`.
    """
    groups = list(setup.groups(points))
    largest = max((setup.size(n) for _, n in groups), default=0)
    exact = np.full((len(points), largest), np.nan)
    for at, n in groups:
        # points that differ in their setting alone (column 0) share a run
        unique, back = np.unique(points[at, 1:], axis=0, return_inverse=True)
        rows = np.column_stack([np.zeros(len(unique)), unique])
        out, _ = runners(CONTENDERS["time"], n)(rows, REFERENCE_RTOL)
        ended = (out.code == CODE["ok"]) | (out.code == CODE["plastic_limit"])
        of_unique = np.where(ended[:, None], out.velocity, np.nan)
        velocity = of_unique[np.ravel(back)]
        exact[at, : setup.size(n)] = velocity
        advance(len(at))
    return exact, _confirm(points, setup, exact)


def _confirm(points: np.ndarray, setup: Setup, exact: np.ndarray) -> Confirmation:
    """Differences of the reference v+ `exact` from scipy's, at a few points that it
    solves soon.

    Up to `CHECKED` of them, spread over the points (P, 7).
    """
    quick = np.array([_is_quick(point, setup) for point in points])
    candidates = np.flatnonzero(np.isfinite(exact[:, 0]) & quick)
    # of points that differ in their setting alone (column 0) the first
    _, first = np.unique(points[candidates, 1:], axis=0, return_index=True)
    candidates = candidates[np.sort(first)]
    stride = max(1, -(-len(candidates) // CHECKED))
    name = "scipy_dop853"
    rtol = CHECK_RTOL
    within = CONFIRMED
    if setup.friction:
        name = "scipy_radau"
        rtol = FRICTION_RTOL
        within = FRICTION_CONFIRMED
    differences = []
    for i in candidates[::stride]:
        balls = int(points[i, AXES.index("balls")])
        numbers = list(map(float, points[i]))
        law, scene, v = setup.impact_at(numbers, balls, CHECK_STEPS)
        _, out = solved(CONTENDERS[name], law, scene, v, rtol)
        difference = relative_error(out.velocity, exact[i, : len(v)])
        differences.append(float(difference))
    agree = sum(x <= within for x in differences)
    largest = max(differences, default=float("nan"))
    return Confirmation(len(points), len(differences), agree, largest, within)


def _is_quick(point: np.ndarray, setup: Setup) -> bool:
    """True for a point (7,) that scipy solves soon, and does not end too early (small
    e).

    Equation: `sqrt(2) eta / e spread < QUICK_RATIO`: the largest frequency of the
    linearized flow is at most `sqrt(2) eta / e` of the fastest contact's, and that
    `spread` of the slowest's.
    """
    _, kappa, eta, e, mass_ratio, balls, _ = map(float, point)
    by_stiffness = max(kappa, 1 / kappa) ** (1 / (eta + 1))
    by_mass = max(mass_ratio, 1 / mass_ratio) ** 0.5
    spread = by_stiffness * by_mass
    few = (balls if setup.scene is None else setup.scene.contacts) <= QUICK_BALLS
    if not (few and e >= RECLOSING):
        return False
    fastest = np.sqrt(2) * eta / e
    return fastest * spread < QUICK_RATIO


# ---------------------------------------------------------------------------------
# classes


def classes_of(
    method: Contender,
    setup: Setup,
    exact: np.ndarray,
    runners: Runners,
    advance: Callable[[int], None],
    points: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Class (index of `CLASSES`) and error of v+ of every point (P, 7) by one method.

    Errors are the largest |v+ - exact|, over the largest |v-|, which is 1. A wrong
    result is tried again at a finer setting: `stalls` if its error does not fall.
    """
    codes = np.full(len(points), FLAGGED)
    errors = np.full(len(points), np.nan)
    level = points[:, AXES.index("setting")]
    setting = setting_of(method.setting, level)
    fixed = np.full(len(points), FIXED_STEP_RIGHT)
    if method.setting == "rtol":
        allowed = HONEST * setting
    else:
        allowed = fixed
    e = points[:, AXES.index("restitution")]
    for group, n in setup.groups(points):
        run = runners(method, n)
        size = setup.size(n)
        # refused at e = 0: flagged
        if method.divides:
            at = group[e[group] > 0]
        else:
            at = group
        if len(at):
            out, gain = run(points[at], setting[at])
            errors[at] = relative_error(out.velocity, exact[at, :size])
            codes[at] = _classified(out, gain, errors[at], allowed[at])
        wrong = at[codes[at] == WRONG]
        if len(wrong):
            finer, _ = run(points[wrong], FINER * setting[wrong])
            finer_errors = relative_error(finer.velocity, exact[wrong, :size])
            falls = finer_errors < FALLS * errors[wrong]
            converged = finer.code == CODE["ok"]
            codes[wrong[converged & ~falls]] = STALLS
        advance(len(group))
    return codes, errors


def _classified(
    out: Outcomes, gain: np.ndarray, error: np.ndarray, allowed: np.ndarray
) -> np.ndarray:
    """Classes (L,) before a finer setting is tried: the first case that holds.

    `gain` is energy over T-, `error` of v+ NaN without a reference, `allowed` the
    largest error that is right; all (L,).
    """
    status = np.where(out.code == CODE["ok"], out.status, out.code)
    cases = {
        NOT_FINITE: status == CODE["not_finite"],
        ENDLESS: status == CODE["max_steps"],
        RIGHT: error <= allowed,
        GAINS_ENERGY: (status == CODE["energy_gain"]) | (gain > allowed),
        FLAGGED: status != CODE["ok"],
        WRONG: np.isfinite(error),
    }
    return np.select(list(cases.values()), list(cases), UNCHECKED)
