"""What is wrong with measured shots: tests, each with the sentence that the report has
for it.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtr, stdtrit

from jimpact.core.scene import Scene, dense_mass
from jimpact.fits.findings import Finding
from jimpact.shots.covariances import diagonal_blocks
from jimpact.shots.data import ROUNDING, Experiments, closed_normals, possible_normals
from jimpact.tools.records import listed

# ------------------------------------------------------------------ thresholds of the
# data Defects below this share of the momentum or energy before are not reported: a
# good measurement of a velocity is accurate to a tenth of a percent. Ten times more
# would hide defects of a percent.
DEFECT_TOLERANCE = 1e-3
# With `sigma`, a defect is reported beyond this many of its standard errors, ...
DEFECT_SIGMAS = 3.0
# ... or beyond more, so that all shots together show one by chance at most this often.
DEFECT_LEVEL = 0.02
# Without `sigma`, a gain of energy of one shot is reported where the scatter of all
# shots shows one by chance this often, by Student's t; of 15 shots it is really .015,
# as the scatter of few is often too small by chance. With ten times more, elastic shots
# are blamed in one of ten sets.
OUTLIER_LEVEL = 0.003
# Beyond this share of the momentum or energy before, in half of the shots or more, a
# defect needs no test: no noise of a useful measurement is as large, but a wrong unit
# is. With ten times more, a factor of 3.6 (km/h) in two shots would go unseen.
GROSS = 0.5
# Factors that a wrong unit leaves in velocities: cm/s or mm/s for m/s, km/h, a decimal
# slip. A median ratio of velocities within UNIT_NEAR of one (or of its inverse) is
# reported. Ten times nearer, and noise of a percent would hide it.
UNIT_FACTORS = {10.0: "a decimal point", 100.0: "cm/s", 1000.0: "mm/s", 3.6: "km/h"}
UNIT_NEAR = 0.1

# Standard deviation of a normal distribution over half the length of its shortest half,
# and the share of the values that would estimate it as well by their mean square
# (Rousseeuw and Leroy 1988).
_SIGMA_OVER_HALF = 1.4826
_EFFICIENCY_OF_HALF = 0.37

LISTED = 6  # shots named one by one (with their ratios); of more, how many there are


def share(count: int, total: int) -> str:
    """So many of all shots, in words.

    >>> from jimpact.fits.data_checks import share
    >>> share(1, 1), share(6, 6), share(2, 6)
    ('this shot', 'all 6 shots', '2 of 6 shots')
    """
    if count == total < 3:
        if total == 1:
            return "this shot"
        return "both shots"
    if count == total:
        return f"all {total} shots"
    return f"{count} of {total} shots"


# ------------------------------------------------------------------ what the data break


class _Defect(NamedTuple):
    """The balance of a momentum [N s], or of the energy [J], of a shot."""

    k: int  # index of the shot
    excess: float  # after less before
    scale: float  # sum |m v-|, or the energy before
    before: float
    ratio: float  # 1: conserved; see `DataBalances`
    # standard error of the excess; with a sigma of 1 where it is not known
    error: float


class DataBalances:
    """Balances of momentum and energy of measured shots; those with missing values have
    none.

    Momentum is reported as `1 + excess / sum |m v-|`, the excess in the direction of
    the momentum before: after over before where all bodies move one way. Without
    `sigma` the shots show their noise: a defect is one that they have in common, the
    same excess or the same share of the momentum before, whichever way that points (t
    tests), or one of half of the momentum in half of the shots; of a single shot any
    above a tenth of a percent. A gain of energy is one of a shot by itself, too, where
    it is beyond the scatter of all shots.

    Args:
        experiments: the shots.
        scene: the common scene, None where the shots carry their own.
        stored_energy: what the law may add to the energy (precompression) [J].
        uses_gaps: whether open contacts take part.
    """

    def __init__(
        self,
        experiments: Experiments,
        scene: Scene | None,
        stored_energy: float,
        uses_gaps: bool,
    ):
        """Compute the balances of all shots; arguments as of the class.

        Momentum: excess `C^T M (v+ - v-)`, scale `sum |m v-|`. Energy:
        `T+ - T- - stored_energy`.
        """
        self.experiments = experiments
        self.scene = scene
        self.stored_energy = stored_energy
        self.uses_gaps = uses_gaps
        self.total = len(experiments.shots)
        self.momenta: dict[int, list[_Defect]] = {}  # by the momentum that is conserved
        self.energies: list[_Defect] = []
        count, n = experiments.pre.shape
        # covariance of (v-, v+); where it is not known, v+ have errors of 1 m/s
        variances = np.repeat([0.0, 1.0], n)
        joint = np.tile(np.diag(variances), (count, 1, 1))
        if experiments.joint is not None:
            joint = diagonal_blocks(experiments.joint, 2 * n)
        masses = experiments.each(scene, dense_mass)
        balances = zip(experiments.balances(scene), masses, joint)
        for k, ((rows, pre, post), mass, covariance) in enumerate(balances):
            if np.isnan(post).any():
                continue
            for j, row in enumerate(rows):  # row @ v is a momentum
                excess = row @ (post - pre)
                scale = np.abs(row) @ np.abs(pre)
                before = row @ pre
                is_negative = before < -ROUNDING * scale
                if scale:
                    ratio = 1 + (-excess if is_negative else excess) / scale
                else:
                    ratio = np.inf
                error = _error(np.append(-row, row), covariance)
                defect = _Defect(k, excess, scale, before, ratio, error)
                self.momenta.setdefault(j, []).append(defect)
            t_minus = 0.5 * pre @ mass @ pre
            t_plus = 0.5 * post @ mass @ post
            gain = t_plus - t_minus - stored_energy
            if t_minus:
                ratio = t_plus / t_minus
            else:
                ratio = np.nan
            error = _error(np.append(-mass @ pre, mass @ post), covariance)
            of_energy = _Defect(k, gain, t_minus, t_minus, ratio, error)
            self.energies.append(of_energy)

    def approaching(self, normals_of: Callable[[Scene], np.ndarray]) -> np.ndarray:
        """True for shots (K,) in which one of the contacts with these normals
        approaches.
        """
        of_shots = self.experiments.each(self.scene, normals_of)
        pairs = zip(of_shots, np.asarray(self.experiments.pre))
        return np.array([_approaches(normals, pre) for normals, pre in pairs])

    def labels(self, shots: Iterable[int]) -> tuple[str, ...]:
        """Labels of these shots."""
        return tuple(self.experiments.shots[k] for k in shots)

    def listed(self, ratios: dict[int, float]) -> str:
        """Labels of shots with their ratios, as text; of many, their number and the
        range.
        """
        if len(ratios) <= LISTED:
            shots = self.experiments.shots
            return ", ".join(f"shot {shots[k]}: {r:.4f}" for k, r in ratios.items())
        values = ratios.values()
        return (
            f"{len(ratios)} of {self.total} shots, {min(values):.4f} to "
            f"{max(values):.4f}"
        )

    def beyond(
        self, defects: list[_Defect], level: float, gains: bool = False
    ) -> dict[int, float]:
        """Ratios, by shot, of the balances that fail by more than the noise.

        With sigma: an excess beyond a multiple of its standard error. Without: one of
        more than `DEFECT_TOLERANCE` of the scale; all of these if there is one shot, or
        half of the shots are beyond `GROSS`; else, of gains, the outliers alone if
        there are any; else all if a t test shows an excess in common, in proportion to
        its standard error, or to the momentum or energy before; else none.

        Args:
            defects: of one momentum, or of the energy, one for each shot.
            level: how often honest shots may be reported together.
            gains: only excesses > 0 count.
        """
        excess = np.array([d.excess for d in defects])
        scale = np.array([d.scale for d in defects])
        before = np.array([d.before for d in defects])
        error = np.array([d.error for d in defects])
        if gains:
            size = excess
        else:
            size = np.abs(excess)
        has_sigma = self.experiments.sigma is not None
        count = max(len(defects), 1)
        sigmas = max(DEFECT_SIGMAS, float(ndtri(1 - 0.5 * level / count)))
        is_far = size > (sigmas * error if has_sigma else DEFECT_TOLERANCE * scale)
        flagged = {d.k: d.ratio for d, far in zip(defects, is_far) if far}
        if (
            has_sigma
            or len(defects) < 2
            or not flagged
            or np.mean(size > GROSS * scale) >= 0.5
        ):
            return flagged
        if gains:
            outliers = self._gain_outliers(defects)
        else:
            outliers = set()
        if outliers:
            return {k: ratio for k, ratio in flagged.items() if k in outliers}
        has_error = error > 0
        weight = 1 / error[has_error]
        # excess / error is compared with a constant, and with before / error
        shapes = np.ones_like(weight), weight * before[has_error]
        weighted = weight * excess[has_error]
        chance = min(_p_value(weighted, shape, gains) for shape in shapes)
        if chance < level / len(shapes):
            return flagged
        return {}

    def _gain_outliers(self, gains: list[_Defect]) -> set[int]:
        """Indices of shots whose gain of energy is an outlier among all shots, of
        experiments without sigma.

        Excesses over their standard errors (of a sigma of 1 m/s) scatter by the noise
        about their median; the noise is the root mean square of the sigmas of energy
        and momenta by their shorter half, which outliers hardly change. An outlier is
        above the median by Student's t of OUTLIER_LEVEL, shared among the shots, times
        the noise, and above 0 by the normal quantile of DEFECT_LEVEL times the noise.
        Without degrees of freedom there is none.
        """
        groups = [gains, *self.momenta.values()]
        ratios = [
            np.array([d.excess / d.error for d in each if d.error > 0])
            for each in groups
        ]
        of_gains, *_ = ratios
        squares = [_sigma_by_shorter_half(each) ** 2 for each in ratios if len(each)]
        noise = np.sqrt(np.mean(squares))
        degrees_of_freedom = sum(len(each) - 1 for each in ratios if len(each))
        effective_freedom = _EFFICIENCY_OF_HALF * degrees_of_freedom
        if effective_freedom == 0:
            return set()
        share = OUTLIER_LEVEL / len(gains)
        apart = noise * float(stdtrit(effective_freedom, 1 - share))
        of_level = noise * float(ndtri(1 - DEFECT_LEVEL))
        least = max(of_level, np.median(of_gains) + apart)
        return {d.k for d in gains if d.error > 0 and d.excess / d.error > least}


def _error(gradient: np.ndarray, covariance: np.ndarray) -> float:
    """Standard error `sqrt(g^T S g)` of a function with the gradient g (2n,) in (v-,
    v+).
    """
    return float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))


def wrong_unit(experiments: Experiments, scene: Scene | None) -> str:
    """The sentence of the finding `units`, by the data alone; '' where units seem
    right.
    """
    balances = DataBalances(experiments, scene, stored_energy=0.0, uses_gaps=True)
    lines = (found.line for found in _units(balances))
    return next(lines, "")


def _units(data: DataBalances) -> Iterator[Finding]:
    """Yield `units` where velocities after exceed those before by the factor of a wrong
    unit.

    The factor is the median ratio of the conserved momenta; where there are none, the
    median root of the ratio of energies that grow.
    """
    ratios = [d.ratio for each in data.momenta.values() for d in each]
    gains = [np.sqrt(d.ratio) for d in data.energies if d.ratio > 1]
    if ratios:
        what = "momentum"
        values = ratios
    else:
        what = "root of the energy"
        values = gains
    balances = max(len(ratios), len(data.energies))
    if not values or len(values) < 0.5 * balances:
        return
    ratio = float(np.median(values))
    for factor, unit in UNIT_FACTORS.items():
        near = (factor, 1 / factor) if what == "momentum" else (factor,)
        if any(abs(ratio / value - 1) < UNIT_NEAR for value in near):
            if ratio >= 100:
                plainly = f"{ratio:.0f}"
            else:
                plainly = f"{ratio:.3g}"
            yield Finding(
                "units",
                f"Units? The {what} after is {plainly} times that before: {unit} in "
                f"one of the columns?",
                "the units are suspect",
                numbers={"ratio": ratio, "factor": factor},
            )
            return


def _momentum(data: DataBalances) -> Iterator[Finding]:
    """Yield `momentum`: shots that break a balance of momentum, and the rms that this
    leaves.
    """
    level = DEFECT_LEVEL / max(len(data.momenta), 1)
    ratios = {
        k: r
        for each in data.momenta.values()
        for k, r in data.beyond(each, level).items()
    }
    if not ratios:
        return
    floor = ""
    experiments = data.experiments
    if experiments.sigma is None:
        corrected = experiments.momentum_corrected(data.scene)
        change = np.asarray(experiments.post) - np.asarray(corrected.post)
        floor = f" (rms {np.sqrt(np.nanmean(change**2)):.3g} m/s)"
    yield Finding(
        "momentum",
        f"The data violate conservation of momentum (1 = conserved): "
        f"{data.listed(ratios)}; no law "
        f"can reproduce that part{floor}.",
        (
            f"the data violate conservation of momentum in "
            f"{share(len(ratios), data.total)}"
        ),
        data.labels(ratios),
    )


def _energy(data: DataBalances) -> Iterator[Finding]:
    """Yield `energy_gain`: shots whose kinetic energy grows by more than their
    noise.
    """
    if ratios := data.beyond(data.energies, DEFECT_LEVEL, gains=True):
        yield Finding(
            "energy_gain",
            f"The data gain energy (1 = conserved): {data.listed(ratios)}.",
            f"kinetic energy grows in {share(len(ratios), data.total)}",
            data.labels(ratios),
        )


def _resting(data: DataBalances) -> Iterator[Finding]:
    """Yield `no_approach`: shots in which no contact approaches that takes part in the
    law.
    """
    if data.stored_energy:
        return
    closed, possible = map(data.approaching, (closed_normals, possible_normals))
    resting = np.flatnonzero(~(possible if data.uses_gaps else closed))
    if count := len(resting):
        labels = data.labels(resting)
        why = "are pre and post swapped, or is a sign wrong?"
        if possible[resting].all():
            why = (
                "only open ones do, which take part in `Compliant` and `Binary` alone."
            )
        yield Finding(
            "no_approach",
            (
                f"No contact approaches in {count} of {data.total} shots "
                f"({listed(labels)}): {why}"
            ),
            f"no contact approaches in {share(count, data.total)}",
            labels,
        )


def _copies(data: DataBalances) -> Iterator[Finding]:
    """Yield `copies` where more than half of the shots are multiples of one, without
    sigma.

    Rows (v-, v+) of length 1 are compared with their median.
    """
    experiments = data.experiments
    if experiments.scenes is not None or experiments.sigma is not None:
        return
    pre = np.asarray(experiments.pre, float)
    rows = np.hstack([pre, np.asarray(experiments.post, float)])
    squares = np.nansum(rows**2, axis=1, keepdims=True)
    size = np.sqrt(squares)
    scaled = rows / np.where(size > 0, size, 1.0)
    unit = np.nan_to_num(scaled, nan=np.inf)
    # the median is the row that more than half have in common, if there is one
    median = np.median(unit, axis=0)
    same = np.isclose(unit, median, rtol=0, atol=ROUNDING).all(axis=1)
    count = int(same.sum())
    total = data.total
    if 2 * count > total > 1:
        every = count == total
        yield Finding(
            "copies",
            f"{f'All {total}' if every else f'{count} of {total}'} shots are equal to "
            f"the last digit, but for a factor: they carry no more information than "
            f"one of them, and none on the noise; without `sigma` or `resolution` the "
            f"errors are meaningless.",
            f"{'the' if every else f'{count} of'} {total} shots are copies of one",
            data.labels(np.flatnonzero(same)),
        )


def _approaches(normals: np.ndarray, before: np.ndarray) -> bool:
    """True where a contact of normals (n, c) approaches: `N^T v- < 0` by more than
    rounding.
    """
    rounding = -ROUNDING * np.abs(normals).T @ np.abs(before)
    return bool((normals.T @ before < rounding).any())


DATA_CHECKS = (_units, _momentum, _energy, _resting, _copies)


def _sigma_by_shorter_half(values: np.ndarray) -> float:
    """Robust standard deviation: 1.4826 / 2 times the length of the shortest half of
    the values.

    That is the shortest interval that holds more than half of them (Rousseeuw and
    Leroy, 1988).
    """
    ordered = np.sort(values)
    count = len(ordered) // 2 + 1
    return (
        _SIGMA_OVER_HALF
        * float(np.min(ordered[count - 1 :] - ordered[: 1 - count or None]))
        / 2
    )


def _p_value(excess: np.ndarray, shape: np.ndarray, gains: bool) -> float:
    """p-value of the hypothesis a = 0 in a regression of excesses (N,) on a shape (N,).

    Equation: `excess = a shape + noise`, `t = a / error(a)`; P(T > t) of Student's t
    with N - 1 degrees of freedom for `gains`, else P(|T| > |t|). 1 where it cannot be
    judged.
    """
    squares = float(shape @ shape)
    freedom = len(excess) - 1
    if freedom < 1 or squares == 0 or not excess.any():
        return 1.0
    slope = float(shape @ excess) / squares
    unexplained = float(np.sum((excess - slope * shape) ** 2))
    error = np.sqrt(unexplained / freedom / squares)
    if error:
        t = slope / error
    else:
        t = np.inf * np.sign(slope)
    above = float(stdtr(freedom, -t))
    if gains:
        return above
    return 2 * min(above, 1 - above)
