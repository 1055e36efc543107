"""Candidates at points against a reference: outcomes in batches, their errors, and
their times.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.impacts import Impact, impact
from jimpact.core.law import Law, with_entries
from jimpact.core.scene import Scene, dense_mass, with_gaps
from jimpact.tools.compiling import quick_jit
from jimpact.tools.status import CODE, STATUS
from jimpact.tools.threads import in_parts

Result = TypeVar("Result")

# [s]: calls that are faster are run several times for one measurement, so that the
SHORT = 2e-3
MOST_RUNS = 20  # clock's resolution does not count, but no more often than this
UNCOUNTED = -1  # evaluations of a method that does not count them
LEAST_REPEATS = 3  # measurements of each run; ..
BUDGET = 2.0  # .. more of them only within so many seconds of calls


class Solution(NamedTuple):
    """Impulses (m,) [N s], status (), duration () [s], field evaluations (), impulses
    (t,) [N s].

    NaN: a duration that is not known; `UNCOUNTED`: evaluations likewise; None: no
    friction.
    """

    impulse: Any
    code: Any = CODE["ok"]
    duration: Any = np.nan
    evaluations: Any = UNCOUNTED
    tangential: Any = None


TIMELESS = Solution(None)  # of a law, whose impacts are not integrated in time


class Outcomes(NamedTuple):
    """Numbers of r impacts, to be compared between laws or methods; JAX arrays, or
    NumPy's.
    """

    velocity: Any  # v+ (r, n) [m/s]
    impulse: Any  # p (r, m) [N s]
    tangential: Any  # p_t (r, t) [N s]
    energy_change: Any  # T+ - T- (r,) [J]
    status: Any  # of the impact (r,)
    code: Any  # own status of a contender (r,)
    duration: Any  # (r,) [s], NaN of a law
    evaluations: Any  # of the field (r,), `UNCOUNTED` of a law
    jacobian: Any = None  # of v+, where one was asked for

    @classmethod
    def of(cls, out: Impact, solution: Solution = TIMELESS) -> "Outcomes":
        """Numbers of an impact, and of the contender's solution that it was made of, if
        any.
        """
        energy = out.energy_change
        work = (solution.code, solution.duration, solution.evaluations)
        moved = (out.velocity, out.impulse, out.tangential_impulse)
        return cls(*moved, energy, out.status, *work)

    @property
    def failed(self) -> np.ndarray:
        """Mask (r,) of impacts whose status is a failure."""
        failures = [STATUS[int(code)].failure for code in self.status]
        return np.array(failures, bool)

    def check_first(self, what: str) -> None:
        """Raise a RuntimeError that begins with `what` if the first impact failed."""
        if self.failed[0]:
            raise RuntimeError(f"{what}: {STATUS[int(self.status[0])].message}.")

    def where_usable(self) -> "Outcomes":
        """Outcomes with v+, p and p_t NaN where the impact failed."""
        lost = self.failed[:, None]
        parts = self.velocity, self.impulse, self.tangential
        v, p, p_t = (np.where(lost, np.nan, x) for x in parts)
        return self._replace(velocity=v, impulse=p, tangential=p_t)


@quick_jit
def varied_impacts(
    law: Law, scene: Scene, velocity: jax.Array, varied: dict[str, Any]
) -> Outcomes:
    """Outcomes (r,) of impacts at v- (n,) [m/s] with the arguments `varied`, a row
    each.

    Names are `velocity` (r, n), `gaps` (r, m) [m], `rtol` (r,) of `impact`, or
    parameters of the law (r, ...).
    """

    def one(values: dict[str, jax.Array]) -> Outcomes:
        """Outcome with one row of the arguments `values`."""
        one_scene = scene
        one_law = law
        v = velocity
        rtol = None
        for name, value in values.items():
            if name == "velocity":
                v = value
            elif name == "gaps":
                one_scene = with_gaps(scene, value)
            elif name == "rtol":
                rtol = value
            else:
                one_law = with_entries(one_law, (name,), jnp.ravel(value))
        return Outcomes.of(impact(one_law, one_scene, v, rtol=rtol))

    return jax.vmap(one)(varied)


class EnergyNorm(NamedTuple):
    """`sqrt(dv^T M dv) / sqrt(v-^T M v-)`: a ratio that does not mix m/s and rad/s.

    `mass` is that of the `watched` coordinates, `before` the norm of v- (of 1 at rest).
    """

    mass: np.ndarray
    before: float
    watched: np.ndarray

    @classmethod
    def of(
        cls, scene: Scene, velocity: np.ndarray, watched: Any = None
    ) -> "EnergyNorm":
        """Norm of a scene at v- (n,) over the coordinates `watched` (indices), None:
        all.
        """
        count = scene.size
        if watched is None:
            index = np.arange(count)
        else:
            index = np.atleast_1d(np.asarray(watched))
        row = index.ndim == 1 and index.size > 0
        whole = row and np.issubdtype(index.dtype, np.integer)
        if not whole or index.min() < 0 or index.max() >= count:
            raise ValueError(
                f"Argument `watched` must be indices of coordinates from 0 to "
                f"{count - 1}, but has value {watched!r}."
            )
        mass = dense_mass(scene)
        before = float(np.sqrt(velocity @ mass @ velocity)) or 1.0
        return cls(mass[np.ix_(index, index)], before, index)

    def __call__(self, change: np.ndarray) -> np.ndarray:
        """Norms (...) of differences dv (..., n) of velocities."""
        dv = change[..., self.watched]
        square = np.sum((dv @ self.mass) * dv, axis=-1)
        return np.sqrt(square) / self.before


def in_batches(
    run: Callable[[Any], Any],
    rows: Any,
    size: int,
    advance: Callable[[int], Any] = lambda count: None,
) -> Any:
    """Results of `run` over rows, `size` of them at a time, on all cores.

    Rows are a tree of arrays (r, ...), results trees with the same r. `advance` is
    called with the number of rows of each batch.
    """
    count = len(jax.tree.leaves(rows)[0])
    parts: list[Any] = []
    for _, part in in_parts(run, [rows], size):
        advance(min(size, count - size * len(parts)))
        parts.append(part)
    # without the rows that filled up the last batch
    joined = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return jax.tree.map(lambda x: x[:count], joined)


def at_points(
    candidates: Mapping[str, Callable[[Any], Result]], points: Any
) -> tuple[dict[str, Result], dict[str, str]]:
    """Results of candidates, functions of the points, by name, and reasons why some are
    missing.

    A user's law or contender may fail in any way: one that raises is left out, the
    others stand.
    """
    results: dict[str, Result] = {}
    left_out: dict[str, str] = {}
    for name, run in candidates.items():
        try:
            results[name] = run(points)
        except Exception as error:
            reason = next(iter(str(error).splitlines()), "-")
            left_out[name] = f"raised {type(error).__name__}: {reason}"
    return results, left_out


def left_out_notes(left_out: Mapping[str, str], what: str = "is left out") -> list[str]:
    """A line of a table's notes for each candidate that is left out, or that lacks
    something.
    """
    return [f"{name} {what}: it {why}" for name, why in left_out.items()]


def relative_error(value: Any, exact: Any, scale: Any = 1.0) -> np.ndarray:
    """`max_i |value_i - exact_i| / scale` (...) over the last axis of arrays (...,
    n).
    """
    largest = np.abs(np.asarray(value) - exact).max(axis=-1)
    return largest / scale


def seconds(run: Callable[[], Any], count: int = 1) -> float:
    """Mean time [s] of `count` calls, until their results are computed."""
    begin = time.perf_counter()
    for _ in range(count):
        jax.block_until_ready(run())
    return (time.perf_counter() - begin) / count


def in_turns(
    runs: Sequence[Callable[[], Any]],
    repeats: int,
    advance: Callable[[], Any] = lambda: None,
) -> list[np.ndarray]:
    """Times a call [s] of each of `runs`, from `repeats` measurements, or fewer of slow
    ones.

    In turns, one measurement of each run after the other: a busy machine slows all
    alike. Fast runs are called several times in one measurement. `advance` is called
    after each measurement.
    """
    # the first call may compile
    warm = [min(seconds(run), seconds(run)) for run in runs]
    in_short = [SHORT / max(t, 1e-9) for t in warm]
    counts = [int(np.clip(count, 1, MOST_RUNS)) for count in in_short]
    times: list[list[float]] = [[] for _ in runs]
    for _ in range(repeats):
        for run, count, measured in zip(runs, counts, times):
            if len(measured) < LEAST_REPEATS or count * sum(measured) < BUDGET:
                measured.append(seconds(run, count))
            advance()
    return [np.array(measured) for measured in times]
