"""Errors of the velocities before an impact, passed on to those after it."""

import numpy as np

from jimpact.core.scene import Scene
from jimpact.fits.covariances import diagonal_blocks, moved_covariance
from jimpact.fits.data import Experiments, kept_by_corrections


def covariance_after(data: Experiments, scene: Scene | None, slopes: np.ndarray) -> np.ndarray:
    """Covariance (K, n, n), or (K, n, K, n), of v+ measured less v+ of a law at v- measured.

    Equation: `C = [-K J, I] S [-K J, I]^T` with S the covariance of (v-, v+), `J = dv+/dv-` of the
    law and K the projector by which momentum was corrected, the identity where it was not; of
    values that a correction keeps, `(I - K) S_++ (I - K)` is added.

    Args:
        data: K shots of n velocities, with errors of v-.
        scene: of all; None: each has its own.
        slopes: J (K or more, n, n); where it is not finite, the identity.
    """
    count, n = data.pre.shape
    slope = np.asarray(slopes[:count], float)
    slope = np.where(np.isfinite(slope).all(axis=(1, 2), keepdims=True), slope, np.eye(n))
    # a residual that conserves momentum shows that part of the errors
    kept = kept_by_corrections(data, scene)
    gain = kept @ np.concatenate([-slope, np.broadcast_to(np.eye(n), slope.shape)], axis=2)
    covariance = moved_covariance(data.joint, gain)
    own = diagonal_blocks(data.joint, 2 * n)[:, n:, n:]
    rest = (np.eye(n) - kept) @ own @ (np.eye(n) - kept).swapaxes(1, 2)
    each = np.arange(count)
    if covariance.ndim == 4:
        covariance[each, :, each] += rest
    else:
        covariance += rest
    return covariance
