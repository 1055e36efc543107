"""What is wrong with measured shots: tests, each with the sentence that the report has for it."""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtr, stdtrit

from jimpact.core.scene import Scene, dense_mass
from jimpact.fits.covariances import diagonal_blocks
from jimpact.fits.data import ROUNDING, Experiments, closed_normals, possible_normals
from jimpact.fits.findings import Finding
from jimpact.tools.records import listed

# ------------------------------------------------------------------ thresholds of the data
# Defects below this share of the momentum or energy before are not reported: a good measurement of
# a velocity is accurate to a tenth of a percent. Ten times more would hide defects of a percent.
DEFECT_TOLERANCE = 1e-3
# With `sigma`, a defect is reported beyond this many of its standard errors, ...
DEFECT_SIGMAS = 3.0
# ... or beyond more, so that all shots together show one by chance at most this often.
DEFECT_LEVEL = 0.02
# Without `sigma`, a gain of energy of one shot is reported where the scatter of all shots shows one
# by chance this often, by Student's t; of 15 shots it is really .015, as the scatter of few is
# often too small by chance. With ten times more, elastic shots are blamed in one of ten sets.
OUTLIER_LEVEL = 0.003
# Beyond this share of the momentum or energy before, in half of the shots or more, a defect needs
# no test: no noise of a useful measurement is as large, but a wrong unit is. With ten times more, a
# factor of 3.6 (km/h) in two shots would go unseen.
GROSS = 0.5
# Factors that a wrong unit leaves in velocities: cm/s or mm/s for m/s, km/h, a decimal slip. A
# median ratio of velocities within UNIT_NEAR of one (or of its inverse) is reported. Ten times
# nearer, and noise of a percent would hide it.
UNIT_FACTORS, UNIT_NEAR = {10.0: "a decimal point", 100.0: "cm/s", 1000.0: "mm/s", 3.6: "km/h"}, 0.1

# Standard deviation of a normal distribution over half the length of its shortest half, and the
# share of the values that would estimate it as well by their mean square (Rousseeuw and Leroy
# 1988).
_SIGMA_OVER_HALF, _EFFICIENCY_OF_HALF = 1.4826, 0.37

LISTED = 6  # shots named one by one (with their ratios); of more, how many there are


def share(count: int, total: int) -> str:
    """So many of all shots, in words.

    >>> from jimpact.fits.data_checks import share
    >>> share(1, 1), share(6, 6), share(2, 6)
    ('this shot', 'all 6 shots', '2 of 6 shots')
    """
    if count == total < 3:
        return "this shot" if total == 1 else "both shots"
    return f"all {total} shots" if count == total else f"{count} of {total} shots"


# ------------------------------------------------------------------ what the data break


class _Defect(NamedTuple):
    """By how much a balance of the k-th shot fails, its scale, the momentum or energy before, a
    ratio, the standard error of the excess (with a sigma of 1 where it is not known)."""

    k: int
    excess: float
    scale: float
    before: float
    ratio: float
    error: float


