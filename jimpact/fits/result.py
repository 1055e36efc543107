"""`FitResult`: what a fit finds, in numbers; findings and profiles when they are asked
for.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Generic, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.law import AnyLaw, parameters_of
from jimpact.core.scene import Scene
from jimpact.fits.checks import Judged, fit_findings
from jimpact.fits.curvature import bent_within_errors
from jimpact.fits.deviances import PROFILE_STARTS, lower_minimum, profiles_of
from jimpact.fits.estimate import LEVEL, Estimate, in_own_precision
from jimpact.fits.findings import Finding
from jimpact.fits.intervals import Profile
from jimpact.fits.parameters import LawInScene, tied_names, tied_value
from jimpact.fits.problem import outcome_at
from jimpact.fits.search import solution_of
from jimpact.shots.data import Experiments
from jimpact.tools.checks import check_choice, check_kind, check_values
from jimpact.tools.records import Column, Table, Tabular, counted, plain
from jimpact.tools.status import STATUS

_PRINTED_SHOTS = 12  # of predictions; ten times more fill pages
# Share of a prior's standard deviation from which on a standard error is the prior's:
# the data have then less than a tenth of the information. Ten times as much would call
# priors of half of it so.
PRIOR_ALONE = 0.95
# Shots up to which a fit profiles of itself, with one start and with several: as long
# as half of the fit. Parameters: with four of LZB it takes longer than the search.
FEW_SHOTS = 64
MANY_SHOTS = 256
MOST_PARAMETERS = 3
# of fields that no file holds
NOT_SAVED: Mapping[str, bool] = MappingProxyType({"saved": False})


class FittedParameter(NamedTuple):
    """A parameter of a fit: its value, standard error, 95 % interval in pieces, and
    whether the data determine it.
    """

    value: float
    standard_error: float
    intervals: tuple[tuple[float, float], ...]
    determined: bool


class Predicted(NamedTuple):
    """Velocities after each shot (K, n) [m/s], their standard errors (K, n), status
    codes (K,).

    `noise` (K, n) is the standard error of a measurement of them. `low` and `high` (K,
    n) are the ends of the band in which such a measurement lies. `units` (n,): of the
    velocities.
    """

    velocity: np.ndarray
    standard_error: np.ndarray
    status: np.ndarray
    noise: np.ndarray
    low: np.ndarray
    high: np.ndarray
    units: tuple[str, ...]

    def __str__(self) -> str:
        """Table of predictions, a row for each velocity of the first shots; status if
        not ok.
        """
        columns = (
            *(Column("shot"), Column("coordinate"), Column("velocity", ".5g")),
            *(Column("standard_error", ".2g", "std. error"), Column("low", ".5g")),
            *(Column("high", ".5g"), Column("unit"), Column("status")),
        )
        rows = [
            [
                *(
                    k + 1,
                    i + 1,
                    plain(float(self.velocity[k, i])),
                    self.standard_error[k, i],
                ),
                *(self.low[k, i], self.high[k, i], self.units[i]),
                STATUS[int(self.status[k])].name if self.status[k] else None,
            ]
            for k, i in np.ndindex(*self.velocity[:_PRINTED_SHOTS].shape)
        ]
        more = len(self.velocity) - _PRINTED_SHOTS
        if more > 0:
            notes = [f"... and {counted(more, 'more shot')}"]
        else:
            notes = []
        all_notes = [*notes, "low to high: of a measurement."]
        return str(Table(columns, rows, notes=all_notes, keys=2))


@dataclass(frozen=True, eq=False, kw_only=True)
class FitResult(Estimate[AnyLaw], Tabular, Generic[AnyLaw]):
    """The result of `fit` in numbers; see `Fit`, which can be printed and saved.

    Findings and profiles are computed on first access.
    """

    judged: Judged | None = field(default=None, repr=False, metadata=NOT_SAVED)
    wants_profiles: bool | None = field(default=False, metadata=NOT_SAVED)
    progress: float | None = field(default=None, metadata=NOT_SAVED)
    known_findings: tuple[Finding, ...] | None = None
    known_profiles: tuple[Profile, ...] | None = None
    picture = "fit"

    @cached_property
    @in_own_precision
    def findings(self) -> tuple[Finding, ...]:
        """Results of the tests of data and fit, by kind, shots and numbers."""
        if self.known_findings is not None:
            return self.known_findings
        return (*self._findings_of_search, *lower_minimum(self.names, self.profiles))

    @cached_property
    @in_own_precision
    def _findings_of_search(self) -> tuple[Finding, ...]:
        """The findings without those of profiles, which need these first."""
        assert self.judged is not None
        return (*fit_findings(self.judged), *bent_within_errors(self.judged))

    @cached_property
    @in_own_precision
    def profiles(self) -> tuple[Profile, ...]:
        """Profiles of all parameters if `wants_profiles`, or if it is None and they are
        needed.
        """
        if self.known_profiles is not None:
            return self.known_profiles
        wanted = self.wants_profiles
        if wanted is None:
            wanted = self._needs_profiles
        if not wanted:
            return ()
        if self.wants_profiles:
            points = PROFILE_STARTS
        else:
            points = 0
        every = range(len(self.names))
        return profiles_of(self, every, LEVEL, points, self.progress)

    @property
    def _needs_profiles(self) -> bool:
        """True where standard errors may mislead, and profiles cost no more than the
        fit.

        Not after lack of fit: no interval of such a law means anything, and its valleys
        are rough.
        """
        if self.start_count == 1:
            most = FEW_SHOTS
        else:
            most = MANY_SHOTS
        few = self.experiments is not None and len(self.predicted) <= most
        few &= len(self.names) <= MOST_PARAMETERS
        rejected = any(each.kind == "lack_of_fit" for each in self._findings_of_search)
        return few and self.linearization_misleads and not rejected

    @property
    def warnings(self) -> tuple[str, ...]:
        """The sentences of the findings."""
        return tuple(each.line for each in self.findings if each.line)

    @property
    def reservations(self) -> tuple[str, ...]:
        """In words, what has to be said where a value is quoted."""
        return tuple(each.reservation for each in self.findings if each.reservation)

    def found(self, kind: str) -> bool:
        """True if there is a finding of this kind, one of
        `jimpact.fits.findings.KINDS`.
        """
        return any(each.kind == kind for each in self.findings)

    @property
    def table(self) -> Table:
        """A row for each parameter: value, standard error, ends of its 95 % interval,
        flags.
        """
        names = (
            "value",
            "standard_error",
            "low_95",
            "high_95",
            "at_bound",
            "determined",
        )
        ends = self.confidence_interval().T
        columns = (
            self.value,
            self.standard_error,
            *ends,
            self.at_bound,
            self.determined,
        )
        lists = (column.tolist() for column in columns)
        rows = list(zip(self.names, *lists))
        heads = ("parameter", *names)
        return Table([Column(name) for name in heads], rows)

    @property
    @in_own_precision
    def scene(self) -> Scene | None:
        """The scene of all shots, with what was fitted of it; None: the shots have
        their own.
        """
        return self.problem.to_scene(self.value)

    @property
    def determined(self) -> np.ndarray:
        """True (P,) for parameters that the data bound at all; the values of others are
        starts.
        """
        seen = ~np.isinf(self.standard_error)
        for i, each in enumerate(self.profiles):
            seen[i] &= each.determines
        return seen

    @property
    def from_prior(self) -> np.ndarray:
        """True (P,) for parameters known by their priors alone: data hardly reduce
        their errors.
        """
        std = np.full(len(self.names), np.inf)
        for prior in self.problem.priors:
            std[prior.parameter] = prior.std
        return self.standard_error > PRIOR_ALONE * self.noise * std

    @property
    @in_own_precision
    def tied(self) -> dict[str, tuple[float, float]]:
        """Values of tied entries with their standard errors, by name."""
        problem = self.problem
        ties = self.problem.ties
        if not ties:
            return {}

        def values(x: jax.Array) -> jax.Array:
            """The tied entries at parameters x (P,)."""
            law = problem.law_in_scene(x)
            return jnp.concatenate([tied_value(law, tie) for tie in ties])

        x = jnp.asarray(self.value, problem.precision)
        names = tied_names(problem.law, ties)
        slope = jax.jacfwd(values)(x)
        errors = self.errors_of(np.asarray(slope, float))
        tied_values = np.asarray(values(x), float).tolist()
        return dict(zip(names, zip(tied_values, errors.tolist())))

    def errors_of(self, slope: np.ndarray) -> np.ndarray:
        """Standard errors (...) of functions of the parameters, by linear propagation.

        Equation: `sqrt(J C J^T)`; inf where a function depends on what the data do not
        determine.

        Args:
            slope: J, derivatives (..., P) of the functions in the parameters.
        """
        seen = self.determined
        determined_slope = slope[..., seen]
        covariance = self.covariance[np.ix_(seen, seen)]
        variance = np.einsum(
            "...p,pq,...q->...", determined_slope, covariance, determined_slope
        )
        of_unseen = np.abs(slope[..., ~seen])
        blind = (of_unseen > 0).any(axis=-1)
        return np.where(blind, np.inf, np.sqrt(variance))

    @in_own_precision
    def predict(
        self, shots: Any, scene: Scene | None = None, level: float = 0.95
    ) -> Predicted:
        """Velocities after further shots, with the errors that the parameters leave in
        them.

        Equation: `sqrt(J C J^T)`, J derivatives in the parameters, C their covariance;
        a measurement, with its own standard error s, lies within
        `q sqrt(J C J^T + s^2)`, q the quantile as in `intervals`.

        Args:
            shots: v- (K, n) [m/s], or `Experiments`, of which v- and scenes count.
            scene: of all shots; None: that of the fit, or those of the shots.
            level: of the band.

        Returns:
            `velocity` (K, n) [m/s], `standard_error` (K, n): inf where it depends on
            what the data do not determine, NaN where the errors are unknown; `status`
            (K,); `noise` (K, n) of a
            measurement: the `sigma` of the shots if they have one, else as in the fit;
            `low` and `high` (K, n), the band of a measurement.

        Raises:
            ValueError: a fit of something else than shots; velocities that do not fit
                the scene, a scene that does not fit the law; a level outside (0, 1).
        """
        quantile = self.quantile(level)
        if self.experiments is None:
            raise ValueError("Argument `fit` must be to shots.")
        data = shots
        scenes = None
        units = self.experiments.units
        sigma = None
        if isinstance(shots, Experiments):
            data = shots.pre
            scenes = shots.scenes
            units = shots.units
            sigma = shots.sigma
        if np.ndim(data) != 2 or np.shape(data)[1] != len(units):
            raise ValueError(
                f"Argument `shots` must have shape (K, {len(units)}), velocities of "
                f"the bodies of the fit, but has shape {np.shape(data)}."
            )
        check_values("shots", data)
        nothing = np.zeros_like(np.asarray(data, float))
        data = Experiments(data, nothing, scenes=scenes, units=units)
        if isinstance(self.problem.law, LawInScene) and scene is not None:
            raise ValueError(
                "Argument `scene` must be left out where parts of the scene were "
                "fitted: they hold for that of the fit only."
            )
        if scene is None:
            common = self.problem.scene
        else:
            common = scene
        if scenes is None:
            largest = common
        else:
            largest = max(scenes, key=lambda each: each.contacts)
        self._check_scene(largest, len(units))
        problem = self.problem.of_other(data, common)
        outcome = solution_of(problem, outcome_at(problem, self.value))
        error = self.errors_of(problem.derivatives(outcome.starts[0]))
        value = outcome.predicted
        noise = np.broadcast_to(self._noise_of(sigma), data.pre.shape)
        half = quantile * np.hypot(error, noise)
        return Predicted(
            velocity=value,
            standard_error=error,
            status=np.asarray(outcome.status),
            noise=noise,
            low=value - half,
            high=value + half,
            units=tuple(units),
        )

    def _check_scene(self, scene: Any, size: int) -> None:
        """Raise unless `scene` has `size` velocities and the contacts of the law's
        parameters.
        """
        check_kind("scene", scene, Scene)
        values = [
            x.value for x in parameters_of(self.law).values() if x.domain.per_contact
        ]
        lists = (value for value in values if np.ndim(value) == 1)
        counts = {np.shape(value)[0] for value in lists}
        if scene.size != size or counts - {scene.contacts}:
            if counts:
                also = f" and {min(counts)} contacts, one for each value of the law"
            else:
                also = ""
            raise ValueError(
                f"Argument `scene` must have {size} velocities as the fit{also}, but "
                f"has {scene.size} and {scene.contacts}."
            )

    def _noise_of(self, sigma: Any) -> np.ndarray:
        """Standard errors of measured velocities: `sigma` stretched as in the fit.

        A fit without sigma stretches nothing, as its `noise` is a velocity; that of a
        fit with sigma is the factor. None: the errors of the fit, root mean squares
        (n,) over its shots.
        """
        if sigma is not None:
            if self.problem.sigma is None:
                stretch = 1.0
            else:
                stretch = self.noise
            return stretch * np.asarray(sigma, float)
        weights = np.asarray(self.problem.measurement.weight, float)
        weight = np.ma.masked_equal(weights, 0.0)
        # NaN: never measured
        deviation = np.sqrt((1 / weight**2).mean(axis=0))
        return self.noise * deviation.filled(np.nan)

    def __getitem__(self, name: str) -> FittedParameter:
        """The parameter of this name, as in `names`."""
        check_choice("name", name, self.names)
        i = self.names.index(name)
        value = float(self.value[i])
        error = float(self.standard_error[i])
        determined = bool(self.determined[i])
        return FittedParameter(value, error, self.intervals()[i], determined)

    def intervals(
        self, level: float = LEVEL
    ) -> tuple[tuple[tuple[float, float], ...], ...]:
        """The pieces, in order, of the confidence interval of each of the P parameters.

        Those of `profiles`, if there are some of this level. Else linearized, cut at
        the bounds, a piece for every minimum that fits well enough.

        Equation: `value -+ q standard_error`, q the quantile of Student's t with the
        degrees of freedom that are left, or of the normal law if `sigma` is known; of
        what is fitted in its logarithm `value exp(-+ q standard_error / value)`; at a
        minimum whose sum of squares is higher by d, q^2 - d / noise^2 in place of q^2.
        """
        if self.profiles and self.profiles[0].level == level:
            return tuple(profile.intervals for profile in self.profiles)
        return self.linearized_intervals(level)

    def confidence_interval(self, level: float = LEVEL) -> np.ndarray:
        """The outermost ends (P, 2) of `intervals` at a level in (0, 1)."""
        intervals = self.intervals(level)
        return np.array([(pieces[0][0], pieces[-1][1]) for pieces in intervals])

    @property
    def shows_lack_of_fit(self) -> bool:
        """True if a test rejects the law."""
        return self.found("lack_of_fit")
