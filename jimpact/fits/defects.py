"""What measured shots break beyond their errors: momentum, energy, approach."""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtr

from jimpact.files.records import listed
from jimpact.fits.experiments import Experiments, closed_normals
from jimpact.fits.findings import Finding, share
from jimpact.scene import Scene, dense_mass

# Defects below this share of the momentum or energy before are not reported: a good measurement of
# a velocity is accurate to a tenth of a percent. Ten times more would hide defects of a percent.
DEFECT_TOLERANCE = 1e-3
# With `sigma`, a defect is reported beyond this many of its standard errors, ...
DEFECT_SIGMAS = 3.0
# ... or beyond more, so that all shots together show one by chance at most this often.
DEFECT_LEVEL = 0.02
# Beyond this share of the momentum or energy before, in half of the shots or more, a defect needs
# no test: no noise of a useful measurement is as large, but a wrong unit is. With ten times more, a
# factor of 3.6 (km/h) in two shots would go unseen.
GROSS = 0.5
SEPARATION = 1e-9  # share of the velocities up to which an approach is rounding
# Share of the velocities by which copies of a shot, scaled, may differ: rounding. Ten times more
# would still be far below what is measured.
COPIED = 1e-9
# Factors that a wrong unit leaves in velocities: cm/s or mm/s for m/s, km/h, a decimal slip. A
# median ratio of velocities within UNIT_NEAR of one (or of its inverse) is reported. Ten times
# nearer, and noise of a percent would hide it.
UNIT_FACTORS, UNIT_NEAR = {10.0: "a decimal point", 100.0: "cm/s", 1000.0: "mm/s", 3.6: "km/h"}, 0.1
_LISTED = 6  # shots listed one by one with their ratios; of more, the range is reported


def data_defects(
    experiments: Experiments, scene: Scene | None = None, stored_energy: float = 0.0
) -> list[str]:
    """What the data break beyond their error, a line each: momentum, energy, approach; copies.

    Momentum is reported as `1 + excess / sum |m v-|`, the excess in the direction of the momentum
    before: after over before where all bodies move one way. Without `sigma` the shots show their
    noise: a defect is one that they have in common, the same excess or the same share of the
    momentum before, whichever way that points (t tests), or one of half of the momentum in half of
    the shots; of a single shot any above a tenth of a percent.

    Args:
        experiments: the shots; those with missing values are not judged.
        scene: the common scene, None where the shots carry their own.
        stored_energy: what the law may add to the energy (precompression) [J].

    >>> import jimpact as ji
    >>> from jimpact.fits.defects import data_defects
    >>> data_defects(ji.Experiments([1.0, 0.0], [0.0, 1.2]), ji.chain([1.0, 1.0]))[1]
    'The data gain energy (1 = conserved): shot 1: 1.4400.'
    """
    return [found.line for found in find_defects(experiments, scene, stored_energy)]


def find_defects(
    experiments: Experiments, scene: Scene | None, stored_energy: float
) -> list[Finding]:
    """The same, and what a quoted value has to say of each."""
    measured = _balances(experiments, scene, stored_energy)
    momentum = {
        k: ratio
        for each in measured.momenta.values()
        for k, ratio in _beyond_noise(each, DEFECT_LEVEL / len(measured.momenta)).items()
    }
    energy = _beyond_noise(measured.energies, DEFECT_LEVEL, gains=True)
    resting = [experiments.shots[k] for k in measured.resting]
    total, found = len(experiments.shots), []
    found += _units(measured)
    if momentum:
        found.append(
            Finding(
                "The data violate conservation of momentum (1 = conserved): "
                f"{_listed(experiments, momentum)}; "
                f"no law can reproduce that part{_floor(experiments, scene)}.",
                f"the data violate conservation of momentum in {share(len(momentum), total)}",
            )
        )
    if energy:
        found.append(
            Finding(
                f"The data gain energy (1 = conserved): {_listed(experiments, energy)}.",
                f"kinetic energy grows in {share(len(energy), total)}",
            )
        )
    if resting:
        found.append(
            Finding(
                f"No contact approaches in {len(resting)} of {total} shots "
                f"({listed(resting)}): are pre and post swapped, or is a sign wrong?",
                f"no contact approaches in {share(len(resting), total)}",
            )
        )
    copies = _copies(experiments)
    if experiments.sigma is None and 2 * copies > total > 1:
        which = f"All {total}" if copies == total else f"{copies} of {total}"
        found.append(
            Finding(
                f"{which} shots are equal to the last digit, but for a factor: they carry no "
                "more information than one of them, and none on the noise; without `sigma` or "
                "`resolution` the errors are meaningless.",
                f"{'the' if copies == total else f'{copies} of'} {total} shots are copies of one",
            )
        )
    return found


