"""The least-squares problem of a fit: what is observed of a law, against what was
measured.

Shots, a motion and a user's own function are three observables. A point is x, the
values of the P parameters, or y (Q,), the same in the solver's scale: of the Q entries
of the fitted fields the first P count, so that a compiled program does not depend on
which entries are free.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.law import Law, entries, forward_only, with_entries
from jimpact.core.scene import Scene, dense_mass, stackable
from jimpact.fits.errors_before import ErrorsBefore
from jimpact.fits.matrices import AdmissibleMatrices, matrix_region
from jimpact.fits.measurement import Measurement
from jimpact.fits.observables import (
    Observed,
    Prediction,
    Shots,
    filled_count,
    tolerated,
)
from jimpact.fits.parameters import (
    DEFAULT_FREE,
    LawInScene,
    Parameters,
    Prior,
    Ties,
    bounds_of,
    checked_ties,
    free_parameters,
    limits_with_scene,
    plain_law,
    priors_of,
    tied,
    with_parts_of_scene,
)
from jimpact.fits.solve import EXACT, Ends, LeastSquares, Solver, minimize
from jimpact.fits.true_velocities import LawAtShots, law_at_shots
from jimpact.fits.variables import Variables
from jimpact.numerics.derive import without_derivatives
from jimpact.shots.data import Experiments
from jimpact.tools.checks import (
    as_float_array,
    check_concrete,
    check_function,
    check_kind,
    check_shape,
    check_values,
)
from jimpact.tools.compiling import full_precision

# Programs of up to so many shots (or values in a row) are shared by all numbers of
# starts.
FEW = 64

ONLY_FIRST = (
    "A fit with errors of v- must be differentiated once only: its "
    "derivatives hold the true v-."
)

_STATIC = {"static": True}  # fields that are no arrays for JAX
# ... and what a compiled function does not get: it would be compiled anew for each
# value
_ONLY_ON_HOST: dict[str, Any] = dict.fromkeys(
    (
        "matrix",
        "parameters",
        "domains",
        "priors",
        "notes",
        "experiments",
        "scene",
        "left_out",
    )
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class FitProblem:
    """The least-squares problem behind a fit, in the parameters x (P,) themselves.

    Equation: `residual = (observed(law(x)) - measured) / sigma` (where it is not known,
    sigma = 1 for m/s, and for rad/s what has the same kinetic energy) over the R
    measured values; `fit` minimizes its sum of squares. `residual`, `jacobian`,
    `log_density` and `to_law` are pure functions of x for jit, vmap and grad, and so
    for any solver or sampler; `start` (P,), `domains` (P, 2) and `names` say where to
    begin, how far x may go, and what it means. `fit(problem)` does all that `fit` does.
    Each of the `priors` adds a value to the residual, `(x_i - mean) / std`.

    Errors of v- make the true v- of each shot, a, a nuisance that is projected out (see
    `errors_before`): with S the covariance of (v-, v+), J = dv+/dv- of the law at a and
    `A = [-J, I]`, the residual is `F^-1 (v+(a) + J (v- - a) - v+ measured)`,
    `F F^T = A S A^T`. Its derivatives are those of Gauss-Newton, at fixed a and F: the
    gradient of its sum of squares is exact, and second derivatives raise a
    NotImplementedError. Of shots whose momentum was corrected,
    `post - K m (post - pre)`, A is `(I - K m) [-J, I]`.

    Make one with `from_shots` or `from_observable`. Solvers work on y, x in natural
    scales; arrays of parameters are as long as there are entries in the fitted fields,
    Q, of which the first P count.

    Attributes:
        law: with its start values, and with the parts of the scene that are fitted.
        observe: law -> `Prediction`.
        variables: the parameters as a solver sees them.
        measurement: what was measured, and its errors.
        before: errors of (v-, v+) where those of v- count, or None; `measurement` then
            has the errors of v+ for one J: of the start, or where a fit has ended.
        matrix: the part of the box in which a restitution matrix is admissible, or
            None.
        prior_mean, prior_weight: (Q,) of the parameters; weight 1 / std, 0 without a
            prior.
        fields: that hold the entries.
        ties: what follows from parameters by the user's functions.
        parameters: which entries are free.
        domains: (P, 2) lowest and highest values.
        priors: of parameters.
        notes: in words, what was fixed instead of fitted.
        experiments, scene: of shots, or None.
        left_out: labels of shots that were left out.

    >>> import jimpact as ji
    >>> data = ji.Experiments(
    ...     pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]]
    ... )
    >>> problem = ji.FitProblem.from_shots(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> problem.names, problem.domains.tolist()
    (('restitution',), [[0.0, 1.0]])
    >>> [round(float(r), 6) for r in problem.residual(problem.start)]
    [-0.25, 0.25, -0.5, 0.5]
    """

    law: Law
    observe: Callable[[Law], Prediction]
    variables: Variables
    measurement: Measurement
    matrix: AdmissibleMatrices | None
    prior_mean: Any
    prior_weight: Any
    fields: tuple[str, ...] = field(metadata=_STATIC)
    ties: Ties = field(metadata=_STATIC)
    parameters: Parameters = field(metadata=_STATIC)
    domains: np.ndarray = field(metadata=_STATIC)
    priors: tuple[Prior, ...] = field(metadata=_STATIC)
    notes: tuple[str, ...] = field(metadata=_STATIC)
    experiments: Experiments | None = field(default=None, metadata=_STATIC)
    scene: Scene | None = field(default=None, metadata=_STATIC)
    left_out: tuple[str, ...] = field(default=(), metadata=_STATIC)
    before: ErrorsBefore | None = None

    # ------------------------------------------------------------------ how problems
    # are made

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
            free, bounds, priors, ties: as in `fit`.
        """
        problem = of_shots(law, scene, experiments, free, bounds, priors, ties)
        if problem.before is None:
            return problem
        slopes = outcome_at(problem, problem.start).slopes
        assert slopes is not None  # as errors of v- count
        return problem.with_errors_before(slopes[0])

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
            observe: law -> array, differentiable in forward mode; NaN where the law
                fails. A residual is an observable of which zeros were measured.
            measured: what was measured of it, of the same shape; NaN where no value was
                measured.
            sigma: standard errors, scalar or of the same shape; None: one common,
                unknown.
            free, bounds, priors, ties: as in `fit`.

        Raises:
            ValueError: no measured value, sigma <= 0, an observable of another shape,
                and as `fit`.

        >>> import jax.numpy as jnp
        >>> import jimpact as ji
        >>> def height(law):  # of two bounces from 1 m
        ...     return law.restitution ** jnp.array([2, 4])
        >>> problem = ji.FitProblem.from_observable(
        ...     ji.Newton(0.9), height, [0.49, 0.24], 0.001
        ... )
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
            raise ValueError(
                "Argument `measured` must have at least one value that is not NaN."
            )
        if sigma is not None:
            sigma = np.asarray(as_float_array("sigma", sigma))
            if sigma.ndim:
                check_shape("sigma", sigma, post.shape, "like `measured`, or a number")
            sigma = np.where(np.isnan(post), 1.0, sigma)
            check_values("sigma", sigma, low=0.0, open_low=True)
        # a stiffness that the user names is one that the function sees
        is_observable = isinstance(observe, eqx.Module)
        if is_observable:
            observable = observe
        else:
            observable = Observed(observe, free is not DEFAULT_FREE)
        weight = np.where(np.isnan(post), 0.0, 1 / (1.0 if sigma is None else sigma))
        measurement = Measurement.of(post, sigma, weight, np.nanmax(np.abs(post)))
        problem = _build(law, observable, measurement, (free, bounds, priors, ties))
        shape = eqx.filter_eval_shape(observable, law).value.shape
        if shape != post.shape:
            raise ValueError(
                f"Argument `observe` must give values of shape {post.shape} like "
                f"`measured`, but gives shape {shape}."
            )
        return problem

    def of_other(self, data: Experiments, scene: Scene | None) -> "FitProblem":
        """The same problem of other shots; many times quicker than to make it anew.

        Errors of v- count as if there were none; the law and its tolerance stay.

        Args:
            data: shots of as many bodies.
            scene: of all; None: they have their own.
        """
        observe, _, measurement = _measured_shots(data, scene)
        observe, measurement = _in(self.dtype, (observe, measurement))
        return replace(
            self,
            observe=observe,
            measurement=measurement,
            before=None,
            experiments=data,
            scene=scene,
        )

    def weighed(self, factor: np.ndarray) -> "FitProblem":
        """The problem with the residuals multiplied by factors.

        Args:
            factor: shaped like `measured`; 0 leaves a value out. With errors of v-, 0
                or 1.
        """
        return replace(
            self, measurement=_in(self.dtype, self.measurement.weighed(factor))
        )

    def measured_again(
        self,
        measured: np.ndarray,
        prior_mean: np.ndarray,
        pre: np.ndarray | None = None,
    ) -> "FitProblem":
        """The problem with other measured values of the same errors, and other means of
        priors.

        Args:
            measured: shaped like that of the problem.
            prior_mean: (Q,).
            pre: v- (K, n); None: they stay.
        """
        measurement = replace(self.measurement, value=measured)
        again = replace(self, measurement=measurement, prior_mean=prior_mean)
        if pre is None:
            return again
        return again.with_velocities_before(pre)

    def with_velocities_before(self, pre: np.ndarray) -> "FitProblem":
        """The problem of shots with other v-.

        Args:
            pre: v- (K, n).
        """
        assert isinstance(self.observe, Shots)
        velocities = np.array(self.observe.pre)
        velocities[:, : pre.shape[1]] = pre
        return self.with_velocities(velocities)

    def with_velocities(self, pre: Any) -> "FitProblem":
        """The problem of shots with other v- of all coordinates.

        Args:
            pre: v- (K, N), of the coordinates that made scenes alike, too.
        """
        observe = eqx.tree_at(lambda shots: shots.pre, self.observe, pre)
        return replace(self, observe=observe)

    def with_errors_before(self, slopes: np.ndarray | None) -> "FitProblem":
        """The problem whose `measurement` has the errors of v+ with those of v- passed
        on.

        Args:
            slopes: `J = dv+/dv-` of the shots (K or more, n, n); None: nothing changes.
        """
        if slopes is None or self.before is None:
            return self
        covariance = self.before.covariance_after(
            np.asarray(slopes[: len(self.measured)], float)
        )
        changed = self.measurement.with_covariance(covariance)
        return replace(self, measurement=_in(self.dtype, changed))

    def held(self, pre: np.ndarray, slopes: np.ndarray) -> "FitProblem":
        """The problem with the true v- held, as one without errors of v-.

        Equation: v+ measured less `J (v- - a)` is compared with the law at a; the
        errors stay.

        Args:
            pre: a (K, n).
            slopes: J (K, n, n) at a.
        """
        shift = np.einsum("kij,kj->ki", slopes, self.velocities_before - pre)
        measurement = replace(self.measurement, value=self.measured - shift)
        held = replace(self, measurement=measurement, before=None)
        return held.with_velocities_before(pre)

    @property
    def velocities_before(self) -> np.ndarray:
        """Measured v- (K, n)."""
        assert isinstance(self.observe, Shots)
        return np.asarray(self.observe.pre, float)[:, : self.observe.bodies]

    def without_host(self) -> "FitProblem":
        """The problem without what only the host needs."""
        measurement = replace(self.measurement, sigma=None)  # its weights have it
        return replace(self, **_ONLY_ON_HOST, measurement=measurement)

    def for_compiled(self) -> "FitProblem":
        """The problem as an argument of compiled functions, which serve many problems.

        What only the host needs is None. The number of shots is raised to
        `filled_count` by copies of the last one, of no weight.
        """
        bare = self.without_host()
        if not isinstance(self.observe, Shots):
            return bare
        count = len(self.measured)
        shots = np.minimum(np.arange(filled_count(count)), count - 1)
        observe = jax.tree.map(lambda x: np.asarray(x)[shots], self.observe)
        if self.before is None:
            before = None
        else:
            before = self.before.filled(shots)
        return replace(
            bare,
            observe=observe,
            measurement=bare.measurement.filled(shots),
            before=before,
        )

    def least_squares(self) -> LeastSquares:
        """The problem as solvers need it: residual, box and projection in the variables
        y (Q,).
        """
        bare = self.for_compiled()
        low = self.variables.low
        shape = bare.measured.shape
        q = len(low)
        dtype = low.dtype
        is_table = isinstance(self.observe, Shots) or self.measured.ndim == 2
        if isinstance(self.observe, Shots):
            statuses = shape[0]
        else:
            statuses = 1
        # zeros shaped like predictions and status codes, then dv+/dv- and true v- of
        # each shot
        outcomes: Any = (np.zeros(shape, dtype), np.zeros(statuses, np.int32))
        if bare.before is not None:
            outcomes += (np.zeros((*shape, shape[-1]), dtype), np.zeros(shape, dtype))
        # those of the priors of all variables come last
        residual = np.zeros(math.prod(shape) + q, dtype)
        project = None
        if self.matrix is not None:
            project = jax.tree_util.Partial(AdmissibleMatrices.nearest, self.matrix)
        return LeastSquares(
            evaluate=jax.tree_util.Partial(FitProblem.evaluate, bare),
            low=low,
            high=self.variables.high,
            size=self.measurement.size,
            project=project,
            zeros=(residual, np.zeros((len(residual), q), dtype), outcomes),
            short=is_table and shape[1] <= FEW,
        )

    # ------------------------------------------------------------------ functions of x

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters x; contacts are numbered from 1."""
        return self.parameters.names

    @property
    def start(self) -> np.ndarray:
        """x of the law itself."""
        return entries(self.law, self.fields)[self.parameters.first]

    @full_precision
    def law_in_scene(self, x: Any) -> Law:
        """The law with parameters x (P,), and with the parts of the scene that are
        fitted.
        """
        if not isinstance(x, jax.Array):
            x = np.asarray(x)
        values = self.variables.entries(x.astype(self.dtype))
        law = with_entries(self.law, self.fields, values)
        if self.ties:
            return tied(law, self.ties)
        return law

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
        """Residuals `(observed - measured) / sigma` (R,) at x (P,), then those of the
        priors.

        A large number where the law fails.
        """
        x = jnp.asarray(x, self.dtype)
        which = np.array([prior.parameter for prior in self.priors], int)
        of_priors = (x[which] - self.prior_mean[which]) * self.prior_weight[which]
        return jnp.concatenate([self._of_data(x), of_priors])

    def _of_data(self, x: Any) -> jax.Array:
        """The residual of what was measured."""
        measured = np.flatnonzero(self.measurement.is_measured)
        if self.before is not None:
            return self._projected(jnp.asarray(x, self.dtype))[measured]
        return self.measurement.residual(self.observe(self.law_in_scene(x)))[measured]

    @full_precision
    def _projected(self, x: jax.Array) -> jax.Array:
        """The residual from which the true v- are projected out; only its first
        derivatives.
        """

        @jax.custom_jvp
        def residual(x: jax.Array) -> jax.Array:
            """At parameters x (P,)."""
            return self._law_at_shots(self.law_in_scene, x).residual.reshape(-1)

        @residual.defjvp
        def _rule(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
            """The residual and `jacobian dx`; a second derivative raises."""
            x = without_derivatives(primals[0], NotImplementedError(ONLY_FIRST))
            law = self._law_at_shots(self.law_in_scene, x)
            return law.residual.reshape(-1), (law.jacobian @ tangents[0]).reshape(-1)

        return residual(x)

    def _law_at_shots(
        self, law_of: Callable[[jax.Array], Law], x: jax.Array
    ) -> LawAtShots:
        """The law linearized at the true v- that agree best with it and the data."""
        assert isinstance(self.observe, Shots)
        assert self.before is not None
        return law_at_shots(law_of, x, self.observe, self.measurement, self.before)

    def jacobian(self, x: Any) -> jax.Array:
        """(R, P) derivatives of `residual` at x (P,), by forward mode."""
        return jax.jacfwd(self.residual)(jnp.asarray(x, self.dtype))

    def project(self, x: Any) -> jax.Array:
        """The allowed parameters (P,) nearest to x (P,): within bounds, as an
        admissible matrix.

        Equation: minimize `sum ((z - x) / s)^2` over allowed z; s is the natural scale
        of each parameter, and what is fitted in its logarithm is measured in that. For
        gradient descent of your own (docs/gradient_descent.md). Not differentiable.
        """
        x = jax.lax.stop_gradient(jnp.asarray(x, self.dtype))
        y = self.variables.of_parameters(x)
        inside = jnp.clip(y, self.variables.low, self.variables.high)
        if self.matrix is not None:
            inside = self.matrix.nearest(
                y, jnp.eye(len(y), dtype=y.dtype), jnp.zeros_like(y)
            )
        return self.variables.parameters(inside)[: len(x)]

    def log_density(self, x: Any) -> jax.Array:
        """Logarithm () of the probability density of the data at x (P,), normally
        distributed.

        That of the priors is not in it.

        Equation: `-|r|^2 / 2 - sum log(sigma sqrt(2 pi))`; where sigma is unknown, it
        is integrated over `d sigma / sigma`: `-R log |r|`, up to a constant. With
        errors of v- the true v- are the most probable ones, and the sum is that of the
        start: were it that of x, it would draw a restitution down as errors of v- that
        are left out do.
        """
        squares = jnp.sum(self._of_data(x) ** 2)
        if self.sigma is None:
            return -0.5 * self.values * jnp.log(squares)
        return -0.5 * squares - self.measurement.log_of_norm()

    # ------------------------------------------------------------------ for solvers

    def evaluate(self, y: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
        """At y (Q,): residual (R + Q,) over `size`, Jacobian (R + Q, Q), (values,
        status).

        The last Q are those of the priors. With errors of v-, `dv+/dv-` (K, n, n) and
        the true v- (K, n) come last.
        """
        if self.before is not None:
            return self._evaluate_projected(y)

        def outcome(y: jax.Array) -> tuple[jax.Array, Any]:
            """Residual, to be differentiated, and all outcomes as values."""
            residual, prediction = self._scaled_residual(y)
            return residual, (residual, prediction.value, prediction.status)

        jacobian, (residual, *outcomes) = jax.jacfwd(outcome, has_aux=True)(y)
        return residual, jacobian, tuple(outcomes)

    def _evaluate_projected(self, y: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
        """`evaluate` with errors of v-."""

        def law_of(y: jax.Array) -> Law:
            """The law at the variables y (Q,)."""
            return forward_only(self.law_in_scene(self.variables.parameters(y)))

        law = self._law_at_shots(law_of, y)
        residual = jnp.concatenate([law.residual.reshape(-1), self._of_priors(y)])
        of_data = law.jacobian.reshape(-1, len(y))
        jacobian = jnp.concatenate([of_data, jax.jacfwd(self._of_priors)(y)])
        size = self.measurement.size
        outcomes = law.predicted, law.status, law.by_velocities, law.pre
        return residual / size, jacobian / size, outcomes

    def squares(self, y: jax.Array) -> jax.Array:
        """The sum of squares of the residual at `y` (Q,), see `evaluate`; without
        derivatives.

        With errors of v- those that `measurement` has passed on.
        """
        return jnp.sum(self._scaled_residual(y)[0] ** 2)

    def _scaled_residual(self, y: jax.Array) -> tuple[jax.Array, Prediction]:
        """Residual (R + Q,) over `size` at y (Q,), of the priors last, and the
        prediction.
        """
        x = self.variables.parameters(y)
        prediction = self.observe(forward_only(self.law_in_scene(x)))
        residual = jnp.concatenate(
            [self.measurement.residual(prediction), self._of_priors(y)]
        )
        return residual / self.measurement.size, prediction

    def _of_priors(self, y: jax.Array) -> jax.Array:
        """`(x - mean) / std` of the priors (Q,) at y (Q,)."""
        return (self.variables.parameters(y) - self.prior_mean) * self.prior_weight

    def values_at(self, y: np.ndarray) -> np.ndarray:
        """x (..., P) of y (..., Q), on the host."""
        return self.variables.values_at(y)[..., : len(self.names)]

    def steps_at(self, x: np.ndarray) -> np.ndarray:
        """(P,) dx/dy: the natural size of a change of each parameter at x."""
        return np.where(
            self.parameters.log, x, np.asarray(self.variables.scale, float)[: len(x)]
        )

    # ------------------------------------------------------------------ for judging a
    # fit

    measured = property(
        attrgetter("measurement.value"),
        doc="What was measured; NaN where no value was.",
    )
    sigma = property(
        attrgetter("measurement.sigma"),
        doc="Standard errors of what was measured, or None.",
    )

    @property
    def values(self) -> int:
        """Number of independent values: measured ones, less those that corrections
        took; priors.
        """
        measured = self.measurement.is_measured
        data = self.experiments
        if data is None:
            lost = 0
        else:
            lost = np.array(data.lost)[measured.any(axis=1)].sum()
        return int(measured.sum() - lost) + len(self.priors)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the shots, or of the rows of what was measured."""
        if self.experiments is not None:
            return self.experiments.shots
        return tuple(str(k + 1) for k in range(len(np.atleast_1d(self.measured))))

    def of_data(self, rows: np.ndarray) -> np.ndarray:
        """The part of rows (R, ...) of a residual that belongs to `measured`, in its
        shape.
        """
        count = self.measured.size
        return rows[:count].reshape((*self.measured.shape, *rows.shape[1:]))

    def derivatives(self, minimum: Any) -> np.ndarray:
        """Derivatives (K, n, P) of predictions in the parameters; NaN where nothing was
        measured.

        Args:
            minimum: with its `jacobian` and `value`.
        """
        slope = self.of_data(minimum.jacobian) / self.steps_at(minimum.value)
        return self.measurement.errors_of(slope)

    def rms(self, errors: np.ndarray) -> float:
        """The root mean square of errors of what was measured, of rad/s by kinetic
        energy [m/s].
        """
        data = self.experiments
        natural_error = 1.0 if data is None else data.natural_errors(self.scene)
        finite = (errors / natural_error)[np.isfinite(errors)]
        if finite.size:
            return float(np.sqrt(np.mean(finite**2)))
        return np.nan

    @property
    def precision(self) -> str:
        """'float64' or 'float32', in which all is computed."""
        return str(self.dtype)

    dtype = property(
        attrgetter("variables.low.dtype"), doc="Floating type of all numbers."
    )

    @property
    def exact_squares(self) -> float:
        """Sum of squares (in units of sigma) up to which data count as reproduced
        exactly.
        """
        return float(EXACT[self.precision] * self.measurement.size**2)


def outcome_at(problem: FitProblem, x: Any) -> Ends:
    """Residual, Jacobian and predictions at x (P,): a solve of one step with all of y
    fixed.
    """
    point = problem.variables.point(np.asarray(x))[None]
    once = Solver(max_steps=1)
    every = np.ones(point.shape, bool)
    return minimize([problem.least_squares()], point, once, fixed=every)


def of_shots(
    law: Law,
    scene: Scene | None,
    experiments: Experiments,
    free: Any = DEFAULT_FREE,
    *choice: Any,
) -> FitProblem:
    """`FitProblem.from_shots`, but `measurement` has the errors of v+ for
    `dv+/dv- = I`.

    `choice`: bounds, priors and ties.
    """
    check_kind("law", law, Law)
    check_kind("experiments", experiments, Experiments)
    if scene is not None:
        check_kind("scene", scene, Scene)
    check_concrete("law", law)
    check_concrete("scene", scene)
    law, note_on_rtol = tolerated(law, scene, experiments)
    observe, alike, measurement = _measured_shots(experiments, scene)
    law = with_parts_of_scene(law, scene, experiments.scenes is not None, free)
    masses = experiments.each(scene, dense_mass)
    energy = (
        max(0.5 * v @ mass @ v for mass, v in zip(masses, np.asarray(experiments.pre)))
        or 1.0
    )
    problem = _build(law, observe, measurement, (free, *choice), energy)
    problem = replace(
        problem,
        notes=(*problem.notes, *note_on_rtol),
        experiments=experiments,
        scene=scene,
        matrix=matrix_region(
            problem.law, alike, problem.variables, problem.start, problem.ties
        ),
    )
    if experiments.sigma_pre is None:
        return problem
    before = _in(problem.dtype, ErrorsBefore.of(experiments, scene))
    count, n = experiments.pre.shape
    return replace(problem, before=before).with_errors_before(
        np.tile(np.eye(n), (count, 1, 1))
    )


def _measured_shots(
    data: Experiments, scene: Scene | None
) -> tuple[Shots, list[Scene], Measurement]:
    """The observable of shots, their scenes made alike in shape (one if it is common),
    and v+.
    """
    count, n = data.pre.shape
    pre = np.asarray(data.pre)
    post = np.asarray(data.post)
    if data.sigma is None:
        sigma = None
    else:
        sigma = np.asarray(data.sigma)
    if sigma is None:
        errors = data.natural_errors(scene)
    else:
        errors = sigma
    unit = max(np.abs(pre).max(), np.nanmax(np.abs(post)))
    measurement = Measurement.of(
        post, sigma, np.where(np.isnan(post), 0.0, 1 / errors), unit
    )
    of_shots = data.each(scene, lambda s: s)
    # with `extra` coordinates at the end, which move so that their open contacts
    # separate
    alike, extra = stackable(of_shots if data.scenes is not None else of_shots[:1])
    if len(alike) == count:
        of_shot = np.arange(count)
    else:
        of_shot = np.zeros(count, int)
    scenes = jax.tree.map(lambda *x: np.stack(x)[of_shot], *alike)
    filled = np.pad(pre, ((0, 0), (0, extra)), constant_values=measurement.unit)
    return Shots(scenes, filled, n), alike, measurement  # type: ignore[arg-type]


def _in(dtype: Any, tree: Any) -> Any:
    """The tree with its floating-point arrays in this type, on the host."""
    return jax.tree.map(
        lambda x: np.asarray(x, dtype) if eqx.is_inexact_array(x) else x, tree
    )


def _build(
    law: Law,
    observe: Any,
    measurement: Measurement,
    choice: tuple[Any, ...],
    energy: float = 1.0,
) -> FitProblem:
    """The problem of a measurement; `choice`: free, bounds, priors, ties; `energy`: a
    scale [J].
    """
    leaves = jax.tree.leaves((law, observe, measurement.value))
    widest = np.result_type(*(x.dtype for x in leaves if eqx.is_inexact_array(x)))
    dtype = jax.dtypes.canonicalize_dtype(widest)  # float32 where JAX computes in that
    free, bounds, prior, tie = (*choice, *[None] * 4)[:4]
    for name, pairs in (("bounds", bounds), ("priors", prior), ("ties", tie)):
        if pairs is not None:
            check_kind(name, pairs, Mapping)
    ties: Ties = ()
    if tie:
        ties = checked_ties(law, tie)
        law = tied(law, ties)
    parameters, notes = free_parameters(
        law, free, getattr(observe, "absolute", False), ties
    )
    limits = bounds_of(parameters, law, bounds)
    if prior:
        priors = priors_of(parameters, limits, prior)
    else:
        priors = ()
    if isinstance(law, LawInScene):
        limits = limits_with_scene(parameters, law, limits, priors)
    if priors and measurement.sigma is None:
        raise ValueError(
            "Argument `priors` must be left out where no `sigma` (or `resolution`) of "
            "the measured values is known: priors and data weigh against each other by "
            "their errors."
        )
    fixed = entries(law, parameters.fields)
    mean, weight = np.zeros((2, len(fixed)))
    for each in priors:
        mean[each.parameter], weight[each.parameter] = each.mean, 1 / each.std
    problem = FitProblem(
        law=law,
        observe=observe,
        variables=Variables.of(fixed, parameters, limits, priors, energy),
        measurement=measurement,
        matrix=None,
        prior_mean=mean,
        prior_weight=weight,
        fields=parameters.fields,
        ties=ties,
        parameters=parameters,
        domains=np.stack(limits, axis=1),
        priors=priors,
        notes=tuple(notes),
    )
    return _in(dtype, problem)
