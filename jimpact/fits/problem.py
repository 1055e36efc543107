"""The least-squares problem of a fit: what is observed of a law, against what was measured.

Shots, a motion and a user's own function are three observables. Solvers see `Residuals`: arrays
alone, in scaled parameters, several problems side by side in the lanes of one program; people see
`FitProblem`: the same in the parameters themselves, with their names.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_concrete, check_kind, check_values
from jimpact.compiling import full_precision, quick_jit
from jimpact.files.study_file import OF_A_SCENE
from jimpact.fits.experiments import Experiments, kept_by_corrections
from jimpact.fits.matrix_fit import matrix_region
from jimpact.fits.parameters import (
    DEFAULT_FREE,
    Parameters,
    Prior,
    bounds_of,
    entries,
    free_parameters,
    priors_of,
    with_entries,
)
from jimpact.fits.scene_parameters import (
    REACH,
    LawInScene,
    placed,
    plain_law,
    with_parts_of_scene,
)
from jimpact.fits.solve import EXACT, BoxRegion, Region
from jimpact.fits.ties import Ties, checked_ties, entry_of, tied
from jimpact.fits.tolerances import tolerated
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.scene import Scene, dense_mass, stackable
from jimpact.status import CODE

# Outcomes whose velocities are meaningless. A trial with one of them gets a residual far above any
# honest one, so that a solver turns back; inadmissible or energetic outcomes are only reported.
UNUSABLE = ("infeasible", "max_steps", "not_finite")
PENALTY = 1e3  # times the largest measured value

# Shots are filled up to 4, 8, 16, ... of them: a program serves all numbers in between, and the
# copies that fill up cost far less than compiling another one.
FEWEST, FEW = 4, 64
# Problems that a program solves side by side: starts of one, and many problems. With ten times
# more of them, all wait for the one whose impacts take longest.
LANES, LANES_OF_MANY = 4, 64


class Prediction(NamedTuple):
    """What a law predicts: values, where they are meaningless, and status codes (S,)."""

    value: jax.Array
    bad: jax.Array
    status: jax.Array


class Shots(eqx.Module):
    """The observable of impacts: v+ (K, n)."""

    scenes: Scene  # stacked, one for each shot
    pre: jax.Array  # (K, n), further columns where scenes were made alike
    bodies: int = eqx.field(static=True)

    def __call__(self, law: Law) -> Prediction:
        """Velocities after every shot, and the status of its impact."""
        law, scenes = placed(law, self.scenes)
        out = jax.vmap(impact, in_axes=(None, 0, 0))(law, scenes, self.pre)
        bad = meaningless(out.status)
        return Prediction(out.velocity[:, : self.bodies], bad[:, None], out.status)


def meaningless(status: jax.Array) -> jax.Array:
    """Whether velocities with these codes (K,) are meaningless."""
    codes = jnp.asarray([CODE[name] for name in UNUSABLE], status.dtype)
    return jnp.any(status[:, None] == codes[None, :], axis=1)


class Observed(eqx.Module):
    """The observable of a user's own function of a law.

    `absolute`: it may see absolute stiffnesses (a force, a time), not only their ratios.
    """

    function: Callable[[Law], Any] = eqx.field(static=True)
    absolute: bool = eqx.field(static=True, default=False)

    def __call__(self, law: Law) -> Prediction:
        """The value of the function; NaN counts as meaningless."""
        value = jnp.asarray(self.function(law))
        return Prediction(value, ~jnp.isfinite(value), jnp.zeros(1, jnp.int32))


Observable = Callable[[Law], Prediction]


class Residuals(eqx.Module):
    """Law, observable and region of a fit: a pytree that compiled functions take as argument.

    Solvers work on y (Q,), of which the first P count, the rest is 0. The entries of the law's
    fields in scaled form are `offset + mix y`; an entry is `scale` times that, or its exponential
    where `log` is set. Entries that are tied follow from these. A prior weighs the value of the
    entry that stands for its parameter.
    """

    law: Law
    mix: jax.Array
    offset: jax.Array
    scale: jax.Array
    log: jax.Array
    low: jax.Array  # bounds of y
    high: jax.Array
    region: Region  # where y may lie: the box, or a part of it
    observe: Observable
    measured: jax.Array  # 0 where not measured
    weight: jax.Array  # 0 where not measured; makes |r|^2 a mean square relative to `unit`
    size: jax.Array  # () size r is (prediction - measured) / sigma, with sigma = 1 where unknown
    unit: jax.Array  # () the largest measured value
    prior_mean: jax.Array  # (Q,) of entries
    prior_weight: jax.Array  # (Q,) 1 / standard deviation, 0 where there is no prior
    fields: tuple[str, ...] = eqx.field(static=True)
    mixing: jax.Array | None = None  # (K, n, n): makes correlated errors of a shot independent
    ties: Ties = eqx.field(static=True, default=())

    @full_precision
    def entries_at(self, y: jax.Array) -> jax.Array:
        """The entries (Q,) of scaled parameters y, before those that are tied follow."""
        scaled = self.offset + self.mix @ y
        exponential = jnp.exp(jnp.where(self.log, scaled, 0.0))
        return jnp.where(self.log, exponential, scaled * self.scale)

    def law_of(self, values: Any) -> Law:
        """The law of entries (Q,)."""
        return tied(with_entries(self.law, self.fields, values), self.ties)

    def law_at(self, y: jax.Array) -> Law:
        """The law of scaled parameters y."""
        return self.law_of(self.entries_at(y))

    def prior_residual(self, y: jax.Array) -> jax.Array:
        """Weighted distances (Q,) from the priors."""
        return (self.entries_at(y) - self.prior_mean) * self.prior_weight / self.size

    def residual(self, y: jax.Array) -> tuple[jax.Array, Prediction]:
        """Weighted residual (R,) of what was measured, and what the law makes visible."""
        prediction = self.observe(self.law_at(y))
        bad = jnp.broadcast_to(prediction.bad, self.measured.shape)
        harmless = jnp.where(bad, self.measured, prediction.value)
        error = jnp.where(bad, PENALTY * self.unit, harmless - self.measured)
        error = jnp.where(self.weight > 0, error, 0.0)  # its derivatives may be NaN
        return self.mixed(error * self.weight).reshape(-1), prediction

    @full_precision
    def mixed(self, weighted: Any) -> Any:
        """Weighted errors, shaped like what was measured, as independent ones."""
        if self.mixing is None:
            return weighted
        return (self.mixing @ weighted[..., None])[..., 0]

    def evaluate(self, y: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
        """Weighted residual (R + Q,), its Jacobian (R + Q, Q), and (predicted values, status).

        The last Q are those of the priors. Where errors of v- are passed on, `dv+/dv-` (K, n, n)
        of the shots comes last: one program compiles an impact once.
        """
        count, passed = y.shape[0], 0 if self.mixing is None else self.mixing.shape[-1]

        def outcome(y_and_shift: jax.Array) -> tuple[tuple[jax.Array, jax.Array], Any]:
            """Residual and prediction of y and a change of v-, and all not differentiated."""
            y, shift = y_and_shift[:count], y_and_shift[count:]
            data, prediction = (self.shifted(shift) if passed else self).residual(y)
            residual = jnp.concatenate([data, self.prior_residual(y)])
            out = residual, prediction.value
            return out, (*out, prediction.status)

        both = jnp.concatenate([y, jnp.zeros(passed, y.dtype)])
        (jacobian, slopes), (residual, *aux) = jax.jacfwd(outcome, has_aux=True)(both)
        if passed:
            aux.append(slopes[..., count:])
        return residual, jacobian[:, :count], tuple(aux)

    def blank(self, y: np.ndarray) -> tuple[Any, Any, Any]:
        """Zeros shaped like what `evaluate` gives of S such problems at y (S, Q), on the host."""
        (count, q), shape, dtype = y.shape, self.measured.shape[1:], y.dtype
        size = math.prod(shape) + q
        statuses = shape[0] if isinstance(self.observe, Shots) else 1
        aux: Any = (np.zeros((count, *shape), dtype), np.zeros((count, statuses), np.int32))
        if self.mixing is not None:
            aux += (np.zeros(np.shape(self.mixing), dtype),)
        return np.zeros((count, size), dtype), np.zeros((count, size, q), dtype), aux

    def lanes(self, count: int) -> int:
        """How many of `count` such problems are solved side by side.

        Fits of few shots, or of few values in a row, share the program for all; motions take too
        long for that.
        """
        listed = isinstance(self.observe, Shots) or self.measured.ndim == 2
        if listed and self.measured.shape[1] <= FEW:
            return LANES if count <= LANES_OF_MANY else LANES_OF_MANY
        return LANES if count > 1 else 1

    def shifted(self, shift: jax.Array) -> "Residuals":
        """With this change (n,) of the velocities before all shots."""
        pre = self.observe.pre  # type: ignore[attr-defined]
        return eqx.tree_at(lambda r: r.observe.pre, self, pre.at[:, : shift.shape[0]].add(shift))


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

    Make one with `from_shots` or `from_observable`. It holds what was `measured` (NaN where no
    value was), `sigma`, `experiments` and `scene` or None, how many independent `values`
    were measured or are priors; in words, `notes` on what was fixed instead of fitted, and shots
    `left_out`; and for the solvers `residuals` and `parameters`.

    >>> import jimpact as ji
    >>> data = ji.Experiments(pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]])
    >>> problem = ji.FitProblem.from_shots(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> problem.names, problem.domains.tolist()
    (('restitution',), [[0.0, 1.0]])
    >>> [round(float(r), 6) for r in problem.residual(problem.start)]
    [-0.25, 0.25, -0.5, 0.5]
    """

    residuals: Residuals
    parameters: Parameters
    notes: tuple[str, ...]  # what was fixed instead of fitted
    domains: np.ndarray
    measured: np.ndarray  # NaN where not
    sigma: np.ndarray | None
    values: int  # independent measured values, and priors
    experiments: Experiments | None = None
    scene: Scene | None = None
    left_out: tuple[str, ...] = ()  # which shots, in words
    priors: tuple[Prior, ...] = ()

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
        return problem.passing_errors_at(problem.point(problem.start))

    def with_errors_before(self, slopes: np.ndarray | None) -> "FitProblem":
        """With the errors of v-, if there are any, passed on to v+ by slopes.

        Args:
            slopes: `dv+/dv-` of the shots (K or more, n, n); None: nothing changes.
        """
        data, r = self.experiments, self.residuals
        if slopes is None or data is None or data.sigma_pre is None:
            return self
        count, n = self.measured.shape
        slope = np.asarray(slopes[:count], float)
        slope = np.where(np.isfinite(slope).all(axis=(1, 2), keepdims=True), slope, np.eye(n))
        for k, kept in enumerate(kept_by_corrections(data, self.scene)):
            if kept is not None:  # a residual that conserves momentum shows that part of the errors
                slope[k] = kept @ slope[k]
        here = ~np.isnan(self.measured)
        before = slope * np.asarray(data.sigma_pre, float)[:, None, :]
        variance = np.where(here, np.asarray(data.sigma, float), 1.0) ** 2
        both = np.where(here[:, :, None] & here[:, None, :], before @ before.swapaxes(1, 2), 0.0)
        covariance = both + variance[:, :, None] * np.eye(n)
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        factor = np.linalg.cholesky(covariance / (sigma[:, :, None] * sigma[:, None, :]))
        # factors that a weight already has (shots left out) stay
        old = np.where(here, np.asarray(self.sigma, float), 1.0)
        weight = self.weight * old / sigma
        size = float(r.unit) * np.linalg.norm(weight)
        mixing = jnp.asarray(np.linalg.inv(factor), r.weight.dtype)
        arrays = (jnp.asarray(weight / size, r.weight.dtype), jnp.asarray(size, r.size.dtype))
        residuals = eqx.tree_at(
            lambda r: (r.weight, r.size, r.mixing),
            r,
            (*arrays, mixing),
            is_leaf=lambda x: x is None,
        )
        return replace(self, residuals=residuals, sigma=np.where(here, sigma, np.nan))

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
        post = np.asarray(as_float_array("measured", measured))
        check_values("measured", post, nan_allowed=True)
        if not np.isfinite(post).any():
            raise ValueError("Argument `measured` must have at least one value that is not NaN.")
        if sigma is not None:
            sigma = np.where(np.isnan(post), 1.0, np.asarray(as_float_array("sigma", sigma)))
            check_values("sigma", sigma, low=0.0, open_low=True)
        # a stiffness that the user names is one that the function sees
        absolute = free is not DEFAULT_FREE
        own = isinstance(observe, eqx.Module)
        observable = observe if own else Observed(observe, absolute)
        unit = np.nanmax(np.abs(post)) or 1.0
        dtype = _dtype(law, observable, post)
        errors = np.ones(()) if sigma is None else sigma
        choice = _choice(law, observable, free, bounds, priors, ties)
        problem = _build(choice, observable, post, sigma, errors, dtype, unit, 1.0, [])
        shape = eqx.filter_eval_shape(observable, law).value.shape
        if shape != post.shape:
            raise ValueError(
                f"Argument `observe` must give values of shape {post.shape} like `measured`, "
                f"but gives shape {shape}."
            )
        return problem

    @property
    def law(self) -> Law:
        """The law with its start values, and with the parts of the scene that are fitted."""
        return self.residuals.law

    @property
    def value_name(self) -> str:
        """What one of the measured values is."""
        return "value" if self.experiments is None else "velocity"

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the shots, or of the rows of what was measured."""
        if self.experiments is not None:
            return self.experiments.shots
        rows = self.measured.shape[0] if self.measured.ndim else 1
        return getattr(self.residuals.observe, "labels", None) or tuple(
            str(k + 1) for k in range(rows)
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters x; contacts are numbered from 1."""
        return self.parameters.names

    @property
    def start(self) -> np.ndarray:
        """x of the law itself."""
        return entries(self.law, self.parameters.fields)[self.parameters.first]

    def to_law(self, x: Any) -> Law:
        """The law with parameters x (P,)."""
        return plain_law(self.law_in_scene(x))

    def to_scene(self, x: Any) -> Scene | None:
        """The scene with parameters x (P,); None where each shot has its own."""
        law = self.law_in_scene(x)
        if self.scene is None or not isinstance(law, LawInScene):
            return self.scene
        return law.in_scene(self.scene)

    def law_in_scene(self, x: Any) -> Law:
        """The law with parameters x (P,), and with the parts of the scene that are fitted."""
        return self.residuals.law_at(self._scaled(x))

    def residual(self, x: Any) -> jax.Array:
        """(R,) `(observed - measured) / sigma` at x (P,), then those of the priors.

        Where the law fails, a large number.
        """
        return jnp.concatenate([self._of_data(x), self._of_priors(x)])

    def _of_data(self, x: Any) -> jax.Array:
        """The residual of what was measured."""
        residual, _ = self.residuals.residual(self._scaled(x))
        return self.residuals.size * residual[np.flatnonzero(~np.isnan(self.measured))]

    def _of_priors(self, x: Any) -> jax.Array:
        """The residual of the priors."""
        first = np.array([self.parameters.first[p.parameter] for p in self.priors], int)
        return self.residuals.size * self.residuals.prior_residual(self._scaled(x))[first]

    def jacobian(self, x: Any) -> jax.Array:
        """(R, P) derivatives of `residual` at x (P,), by forward mode."""
        return jax.jacfwd(self.residual)(jnp.asarray(x, self.residuals.offset.dtype))

    def project(self, x: Any) -> jax.Array:
        """The allowed parameters (P,) nearest to x (P,): within bounds, as an admissible matrix.

        Equation: minimize `sum ((z - x) / s)^2` over allowed z; s is the natural scale of each
        parameter, and what is fitted in its logarithm is measured in that. For gradient descent
        of your own (docs/gradient_descent.md). Not differentiable.
        """
        y = self._scaled(jax.lax.stop_gradient(jnp.asarray(x, self.residuals.offset.dtype)))
        first = np.array(self.parameters.first)
        return self.residuals.entries_at(self.residuals.region.nearest(y))[first]

    def log_density(self, x: Any) -> jax.Array:
        """Logarithm () of the probability density of the data at x (P,), normally distributed.

        That of the priors is not in it.

        Equation: `-|r|^2 / 2 - sum log(sigma sqrt(2 pi))`; where sigma is unknown, it is integrated
        over `d sigma / sigma`: `-R log |r|`, up to a constant.
        """
        squares = jnp.sum(self._of_data(x) ** 2)
        if self.sigma is None:
            return -0.5 * self.values * jnp.log(squares)
        sigma = np.broadcast_to(self.sigma, self.measured.shape)[~np.isnan(self.measured)]
        other = np.zeros_like(self.measured)
        if self.residuals.mixing is not None:
            other = np.log(np.diagonal(self.residuals.mixing, axis1=1, axis2=2))
        constant = np.log(sigma * math.sqrt(2 * math.pi)) - other[~np.isnan(self.measured)]
        return -0.5 * squares - float(np.sum(constant))

    @property
    def shot_of_value(self) -> np.ndarray:
        """(R,) the shot (or row, from 0) of every measured value."""
        here = ~np.isnan(self.measured)
        return np.nonzero(here)[0] if here.ndim else np.zeros(1, int)

    def prior_errors(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of each prior: its mean less x (P,), and the derivatives of x (., P), over its std."""
        means, stds = (np.array([p[k] for p in self.priors], float) for k in (1, 2))
        which = np.array([p.parameter for p in self.priors], int)
        return (means - x[which]) / stds, np.eye(len(self.names))[which] / stds[:, None]

    @property
    def ties(self) -> Ties:
        """What follows from parameters by the user's functions."""
        return self.residuals.ties

    @property
    def weight(self) -> np.ndarray:
        """1 / sigma, shaped like `measured`; 0 where no value was measured."""
        return np.asarray(self.residuals.weight, float) * self.size

    def independent(self, errors: np.ndarray) -> np.ndarray:
        """Errors of what was measured, in units of sigma and as independent ones.

        Args:
            errors: (K, n, ...), shaped like `measured`, in its units.
        """
        more = (1,) * (errors.ndim - self.measured.ndim)
        scaled = np.nan_to_num(errors) * self.weight.reshape((*self.measured.shape, *more))
        mixing = self.residuals.mixing
        return scaled if mixing is None else np.einsum("kij,kj...->ki...", mixing, scaled)

    def errors_of(self, independent: np.ndarray) -> np.ndarray:
        """The errors (K, n, ...) that are these as independent ones; NaN where not measured."""
        more = (1,) * (independent.ndim - self.measured.ndim)
        weight = self.weight.reshape((*self.measured.shape, *more))
        if self.residuals.mixing is not None:
            back = np.linalg.inv(np.asarray(self.residuals.mixing, float))
            independent = np.einsum("kij,kj...->ki...", back, independent)
        return np.where(weight > 0, independent / np.where(weight > 0, weight, 1.0), np.nan)

    def passing_errors_at(self, y: Any) -> "FitProblem":
        """With errors of v-, if there are any, passed on as the law of y (Q,) does."""
        if self.residuals.mixing is None:
            return self
        law = self.residuals.law_at(jnp.asarray(y, self.residuals.offset.dtype))
        return self.with_errors_before(slopes_before(law, filled_up(self.residuals).observe))

    def weighed(self, factor: np.ndarray) -> "FitProblem":
        """With factors on the independent errors.

        Args:
            factor: shaped like `measured`; 0 leaves a value out.
        """
        r, used = self.residuals, factor > 0
        mixing: Any = r.mixing
        weight = self.weight * factor
        if mixing is not None:  # which comes before the factors
            weight = self.weight * used
            mixing = np.asarray(np.where(used, factor, 1.0)[..., None] * mixing, r.weight.dtype)
        size = float(r.unit) * np.linalg.norm(weight)
        arrays = (np.asarray(weight / size, r.weight.dtype), np.asarray(size, r.size.dtype), mixing)
        measured = np.where(used, self.measured, np.nan)
        lost = int(np.isnan(measured).sum() - np.isnan(self.measured).sum())
        if self.experiments is not None:  # whole shots are left out, with what a correction took
            gone = np.isnan(measured).all(axis=1) & ~np.isnan(self.measured).all(axis=1)
            lost -= int(np.array(self.experiments.lost)[gone].sum())
        residuals = eqx.tree_at(
            lambda r: (r.weight, r.size, r.mixing), r, arrays, is_leaf=lambda x: x is None
        )
        return replace(self, residuals=residuals, measured=measured, values=self.values - lost)

    @property
    def size(self) -> float:
        """Weighted residuals of the solvers times this are in units of sigma."""
        return float(self.residuals.size)

    @property
    def precision(self) -> str:
        """'float64' or 'float32', in which all is computed."""
        return str(self.residuals.offset.dtype)

    @property
    def exact_squares(self) -> float:
        """Sum of squares (in units of sigma) up to which data count as reproduced exactly."""
        return EXACT[self.precision] * self.size**2

    @property
    def log(self) -> np.ndarray:
        """(P,) whether a parameter is fitted in its logarithm."""
        return np.asarray(self.residuals.log)[self.parameters.first]

    @property
    def scale(self) -> np.ndarray:
        """(P,) the size of a change of order 1; 1 where fitted in the logarithm."""
        return np.asarray(self.residuals.scale, float)[self.parameters.first]

    def point(self, values: np.ndarray) -> np.ndarray:
        """y (..., Q) of values (..., P), on the host."""
        y = np.zeros((*values.shape[:-1], len(self.residuals.offset)))
        y[..., : len(self.names)] = to_scaled(values, self.scale, self.log)
        return y

    def values_at(self, y: np.ndarray) -> np.ndarray:
        """Values (..., P) of y (..., Q), on the host."""
        y = np.asarray(y, float)
        return from_scaled(y[..., : len(self.names)], self.scale, self.log)

    def _scaled(self, x: Any) -> jax.Array:
        """y (Q,) of x (P,)."""
        r, first = self.residuals, np.asarray(self.parameters.first)
        x = jnp.asarray(x, r.offset.dtype)
        log = r.log[first]
        y = jnp.where(log, jnp.log(jnp.where(log, x, 1.0)), x / r.scale[first])
        return jnp.zeros_like(r.offset).at[: len(first)].set(y)


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
    scenes = experiments.each(scene, lambda s: s)
    same = experiments.scenes is None
    fixed, law = law, with_parts_of_scene(law, scene, not same, free)
    alike, extra = stackable(scenes[:1] if same else scenes)
    dtype = _dtype(law, alike, experiments.pre)
    pre, post = np.asarray(experiments.pre), np.asarray(experiments.post)
    unit = max(np.abs(pre).max(), np.nanmax(np.abs(post))) or 1.0
    count, n = pre.shape
    masses = experiments.each(scene, dense_mass)
    energy = max(0.5 * v @ mass @ v for mass, v in zip(masses, pre)) or 1.0
    stacked = jax.tree.map(
        lambda *x: np.repeat(np.stack(x), count, axis=0) if same else np.stack(x), *alike
    )
    filled = np.pad(pre, ((0, 0), (0, extra)), constant_values=unit)
    observe = Shots(_in(dtype, stacked), np.asarray(filled, dtype), n)  # type: ignore[arg-type]
    sigma = None if experiments.sigma is None else np.asarray(experiments.sigma)
    errors = experiments.natural_errors(scene) if sigma is None else sigma
    choice = _choice(law, observe, free, *known)
    if law is not fixed:
        choice = choice._replace(limits=_limits_of_scene(choice))
    problem = _build(choice, observe, post, sigma, errors, dtype, unit, energy, alike)
    values = problem.values - experiments.lost_freedom
    notes = (*problem.notes, *of_tolerance)
    problem = replace(problem, notes=notes, values=values, experiments=experiments, scene=scene)
    return problem.with_errors_before(np.tile(np.eye(n), (count, 1, 1)))


def _dtype(*trees: Any) -> np.dtype:
    """The type of all floating numbers in these trees."""
    leaves = [x for x in jax.tree.leaves(trees) if eqx.is_inexact_array(x)]
    return np.result_type(*(x.dtype for x in leaves))


def _in(dtype: np.dtype, tree: Any) -> Any:
    """The tree with all numbers of this type, in arrays on the host."""
    return jax.tree.map(lambda x: np.asarray(x, dtype) if eqx.is_inexact_array(x) else x, tree)


class _Choice(NamedTuple):
    """What is fitted of a law: parameters, their limits and priors, and what follows from them."""

    law: Law  # with the values at the start
    parameters: Parameters
    notes: list[str]
    limits: tuple[np.ndarray, np.ndarray]
    priors: tuple[Prior, ...]
    ties: Ties


def _choice(
    law: Law,
    observe: Observable,
    free: Any,
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    ties: Mapping[str, Any] | None = None,
) -> _Choice:
    """The user's choices, checked."""
    functions = checked_ties(law, ties)
    law = tied(law, functions)
    absolute = getattr(observe, "absolute", False)
    parameters, notes = free_parameters(law, free, absolute, functions)
    limits = bounds_of(parameters, law, bounds)
    return _Choice(law, parameters, notes, limits, priors_of(parameters, limits, priors), functions)


def _limits_of_scene(choice: _Choice) -> tuple[np.ndarray, np.ndarray]:
    """Limits of all parameters, those of the scene no farther away than their priors allow.

    Raises:
        ValueError: a part of the scene without a prior, or far from it at the start.
    """
    parameters, priors = choice.parameters, {prior.parameter: prior for prior in choice.priors}
    low, high = (end.copy() for end in choice.limits)
    start = entries(choice.law, parameters.fields)[parameters.first]
    for i, name in enumerate(parameters.names):
        if parameters.field_of(i) not in OF_A_SCENE:
            continue
        if i not in priors:
            raise ValueError(
                f"Argument `priors` must have (mean, standard deviation) for `{name}`, a part of "
                "the scene that is fitted with the law."
            )
        _, mean, std = priors[i]
        low[i], high[i] = max(low[i], mean - REACH * std), min(high[i], mean + REACH * std)
        if not low[i] <= start[i] <= high[i]:
            raise ValueError(
                f"Argument `priors` must have a mean for `{name}` within {REACH:g} standard "
                f"deviations of its value in the scene, {start[i]:g}, but has {mean:g} ± {std:g}."
            )
    return low, high


def _build(
    choice: _Choice,
    observe: Observable,
    measured: np.ndarray,
    sigma: np.ndarray | None,
    errors: np.ndarray,
    dtype: np.dtype,
    unit: float,
    energy: float,
    scenes: list[Scene],
) -> FitProblem:
    """Arrays, weights and natural scales of a fit."""
    law, parameters, notes, limits, priors, ties = choice
    if priors and sigma is None:
        raise ValueError(
            "Argument `priors` must be left out where no `sigma` (or `resolution`) of the measured "
            "values is known: priors and data weigh against each other by their errors."
        )
    law = _in(dtype, law)
    here = ~np.isnan(measured)
    weight = np.where(here, 1 / np.where(here, errors, 1.0), 0.0)
    size = unit * np.linalg.norm(weight)
    values = entries(law, parameters.fields)
    scale, log = _scales(parameters, values, energy)
    for prior in priors:
        if parameters.field_of(prior.parameter) in OF_A_SCENE:  # a gap is far smaller than 1 m
            scale[list(parameters.groups[prior.parameter])] = prior.std
    offset, mix = to_scaled(values, scale, log), np.zeros((len(values), len(values)))
    for i, group in enumerate(parameters.groups):
        mix[list(group), i], offset[list(group)] = 1.0, 0.0
    ends = np.zeros((2, len(values)))
    first, count = parameters.first, len(parameters.names)
    ends[:, :count] = [to_scaled(end, scale[first], log[first]) for end in limits]
    arrays = _prior_arrays(priors, first, len(values)) | {"size": size, "unit": unit}
    arrays |= {"mix": mix, "offset": offset, "scale": scale, "low": ends[0], "high": ends[1]}
    arrays |= {"measured": np.nan_to_num(measured), "weight": weight / size}
    region = matrix_region(law, scenes, scale * offset, scale[:, None] * mix, ends)
    if region is not None and any(entry_of(name)[0] == "matrix" for name, _ in ties):
        raise ValueError("Argument `ties` must not tie a `matrix` that has to stay admissible.")
    host: dict[str, Any] = {name: np.asarray(array, dtype) for name, array in arrays.items()}
    residuals = Residuals(
        law=law,
        region=region or BoxRegion(host["low"], host["high"]),
        log=log,  # type: ignore[arg-type]
        observe=observe,
        fields=parameters.fields,
        ties=ties,
        **host,
    )
    domains, values_known = np.stack(limits, axis=1), int(here.sum()) + len(priors)
    return FitProblem(
        residuals,
        parameters,
        tuple(notes),
        domains,
        measured,
        sigma,
        values_known,
        priors=priors,
    )


def _prior_arrays(priors: tuple[Prior, ...], first: Any, count: int) -> dict[str, np.ndarray]:
    """Mean and 1 / std (count,) of the priors, each at its parameter's first entry."""
    mean, weight = np.zeros((2, count))
    for prior in priors:
        mean[first[prior.parameter]], weight[first[prior.parameter]] = prior.mean, 1 / prior.std
    return {"prior_mean": mean, "prior_weight": weight}


def _scales(
    parameters: Parameters, values: np.ndarray, energy: float
) -> tuple[np.ndarray, np.ndarray]:
    """Of each entry: the size of a change of order 1 (or 1, where fitted in its logarithm), log."""
    log = parameters.log
    of_energy = np.array([field == "initial_energy" for field in parameters.entry_fields])
    scale = np.where(of_energy, energy, np.maximum(np.abs(values), 1.0))
    return np.where(log, 1.0, scale), log


def to_scaled(values: np.ndarray, scale: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Scaled form of entries, on the host."""
    with np.errstate(divide="ignore"):
        return np.where(log, np.log(np.where(log, values, 1.0)), values / scale)


def from_scaled(scaled: np.ndarray, scale: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Entries of their scaled form, on the host."""
    return np.where(log, np.exp(np.where(log, scaled, 0.0)), scaled * scale)


def filled_count(count: int) -> int:
    """How many shots a program has that serves so many."""
    return FEWEST if count <= FEWEST else 2 ** math.ceil(math.log2(count))


def filled_up(residuals: Residuals) -> Residuals:
    """With copies of the last shot, of no weight, up to a number that other fits have, too."""
    if not isinstance(residuals.observe, Shots):
        return residuals
    count = len(residuals.measured)
    goal = FEWEST
    while goal < count:
        goal *= 2

    last = np.minimum(np.arange(goal), count - 1)
    parts = (residuals.observe, residuals.measured, residuals.weight, residuals.mixing)
    observe, measured, weight, mixing = jax.tree.map(lambda x: np.asarray(x)[last], parts)
    weight[count:] = 0.0
    return eqx.tree_at(
        lambda r: (r.observe, r.measured, r.weight, r.mixing),
        residuals,
        (observe, measured, weight, mixing),
        is_leaf=lambda x: x is None,
    )


@quick_jit
def _slopes_before(law: Law, shots: Shots) -> jax.Array:
    """Compiled `dv+/dv-` of every shot."""
    law, scenes = placed(law, shots.scenes)

    def after(v: jax.Array, scene: Scene) -> jax.Array:
        """v+ of v-."""
        return impact(law, scene, v).velocity

    return jax.vmap(jax.jacfwd(after))(shots.pre, scenes)


def slopes_before(law: Law, shots: Any) -> np.ndarray:
    """`dv+/dv-` (K, n, n) of every shot."""
    n = shots.bodies
    return np.asarray(_slopes_before(_in(_dtype(shots), law), shots), float)[:, :n, :n]
