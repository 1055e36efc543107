"""Measured spin of a body, on which the acceleration of its flights may depend."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from jimpact.tools.checks import as_float_array, check_concrete, check_values


@dataclass(frozen=True)
class Spin:
    """Angular velocities (T, 3) [rad/s] at times (T,) since the mean one."""

    t: np.ndarray
    omega: np.ndarray

    def at(self, times: np.ndarray, ends: np.ndarray | None = None) -> np.ndarray:
        """Angular velocities (..., 3) at times (...), linear between those measured.

        Of B flights with ends (B, 2) at times (B, ...) by frames between these, as an
        impact changes the spin; None: by all.
        """
        if ends is not None:
            begin, end = ends.T
            last = len(self.t) - 1
            first_frame = np.searchsorted(self.t, begin).clip(0, last)
            last_frame = (np.searchsorted(self.t, end, "right") - 1).clip(0, last)
            low = self.t[first_frame][:, None]
            times = np.clip(times, low, np.maximum(self.t[last_frame][:, None], low))
        columns = [np.interp(times, self.t, w) for w in self.omega.T]
        return np.stack(columns, axis=-1)


def spin_of(t: np.ndarray, spin: Any) -> Spin | None:
    """Checked spin (3,) or (T, 3), NaN where it is not known; None: none is given."""
    if spin is None:
        return None
    check_concrete("spin", spin)
    omega = np.asarray(as_float_array("spin", spin), float)
    if omega.shape not in ((3,), (len(t), 3)):
        raise ValueError(
            f"Argument `spin` must have shape (3,) or ({len(t)}, 3), that of each "
            f"frame, but has shape {omega.shape}."
        )
    check_values("spin", omega, nan_allowed=True)
    omega = np.broadcast_to(omega, (len(t), 3))
    known = np.isfinite(omega).all(axis=1)
    if not known.any():
        raise ValueError("Argument `spin` must be known in a frame, but is NaN in all.")
    return Spin((t - t.mean())[known], omega[known])
