"""The least-squares problem of a fit: what is observed of a law, against what was measured.

Shots, a motion and a user's own function are three observables. A point is x, the values of the P
parameters, or y (Q,), the same in the solver's scale: of the Q entries of the fitted fields the
first P count, so that a compiled program does not depend on which entries are free.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.law import Law, entries, forward_only, with_entries
from jimpact.core.scene import Scene, dense_mass, stackable
from jimpact.fits.covariances import diagonal_blocks, moved_covariance, whitening
from jimpact.fits.data import Experiments, kept_by_corrections
from jimpact.fits.matrices import AdmissibleMatrices, matrix_region
from jimpact.fits.observables import (
    Observed,
    Prediction,
    Shots,
    filled_count,
    tolerated,
)
from jimpact.fits.parameters import (
    DEFAULT_FREE,
    OF_A_SCENE,
    LawInScene,
    Limits,
    Parameters,
    Prior,
    Ties,
    bounds_of,
    checked_ties,
    free_parameters,
    limits_with_scene,
    plain_law,
    priors_of,
    scaled,
    tied,
    unscaled,
    with_parts_of_scene,
)
from jimpact.fits.solve import EXACT, outcome_at
from jimpact.tools.checks import (
    as_float_array,
    check_concrete,
    check_function,
    check_kind,
    check_shape,
    check_values,
)
from jimpact.tools.compiling import full_precision

# A trial whose outcome is meaningless gets a residual far above any honest one, so that a solver
# turns back; inadmissible or energetic outcomes are only reported.
PENALTY = 1e3  # times the largest measured value

# Programs of up to so many shots (or values in a row) are shared by all numbers of starts.
FEW = 64
# Problems that a program solves side by side: starts of one, and many problems. With ten times
# more of them, all wait for the one whose impacts take longest; an accelerator has idle cores.
LANES, LANES_OF_MANY, LANES_ON_ACCELERATOR = 2, 64, 1024


_STATIC = {"static": True}  # fields that are no arrays for JAX
# ... of which a compiled function knows none
_ON_HOST: dict[str, Any] = dict.fromkeys(
    ("parameters", "domains", "sigma", "priors", "notes", "experiments", "scene", "left_out")
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class FitProblem:
    """The least-squares problem behind a fit, in the parameters x (P,) themselves.

    Equation: `residual = (observed(law(x)) - measured) / sigma` (where it is not known, sigma = 1
    for m/s, and for rad/s what has the same kinetic energy) over the R measured values; `fit`
    minimizes its sum of squares. `residual`, `jacobian`, `log_density` and `to_law` are pure
    functions of x for jit, vmap and grad, and so for any solver or sampler; `start` (P,), `domains`
    (P, 2) and `names` say where to begin, how far x may go, and what it means. `fit(problem)` does
    all that `fit` does. Each of the `priors` adds a value to the residual, `(x_i - mean) / std`.

    Errors S of v- are passed on: with `J = dv+/dv-` of the law, those of a shot have the covariance
    `C = diag(sigma^2) + J S J^T`, and its residual is multiplied by the inverse of the Cholesky
    factor of C (J of the start; `fit` takes J of the law it finds). Of shots whose momentum was
    corrected, `post - K m (post - pre)`, the residual has `(I - K m) J` in the place of J.

    Make one with `from_shots` or `from_observable`. Solvers work on y, x in natural scales; arrays
    of parameters are as long as there are entries in the fitted fields, Q, of which the first P
    count.

    Attributes:
        law: with its start values, and with the parts of the scene that are fitted.
        observe: law -> `Prediction`.
        owner: (Q,) the parameter that each entry of the fields has, -1 where it is fixed.
        fixed: (Q,) the entries at the start.
        scale: (Q,) the size of a change of order 1 of each parameter.
        log: (Q,) whether a parameter is fitted in its logarithm.
        low, high: (Q,) bounds of y.
        matrix: the part of these bounds in which a restitution matrix is admissible, or None.
        measured: what was measured; NaN where no value was.
        weight: 1 / sigma, 0 where no value was measured.
        unit: the largest measured value.
        size: norm of the weights times `unit`: residuals over it are of order 1.
        prior_mean, prior_weight: (Q,) of the parameters; weight 1 / std, 0 without a prior.
        fields: that hold the entries.
        ties: what follows from parameters by the user's functions.
        parameters: which entries are free.
        domains: (P, 2) lowest and highest values.
        sigma: standard errors of what was measured, or None.
        priors: of parameters.
        notes: in words, what was fixed instead of fitted.
        experiments, scene: of shots, or None.
        left_out: labels of shots that were left out.
        mixing: (K, n, n), makes correlated errors of a shot independent, or None.

    >>> import jimpact as ji
    >>> data = ji.Experiments(pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]])
    >>> problem = ji.FitProblem.from_shots(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> problem.names, problem.domains.tolist()
    (('restitution',), [[0.0, 1.0]])
    >>> [round(float(r), 6) for r in problem.residual(problem.start)]
    [-0.25, 0.25, -0.5, 0.5]
    """

    law: Law
    observe: Callable[[Law], Prediction]
    owner: Any
    fixed: Any
    scale: Any
    log: Any
    low: Any
    high: Any
    matrix: AdmissibleMatrices | None
    measured: Any
    weight: Any
    unit: Any
    size: Any
    prior_mean: Any
    prior_weight: Any
    fields: tuple[str, ...] = field(metadata=_STATIC)
    ties: Ties = field(metadata=_STATIC)
    parameters: Parameters = field(metadata=_STATIC)
    domains: np.ndarray = field(metadata=_STATIC)
    sigma: np.ndarray | None = field(metadata=_STATIC)
    priors: tuple[Prior, ...] = field(metadata=_STATIC)
    notes: tuple[str, ...] = field(metadata=_STATIC)
    experiments: Experiments | None = field(default=None, metadata=_STATIC)
    scene: Scene | None = field(default=None, metadata=_STATIC)
    left_out: tuple[str, ...] = field(default=(), metadata=_STATIC)
    mixing: Any = None

    # ------------------------------------------------------------------ how problems are made

    @classmethod
    def from_shots(
        cls,
        law: Law,
        scene: Scene | None,
        experiments: Experiments,
        free: Any = DEFAULT_FREE,
        bounds: Mapping[str, Any] | None = None,
        priors: Mapping[str, Any] | None = None,
        ties: Mapping[str, Any] | None = None,
    ) -> "FitProblem":
        """The problem of measured shots; errors as of `fit`.

        Args:
            law: start values.
            scene: of all shots; None: they carry their own.
            experiments: measured shots.
            free: as in `fit`.
            bounds: as in `fit`.
            priors: as in `fit`.
            ties: as in `fit`.
        """
        problem = of_shots(law, scene, experiments, free, bounds, priors, ties)
        if problem.mixing is None:
            return problem
        return problem.with_errors_before(outcome_at(problem, problem.start).slopes[0])

    @classmethod
    def from_observable(
        cls,
        law: Law,
        observe: Callable[[Law], Any],
        measured: Any,
        sigma: Any = None,
        free: Any = DEFAULT_FREE,
        bounds: Mapping[str, Any] | None = None,
        priors: Mapping[str, Any] | None = None,
        ties: Mapping[str, Any] | None = None,
    ) -> "FitProblem":
        """The problem of a user's own observable, or residual.

        Args:
            law: start values.
            observe: law -> array, differentiable in forward mode; NaN where the law fails. A
                residual is an observable of which zeros were measured.
            measured: what was measured of it, of the same shape; NaN where no value was measured.
            sigma: standard errors, scalar or of the same shape; None: one common, unknown.
            free: as in `fit`.
            bounds: as in `fit`.
            priors: as in `fit`.
            ties: as in `fit`.

        Raises:
            ValueError: no measured value, sigma <= 0, an observable of another shape, and as `fit`.

        >>> import jax.numpy as jnp
        >>> import jimpact as ji
        >>> def height(law):  # of two bounces from 1 m
        ...     return law.restitution ** jnp.array([2, 4])
        >>> problem = ji.FitProblem.from_observable(ji.Newton(0.9), height, [0.49, 0.24], 0.001)
        >>> round(float(ji.fit(problem).law.restitution), 3)
        0.7
        """
        check_kind("law", law, Law)
        check_concrete("law", law)
        check_concrete("measured", measured)
        check_function("observe", observe)
        post = np.asarray(as_float_array("measured", measured))
        check_values("measured", post, nan_allowed=True)
        if not np.isfinite(post).any():
            raise ValueError("Argument `measured` must have at least one value that is not NaN.")
        if sigma is not None:
            sigma = np.asarray(as_float_array("sigma", sigma))
            if sigma.ndim:
                check_shape("sigma", sigma, post.shape, "like `measured`, or a number")
            sigma = np.where(np.isnan(post), 1.0, sigma)
            check_values("sigma", sigma, low=0.0, open_low=True)
        # a stiffness that the user names is one that the function sees
        own = isinstance(observe, eqx.Module)
        observable = observe if own else Observed(observe, free is not DEFAULT_FREE)
        weight = np.where(np.isnan(post), 0.0, 1 / (1.0 if sigma is None else sigma))
        values = _weighed(post, sigma, weight, np.nanmax(np.abs(post)))
        problem = _build(law, observable, values, (free, bounds, priors, ties))
        shape = eqx.filter_eval_shape(observable, law).value.shape
        if shape != post.shape:
            raise ValueError(
                f"Argument `observe` must give values of shape {post.shape} like `measured`, "
                f"but gives shape {shape}."
            )
        return problem

    def of_other(self, data: Experiments, scene: Scene | None) -> "FitProblem":
        """The same of other shots, which is many times quicker than to make it from them.

        Errors of v- count as if there were none; the law and its tolerance stay.

        Args:
            data: shots of as many bodies.
            scene: of all; None: they have their own.
        """
        observe, _, weights = _measured_shots(data, scene)
        arrays = _in(self.low.dtype, {"observe": observe} | weights)
        return replace(self, **arrays, experiments=data, scene=scene)

    def weighed(self, factor: np.ndarray) -> "FitProblem":
        """With factors on the independent errors.

        Args:
            factor: shaped like `measured`; 0 leaves a value out.
        """
        used, mixing, weight = factor > 0, self.mixing, self.weight * factor
        if mixing is not None:  # which comes before the factors
            weight, scale = self.weight * used, np.where(used, factor, 1.0)
            if mixing.ndim == 4:  # of all shots: those left out leave the covariance, too
                mixing = _without(mixing, used & ~np.isnan(self.measured))
            mixing = scale.reshape(scale.shape + (1,) * (mixing.ndim - 2)) * mixing
        measured = np.where(used, self.measured, np.nan)
        arrays = _weighed(measured, self.sigma, weight, self.unit, mixing)
        return replace(self, **_in(self.low.dtype, arrays))

    def with_errors_before(self, slopes: np.ndarray | None) -> "FitProblem":
        """With the errors of v-, if there are any, passed on to v+ by slopes.

        Args:
            slopes: `dv+/dv-` of the shots (K or more, n, n); None: nothing changes.
        """
        data = self.experiments
        if slopes is None or data is None or data.sigma_pre is None:
            return self
        count, n = self.measured.shape
        slope = np.asarray(slopes[:count], float)
        slope = np.where(np.isfinite(slope).all(axis=(1, 2), keepdims=True), slope, np.eye(n))
        # a residual that conserves momentum shows that part of the errors
        kept = kept_by_corrections(data, self.scene)
        gain = kept @ np.concatenate([-slope, np.broadcast_to(np.eye(n), slope.shape)], axis=2)
        covariance = moved_covariance(data.joint, gain)
        own = diagonal_blocks(data.joint, 2 * n)[:, n:, n:]
        rest = (np.eye(n) - kept) @ own @ (np.eye(n) - kept).swapaxes(1, 2)
        each = np.arange(count)
        if covariance.ndim == 4:
            covariance[each, :, each] += rest
        else:
            covariance += rest
        here = ~np.isnan(self.measured)
        sigma, mixing = whitening(covariance, here)
        # factors that a weight already has (shots left out) stay
        old = np.where(here, np.asarray(self.sigma, float), 1.0)
        weight, sigma = self.weight * old / sigma, np.where(here, sigma, np.nan)
        arrays = _weighed(self.measured, sigma, weight, self.unit, mixing)
        return replace(self, **_in(self.low.dtype, arrays))

    def program(self) -> "FitProblem":
        """As compiled functions take it: without what differs between fits of one program.

        Shots are filled up with copies of the last one, of no weight.
        """
        bare = replace(self, **_ON_HOST)
        if not isinstance(self.observe, Shots):
            return bare
        count = len(self.measured)
        last = np.minimum(np.arange(filled_count(count)), count - 1)
        parts = (self.observe, self.measured, self.weight, self.mixing)
        observe, measured, weight, mixing = jax.tree.map(lambda x: np.asarray(x)[last], parts)
        weight[count:] = 0.0
        if mixing is not None and mixing.ndim == 4:
            mixing = mixing[:, :, last]
            mixing[count:] = 0.0  # or a copy would count as the shot
        return replace(bare, observe=observe, measured=measured, weight=weight, mixing=mixing)

    # ------------------------------------------------------------------ functions of x

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters x; contacts are numbered from 1."""
        return self.parameters.names

    @property
    def start(self) -> np.ndarray:
        """x of the law itself."""
        return entries(self.law, self.fields)[self.parameters.first]

    @full_precision
    def law_in_scene(self, x: Any) -> Law:
        """The law with parameters x (P,), and with the parts of the scene that are fitted."""
        x = jnp.asarray(x, self.fixed.dtype)
        values = jnp.where(self.owner >= 0, x[self.owner], self.fixed)
        return tied(with_entries(self.law, self.fields, values), self.ties)

    def to_law(self, x: Any) -> Law:
        """The law with parameters x (P,)."""
        return plain_law(self.law_in_scene(x))

    def to_scene(self, x: Any) -> Scene | None:
        """The scene with parameters x (P,); None where each shot has its own."""
        law = self.law_in_scene(x)
        if self.scene is None or not isinstance(law, LawInScene):
            return self.scene
        return law.in_scene(self.scene)

    def residual(self, x: Any) -> jax.Array:
        """(R,) `(observed - measured) / sigma` at x (P,), then those of the priors.

        Where the law fails, a large number.
        """
        x = jnp.asarray(x, self.low.dtype)
        which = np.array([prior.parameter for prior in self.priors], int)
        of_priors = (x[which] - self.prior_mean[which]) * self.prior_weight[which]
        return jnp.concatenate([self._of_data(x), of_priors])

    def _of_data(self, x: Any) -> jax.Array:
        """The residual of what was measured."""
        residual, _ = self._errors(self.law_in_scene(x))
        return residual[np.flatnonzero(~np.isnan(self.measured))]

    def jacobian(self, x: Any) -> jax.Array:
        """(R, P) derivatives of `residual` at x (P,), by forward mode."""
        return jax.jacfwd(self.residual)(jnp.asarray(x, self.low.dtype))

    def project(self, x: Any) -> jax.Array:
        """The allowed parameters (P,) nearest to x (P,): within bounds, as an admissible matrix.

        Equation: minimize `sum ((z - x) / s)^2` over allowed z; s is the natural scale of each
        parameter, and what is fitted in its logarithm is measured in that. For gradient descent
        of your own (docs/gradient_descent.md). Not differentiable.
        """
        x = jax.lax.stop_gradient(jnp.asarray(x, self.low.dtype))
        y = scaled(jnp.pad(x, (0, len(self.low) - len(x))), self.scale, self.log, jnp)
        inside = jnp.clip(y, self.low, self.high)
        if self.matrix is not None:
            inside = self.matrix.nearest(y, jnp.eye(len(y), dtype=y.dtype), jnp.zeros_like(y))
        return self._values(inside)[: len(x)]

    def log_density(self, x: Any) -> jax.Array:
        """Logarithm () of the probability density of the data at x (P,), normally distributed.

        That of the priors is not in it.

        Equation: `-|r|^2 / 2 - sum log(sigma sqrt(2 pi))`; where sigma is unknown, it is integrated
        over `d sigma / sigma`: `-R log |r|`, up to a constant.
        """
        squares = jnp.sum(self._of_data(x) ** 2)
        if self.sigma is None:
            return -0.5 * self.values * jnp.log(squares)
        here = ~np.isnan(self.measured)
        sigma, other = np.broadcast_to(self.sigma, here.shape), np.zeros(here.shape)
        if self.mixing is not None:
            size = here.size if self.mixing.ndim == 4 else here.shape[1]
            own = np.diagonal(self.mixing.reshape(-1, size, size), axis1=1, axis2=2)
            other = np.log(own.reshape(here.shape))
        constant = np.log(sigma[here] * math.sqrt(2 * math.pi)) - other[here]
        return -0.5 * squares - float(np.sum(constant))

    # ------------------------------------------------------------------ for solvers

    @full_precision
    def _values(self, y: jax.Array) -> jax.Array:
        """x (Q,) of y (Q,)."""
        return unscaled(y, self.scale, self.log, jnp)

    def _errors(self, law: Law) -> tuple[jax.Array, Prediction]:
        """Residual of what was measured, 0 elsewhere, and what the law makes visible."""
        prediction = self.observe(law)
        bad = jnp.broadcast_to(prediction.bad, self.measured.shape)
        error = jnp.where(bad, 0.0, prediction.value) - jnp.where(bad, 0.0, self.measured)
        error = jnp.where(bad, PENALTY * self.unit, error)
        error = jnp.where(self.weight > 0, error, 0.0)  # its derivatives may be NaN
        return _mixed(error * self.weight, self.mixing, jnp).reshape(-1), prediction

    def evaluate(self, y: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
        """At y (Q,): residual (R + Q,) over `size`, Jacobian (R + Q, Q), (values, status).

        The last Q are those of the priors. Where errors of v- are passed on, `dv+/dv-` (K, n, n)
        of the shots comes last: one program compiles an impact once.
        """
        count, passed = y.shape[0], 0 if self.mixing is None else self.mixing.shape[-1]

        def outcome(both: jax.Array) -> tuple[tuple[jax.Array, jax.Array], Any]:
            """Residual and prediction of y and a change of v-, and all not differentiated."""
            moved = self
            if passed:
                pre = self.observe.pre.at[:, :passed].add(both[count:])  # type: ignore[attr-defined]
                moved = eqx.tree_at(lambda problem: problem.observe.pre, self, pre)
            residual, prediction = moved._scaled_residual(both[:count])
            out = residual, prediction.value
            return out, (*out, prediction.status)

        both = jnp.concatenate([y, jnp.zeros(passed, y.dtype)])
        (jacobian, slopes), (residual, *aux) = jax.jacfwd(outcome, has_aux=True)(both)
        if passed:
            aux.append(slopes[..., count:])
        return residual, jacobian[:, :count], tuple(aux)

    def squares(self, y: jax.Array) -> jax.Array:
        """The sum of squares of the residual at `y` (Q,), see `evaluate`; without derivatives."""
        return jnp.sum(self._scaled_residual(y)[0] ** 2)

    def _scaled_residual(self, y: jax.Array) -> tuple[jax.Array, Prediction]:
        """Residual (R + Q,) over `size`, of the priors last, and what the law predicts."""
        x = self._values(y)
        data, prediction = self._errors(forward_only(self.law_in_scene(x)))
        of_priors = (x - self.prior_mean) * self.prior_weight
        return jnp.concatenate([data, of_priors]) / self.size, prediction

    def blank(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, Any]:
        """Zeros shaped like what `evaluate` gives of S such problems at y (S, Q), on the host."""
        (count, q), shape, dtype = y.shape, self.measured.shape[1:], y.dtype
        size = math.prod(shape) + q
        statuses = shape[0] if isinstance(self.observe, Shots) else 1
        aux: Any = (np.zeros((count, *shape), dtype), np.zeros((count, statuses), np.int32))
        if self.mixing is not None:  # dv+/dv- of each shot
            aux += (np.zeros((count, *shape, shape[-1]), dtype),)
        return np.zeros((count, size), dtype), np.zeros((count, size, q), dtype), aux

    def lanes(self, count: int) -> int:
        """How many of `count` such problems are solved side by side.

        Fits of few shots, or of few values in a row, share the program for all; motions take too
        long for that.
        """
        listed = isinstance(self.observe, Shots) or self.measured.ndim == 2
        if listed and self.measured.shape[1] <= FEW:
            many = LANES_OF_MANY if jax.default_backend() == "cpu" else LANES_ON_ACCELERATOR
            return LANES if count <= LANES_OF_MANY else many
        return LANES if count > 1 else 1

    def point(self, x: np.ndarray) -> np.ndarray:
        """y (..., Q) of x (..., P), on the host."""
        every = np.zeros((*x.shape[:-1], len(self.low)))
        every[..., : x.shape[-1]] = x
        return np.asarray(scaled(every, np.asarray(self.scale, float), np.asarray(self.log)))

    def values_at(self, y: np.ndarray) -> np.ndarray:
        """x (..., P) of y (..., Q), on the host."""
        x = unscaled(np.asarray(y, float), np.asarray(self.scale, float), np.asarray(self.log))
        return np.asarray(x)[..., : len(self.names)]

    def steps_at(self, x: np.ndarray) -> np.ndarray:
        """(P,) dx/dy: the natural size of a change of each parameter at x."""
        return np.where(self.parameters.log, x, np.asarray(self.scale, float)[: len(x)])

    # ------------------------------------------------------------------ for judging a fit

    @property
    def values(self) -> int:
        """How many independent values were measured or are priors."""
        here, data = ~np.isnan(self.measured), self.experiments
        lost = 0 if data is None else np.array(data.lost)[here.any(axis=1)].sum()
        return int(here.sum() - lost) + len(self.priors)

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the shots, or of the rows of what was measured."""
        if self.experiments is not None:
            return self.experiments.shots
        return tuple(str(k + 1) for k in range(len(np.atleast_1d(self.measured))))

    def of_data(self, rows: np.ndarray) -> np.ndarray:
        """Those of rows (R, ...), as of a residual, that are of what was measured, in its shape."""
        count = self.measured.size
        return rows[:count].reshape((*self.measured.shape, *rows.shape[1:]))

    def derivatives(self, minimum: Any) -> np.ndarray:
        """Of what was measured in the parameters (K, n, P); NaN where it was not measured.

        Args:
            minimum: with its `jacobian` and `value`.
        """
        slope = self.of_data(minimum.jacobian) / self.steps_at(minimum.value)
        return self.errors_of(slope)

    def independent(self, errors: np.ndarray) -> np.ndarray:
        """Errors of what was measured, in units of sigma and as independent ones.

        Args:
            errors: (K, n, ...), shaped like `measured`, in its units.
        """
        return _mixed(np.nan_to_num(errors) * self._weight_of(errors), self.mixing)

    def errors_of(self, independent: np.ndarray) -> np.ndarray:
        """The errors (K, n, ...) that are these as independent ones; NaN where not measured."""
        weight = self._weight_of(independent)
        back = None if self.mixing is None else _inverse(np.asarray(self.mixing, float))
        errors = _mixed(independent, back)
        return np.where(weight > 0, errors / np.where(weight > 0, weight, 1.0), np.nan)

    def _weight_of(self, errors: np.ndarray) -> np.ndarray:
        """The weights, with as many axes as these errors."""
        more = (1,) * (errors.ndim - self.measured.ndim)
        return np.asarray(self.weight, float).reshape((*self.measured.shape, *more))

    @property
    def precision(self) -> str:
        """'float64' or 'float32', in which all is computed."""
        return str(self.low.dtype)

    @property
    def exact_squares(self) -> float:
        """Sum of squares (in units of sigma) up to which data count as reproduced exactly."""
        return float(EXACT[self.precision] * self.size**2)


def of_shots(
    law: Law, scene: Scene | None, experiments: Experiments, free: Any = DEFAULT_FREE, *known: Any
) -> FitProblem:
    """`FitProblem.from_shots`, but errors of v- count as if v+ had them, until a law is found.

    `known`: bounds, priors and ties.
    """
    check_kind("law", law, Law)
    check_kind("experiments", experiments, Experiments)
    check_concrete("law", law)
    check_concrete("scene", scene)
    law, of_tolerance = tolerated(law, scene, experiments)
    observe, alike, weights = _measured_shots(experiments, scene)
    law = with_parts_of_scene(law, scene, experiments.scenes is not None, free)
    masses = experiments.each(scene, dense_mass)
    energy = max(0.5 * v @ mass @ v for mass, v in zip(masses, np.asarray(experiments.pre))) or 1.0
    problem = _build(law, observe, weights, (free, *known), energy)
    problem = replace(
        problem,
        notes=(*problem.notes, *of_tolerance),
        experiments=experiments,
        scene=scene,
        matrix=matrix_region(problem, alike),
    )
    count, n = experiments.pre.shape
    return problem.with_errors_before(np.tile(np.eye(n), (count, 1, 1)))


def _measured_shots(
    data: Experiments, scene: Scene | None
) -> tuple[Shots, list[Scene], dict[str, Any]]:
    """The observable of shots; their scenes, made alike, of a common one only this; weights."""
    (count, n), pre, weights = data.pre.shape, np.asarray(data.pre), _weighed_shots(data, scene)
    own = data.each(scene, lambda s: s)
    alike, extra = stackable(own if data.scenes is not None else own[:1])
    each = np.arange(count) if len(alike) == count else np.zeros(count, int)
    scenes = jax.tree.map(lambda *x: np.stack(x)[each], *alike)
    filled = np.pad(pre, ((0, 0), (0, extra)), constant_values=weights["unit"])
    return Shots(scenes, filled, n), alike, weights  # type: ignore[arg-type]


def _in(dtype: Any, tree: Any) -> Any:
    """The tree with all numbers of this type, in arrays on the host."""
    return jax.tree.map(lambda x: np.asarray(x, dtype) if eqx.is_inexact_array(x) else x, tree)


def _build(
    law: Law, observe: Any, values: dict[str, Any], choice: tuple[Any, ...], energy: float = 1.0
) -> FitProblem:
    """The problem of weighed values; `choice`: free, bounds, priors, ties."""
    leaves = jax.tree.leaves((law, observe, values["measured"]))
    dtype = np.result_type(*(x.dtype for x in leaves if eqx.is_inexact_array(x)))
    free, bounds, prior, tie = (*choice, *[None] * 4)[:4]
    for name, pairs in (("bounds", bounds), ("priors", prior), ("ties", tie)):
        if pairs is not None:
            check_kind(name, pairs, Mapping)
    ties = checked_ties(law, tie)
    law = tied(law, ties)
    parameters, notes = free_parameters(law, free, getattr(observe, "absolute", False), ties)
    limits = bounds_of(parameters, law, bounds)
    priors = priors_of(parameters, limits, prior)
    limits = limits_with_scene(parameters, law, limits, priors)
    if priors and values["sigma"] is None:
        raise ValueError(
            "Argument `priors` must be left out where no `sigma` (or `resolution`) of the measured "
            "values is known: priors and data weigh against each other by their errors."
        )
    arrays = _of_parameters(law, parameters, limits, priors, energy) | values
    return FitProblem(
        law=_in(dtype, law),
        observe=_in(dtype, observe),
        matrix=None,
        **_in(dtype, arrays),
        fields=parameters.fields,
        ties=ties,
        parameters=parameters,
        domains=np.stack(limits, axis=1),
        priors=priors,
        notes=tuple(notes),
    )


def _weighed(
    measured: np.ndarray, sigma: Any, weight: np.ndarray, unit: Any, mixing: Any = None
) -> dict[str, Any]:
    """What was measured, its weights, and the sizes that follow."""
    unit = np.asarray(float(unit) or 1.0)
    arrays = {"measured": measured, "weight": weight, "unit": unit, "mixing": mixing}
    return arrays | {"size": np.asarray(unit * np.linalg.norm(weight)), "sigma": sigma}


def _weighed_shots(data: Experiments, scene: Scene | None) -> dict[str, Any]:
    """The same of shots."""
    post, sigma = np.asarray(data.post), None if data.sigma is None else np.asarray(data.sigma)
    unit = max(np.abs(np.asarray(data.pre)).max(), np.nanmax(np.abs(post)))
    errors = data.natural_errors(scene) if sigma is None else sigma
    return _weighed(post, sigma, np.where(np.isnan(post), 0.0, 1 / errors), unit)


def _of_parameters(
    law: Law, parameters: Parameters, limits: Limits, priors: tuple[Prior, ...], energy: float
) -> dict[str, Any]:
    """Entries, natural scales, bounds and priors (Q,) of the parameters of a fit."""
    fixed, count = entries(law, parameters.fields), len(parameters.names)
    owner, starts = np.full(len(fixed), -1), fixed[parameters.first]
    natural = np.where(parameters.log, 1.0, np.maximum(np.abs(starts), 1.0))
    for i, (group, name) in enumerate(zip(parameters.groups, parameters.of_fields)):
        owner[list(group)] = i
        natural[i] = energy if name == "initial_energy" else natural[i]
    mean, weight = np.zeros((2, count))
    for prior in priors:
        i = prior.parameter
        mean[i], weight[i] = prior.mean, 1 / prior.std
        if parameters.of_fields[i] in OF_A_SCENE:  # a gap is far smaller than 1 m
            natural[i] = prior.std
    low, high = (scaled(end, natural, parameters.log) for end in limits)
    rest = (0, len(fixed) - count)
    arrays = {"log": parameters.log, "low": low, "high": high}
    arrays |= {"prior_mean": mean, "prior_weight": weight}
    padded = {name: np.pad(array, rest) for name, array in arrays.items()}
    scale = np.pad(natural, rest, constant_values=1.0)
    return {"owner": owner, "fixed": fixed, "scale": scale} | padded


@full_precision
def _mixed(errors: Any, mixing: Any, xp: Any = np) -> Any:
    """Weighted errors (K, n, ...) mixed within each shot, or between all shots."""
    if mixing is None:
        return errors
    axes = "kij,kj...->ki..." if mixing.ndim == 3 else "kilj,lj...->ki..."
    return xp.einsum(axes, mixing, errors)


def _inverse(mixing: np.ndarray) -> np.ndarray:
    """The inverse of mixing within shots (K, n, n), or between all (K, n, K, n)."""
    if mixing.ndim == 3:
        return np.linalg.inv(mixing)
    size = mixing.shape[0] * mixing.shape[1]
    return np.linalg.inv(mixing.reshape(size, size)).reshape(mixing.shape)


def _without(mixing: np.ndarray, here: np.ndarray) -> np.ndarray:
    """Mixing between shots where only the values `here` (K, n) take part."""
    back = _inverse(np.asarray(mixing, float)).reshape(here.size, here.size)
    return whitening((back @ back.T).reshape(mixing.shape), here)[1]
