"""Methods on many points of a stability map at once, and what becomes of each point.

A batch is one compiled function a method and number of balls, over lanes of points; lanes of
one chunk wait for the slowest, so the number of steps is bounded.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.audits import audit
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import Method, MethodResult, in_si, lzb_only, outcome, problem
from jimpact.methods.stability.points import AXES, chain_of, setting_of
from jimpact.numerics import dimensionless
from jimpact.scene import Scene, chain
from jimpact.status import CODE

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


def _solve_default(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    """What `ji.impact(ji.LZB(..., rtol=setting), ...)` does."""
    given = problem(law, scene, velocity, setting)
    p, code = dimensionless.solve(
        given.inputs, given.exponent, given.chain, given.max_steps, law.method
    )
    unknown = jnp.full((), jnp.nan, p.dtype)
    return in_si(given, p, unknown, jnp.asarray(-1), code)


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
