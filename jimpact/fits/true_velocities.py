"""The true velocities before impacts that agree best with law and data, and the law
there.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.core.law import Law
from jimpact.fits.errors_before import ErrorsBefore
from jimpact.fits.measurement import Measurement
from jimpact.fits.observables import Prediction, Shots
from jimpact.tools.compiling import full_precision
from jimpact.tools.masks import quotient

# True velocities stay where a step moves none by more than this many of its standard
# errors: the misfit, at its least there, is right to the square of it. Ten times more:
# parameters move by a ten-thousandth of a standard error between builds; in float32
# that is what rounding leaves.
STAYS = {"float64": 1e-7, "float32": 1e-3}
# Steps at most: two suffice for a law that is linear in v-, some five for a smooth one.
# Ten times more: true velocities that a kink of the law sends to and fro take as many.
MOST_STEPS = 16
# ... from this one on they go half of the way, which ends most of such cycles.
HALF_STEPS_FROM = 6


class LawAtShots(NamedTuple):
    """A law linearized in parameters x and true velocities a at K shots.

    Attributes:
        pre: a.
        predicted: `f(a) + J (measured v- - a)`, v+ at the measured v-.
        by_parameters: `G = df/dx` at a.
        by_velocities: `J = df/da`.
        status: codes of the impacts at a.
        residual: independent residuals `F^-1 (predicted - measured) / sigma`; 0 of
            values that were not measured.
        jacobian: `F^-1 G / sigma`, its derivatives in x.
        moved: the largest change of a in the last step, over its standard error.
    """

    pre: Float[Array, "K n"]
    predicted: Float[Array, "K n"]
    by_parameters: Float[Array, "K n X"]
    by_velocities: Float[Array, "K n n"]
    status: Int[Array, " K"]
    residual: Float[Array, "K n"]
    jacobian: Float[Array, "K n X"]
    moved: Float[Array, ""]


class _Iteration(NamedTuple):
    """Steps so far, the true velocities of the next one, and the law at those of the
    last one.
    """

    steps: Int[Array, ""]
    pre: Float[Array, "K n"]
    law: LawAtShots


@full_precision
def law_at_shots(
    law_of: Callable[[Float[Array, " X"]], Law],
    x: Float[Array, " X"],
    observe: Shots,
    measurement: Measurement,
    before: ErrorsBefore,
) -> LawAtShots:
    """The law at parameters x, linearized at the true velocities that agree best with
    it.

    Equation: `a = argmin (x - a, y - f(a)) S^-1 (x - a, y - f(a))^T` for measured
    velocities x and y of each shot, by Gauss-Newton steps (`errors_before`) from the
    measured v-. Shots whose outcome is meaningless stay where they are; their residual
    is that of `Measurement.error`.

    Args:
        law_of: the law of parameters.
        x: parameters.
        observe: shots, with the measured v-.
        measurement: v+, and which of them are used.
        before: S.
    """
    measured = jnp.asarray(observe.pre)[:, : observe.bodies]
    used = jnp.asarray(measurement.weight) > 0
    error_before = jnp.asarray(before.standard_errors(measured.shape))
    n = observe.bodies
    outcome = partial(_outcome, law_of, observe)

    def at(pre: Float[Array, "K n"]) -> tuple[LawAtShots, Float[Array, "K n"]]:
        """The law linearized at true velocities, and the true velocities that
        follow.
        """
        start = jnp.concatenate([x, jnp.zeros(n, x.dtype)])
        slopes_at = jax.jacfwd(partial(outcome, pre), has_aux=True)
        slopes, prediction = slopes_at(start)
        identity = jnp.eye(n, dtype=x.dtype)[None]
        bad = prediction.bad
        by_velocities = jnp.where(bad[..., None], identity, slopes[..., -n:])
        by_parameters = slopes[..., :-n]
        shift = jnp.einsum("kij,kj->ki", by_velocities, measured - pre)
        at_measured = prediction._replace(value=prediction.value + shift)
        error = measurement.error(at_measured)
        whitener = before.whitener(by_velocities, used)
        counts = used & ~jnp.broadcast_to(bad, used.shape)
        slope_of_error = jnp.where(counts[..., None], by_parameters, 0.0)
        independent = jax.vmap(whitener.independent, in_axes=-1, out_axes=-1)
        agreeing = measured + whitener.shift(error)
        estimate = jnp.where(bad, pre, agreeing)
        law = LawAtShots(
            pre=pre,
            predicted=at_measured.value,
            by_parameters=by_parameters,
            by_velocities=by_velocities,
            status=prediction.status,
            residual=whitener.independent(error),
            jacobian=independent(slope_of_error),
            moved=_largest(jnp.abs(estimate - pre), error_before),
        )
        return law, estimate

    def step(iteration: _Iteration) -> _Iteration:
        """Linearize the law at the true velocities, and move them."""
        law, estimate = at(iteration.pre)
        share = jnp.where(iteration.steps >= HALF_STEPS_FROM, 0.5, 1.0)
        pre = iteration.pre + share * (estimate - iteration.pre)
        return _Iteration(iteration.steps + 1, pre, law)

    def goes_on(iteration: _Iteration) -> Bool[Array, ""]:
        """True until the true velocities stay."""
        moves = iteration.law.moved > STAYS[str(x.dtype)]
        return (iteration.steps < MOST_STEPS) & moves

    shapes = jax.eval_shape(lambda: at(measured)[0])
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    unknown = nothing._replace(moved=jnp.asarray(jnp.inf, x.dtype))
    first = _Iteration(jnp.asarray(0), measured, unknown)
    last = jax.lax.while_loop(goes_on, step, first)
    return last.law


def _outcome(
    law_of: Callable[[Float[Array, " X"]], Law],
    observe: Shots,
    pre: Float[Array, "K n"],
    moved: Float[Array, " X+n"],
) -> tuple[Any, Prediction]:
    """v+ at (parameters, change of all v- from `pre`), to be differentiated, and as it
    is.
    """
    n = observe.bodies
    parameters = moved[:-n]
    change = moved[None, -n:]
    velocities = jnp.asarray(observe.pre).at[:, :n].set(pre + change)
    shots = eqx.tree_at(lambda shots: shots.pre, observe, velocities)
    prediction = shots(law_of(parameters))
    return prediction.value, prediction


def _largest(
    change: Float[Array, "K n"], error: Float[Array, "K n"]
) -> Float[Array, ""]:
    """The largest change over its standard error; exact velocities, of error 0,
    stay.
    """
    uncertain = error > 0
    return jnp.max(quotient(change, error, where=uncertain))
