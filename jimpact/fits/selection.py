"""Which law: every registered one on the same data, the simplest adequate one first."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.special import chdtrc, fdtrc, stdtr

from jimpact.core.law import Law, free_parameters_of, with_parameter
from jimpact.core.registry import REGISTRY, registered_laws, simplest_first
from jimpact.core.scene import Scene
from jimpact.fits.fitting import fit, leave_one_out
from jimpact.fits.matrices import admissible_start
from jimpact.fits.parameters import OF_SPEED, default_free
from jimpact.fits.problem import FEW
from jimpact.fits.report import Fit, check_squares, named_values
from jimpact.fits.search import Search
from jimpact.laws.velocity_dependent import VelocityDependent
from jimpact.shots.data import Experiments
from jimpact.tools.checks import check_choice, check_kind
from jimpact.tools.progress import progress_bar
from jimpact.tools.records import Column, Table, Tabular, as_data, degrees
from jimpact.tools.status import STATUS

RESTITUTION = 0.8  # start value by default
SPEED_EXPONENT = 0.1  # start of a dependence on the speed
WORSE = 0.01  # p-value below which a law counts as a worse predictor than the best
WORSE_OF_FEW = 0.05  # the same by the residuals, of fewer shots
SAME = 1e-5  # share by which squares of the same law differ, as solvers leave them
_LEAST = 4  # shots from which predictions of two laws are compared
_TIERS = ("fits", "lack of fit", "worse", "fails")


@dataclass(frozen=True, eq=False)
class LawFit:
    """The fit of a law, its error in shots left out, and the verdict of the tests.

    `left_out_error` is the root mean square error of shots predicted from the others
    [m/s], NaN of fewer than two shots; `aicc` is NaN where it is meaningless (see
    `fit_laws`); `verdict` is 'fits', or why not.
    """

    name: str
    fit: Fit
    left_out_error: float
    aicc: float
    verdict: str
    tier: str

    @property
    def adequate(self) -> bool:
        """True if no test speaks against the law."""
        return self.tier == "fits"

    @property
    def parameters(self) -> int:
        """Number of fitted parameters."""
        return len(self.fit.names)

    def to_dict(self) -> dict[str, Any]:
        """The record of a law as JSON data."""
        names = ("parameters", "left_out_error", "aicc", "adequate", "verdict", "fit")
        record = {name: getattr(self, name) for name in names}
        return as_data({"rms": self.fit.rms} | record)


_COLUMNS = (
    Column("law"),
    Column("parameters", head="free"),
    Column("rms_m_per_s", ".4g", "rms"),
    Column("left_out_m_per_s", ".4g", "left out"),
    Column("aicc", ".1f", "AICc"),
    Column("verdict"),
)


@dataclass(frozen=True, eq=False)
class LawFits(Tabular):
    """The result of `fit_laws`: `entries` by name, the simplest adequate law first.

    `left_out` says by name why a law was not tried; `speed` whether the first law's e
    depends on the speed, if requested, and `speed_fit` is the fit of its exponent.
    """

    entries: dict[str, LawFit]
    left_out: dict[str, str] = field(default_factory=dict)
    speed: "NestedTest | None" = None
    speed_fit: Fit | None = None

    @property
    def best(self) -> LawFit:
        """The first law: the simplest adequate one, if there is one."""
        return next(iter(self.entries.values()))

    @property
    def verdict(self) -> str:
        """A sentence on the simplest adequate law, or the nearest one, with its
        values.
        """
        best = self.best
        which = f"No law fits; the nearest is {best.name} ({best.verdict})"
        if best.adequate:
            which = f"The simplest law that fits is {best.name}"
        elif best.tier == "lack of fit":
            which = (
                f"No law fits; the simplest that predicts as well as any is {best.name}"
            )
        return f"{which}: {best.fit.verdict}"

    @property
    def table(self) -> Table:
        """A row for each law: parameters, rms, error of shots left out, AICc,
        verdict.
        """
        rows = [
            [name, x.parameters, x.fit.rms, x.left_out_error, x.aicc, x.verdict]
            for name, x in self.entries.items()
        ]
        return Table(_COLUMNS, rows)

    def to_dict(self) -> dict[str, Any]:
        """The comparison as JSON data."""
        record = {
            "best": self.best.name,
            "verdict": self.verdict,
            "left_out": self.left_out,
        }
        speed = {"speed": self.speed, "speed_fit": self.speed_fit}
        return record | as_data({"laws": self.entries} | speed)

    def __str__(self) -> str:
        """The table with the values of the parameters, and notes on other laws and the
        speed.
        """
        fits = [entry.fit for entry in self.entries.values()]
        rows = [
            (*row, named_values(x, x.value)) for row, x in zip(self.table.rows, fits)
        ]
        notes = ["rms and error of shots left out in m/s; simplest adequate law first."]
        if not all(x.determined.all() for x in fits):
            notes.append(
                "Values in brackets are starts, which the data do not determine."
            )
        notes += [
            f"{name} is left out: it {reason}" for name, reason in self.left_out.items()
        ]
        if self.speed is not None:
            notes.append(
                f"Restitution that depends on the speed ({self.best.name}): "
                f"{self.speed}"
            )
        if self.speed_fit is not None:
            tier, against = _verdict_alone(self.speed_fit)
            if tier == "fits":
                so = "the data then fit"
            else:
                so = f"still {against}"
            fitted = zip(
                self.speed_fit.names,
                self.speed_fit.value,
                self.speed_fit.standard_error,
            )
            values = ", ".join(
                f"{name} = {x:.4g} ± {error:.2g}" for name, x, error in fitted
            )
            notes.append(f"With it {values}: {so}.")
        columns = (*_COLUMNS, Column("values"))
        table = Table(columns, rows, head=[self.verdict, ""], notes=notes)
        return str(table)


class NestedTest(NamedTuple):
    """A test of further parameters: by F, or by chi^2 where sigma is known and fits.

    `statistic` of `more` parameters, and of the `degrees_of_freedom` left (None:
    chi^2); the p-value `chance`; `names` of the further parameters.
    """

    statistic: float
    more: int
    degrees_of_freedom: int | None
    chance: float
    names: tuple[str, ...]

    @property
    def needed(self) -> bool:
        """True if the p-value is below 1 %: the simpler law hardly yields such data."""
        return self.chance < WORSE

    def __str__(self) -> str:
        """The test in a sentence: statistic, degrees of freedom, p-value."""
        if self.needed:
            needed = "needed"
        else:
            needed = "not needed"
        rest = self.degrees_of_freedom
        kind = "chi^2"
        freedom = degrees(self.more)
        if rest is not None:
            kind = "F"
            freedom = f"{self.more} and {degrees(rest)}"
        return (
            f"{', '.join(self.names)} {needed}: {kind} = {self.statistic:.3g} with "
            f"{freedom}, p-value {self.chance:.2g} (needed: below {WORSE:g})."
        )

    def to_dict(self) -> dict[str, Any]:
        """The test as JSON data."""
        words = {"needed": self.needed, "words": str(self)}
        return as_data(self._asdict() | words)


def nested_test(simple: Fit, full: Fit) -> NestedTest:
    """Test by F or chi^2 if the data need the parameters that one fit has more.

    Equation: `F = (S - S_full) / q / (S_full / f)`, S sums of squares, q further
    parameters that the data determine, f degrees of freedom of the full fit; with
    sigma, unless the full fit contradicts it, `S - S_full` is chi^2 with q degrees of
    freedom. Where the simple law is at the end of a domain of the full one (a yield
    speed of 0), the p-value is up to twice too large.

    Args:
        simple, full: fits by least squares of the same data; the law of `simple` is a
            special case.

    Returns:
        `NestedTest`; `print` says it in words.

    Raises:
        ValueError: other data, a robust loss, no more parameters.

    >>> import jimpact as ji
    >>> data = ji.Experiments(
    ...     pre=[[1.0, 0.0], [2.0, 0.0], [4.0, 0.0], [8.0, 0.0]],
    ...     post=[[0.1, 0.9], [0.26, 1.74], [0.63, 3.37], [1.48, 6.52]],
    ...     sigma=0.005,
    ... )
    >>> law, pair = ji.Newton(0.7), ji.chain([1.0, 1.0])
    >>> constant = ji.fit(law, pair, data)
    >>> falling = ji.fit(ji.VelocityDependent(law, speed_exponent=0.1), pair, data)
    >>> ji.nested_test(constant, falling).needed
    True
    """
    for name, each in (("simple", simple), ("full", full)):
        check_squares(name, each)
    same = np.array_equal(
        simple.problem.measured, full.problem.measured, equal_nan=True
    )
    if not same:
        raise ValueError("Arguments `simple` and `full` must be fits of the same data.")
    more = full.rank - simple.rank
    if more < 1:
        raise ValueError(
            f"Argument `full` must have more parameters that the data see than "
            f"`simple`, but has {full.rank} and {simple.rank}."
        )
    added = tuple(x for x in full.names if x not in simple.names)
    names = added or full.names
    least = full.starts[0].sum_of_squares
    gain = max(simple.starts[0].sum_of_squares - least, 0.0)
    if full.problem.sigma is not None and full.noise <= 1:
        chance = float(chdtrc(more, gain))
        return NestedTest(gain, more, None, chance, names)
    return _f_test(gain, more, full, names)


def _f_test(
    gain: float, more: int, full: Fit, names: tuple[str, ...] = ()
) -> NestedTest:
    """F test of `more` parameters that lower the sum of squares by `gain` to that of
    `full`.

    Equation: `F = (gain / more) / (S_full / f)`, f degrees of freedom left; p-value 1
    without any.
    """
    freedom = full.degrees_of_freedom
    if freedom < 1:
        return NestedTest(np.nan, more, freedom, 1.0, names)
    squares = max(full.starts[0].sum_of_squares, full.problem.exact_squares)
    ratio = gain / more / (squares / freedom)
    chance = float(fdtrc(more, freedom, ratio))
    return NestedTest(ratio, more, freedom, chance, names)


def fit_laws(
    scene: Scene | None,
    data: Experiments,
    laws: Iterable[str] | Mapping[str, Law] | None = None,
    *,
    free: Iterable[str] = (),
    speed: bool = False,
    starts: int | None = None,
    seed: int = 0,
    progress: float | None = None,
    done: Callable[[str, Fit], None] | None = None,
    **values: Any,
) -> LawFits:
    """Every law on the same data: which is the simplest that is adequate?

    Each law is fitted with one e for all contacts, with one each, and, where it has
    stiffnesses, with and without free ratios of them; a `RestitutionMatrix` from an
    admissible one. A law is adequate if its fit converges, shows no lack of fit (see
    `fit`), fails in no shot, and predicts shots left out no worse than the best law
    does: a paired t test over shots at 1 %, of more than 64 shots linearized; of fewer
    than 4 an F test of the residuals at 5 %. Adequate laws come first, those with fewer
    parameters before others, and of these the one that needs to know less of the
    contacts, in the order of `advise`. AICc is reported if it is meaningful: rank full,
    no parameter at a bound, no shot left out, degrees of freedom left.

    Args:
        scene: of all shots; ignored if each shot has its own scene.
        data: measured shots.
        laws: names of the registry, or laws by a name of your own (each with its
            default free parameters); None: all of the registry that these values make.
        free: further parameters, such as 'friction', fitted in every law that has them.
        speed: test whether e of the first law depends on the speed
            (`VelocityDependent`).
        starts, seed, progress: as of `fit`, of every law.
        done: called with name and fit after every law.
        values: parameters by name, `friction=0.2, stiffness=..., exponent=...`: starts
            of what is fitted, fixed otherwise; restitution starts at 0.8. Without a
            stiffness, laws that need it in SI units are left out.

    Returns:
        `LawFits`; `print` gives a table and why each law is adequate or not.

    Raises:
        ValueError: unknown laws, no law that can be fitted, a name in `free` that no
            law has.

    >>> import numpy as np
    >>> import jimpact as ji
    >>> before = np.stack([np.linspace(1, 2, 6), np.zeros(6)], axis=1)
    >>> after = before @ [[0.2, 0.8], [0.8, 0.2]]
    >>> after += 0.01 * np.random.default_rng(1).normal(size=after.shape)
    >>> laws = ji.fit_laws(
    ...     ji.chain([1.0, 1.0]), ji.Experiments(before, after), ["newton"]
    ... )
    >>> laws.best.name, laws.best.adequate
    ('newton', True)
    """
    check_kind("data", data, Experiments)
    scenes = data.each(scene, lambda s: s)
    more = tuple(free)
    candidates, left_out = _candidates(scenes, laws, dict(values), more)
    _check_free(more, candidates)
    fits: dict[str, Fit] = {}
    search = Search(seed=seed, progress=False)
    options: dict[str, Any] = {"starts": starts, "profiles": False, "search": search}
    with progress_bar(progress) as show:
        for i, (name, (law, chosen)) in enumerate(candidates.items()):
            show(
                f"fit_laws: {name}, law {i + 1} of {len(candidates)}",
                i,
                len(candidates),
            )
            try:
                fits[name] = fit(law, scene, data, chosen, **options)
            except ValueError as error:
                left_out[name] = f"cannot be fitted: {error}"
                continue
            if done is not None:
                done(name, fits[name])
        if not fits:
            why = "; ".join(f"{name} {reason}" for name, reason in left_out.items())
            raise ValueError(
                f"Argument `laws` must hold a law that can be fitted, but: {why}"
            )
        entries = _judged(fits)
        best = next(iter(entries))
        # of the best one only, where they are needed
        fits[best] = replace(fits[best], wants_profiles=None)
        entries[best] = replace(entries[best], fit=fits[best])
        test = of_speed = None
        if speed:
            show(
                f"fit_laws: {best}, dependence on the speed",
                len(candidates),
                len(candidates),
            )
            simplest = candidates[best]
            test, of_speed = _speed_test(fits[best], simplest, scene, data, options)
    return LawFits(entries, left_out, test, of_speed)


Candidate = tuple[Law, Any]  # and what is free in it


def _check_free(more: tuple[str, ...], candidates: dict[str, Candidate]) -> None:
    """Raise a ValueError for a name in `free` that no law has, or that has no value."""
    laws = [law for law, _ in candidates.values()]
    known = sorted({name for law in laws for name in free_parameters_of(law)})
    for name in more:
        if name not in known:
            raise ValueError(
                "Argument `free` must hold parameters that a law has and that have a "
                f"value, {', '.join(known)}, but holds {name!r}."
            )


def _candidates(
    scenes: list[Scene],
    laws: Iterable[str] | Mapping[str, Law] | None,
    values: dict[str, Any],
    more: tuple[str, ...],
) -> tuple[dict[str, Candidate], dict[str, str]]:
    """Laws to fit by name, each with what is free, and reasons why others are not
    tried, by name.

    Args:
        scenes: of the shots.
        laws: the user's choice, see `fit_laws`.
        values: start values of parameters, by name.
        more: further parameters to fit.
    """
    if isinstance(laws, Mapping):
        for name, law in laws.items():
            check_kind(f"laws[{name!r}]", law, Law)
        with_free = {name: (law, _default(law, more)) for name, law in laws.items()}
        return with_free, {}
    contacts = max(scene.contacts for scene in scenes)
    alike = len({scene.contacts for scene in scenes}) == 1
    values = {"restitution": RESTITUTION} | values
    left_out: dict[str, str] = {}
    if "matrix" not in values and contacts > 1:
        try:
            values["matrix"] = admissible_start(scenes)
        except ValueError as error:
            left_out["restitution_matrix"] = f"has no start: {error}"
    built, missing = registered_laws(values)
    left_out = missing | left_out
    alternatives = {
        "compliant": "differs from lzb only where contacts have gaps, or open and "
        "close again (as at a wall): name it in `laws` to fit it, too",
        "routh": "is moreau with one restitution, unless contacts separate beforehand: "
        "name it in `laws` to fit it, too",
    }
    if any(map(_opens_and_closes, scenes)):
        del alternatives["compliant"]
    if laws is None:
        left_out |= {name: why for name, why in alternatives.items() if name in built}
    if "base" not in values:
        left_out.pop("velocity_dependent", None)  # an option of the others, see `speed`
    wanted = tuple(REGISTRY if laws is None else laws)
    for name in wanted:
        check_choice("laws", name, tuple(REGISTRY))
    candidates = {
        f"{name}{label}": candidate
        for name, law in built.items()
        if name in wanted and name not in left_out
        for label, candidate in _variants(law, contacts, alike, more).items()
    }
    reasons = {name: why for name, why in left_out.items() if name in wanted}
    return candidates, reasons


def _opens_and_closes(scene: Scene) -> bool:
    """True where gaps matter: a contact is open, or a wall lets contacts open and close
    again.
    """
    return not np.all(scene.closed) or (scene.walls is not None and any(scene.walls))


def _default(law: Law, more: tuple[str, ...]) -> dict[str, Any]:
    """The free parameters of a user's law: those by default, and those of `more` that
    it has.
    """
    available = free_parameters_of(law)
    known = (name for name in more if name in available)
    return dict.fromkeys((*default_free(law), *known), True)


def _variants(
    law: Law, contacts: int, alike: bool, more: tuple[str, ...]
) -> dict[str, Candidate]:
    """Candidates of a law, by the ending of their names, which share one program.

    One restitution for all contacts, or one for each; stiffness ratios fixed, or free.

    Args:
        law: at its start values.
        contacts: the largest number in a scene.
        alike: True if all scenes have as many.
        more: further free parameters.
    """
    available = free_parameters_of(law)
    if "restitution" not in available or np.ndim(available["restitution"].value) > 1:
        return {"": (law, _default(law, more))}
    fields = [name for name in ("restitution", "stiffness") if name in available]
    others = {name: True for name in more if name in available and name not in fields}
    if contacts == 1:  # the same program as a plain fit
        return {"": (law, dict.fromkeys(("restitution", *others), True))}
    for name in fields:
        each = jnp.broadcast_to(available[name].value, (contacts,))
        law = with_parameter(law, name, each)
    # labels of `free`: equal numbers share one value, 0 is fixed
    each_own = np.arange(1, contacts + 1)
    coefficients = {"": np.ones(contacts, int)}
    ratios = {"": np.zeros(contacts, int)}
    if alike:
        coefficients[", e per contact"] = each_own
    # of others the stiffness is one in SI units
    if alike and law.only_stiffness_ratios:
        ratios[", free stiffness ratios"] = each_own
    return {
        f"{a}{b}": (law, dict(zip(fields, (e, k))) | others)
        for a, e in coefficients.items()
        for b, k in ratios.items()
    }


# ------------------------------------------------------------------------------- the
# evidence


def _judged(fits: dict[str, Fit]) -> dict[str, LawFit]:
    """The laws by name in order, with verdicts: `_verdict_alone`, then against the best
    law.

    The best has the least sum of squared errors in shots left out; of fewer than
    `_LEAST` shots, the least variance of the residuals.
    """
    errors = {name: _errors_left_out(each) for name, each in fits.items()}
    against = {name: _verdict_alone(each) for name, each in fits.items()}
    squares = {name: _per_shot(each, errors[name]) for name, each in fits.items()}
    usable = [name for name in fits if against[name][0] != "fails"] or list(fits)
    by_shots = all(np.isfinite(squares[name]).sum() >= _LEAST for name in usable)
    error = {
        n: np.nansum(squares[n]) if by_shots else _variance(fits[n]) for n in usable
    }
    best = min(usable, key=lambda name: (error[name], len(fits[name].names)))
    entries = []
    for name, each in fits.items():
        tier, verdict = against[name]
        if by_shots:
            chance = _paired_p_value(squares[name], squares[best])
            level = WORSE
        else:
            chance = _f_test_of_residuals(each, fits[best])
            level = WORSE_OF_FEW
        if tier != "fails" and chance < level:
            if by_shots:
                verb = "predicts"
            else:
                verb = "fits"
            worse = f"{verb} worse than {best} (p-value {chance:.1g})"
            tier, verdict = "worse", f"{verdict}, {worse}" if tier != "fits" else worse
        rms = each.problem.rms(errors[name])
        entries.append(LawFit(name, each, rms, _aicc(each), verdict, tier))
    return {x.name: x for x in sorted(entries, key=_sort_key)}


def _sort_key(entry: LawFit) -> tuple[Any, ...]:
    """Sort key: tier, then number of parameters (of worse tiers: error), then order of
    `advise`.
    """
    tier = _TIERS.index(entry.tier)
    base = entry.name.split(",")[0]
    order = simplest_first()
    if base in order:
        place = order.index(base)
    else:
        place = len(order)
    if np.isfinite(entry.left_out_error):
        error = entry.left_out_error
    else:
        error = entry.fit.rms
    return tier, entry.parameters if tier < 2 else error, place


def _verdict_alone(result: Fit) -> tuple[str, str]:
    """The tier of a fit by itself, one of `_TIERS`, and the verdict in words."""
    failing = [STATUS[code].name for code in result.status if STATUS[code].failure]
    if failing:
        names = ", ".join(dict.fromkeys(failing))
        return (
            "fails",
            f"fails in {len(failing)} of {len(result.status)} shots: {names}",
        )
    if not result.converged:
        return "fails", "does not converge"
    if result.shows_lack_of_fit:
        return "lack of fit", "lack of fit"
    if result.rank < len(result.names):
        return (
            "fits",
            f"fits, {result.rank} of {len(result.names)} parameters determined",
        )
    return "fits", "fits"


def _errors_left_out(result: Fit) -> np.ndarray:
    """Errors (K, n) of predictions of each shot from a fit to the others; NaN for a
    single shot.

    By a fit without each; of more than `FEW` shots, linearized.
    """
    if result.shot_count < 2:
        return np.full(result.residual.shape, np.nan)
    if len(result.residual) <= FEW:
        return result.problem.measured - leave_one_out(result, progress=False).predicted
    return _linearized(result)


def _linearized(result: Fit) -> np.ndarray:
    """Errors (K, n) of predictions of each shot from the others, by one Gauss-Newton
    step.

    Equation: `(I - H_kk)^-1 r_k` with blocks `H_kk = J_k (J^T J)^-1 J_k^T` of the hat
    matrix, in independent residuals.
    """
    jacobian, residual = map(
        result.problem.measurement.independent, (result.jacobian, result.residual)
    )
    flat = jacobian.reshape(-1, jacobian.shape[-1])
    inverse = np.linalg.pinv(flat.T @ flat, rcond=1e-12, hermitian=True)
    hat = jacobian @ inverse @ np.swapaxes(jacobian, 1, 2)
    complement = np.eye(hat.shape[-1]) - hat
    error = np.stack(
        [np.linalg.lstsq(a, b, rcond=1e-9)[0] for a, b in zip(complement, residual)]
    )
    return result.problem.measurement.errors_of(error)


def _per_shot(result: Fit, error: np.ndarray) -> np.ndarray:
    """Sums of squares (K,) of the errors of each shot, over sigma; NaN where a shot has
    none.
    """
    squares = np.sum(result.problem.measurement.independent(error) ** 2, axis=1)
    return np.where(np.isnan(error).all(axis=1), np.nan, squares)


def _paired_p_value(squares: np.ndarray, best: np.ndarray) -> float:
    """p-value of the hypothesis that a law predicts as well as the best: paired t tests
    over shots.

    The smaller one of two: of the squared errors (K,), and of their logarithms, which a
    few large ones do not dominate.
    """
    both = np.isfinite(squares) & np.isfinite(best)
    positive = both & (squares > 0) & (best > 0)
    gain = _t_test(squares[both] - best[both], best[both])
    return min(gain, _t_test(np.log(squares[positive]) - np.log(best[positive]), 1.0))


def _t_test(more: np.ndarray, size: Any) -> float:
    """p-value of the one-sided t test that the mean of `more` is 0:
    `t = mean / (std / sqrt(N))`.

    Values below `SAME size` count as 0: rounding.
    """
    more = np.where(np.abs(more) > SAME * np.abs(size), more, 0.0)
    if len(more) < _LEAST or not more.any():
        return 1.0
    error = more.std(ddof=1) / np.sqrt(len(more))
    if error == 0:
        return float(more[0] < 0)
    return float(stdtr(len(more) - 1, -more.mean() / error))


def _variance(result: Fit) -> float:
    """Variance of the residuals, |r|^2 / f; infinite where no degree of freedom f is
    left.
    """
    freedom = result.degrees_of_freedom
    if freedom > 0:
        return result.starts[0].sum_of_squares / freedom
    return np.inf


def _f_test_of_residuals(result: Fit, best: Fit) -> float:
    """p-value of an F test of the residuals of a law against those of the best one.

    The best one counts as having one parameter more at least; 1 where its residuals are
    larger.
    """
    gain = result.starts[0].sum_of_squares - best.starts[0].sum_of_squares
    more = max(best.rank - result.rank, 1)
    if gain > 0:
        return _f_test(gain, more, best).chance
    return 1.0


def _aicc(result: Fit) -> float:
    """Akaike's criterion, where sigma is unknown corrected for small samples; NaN if
    meaningless.

    Equation: `AIC + 2 k (k + 1) / (n - k - 1)`, n values, k parameters with the noise.
    It has a meaning for a converged fit of full rank, inside its bounds, to all shots.
    """
    n = result.problem.values
    count = len(result.names)
    regular = (
        result.rank == count
        and not result.at_bound.any()
        and not result.problem.left_out
    )
    if not regular or not result.converged:
        return np.nan
    if result.problem.sigma is not None:
        return result.aic
    k = count + 1  # and the noise
    if n - k - 1 >= 1:
        return result.aic + 2 * k * (k + 1) / (n - k - 1)
    return np.nan


def _speed_test(
    constant: Fit,
    candidate: Candidate,
    scene: Scene | None,
    data: Experiments,
    options: Any,
) -> tuple[NestedTest | None, Fit | None]:
    """Test of a restitution that depends on the speed, and the fit with it.

    None for laws without a restitution or with such a dependence, and for shots of one
    speed.

    Args:
        constant: the fit without it.
        candidate: its law, and what is free.
        scene: of all shots, or None.
        data: the shots.
        options: of `fit`.
    """
    law, free = candidate
    available = free_parameters_of(law)
    speeds = data.approach_speed(scene)
    speeds = speeds[speeds > 0]
    constant_e = "restitution" in available and not available.keys() & set(OF_SPEED)
    if not constant_e or len(speeds) < 2 or np.ptp(speeds) == 0:
        return None, None
    typical = float(np.exp(np.mean(np.log(speeds))))
    falling = VelocityDependent(
        law, speed_exponent=SPEED_EXPONENT, reference_speed=typical
    )
    full = fit(falling, scene, data, {**free, "speed_exponent": True}, **options)
    if full.rank > constant.rank:
        return (nested_test(constant, full), full)
    return (None, None)
