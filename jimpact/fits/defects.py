"""What measured shots break beyond their errors: momentum, energy, approach."""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtr

from jimpact.files.records import listed
from jimpact.fits.experiments import Experiments, closed_normals
from jimpact.scene import Scene, dense_mass

# Defects below this share of the momentum or energy before are not reported: a good measurement of
# a velocity is accurate to a tenth of a percent. Ten times more would hide defects of a percent.
DEFECT_TOLERANCE = 1e-3
# With `sigma`, a defect is reported beyond this many of its standard errors, ...
DEFECT_SIGMAS = 3.0
# ... or beyond more, so that all shots together show one by chance at most this often.
DEFECT_LEVEL = 0.02
SEPARATION = 1e-9  # share of the velocities up to which an approach is rounding
_LISTED = 6  # shots listed one by one with their ratios; of more, the range is reported


def data_defects(
    experiments: Experiments, scene: Scene | None = None, stored_energy: float = 0.0
) -> list[str]:
    """What the data break beyond their error, a line each: momentum, energy, approach; copies.

    Momentum is reported as `1 + excess / sum |m v-|`: after over before where all bodies move one
    way. Without `sigma` the shots show their noise: a defect is one that they have in common (a t
    test), of a single shot any above a tenth of a percent.

    Args:
        experiments: the shots; those with missing values are not judged.
        scene: the common scene, None where the shots carry their own.
        stored_energy: what the law may add to the energy (precompression) [J].

    >>> import jimpact as ji
    >>> from jimpact.fits.defects import data_defects
    >>> data_defects(ji.Experiments([1.0, 0.0], [0.0, 1.2]), ji.chain([1.0, 1.0]))[1]
    'The data gain energy (1 = conserved): shot 1: 1.4400.'
    """
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
            ratio = 1 + excess / scale if scale else np.inf
            defect = _Defect(excess, scale, np.append(row, -row)[both], sigma, ratio)
            momenta.setdefault(j, []).append((k, defect))
        t_minus, t_plus = 0.5 * pre @ mass @ pre, 0.5 * post @ mass @ post
        gain = t_plus - t_minus - stored_energy
        slope = np.append(mass @ post, -mass @ pre)[both]
        energies.append((k, _Defect(gain, t_minus, slope, sigma, energy_ratios[k])))
    momentum = {
        k: ratio
        for momentum_ratios in momenta.values()
        for k, ratio in _beyond_noise(momentum_ratios).items()
    }
    energy = _beyond_noise(energies, gains=True)
    lines = []
    if momentum:
        lines.append(
            "The data violate conservation of momentum (1 = conserved): "
            f"{_listed(experiments, momentum)}; "
            f"no law can reproduce that part{_floor(experiments, scene)}."
        )
    if energy:
        lines.append(f"The data gain energy (1 = conserved): {_listed(experiments, energy)}.")
    if resting:
        labels = [experiments.shots[k] for k in resting]
        lines.append(
            f"No contact approaches in {len(labels)} of {len(experiments.shots)} shots "
            f"({listed(labels)}): are pre and post swapped, or is a sign wrong?"
        )
    rows = np.hstack([np.asarray(experiments.pre, float), np.asarray(experiments.post, float)])
    copies = len(rows) > 1 and experiments.sigma is None and (rows == rows[:1]).all()
    if copies and experiments.scenes is None:
        lines.append(
            f"All {len(rows)} shots are equal to the last digit: they carry no more information "
            "than one of them, and none on the noise; without `sigma` the errors are meaningless."
        )
    return lines


class _Defect(NamedTuple):
    """By how much a balance fails, its scale, derivatives in v+ (and v-), their errors, a ratio."""

    excess: float
    scale: float
    slope: np.ndarray
    sigma: np.ndarray | None
    ratio: float


def _beyond_noise(defects: list[tuple[int, _Defect]], gains: bool = False) -> dict[int, float]:
    """Ratios of the shots whose balance fails by more than their noise; gains: upwards only."""
    if any(d.sigma is not None for _, d in defects):
        sigmas = max(DEFECT_SIGMAS, float(ndtri(1 - 0.5 * DEFECT_LEVEL / len(defects))))
        return {
            k: d.ratio
            for k, d in defects
            if d.sigma is not None
            and (d.excess if gains else abs(d.excess)) > sigmas * np.linalg.norm(d.slope * d.sigma)
        }
    flagged = {
        k: d.ratio
        for k, d in defects
        if (d.excess if gains else abs(d.excess)) > DEFECT_TOLERANCE * d.scale
    }
    if len(defects) < 2 or not flagged:
        return flagged
    noise = np.array([d.excess / np.linalg.norm(d.slope) for _, d in defects if d.slope.any()])
    if len(noise) < 2:
        return flagged
    mean, error = noise.mean(), noise.std(ddof=1) / np.sqrt(len(noise))
    chance = stdtr(len(noise) - 1, -mean / error if error else -np.inf * np.sign(mean))
    return flagged if (chance if gains else 2 * min(chance, 1 - chance)) < DEFECT_LEVEL else {}


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
