"""Free rotation of a body, and the orientation and angular velocity of a flight from
its frames.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from jimpact.tracks.frames import neighbours

# Turn [rad] and angular velocity [rad/s] of difference quotients: errors are as many
# parts of a derivative. Ten times more does no harm; ten times less, and rounding
# counts as much.
SMALL = 1e-5
RTOL = 1e-10  # of free rotation, relative; ten times more is still far below noise
STEPS = 20  # of Gauss-Newton in a flight; 4 are common, and more do not help
SETTLED = 1e-9  # [rad] of a step; ten times more is still far below noise


@dataclass(frozen=True)
class Turning:
    """Free rotation of a flight: orientation and angular velocity omega in its middle.

    Fields: middle [s]; turn, the orientation; omega (3,) [rad/s] in the axes of the
    body; covariance (6, 6) of (turn about axes of the body [rad], omega); inertia (3,
    3) up to a factor,
    None: that of a sphere.
    """

    middle: float
    turn: Rotation
    omega: np.ndarray
    covariance: np.ndarray
    inertia: np.ndarray | None

    def moved(self, step: np.ndarray) -> "Turning":
        """Rotation after a change (6,) of turn, about axes of the body [rad], and of
        omega.
        """
        turned, change = np.split(step, 2)
        turn = self.turn * Rotation.from_rotvec(turned)
        omega = self.omega + change
        return Turning(self.middle, turn, omega, self.covariance, self.inertia)

    def rate(self, omega: np.ndarray) -> np.ndarray:
        """Acceleration `omega' = -I^-1 (omega x I omega)` (3,) [rad/s^2], without
        torque.
        """
        if self.inertia is None:
            return np.zeros(3)
        momentum = self.inertia @ omega
        moment = np.cross(omega, momentum)
        return -np.linalg.solve(self.inertia, moment)

    def at(self, times: np.ndarray) -> "TurningAt":
        """Orientations and angular velocities at times (F,) [s], and their derivatives.

        By difference quotients: free rotations from here, and from six starts moved by
        SMALL.
        """
        steps = SMALL * np.eye(6)
        starts = [self, *map(self.moved, steps)]
        turns = Rotation.concatenate([x.turn for x in starts])
        omegas = np.stack([x.omega for x in starts])
        rotations = free_rotation(turns, omegas, times - self.middle, self.inertia)
        turn, *moved_turns = rotations[0]
        omega, *moved_omegas = rotations[-1]
        back = turn.inv()
        turning = [(back * x).as_rotvec() / SMALL for x in moved_turns]
        changes = [(x - omega) / SMALL for x in moved_omegas]
        turn_slopes = np.stack(turning, axis=2)
        omega_slopes = np.stack(changes, axis=2)
        return TurningAt(turn, omega, turn_slopes, omega_slopes)


class TurningAt(NamedTuple):
    """A free rotation at F times, and its derivatives in the six values of
    `Turning.moved`.
    """

    turn: Rotation  # F orientations
    omega: np.ndarray  # (F, 3) [rad/s]
    # (F, 3, 6) of the turn about the axes of the body at that time
    turn_slopes: np.ndarray
    omega_slopes: np.ndarray  # (F, 3, 6)


def free_rotation(
    turns: Rotation, omegas: np.ndarray, since: np.ndarray, inertia: np.ndarray | None
) -> tuple[list[Rotation], np.ndarray]:
    """Free rotations from B starts: F orientations each, and omega (B, F, 3).

    Equation: `R' = R [omega]x`, `I omega' = -omega x I omega` without torque, omega in
    the axes of the body, at rising times `since` (F,) [s] after the start.
    """
    if inertia is None:  # omega stays
        angles = (since[:, None] * omega for omega in omegas)
        turned = map(Rotation.from_rotvec, angles)
        paths = [turn * change for turn, change in zip(turns, turned)]
        constant = np.tile(omegas[:, None], (1, len(since), 1))
        return paths, constant
    count = len(omegas)
    inverse = np.linalg.inv(inertia)

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        """Rates of B states: three rows of R, whose rates are `row x omega`, and
        omega.
        """
        of_starts = state.reshape(count, 4, 3)
        rows, w = np.split(of_starts, [3], axis=1)
        slope = -np.cross(w, w @ inertia) @ inverse  # both are symmetric
        changes = np.concatenate([np.cross(rows, w), slope], axis=1)
        return changes.ravel()

    with_omega = np.concatenate([turns.as_matrix(), omegas[:, None]], axis=1)
    start = with_omega.ravel()
    states = np.tile(start, (len(since), 1))
    for way in (-1, 1):  # backwards, then forwards in time
        some = np.flatnonzero(way * since > 0)
        if some.size:
            outwards = some[::way]
            span = (0.0, since[outwards[-1]])
            times = since[outwards]
            path = solve_ivp(rates, span, start, "DOP853", times, rtol=RTOL, atol=RTOL)
            states[outwards] = path.y.T
    by_time = states.reshape(len(since), count, 4, 3)
    states = by_time.swapaxes(0, 1)
    matrices, omega = np.split(states, [3], axis=2)
    return [Rotation.from_matrix(x) for x in matrices], omega[:, :, 0]


def fit_turning(
    t: np.ndarray, measured: Rotation, sigma: np.ndarray, inertia: np.ndarray | None
) -> tuple[Turning, np.ndarray]:
    """Free rotation that fits the orientations of a flight, and the residual turns (F,
    3) [rad].

    Equation: least squares of `(R(t)^-1 R_measured) / sigma`, as rotation vectors, by
    Gauss-Newton in turn and omega; covariance `(J^T J)^-1`.

    Args:
        t: (F,), F >= 2.
        measured: F orientations.
        sigma: of turns about the axes of the body (3,).
        inertia: (3, 3), or None.
    """
    middle = float(t.mean())
    nearest = len(t) // 2
    earlier, later = neighbours(measured)
    turned_by = (earlier.inv() * later).as_rotvec()
    rates = turned_by / np.diff(t)[:, None]
    omega = np.median(rates, axis=0)
    flight = Turning(middle, measured[nearest], omega, np.eye(6), inertia)
    turn_to_middle = (middle - t[nearest]) * omega
    flight = flight.moved(np.append(turn_to_middle, np.zeros(3)))
    for _ in range(STEPS):
        fitted = flight.at(t)
        off = fitted.turn.inv() * measured
        rest = off.as_rotvec() / sigma
        slopes = fitted.turn_slopes / sigma[:, None]
        J = slopes.reshape(-1, 6)
        step, *_ = np.linalg.lstsq(J, rest.ravel(), rcond=None)
        flight = flight.moved(step)
        turned, _ = np.split(step, 2)
        if np.abs(turned).max() < SETTLED:
            break
    covariance = np.linalg.pinv(J.T @ J, hermitian=True)
    off = flight.at(t).turn.inv() * measured
    rest = off.as_rotvec()
    return Turning(middle, flight.turn, flight.omega, covariance, inertia), rest
