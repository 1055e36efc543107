"""Errors of the velocities before an impact, passed on to those after it."""

import numpy as np
from jaxtyping import Float

from jimpact.core.scene import Scene
from jimpact.shots.covariances import diagonal_blocks, moved_covariance
from jimpact.shots.data import Experiments, kept_by_corrections


def covariance_after(
    data: Experiments, scene: Scene | None, slopes: Float[np.ndarray, "M n n"]
) -> Float[np.ndarray, "K n n"] | Float[np.ndarray, "K n K n"]:
    """Covariance of `v+ measured - v+(law at v- measured)`, with the errors of v- passed on.

    Equation: `C = A S A^T + (I - P) S_++ (I - P)^T`, `A = P [-J, I]`, with S the covariance of
    (v-, v+), `J = dv+/dv-` of the law and P the projector by which momentum was corrected, the
    identity where it was not.

    Args:
        data: K shots of n velocities, with errors of v-.
        scene: of all shots; None: each has its own.
        slopes: J of M >= K shots; where it is not finite, the identity.

    Returns:
        C of each shot; of all shots where the covariance of the data is.
    """
    count, n = data.pre.shape
    slope = np.asarray(slopes[:count], float)
    slope = np.where(np.isfinite(slope).all(axis=(1, 2), keepdims=True), slope, np.eye(n))
    # a residual that conserves momentum shows only that part of the errors
    kept = kept_by_corrections(data, scene)
    gain = kept @ np.concatenate([-slope, np.broadcast_to(np.eye(n), slope.shape)], axis=2)
    covariance = moved_covariance(data.joint, gain)
    after, lost = diagonal_blocks(data.joint, 2 * n)[:, n:, n:], np.eye(n) - kept
    removed = lost @ after @ lost.swapaxes(1, 2)
    shots = np.arange(count)
    if covariance.ndim == 4:
        covariance[shots, :, shots] += removed
    else:
        covariance += removed
    return covariance