class DataBalances:
    """Measured shots with the balances of each; those with missing values are not judged.

    Momentum is reported as `1 + excess / sum |m v-|`, the excess in the direction of the momentum
    before: after over before where all bodies move one way. Without `sigma` the shots show their
    noise: a defect is one that they have in common, the same excess or the same share of the
    momentum before, whichever way that points (t tests), or one of half of the momentum in half of
    the shots; of a single shot any above a tenth of a percent. A gain of energy is one of a shot by
    itself, too, where it is beyond the scatter of all shots.

    Args:
        experiments: the shots.
        scene: the common scene, None where the shots carry their own.
        stored_energy: what the law may add to the energy (precompression) [J].
        uses_gaps: whether open contacts take part.
    """

    def __init__(
        self, experiments: Experiments, scene: Scene | None, stored_energy: float, uses_gaps: bool
    ):
        self.experiments, self.scene = experiments, scene
        self.stored_energy, self.uses_gaps = stored_energy, uses_gaps
        self.total = len(experiments.shots)
        self.momenta: dict[int, list[_Defect]] = {}  # by the momentum that is conserved
        self.energies: list[_Defect] = []
        count, n = experiments.pre.shape
        joint = np.tile(np.diag(np.repeat([0.0, 1.0], n)), (count, 1, 1))  # where nothing is known
        if experiments.joint is not None:
            joint = diagonal_blocks(experiments.joint, 2 * n)
        balances = zip(experiments.balances(scene), experiments.each(scene, dense_mass), joint)
        for k, ((rows, pre, post), mass, covariance) in enumerate(balances):
            if np.isnan(post).any():
                continue
            for j, row in enumerate(rows):
                excess, scale, before = row @ (post - pre), np.abs(row) @ np.abs(pre), row @ pre
                back = before < -ROUNDING * scale
                ratio = 1 + (-excess if back else excess) / scale if scale else np.inf
                error = _error(np.append(-row, row), covariance)
                defect = _Defect(k, excess, scale, before, ratio, error)
                self.momenta.setdefault(j, []).append(defect)
            t_minus, t_plus = 0.5 * pre @ mass @ pre, 0.5 * post @ mass @ post
            gain, ratio = t_plus - t_minus - stored_energy, t_plus / t_minus if t_minus else np.nan
            error = _error(np.append(-mass @ pre, mass @ post), covariance)
            self.energies.append(_Defect(k, gain, t_minus, t_minus, ratio, error))

    def approaching(self, normals_of: Callable[[Scene], np.ndarray]) -> np.ndarray:
        """Shots (K,) in which one of the contacts with these normals approaches."""
        pairs = zip(self.experiments.each(self.scene, normals_of), np.asarray(self.experiments.pre))
        return np.array([_approaches(normals, pre) for normals, pre in pairs])

    def labels(self, shots: Iterable[int]) -> tuple[str, ...]:
        """Of these shots."""
        return tuple(self.experiments.shots[k] for k in shots)

    def listed(self, ratios: dict[int, float]) -> str:
        """Shots with their ratios, or the range of the ratios of many."""
        if len(ratios) <= LISTED:
            shots = self.experiments.shots
            return ", ".join(f"shot {shots[k]}: {r:.4f}" for k, r in ratios.items())
        values = ratios.values()
        return f"{len(ratios)} of {self.total} shots, {min(values):.4f} to {max(values):.4f}"

    def beyond(self, defects: list[_Defect], level: float, gains: bool = False) -> dict[int, float]:
        """Shots whose balance fails by more than their noise, with ratios; gains: upwards only."""
        _, excess, scale, before, _, error = np.array(defects).reshape(-1, 6).T
        size, known = excess if gains else np.abs(excess), self.experiments.sigma is not None
        sigmas = max(DEFECT_SIGMAS, float(ndtri(1 - 0.5 * level / max(len(defects), 1))))
        beyond = size > (sigmas * error if known else DEFECT_TOLERANCE * scale)
        flagged = {d.k: d.ratio for d, far in zip(defects, beyond) if far}
        if known or len(defects) < 2 or not flagged or np.mean(size > GROSS * scale) >= 0.5:
            return flagged
        alone = self._beyond_scatter(defects) if gains else set()
        if alone:
            return {k: ratio for k, ratio in flagged.items() if k in alone}
        some = error > 0
        weight = 1 / error[some]
        shapes = np.sign(weight), weight * before[some]
        chance = min(_chance(weight * excess[some], shape, gains) for shape in shapes)
        return flagged if chance < level / len(shapes) else {}

    def _beyond_scatter(self, gains: list[_Defect]) -> set[int]:
        """Shots that gain energy, and do so beyond the noise that the scatter of all shots shows.

        Excesses over their standard errors with a sigma of 1 [m/s] scatter by the noise about what
        the shots have in common, but for some: the shorter half of them has its length, of energy
        and momentum. Student's t for each shot.
        """
        groups = [gains, *self.momenta.values()]
        values = [np.array([d.excess / d.error for d in each if d.error > 0]) for each in groups]
        noise = np.sqrt(np.mean([_shorter_half(each) ** 2 for each in values if len(each)]))
        freedom = _EFFICIENCY_OF_HALF * sum(len(each) - 1 for each in values if len(each))
        if freedom == 0:
            return set()
        apart = noise * float(stdtrit(freedom, 1 - OUTLIER_LEVEL / len(gains)))
        least = max(noise * float(ndtri(1 - DEFECT_LEVEL)), np.median(values[0]) + apart)
        return {d.k for d in gains if d.error > 0 and d.excess / d.error > least}


def _error(gradient: np.ndarray, covariance: np.ndarray) -> float:
    """Standard error of what has this gradient (2n,) in (v-, v+)."""
    return float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))


def wrong_unit(experiments: Experiments, scene: Scene | None) -> str:
    """What speaks for a wrong unit, '' if nothing does: by the data alone, before any search."""
    return next((found.line for found in _units(DataBalances(experiments, scene, 0.0, True))), "")


def _units(data: DataBalances) -> Iterator[Finding]:
    """Whether velocities after are those before but for a factor that a wrong unit leaves.

    By the momentum that is conserved; where none is, by the energy where it grows.
    """
    ratios = [d.ratio for each in data.momenta.values() for d in each]
    gains = [np.sqrt(d.ratio) for d in data.energies if d.ratio > 1]
    what, values = ("momentum", ratios) if ratios else ("root of the energy", gains)
    if not values or len(values) < 0.5 * max(len(ratios), len(data.energies)):
        return
    ratio = float(np.median(values))
    for factor, unit in UNIT_FACTORS.items():
        near = (factor, 1 / factor) if what == "momentum" else (factor,)
        if any(abs(ratio / value - 1) < UNIT_NEAR for value in near):
            plainly = f"{ratio:.0f}" if ratio >= 100 else f"{ratio:.3g}"
            yield Finding(
                "units",
                f"Units? The {what} after is {plainly} times that before: {unit} in one of the "
                "columns?",
                "the units are suspect",
                numbers={"ratio": ratio, "factor": factor},
            )
            return


