"""Poses as a tracker writes them: the order of the quaternion, its length, moments of
inertia.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jimpact.bodies.rigid import place_of, quaternion_of
from jimpact.tools.checks import check_choice
from jimpact.tracks.frames import neighbours

ORDERS = {"wxyz": (1, 2, 3, 0), "xyzw": (0, 1, 2, 3)}  # where x, y, z, w stand
# How far a measured quaternion may be from length 1; with three digits it is off by
# less. Ten times more would pass angles for quaternions in one of ten frames.
LENGTH_WITHIN = 1e-2


def as_poses(q: Any, order: str) -> tuple[np.ndarray, np.ndarray]:
    """Places (T, 3) and unit quaternions (T, 4), scalar first, NaN where lost."""
    check_choice("quaternion", order, tuple(ORDERS))
    q = np.array(q, float)
    if q.ndim != 2 or q.shape[1] != 7:
        raise ValueError(
            f"Argument `q` must have shape (T, 7), x, y, z and a quaternion, as "
            f"`quaternion` is given, but has shape {q.shape}."
        )
    e = quaternion_of(q)[:, np.roll(ORDERS[order], 1)]
    length = np.linalg.norm(e, axis=1)
    far = np.abs(length - 1) > LENGTH_WITHIN  # no where a frame is lost
    if far.any():
        k = int(far.argmax())
        raise ValueError(
            f"Argument `q` must have quaternions of length 1, but that of frame "
            f"{k + 1} has length {length[k]:.4g}. Are these angles? A lost frame must "
            f"be NaN, not 0."
        )
    return place_of(q), e / length[:, None]


def as_inertia(inertia: Any) -> np.ndarray | None:
    """Inertia (3, 3) from three moments or a matrix, checked; None where all moments
    are equal.
    """
    if inertia is None:
        return None
    array = np.asarray(inertia, float)
    if array.shape == (3,):
        array = np.diag(array)
    symmetric = (
        array.shape == (3, 3)
        and np.isfinite(array).all()
        and np.allclose(array, array.T)
    )
    if symmetric:
        moments = np.linalg.eigvalsh(array)
    else:
        moments = np.zeros(3)
    if not moments[0] > 0:
        raise ValueError(
            f"Argument `inertia` must be three moments > 0 along the axes of the body, "
            f"or a symmetric (3, 3), but has value {np.asarray(inertia).tolist()}."
        )
    if np.allclose(moments, moments[0]):
        return None
    return array


def turns_since_first(e: np.ndarray) -> np.ndarray:
    """Sums (T, 3) [rad] of turns from frame to frame about the axes of the body; NaN
    where lost.

    A turn is the rotation vector of `R_k^-1 R_(k+1)`.
    """
    seen = np.isfinite(e).all(axis=1)
    sums = np.full((len(e), 3), np.nan)
    measured = Rotation.from_quat(e[seen], scalar_first=True)
    now, then = neighbours(measured)
    steps = (now.inv() * then).as_rotvec()
    sums[seen] = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return sums


def in_the_other_order(e: np.ndarray, order: str) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion (4,) if the file stood in the other order than `order`, and the matrix
    A (3, 3).

    Poses turn evenly in either order, as it turns the unit sphere of quaternions only:
    frames alone cannot tell. omega = 2 e* e' becomes A omega.
    """
    if order == "wxyz":
        shift = 1
    else:
        shift = -1
    other = np.roll(e, shift)
    product = _left(other).T @ np.roll(_left(e), shift, axis=0)
    vectors = slice(1, None)  # rows and columns of x, y, z, without the scalar
    return other, product[vectors, vectors]


def _left(e: np.ndarray) -> np.ndarray:
    """Matrix L (4, 4) of the product of quaternions, `e f = L f`."""
    w, x, y, z = e
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
