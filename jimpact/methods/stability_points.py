"""Points of a stability map: scenes, slices, samples; methods run on many points, classified.

# notation: a point is a row (6,) of AXES
#   setting           0 coarse .. 1 fine, log-linear in what the method takes (`setting_of`)
#   stiffness_ratio   kappa: stiffness of the right half of the contacts; the left half has 1
#   exponent          eta of all contacts
#   restitution       e of all contacts
#   mass_ratio        mu: mass of the middle ball; all others have 1
#   balls             N, a touching chain without walls; v- = (1, 0, .., 0)

A batch is one compiled function a method and number of balls, over lanes of points; lanes of
one chunk wait for the slowest, so the number of steps is bounded.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import check_values
from jimpact.audits import audit
from jimpact.events.impact_dynamics import solve
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import Method, MethodResult, in_si, lzb_only, outcome, problem
from jimpact.scene import Scene, chain
from jimpact.status import CODE

AXES = ("setting", "stiffness_ratio", "exponent", "restitution", "mass_ratio", "balls")
# kind of setting (see `jimpact.methods.contenders.Method`): value at level 0 and at level 1
SETTINGS = {"rtol": (1e-2, 1e-12), "step": (3.0, 3e-3), "impulse step": (0.3, 3e-5)}
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

CLASSES = (
    "right",
    "flagged",
    "wrong",
    "gains energy",
    "stalls",
    "does not end",
    "not finite",
    "unchecked",
)
(RIGHT, FLAGGED, WRONG, GAINS_ENERGY, STALLS, ENDLESS, NOT_FINITE, UNCHECKED) = range(8)
HONEST = 10.0  # error over tolerance up to which a result counts as right
FIXED_STEP_RIGHT = 1e-3  # the same of methods with a step: error in v+ over the largest |v-|
FINER = 0.1  # setting at which a wrong result is tried again: it stalls if the error does
FALLS = 0.5  # not fall below this part
LANES = 32


def setting_of(kind: str, level: Any) -> Any:
    """The number a method takes at `level` in [0, 1].

    >>> from jimpact.methods.stability_points import setting_of
    >>> round(float(setting_of("rtol", 0.6)), 12)
    1e-08
    """
    coarse, fine = SETTINGS[kind]
    return coarse * (fine / coarse) ** level


def chain_of(kappa: Any, mu: Any, balls: int) -> tuple[jax.Array, jax.Array]:
    """Masses (N,) [kg] and stiffnesses (N - 1,) of a point.

    Contact j = 1..N-1 belongs to the right half where j > N // 2; ball N // 2 + 1 is the middle.

    >>> from jimpact.methods.stability_points import chain_of
    >>> [values.tolist() for values in chain_of(10.0, 0.5, 4)]
    [[1.0, 1.0, 0.5, 1.0], [1.0, 1.0, 10.0]]
    """
    kappa, mu = jnp.asarray(kappa, float), jnp.asarray(mu, float)
    middle = balls // 2
    mass = jnp.where(jnp.arange(balls) == middle, mu, jnp.ones_like(mu))
    stiffness = jnp.where(jnp.arange(balls - 1) >= middle, kappa, jnp.ones_like(kappa))
    return mass, stiffness


def default_axes(resolution: int) -> dict[str, np.ndarray]:
    """Values of every axis, `resolution` of each (number of balls: at most six)."""
    r = resolution
    return {
        "setting": np.linspace(0, 1, r),
        "stiffness_ratio": np.logspace(-8, 8, r),
        "exponent": np.linspace(1, 5, r),
        "restitution": np.append(0.0, np.logspace(-3, 0, r - 1)),
        "mass_ratio": np.logspace(-6, 6, r),
        "balls": np.array(BALLS if r >= _FEW else _FEW_BALLS, float),
    }


def checked_axes(
    axes: Mapping[str, Sequence[float]] | None, resolution: int
) -> dict[str, np.ndarray]:
    """The axes to map: those given, or all of the default ones."""
    check_values("resolution", resolution, low=2)
    if axes is None:
        return default_axes(resolution)
    unknown = sorted(set(axes) - set(AXES))
    if unknown or not axes:
        raise ValueError(f"Argument `axes` must name some of {AXES}, but has {unknown}.")
    found = {}
    for name, values in axes.items():
        low, high = _RANGES[name]
        check_values(f"axes[{name!r}]", values, low=low, high=high)
        row = np.atleast_1d(np.asarray(values, float))
        if name == "balls" and np.any(row != np.round(row)):
            raise ValueError(f"Argument `axes['balls']` must hold whole numbers, but has {row}.")
        found[name] = np.unique(row)
    return {name: found[name] for name in AXES if name in found}


def checked_base(base: Mapping[str, float] | None) -> dict[str, float]:
    """The base point: BASE with what `base` puts in its place."""
    unknown = sorted(set(base or {}) - set(AXES))
    if unknown:
        raise ValueError(f"Argument `base` must name some of {AXES}, but has {unknown}.")
    for name, value in (base or {}).items():
        low, high = _RANGES[name]
        check_values(f"base[{name!r}]", value, low=low, high=high)
    return BASE | {name: float(value) for name, value in (base or {}).items()}


def slice_points(
    base: Mapping[str, float], axes: Mapping[str, np.ndarray], varied: tuple[str, ...]
) -> np.ndarray:
    """Points (K_1 .. K_d, 6) in which the axes `along` run over their values."""
    grids = np.meshgrid(*(axes[name] for name in varied), indexing="ij")
    rows = [
        grids[varied.index(name)] if name in varied else np.full(grids[0].shape, base[name])
        for name in AXES
    ]
    return np.stack(rows, axis=-1)


def sample_points(
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


def _solve_default(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    """What `ji.impact(ji.LZB(..., rtol=setting), ...)` does."""
    given = problem(law, scene, velocity, setting)
    p, _, code = solve(given.dynamics, given.max_steps, law.method)
    unknown = jnp.full((), jnp.nan, p.dtype)
    return in_si(given, p / given.units.momentum, unknown, jnp.asarray(-1), code)


DEFAULT = Method(
    name="default",
    label="jimpact's default",
    setting="rtol",
    ladder=(1e-4, 1e-8, 1e-12),
    jax=True,
    supports=lzb_only,
    solve=_solve_default,
)


class Found(NamedTuple):
    """Velocities after (L, n), status of the method and of the impact, energy gained over T-."""

    velocity: np.ndarray
    code: np.ndarray
    status: np.ndarray
    gain: np.ndarray


def threshold(method: Method, level: np.ndarray) -> np.ndarray:
    """Error up to which a result of `method` at these settings is right."""
    if method.setting != "rtol":
        return np.full(np.shape(level), FIXED_STEP_RIGHT)
    return HONEST * np.asarray(setting_of("rtol", level))


def runner(
    method: Method, balls: int, linear: bool, max_steps: int
) -> Callable[[np.ndarray, np.ndarray], Found]:
    """`run(points (L, 6), settings (L,))` of one method on chains of so many balls.

    `linear`: the exponent is the static 1.0, which some methods ask for.
    """

    def one(point: jax.Array, setting: jax.Array) -> tuple[jax.Array, ...]:
        _, kappa, eta, e, mu, _ = point
        mass, stiffness = chain_of(kappa, mu, balls)
        scene, v = chain(mass), jnp.zeros_like(mass).at[0].set(1.0)
        law = LZB(e, stiffness, 1.0 if linear else eta, max_steps=max_steps)
        found = method.solve(law, scene, v, setting)
        out = outcome(law, scene, v, found)
        return out.velocity, found.code, out.status, audit(scene, v, out).energy_gain

    batch = jax.jit(jax.vmap(one))

    def run(points: np.ndarray, settings: np.ndarray) -> Found:
        rows = []
        for begin in range(0, len(points), LANES):
            lanes = np.arange(begin, begin + LANES).clip(max=len(points) - 1)  # the last repeats
            out = batch(jnp.asarray(points[lanes]), jnp.asarray(settings[lanes]))
            rows.append([np.asarray(x)[: len(points) - begin] for x in out])
        return Found(*(np.concatenate(column) for column in zip(*rows)))

    return run


def refused(method: Method, points: np.ndarray, linear: bool) -> np.ndarray:
    """Points (L,) on which the method says beforehand that it cannot work."""
    e = points[:, AXES.index("restitution")]
    reasons = {}
    for value in (0.0, 1.0):
        law = LZB(value, exponent=1.0 if linear else jnp.asarray(1.5))
        reasons[value] = method.supports(law, chain(jnp.ones(2))) is not None
    return np.where(e == 0, reasons[0.0], reasons[1.0])


def error_of(found: Found, exact: np.ndarray) -> np.ndarray:
    """Largest error in v+ (L,) over the largest |v-|, which is 1."""
    return np.abs(found.velocity - exact).max(axis=1)


def classify(found: Found, error: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Classes (L,) before a finer setting is tried; `error` NaN where there is no reference."""
    status = np.where(found.code == CODE["ok"], found.status, found.code)
    cases = [
        (status == CODE["not_finite"], NOT_FINITE),
        (status == CODE["max_steps"], ENDLESS),
        (error <= allowed, RIGHT),
        ((status == CODE["energy_gain"]) | (found.gain > allowed), GAINS_ENERGY),
        (status != CODE["ok"], FLAGGED),
        (np.isfinite(error), WRONG),
    ]
    return np.select([case for case, _ in cases], [code for _, code in cases], UNCHECKED)
