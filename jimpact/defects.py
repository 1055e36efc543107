"""What measured shots break: momentum and energy, in words."""

import numpy as np

from jimpact.experiments import Experiments
from jimpact.scene import Scene, dense_mass

# Defects below this share of the momentum or energy before are no finding: a tenth of a percent
# is what a good measured velocity is worth. With `sigma`, a defect is held against its own error.
DEFECT_TOLERANCE = 1e-3
DEFECT_SIGMAS = 3.0
_LISTED = 6  # shots listed one by one; of more, the range is given


def data_defects(
    experiments: Experiments, scene: Scene | None = None, stored_energy: float = 0.0
) -> list[str]:
    """What the data break beyond their error: at most one line each for momentum and energy.

    Momentum is told as `1 + excess / sum |m v-|`: after over before where all bodies move one way.

    Args:
        experiments: the shots; those with missing values are not judged.
        scene: the common scene, None where the shots carry their own.
        stored_energy: what the law may add to the energy (precompression) [J].

    >>> import jimpact as ji
    >>> from jimpact.defects import data_defects
    >>> data_defects(ji.Experiments([1.0, 0.0], [0.0, 1.2]), ji.chain([1.0, 1.0]))[1]
    'The data gain energy (1 = conserved): shot 1: 1.4400.'
    """
    momentum, energy = {}, {}
    energy_ratios = experiments.energy_ratio(scene)
    for k, (rows, pre, post) in enumerate(experiments.balances(scene)):
        if np.isnan(post).any():
            continue
        sigma = None if experiments.sigma is None else np.asarray(experiments.sigma[k], float)
        for row in rows:
            excess, scale = row @ (post - pre), np.abs(row) @ np.abs(pre)
            error = None if sigma is None else float(np.linalg.norm(row * sigma))
            if _is_defect(excess, scale, error):
                momentum[k] = 1 + excess / scale if scale else np.inf
        mass = dense_mass(experiments.scene_of(scene, k))
        t_minus, t_plus = 0.5 * pre @ mass @ pre, 0.5 * post @ mass @ post
        error = None if sigma is None else float(np.linalg.norm((mass @ post) * sigma))
        gain = t_plus - t_minus - stored_energy
        if gain > 0 and _is_defect(gain, t_minus, error):
            energy[k] = energy_ratios[k]
    lines = []
    if momentum:
        lines.append(
            f"The data break momentum (1 = conserved): {_listed(experiments, momentum)}; "
            f"no law can reproduce that part{_floor(experiments, scene)}."
        )
    if energy:
        lines.append(f"The data gain energy (1 = conserved): {_listed(experiments, energy)}.")
    return lines


def _is_defect(excess: float, scale: float, error: float | None) -> bool:
    if error is not None:
        return bool(abs(excess) > DEFECT_SIGMAS * error)
    return bool(abs(excess) > DEFECT_TOLERANCE * scale)


def _listed(experiments: Experiments, ratios: dict[int, float]) -> str:
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
