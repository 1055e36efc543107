"""Parameters of a law from a measured motion: `fit` with a simulated motion as
observable.
"""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.law import Law
from jimpact.fits.fitting import fit
from jimpact.fits.observables import Prediction
from jimpact.fits.parameters import as_names, entry_of
from jimpact.fits.parts_of_motion import LawInMotion, with_parts_of_motion
from jimpact.fits.problem import FitProblem
from jimpact.fits.report import Fit
from jimpact.fits.search import Search
from jimpact.motion.methods import as_method, start_by
from jimpact.motion.record import Motion
from jimpact.motion.simulate import simulate
from jimpact.motion.system import System
from jimpact.tools.checks import (
    as_float_array,
    check_function,
    check_values,
    in_common_dtype,
)
from jimpact.tools.status import STATUS

Observe = Callable[[Motion], jax.Array]

# Steps of one start before it gives up: more only cost time, since each simulates all
# motions.
MOTION_SEARCH = Search(max_steps=50)
# Motions that are simulated side by side. With ten times as many, all wait for the one
# with the most events.
LANES = 32
_FAILS = tuple(row.failure for row in STATUS)


class MotionObservable(eqx.Module):
    """The observable of a fit to motions: `observe(motion)`, simulated with a law.

    From one state q0, v0 (n,), or from K of them (K, n): K motions.
    """

    system: System
    q0: jax.Array
    v0: jax.Array
    options: dict[str, Any]
    observe: Observe = eqx.field(static=True)

    def __call__(self, law: Law) -> Prediction:
        """`observe` of the motion, or of K motions, with this law; the status of one
        that fails.

        Values are bad where the motion fails or they are not finite.
        """
        if isinstance(law, LawInMotion):
            parts = law
        else:
            parts = LawInMotion(law)
        system = parts.in_system(self.system)
        start, speed = parts.start(system, self.q0, self.v0)

        def one_motion(
            q0: jax.Array, v0: jax.Array
        ) -> tuple[jax.Array, jax.Array, jax.Array]:
            """`observe` of the motion from one state, True if it fails, and its status
            code.
            """
            motion = simulate(system, parts.law, q0=q0, v0=v0, **self.options)
            seen = self.observe(parts.seen(motion, system))
            if not eqx.is_array(seen):
                raise TypeError(
                    f"Argument `observe` must give an array, but gives {seen!r}."
                )
            return seen, jnp.asarray(_FAILS)[motion.status], motion.status

        if start.ndim == 1:
            value, fails, status = one_motion(start, speed)
            return Prediction(value, fails | ~jnp.isfinite(value), status[None])
        count = len(start)
        lanes = min(count, LANES)
        # indices of motions, `lanes` in a row; the last row is filled up with the last
        # motion
        rows = np.minimum(np.arange(-(-count // lanes) * lanes), count - 1).reshape(
            -1, lanes
        )
        groups = jax.lax.map(
            lambda row: jax.vmap(one_motion)(start[row], speed[row]), jnp.asarray(rows)
        )
        value, fails, status = (x.reshape(-1, *x.shape[2:])[:count] for x in groups)
        bad = fails.reshape(-1, *[1] * (value.ndim - 1)) | ~jnp.isfinite(value)
        return Prediction(value, bad, status[jnp.argmax(fails)][None])


def fit_motion(
    system: System,
    law: Law,
    measured: Any,
    q0: Any,
    v0: Any,
    t_end: Any,
    free: Any = ("restitution",),
    *,
    sigma: Any = None,
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    ties: Mapping[str, Any] | None = None,
    observe: Observe | None = None,
    starts: int = 1,
    profiles: bool = False,
    search: Search = MOTION_SEARCH,
    **options: Any,
) -> Fit:
    """The parameters with which `simulate` comes nearest to measured motions.

    Equation: `min sum ((observe(motion) - measured) / sigma)^2` by Levenberg-Marquardt,
    with the exact derivatives of the simulated motion, event times included: forward
    ones, which cost less than reverse ones as long as parameters are fewer than
    residuals.

    Args:
        system: as in `simulate`.
        law: with start values; near enough that the events come in the right order (a
            record of many impacts has many minima: cut it into pieces that begin in
            flight).
        measured: positions (S, n) at S equal times from t_start to t_end, or what
            `observe` gives; NaN where nothing was measured. Of K motions (pieces of a
            record, repeated drops): (K, S, n), or K times what `observe` gives.
        q0: (n,) at the start, (K, n) of K motions.
        v0: (n,) at the start, (K, n) of K motions.
        t_end: [s].
        free: names of the law's parameters, or a mapping to masks over contacts, as in
            `fit`; also of the motion: 'q0', 'v0' (or entries, 'v0[2]'; of K motions
            'q0[2,1]'), 'gravity' of a system that has it, 'floor', the height of the
            floor [m] above the heights' zero, else 0. What is free starts at its value
            here.
        sigma: standard errors of the measurement, scalar or shaped like it; None:
            estimated.
        bounds, priors, ties: as in `fit`.
        observe: Motion -> array; None: the positions. E.g.
            `lambda m: m.events.time[:10]`.
        starts, profiles: as in `fit`.
        search: see `Search`; the default takes at most 50 steps a start.
        options: of `simulate`; `samples` follows from `measured` where `observe` is
            None.

    Returns:
        `Fit`; `print` gives its report.

    Raises:
        ValueError: shapes, unknown parameters, nothing measured.

    >>> import jimpact as ji
    >>> ball = ji.System(ji.Column([1.0]), gravity=True)
    >>> measured = ji.simulate(ball, ji.Newton(0.8), [1.0], [0.0], 1.5, samples=16).q
    >>> result = ji.fit_motion(ball, ji.Newton(0.7), measured, [1.0], [0.0], 1.5)
    >>> round(float(result.value[0]), 8)
    0.8
    """
    if observe is not None:
        check_function("observe", observe)
    check_values("measured", measured, nan_allowed=True)
    record = np.asarray(measured, float)
    q0 = as_float_array("q0", q0)
    v0 = as_float_array("v0", v0)
    for name, begin in (("q0", q0), ("v0", v0)):
        if begin.ndim not in (1, 2) or begin.shape[:-1] != q0.shape[:-1]:
            raise ValueError(
                f"Argument `{name}` must have shape (n,), or (K, n) as that of the "
                f"other, but has shape {begin.shape}."
            )
    if observe is None:
        shape = (*q0.shape[:-1], "S", q0.shape[-1])
        if (
            record.ndim != len(shape)
            or (*record.shape[:-2], "S", record.shape[-1]) != shape
        ):
            raise ValueError(
                f"Argument `measured` must have shape ({', '.join(map(str, shape))}), "
                f"but has shape {record.shape}."
            )
        options = {"samples": record.shape[-2]} | options
    method = as_method(options.get("method", "events"), options.get("step"))
    for q, v in zip(q0.reshape(-1, q0.shape[-1]), v0.reshape(-1, v0.shape[-1])):
        there, _, q, v = in_common_dtype(system, law, q, v)
        start_by(method, there, law, q, v, t_end)  # in the fit `simulate` cannot raise
    observable = MotionObservable(
        system, q0, v0, {"t_end": t_end} | options, observe or _positions
    )
    named = {entry_of(name)[0] for name in as_names("free", free)}
    law = with_parts_of_motion(law, system, q0, v0, named)
    problem = FitProblem.from_observable(
        law, observable, measured, sigma, free, bounds, priors, ties
    )
    return fit(problem, starts=starts, profiles=profiles, search=search)


def _positions(motion: Motion) -> jax.Array:
    """q (S, n)."""
    return motion.q