def _units(measured: "_Balances") -> list[Finding]:
    """Whether velocities after are those before but for a factor that a wrong unit leaves.

    By the momentum that is conserved; where none is, by the energy where it grows.
    """
    ratios = [d.ratio for each in measured.momenta.values() for _, d in each]
    gains = [np.sqrt(d.ratio) for _, d in measured.energies if d.ratio > 1]
    what, values = ("momentum", ratios) if ratios else ("root of the energy", gains)
    if not values or len(values) < 0.5 * max(len(ratios), len(measured.energies)):
        return []
    ratio = float(np.median(values))
    for factor, unit in UNIT_FACTORS.items():
        near = (factor, 1 / factor) if what == "momentum" else (factor,)
        if any(abs(ratio / value - 1) < UNIT_NEAR for value in near):
            text = f"Units? The {what} after is {ratio:.3g} times that before: {unit}"
            return [Finding(f"{text} in one of the columns?", "the units are suspect")]
    return []


class _Balances(NamedTuple):
    """Balances of all shots, with the number of the shot."""

    momenta: dict[int, list[tuple[int, "_Defect"]]]  # by the momentum that is conserved
    energies: list[tuple[int, "_Defect"]]
    resting: list[int]  # shots in which no contact approaches


def _balances(experiments: Experiments, scene: Scene | None, stored_energy: float) -> _Balances:
    """Momentum and energy of each shot before and after."""
    momenta: dict[int, list[tuple[int, _Defect]]] = {}
    energies, resting = [], []
    energy_ratios = experiments.energy_ratio(scene)
    errors = None if experiments.sigma is None else np.asarray(experiments.sigma, float)
    if errors is not None and experiments.sigma_pre is not None:
        errors = np.hstack([errors, np.asarray(experiments.sigma_pre, float)])
    masses, closed = experiments.each(scene, dense_mass), experiments.each(scene, closed_normals)
    for k, (rows, pre, post) in enumerate(experiments.balances(scene)):
        normals, mass = closed[k], masses[k]
        slowest = -SEPARATION * np.abs(normals).T @ np.abs(pre)
        if stored_energy == 0 and (normals.T @ pre >= slowest).all():
            resting.append(k)
        if np.isnan(post).any():
            continue
        sigma = None if errors is None else errors[k]
        both = slice(None) if experiments.sigma_pre is not None else slice(len(post))
        for j, row in enumerate(rows):
            excess, scale = row @ (post - pre), np.abs(row) @ np.abs(pre)
            back = row @ pre < -SEPARATION * scale
            ratio = 1 + (-excess if back else excess) / scale if scale else np.inf
            slope = np.append(row, -row)[both]
            defect = _Defect(excess, scale, row @ pre, slope, sigma, ratio)
            momenta.setdefault(j, []).append((k, defect))
        t_minus, t_plus = 0.5 * pre @ mass @ pre, 0.5 * post @ mass @ post
        gain = t_plus - t_minus - stored_energy
        slope = np.append(mass @ post, -mass @ pre)[both]
        energies.append((k, _Defect(gain, t_minus, t_minus, slope, sigma, energy_ratios[k])))
    return _Balances(momenta, energies, resting)