def _momentum(data: DataBalances) -> Iterator[Finding]:
    """Shots that break a momentum beyond their noise, and the rms that this alone leaves."""
    level = DEFECT_LEVEL / max(len(data.momenta), 1)
    ratios = {k: r for each in data.momenta.values() for k, r in data.beyond(each, level).items()}
    if not ratios:
        return
    floor, experiments = "", data.experiments
    if experiments.sigma is None:
        corrected = experiments.momentum_corrected(data.scene)
        change = np.asarray(experiments.post) - np.asarray(corrected.post)
        floor = f" (rms {np.sqrt(np.nanmean(change**2)):.3g} m/s)"
    yield Finding(
        "momentum",
        f"The data violate conservation of momentum (1 = conserved): {data.listed(ratios)}; no law "
        f"can reproduce that part{floor}.",
        f"the data violate conservation of momentum in {share(len(ratios), data.total)}",
        data.labels(ratios),
    )


def _energy(data: DataBalances) -> Iterator[Finding]:
    """Shots that gain energy beyond their noise."""
    if ratios := data.beyond(data.energies, DEFECT_LEVEL, gains=True):
        yield Finding(
            "energy_gain",
            f"The data gain energy (1 = conserved): {data.listed(ratios)}.",
            f"kinetic energy grows in {share(len(ratios), data.total)}",
            data.labels(ratios),
        )


def _resting(data: DataBalances) -> Iterator[Finding]:
    """Shots in which no contact approaches."""
    if data.stored_energy:
        return
    closed, possible = map(data.approaching, (closed_normals, possible_normals))
    resting = np.flatnonzero(~(possible if data.uses_gaps else closed))
    if count := len(resting):
        labels = data.labels(resting)
        why = "are pre and post swapped, or is a sign wrong?"
        if possible[resting].all():
            why = "only open ones do, which take part in `Compliant` and `Binary` alone."
        yield Finding(
            "no_approach",
            f"No contact approaches in {count} of {data.total} shots ({listed(labels)}): {why}",
            f"no contact approaches in {share(count, data.total)}",
            labels,
        )


def _copies(data: DataBalances) -> Iterator[Finding]:
    """Whether most shots of a scene are one, several times or scaled, with no sigma."""
    experiments = data.experiments
    if experiments.scenes is not None or experiments.sigma is not None:
        return
    rows = np.hstack([np.asarray(experiments.pre, float), np.asarray(experiments.post, float)])
    size = np.sqrt(np.nansum(rows**2, axis=1, keepdims=True))
    unit = np.nan_to_num(rows / np.where(size > 0, size, 1.0), nan=np.inf)
    # what more than half have in common is the median
    same = np.isclose(unit, np.median(unit, axis=0), rtol=0, atol=ROUNDING).all(axis=1)
    count, total = int(same.sum()), data.total
    if 2 * count > total > 1:
        every = count == total
        yield Finding(
            "copies",
            f"{f'All {total}' if every else f'{count} of {total}'} shots are equal to the last "
            "digit, but for a factor: they carry no more information than one of them, and none "
            "on the noise; without `sigma` or `resolution` the errors are meaningless.",
            f"{'the' if every else f'{count} of'} {total} shots are copies of one",
            data.labels(np.flatnonzero(same)),
        )


def _approaches(normals: np.ndarray, before: np.ndarray) -> bool:
    """Whether contacts of normals (n, c) approach at v- (n,), by more than rounding."""
    return bool((normals.T @ before < -ROUNDING * np.abs(normals).T @ np.abs(before)).any())


DATA_CHECKS = (_units, _momentum, _energy, _resting, _copies)


def _shorter_half(values: np.ndarray) -> float:
    """Standard deviation by the shortest interval that holds more than half of the values."""
    ordered = np.sort(values)
    count = len(ordered) // 2 + 1
    return _SIGMA_OVER_HALF * float(np.min(ordered[count - 1 :] - ordered[: 1 - count or None])) / 2


def _chance(excess: np.ndarray, shape: np.ndarray, gains: bool) -> float:
    """p-value of the hypothesis that excesses (N,) hold no part of this shape (N,).

    Equation: regression `excess = a shape + noise`, `t = a / error(a)`; P(T > t) of Student's t
    with N - 1 degrees of freedom for `gains`, else P(|T| > |t|). 1 where it cannot be judged.
    """
    squares, freedom = float(shape @ shape), len(excess) - 1
    if freedom < 1 or squares == 0 or not excess.any():
        return 1.0
    slope = float(shape @ excess) / squares
    left = float(np.sum((excess - slope * shape) ** 2))
    error = np.sqrt(left / freedom / squares)
    t = slope / error if error else np.inf * np.sign(slope)
    above = float(stdtr(freedom, -t))
    return above if gains else 2 * min(above, 1 - above)
