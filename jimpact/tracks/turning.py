"""Free rotation of a body, and the orientation and angular velocity of a flight from its frames."""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

# Turn [rad] and angular velocity [rad/s] of difference quotients: errors are as many parts of a
# derivative. Ten times more does no harm; ten times less, and rounding counts as much.
SMALL = 1e-5
RTOL = 1e-10  # of free rotation, relative; ten times more is still far below noise
STEPS = 20  # of Gauss-Newton in a flight; 4 are common, and more do not help
SETTLED = 1e-9  # [rad] of a step; ten times more is still far below noise


@dataclass(frozen=True)
class Turning:
    """Orientation and angular velocity, in the axes of the body, in the middle of a flight.

    Fields: middle [s]; turn; omega (3,) [rad/s]; covariance (6, 6) of (turn by axes of the body,
    omega); inertia (3, 3) up to a factor, None: that of a sphere.
    """

    middle: float
    turn: Rotation
    omega: np.ndarray
    covariance: np.ndarray
    inertia: np.ndarray | None

    def moved(self, step: np.ndarray) -> "Turning":
        """The same after a change (6,) of turn and omega."""
        turn = self.turn * Rotation.from_rotvec(step[:3])
        return Turning(self.middle, turn, self.omega + step[3:], self.covariance, self.inertia)

    def rate(self, omega: np.ndarray) -> np.ndarray:
        """omega' (3,) at this omega (3,)."""
        if self.inertia is None:
            return np.zeros(3)
        return -np.linalg.solve(self.inertia, np.cross(omega, self.inertia @ omega))

    def at(self, times: np.ndarray) -> tuple[Rotation, np.ndarray, np.ndarray, np.ndarray]:
        """At times (F,): orientations, omega (F, 3), and the slopes of both (F, 3, 6) by `moved`.

        Turns are about the axes that the body has at that time.
        """
        starts = [self, *(self.moved(step) for step in SMALL * np.eye(6))]
        each = [free_rotation(x.turn, x.omega, times - self.middle, self.inertia) for x in starts]
        (turn, omega), others = each[0], each[1:]
        turning = [(turn.inv() * other).as_rotvec() / SMALL for other, _ in others]
        return (
            turn,
            omega,
            np.stack(turning, axis=2),
            np.stack([(other - omega) / SMALL for _, other in others], axis=2),
        )


def free_rotation(
    turn: Rotation, omega: np.ndarray, since: np.ndarray, inertia: np.ndarray | None
) -> tuple[Rotation, np.ndarray]:
    """Orientations and omega (F, 3) at times `since` (F,), rising, of a body without torque.

    Equation: `R' = R [omega]x`, `I omega' = -omega x I omega`, omega in the axes of the body.
    """
    if inertia is None:  # omega stays
        return turn * Rotation.from_rotvec(since[:, None] * omega), np.tile(omega, (len(since), 1))
    inverse = np.linalg.inv(inertia)

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        rows, w = state[:9].reshape(3, 3), state[9:]
        return np.concatenate([np.cross(rows, w).ravel(), -inverse @ np.cross(w, inertia @ w)])

    start = np.concatenate([turn.as_matrix().ravel(), omega])
    states = np.tile(start, (len(since), 1))
    for some in (since < 0, since > 0):
        if some.any():
            times = since[some] if since[some][0] > 0 else since[some][::-1]
            path = solve_ivp(
                rates, (0.0, times[-1]), start, "DOP853", times, rtol=RTOL, atol=RTOL
            ).y.T
            states[some] = path if times[0] > 0 else path[::-1]
    return Rotation.from_matrix(states[:, :9].reshape(-1, 3, 3)), states[:, 9:]


def fit_turning(
    t: np.ndarray, measured: Rotation, sigma: np.ndarray, inertia: np.ndarray | None
) -> tuple[Turning, np.ndarray]:
    """A flight by the orientations of its frames, and the turns (F, 3) [rad] that are left.

    Args:
        t: (F,), F >= 3.
        measured: F orientations.
        sigma: of turns about the axes of the body (3,).
        inertia: (3, 3), or None.
    """
    middle, nearest = float(t.mean()), len(t) // 2
    steps = (measured[:-1].inv() * measured[1:]).as_rotvec() / np.diff(t)[:, None]
    flight = Turning(middle, measured[nearest], np.median(steps, axis=0), np.eye(6), inertia)
    flight = flight.moved(np.append((middle - t[nearest]) * flight.omega, np.zeros(3)))
    for _ in range(STEPS):
        turn, _, slopes, _ = flight.at(t)
        rest = (turn.inv() * measured).as_rotvec()
        J = (slopes / sigma[:, None]).reshape(-1, 6)
        step = np.linalg.lstsq(J, (rest / sigma).ravel(), rcond=None)[0]
        flight = flight.moved(step)
        if np.abs(step[:3]).max() < SETTLED:
            break
    covariance = np.linalg.pinv(J.T @ J, hermitian=True)
    rest = (flight.at(t)[0].inv() * measured).as_rotvec()
    return Turning(middle, flight.turn, flight.omega, covariance, inertia), rest