def _copies(experiments: Experiments) -> int:
    """How many shots of a scene are one, several times or scaled; fewer if at most half are."""
    if experiments.scenes is not None:
        return 1
    rows = np.hstack([np.asarray(experiments.pre, float), np.asarray(experiments.post, float)])
    size = np.sqrt(np.nansum(rows**2, axis=1, keepdims=True))
    unit = np.nan_to_num(rows / np.where(size > 0, size, 1.0), nan=np.inf)
    # what more than half have in common is the median
    return int(np.isclose(unit, np.median(unit, axis=0), rtol=0, atol=COPIED).all(axis=1).sum())


class _Defect(NamedTuple):
    """By how much a balance fails, its scale, the momentum or energy before, derivatives in v+
    (and v-), their errors, a ratio."""

    excess: float
    scale: float
    before: float
    slope: np.ndarray
    sigma: np.ndarray | None
    ratio: float


def _beyond_noise(
    defects: list[tuple[int, _Defect]], level: float, gains: bool = False
) -> dict[int, float]:
    """Ratios of the shots whose balance fails by more than their noise; gains: upwards only."""
    size = np.array([d.excess if gains else abs(d.excess) for _, d in defects])
    if any(d.sigma is not None for _, d in defects):
        sigmas = max(DEFECT_SIGMAS, float(ndtri(1 - 0.5 * level / len(defects))))
        limit = [
            np.inf if d.sigma is None else np.linalg.norm(d.slope * d.sigma) for _, d in defects
        ]
        return {k: d.ratio for (k, d), x, y in zip(defects, size, limit) if x > sigmas * y}
    scale = np.array([d.scale for _, d in defects])
    flagged = {k: d.ratio for (k, d), x in zip(defects, size > DEFECT_TOLERANCE * scale) if x}
    if len(defects) < 2 or not flagged or np.mean(size > GROSS * scale) >= 0.5:
        return flagged
    weight = np.array([1 / np.linalg.norm(d.slope) if d.slope.any() else 0.0 for _, d in defects])
    excess = weight * [d.excess for _, d in defects]
    shapes = [np.sign(weight), weight * [d.before for _, d in defects]]
    chances = [_chance(excess[weight > 0], shape[weight > 0], gains) for shape in shapes]
    return flagged if min(chances) < level / len(shapes) else {}


def _chance(excess: np.ndarray, shape: np.ndarray, gains: bool) -> float:
    """How often noise alone follows a shape as much: Student's t; 1 where it cannot be judged."""
    squares, freedom = float(shape @ shape), len(excess) - 1
    if freedom < 1 or squares == 0:
        return 1.0
    share = float(shape @ excess) / squares
    rest = float(np.sum((excess - share * shape) ** 2))
    error = np.sqrt(rest / freedom / squares)
    t = share / error if error else np.inf * np.sign(share)
    above = float(stdtr(freedom, -t))
    return above if gains else 2 * min(above, 1 - above)


def _listed(experiments: Experiments, ratios: dict[int, float]) -> str:
    """Shots with their ratios, or the range of the ratios of many."""
    if len(ratios) <= _LISTED:
        return ", ".join(f"shot {experiments.shots[k]}: {r:.4f}" for k, r in ratios.items())
    values = list(ratios.values())
    share = f"{len(ratios)} of {len(experiments.shots)} shots"
    return f"{share}, {min(values):.4f} to {max(values):.4f}"


def _floor(experiments: Experiments, scene: Scene | None) -> str:
    """The rms that the momentum defect alone leaves, whatever the law."""
    if experiments.sigma is not None:
        return ""
    change = np.asarray(experiments.post) - np.asarray(experiments.momentum_corrected(scene).post)
    return f" (rms {np.sqrt(np.nanmean(change**2)):.3g} m/s)"
