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
        turns = Rotation.concatenate([x.turn for x in starts])
        each = np.stack([x.omega for x in starts])
        turn, omega = free_rotation(turns, each, times - self.middle, self.inertia)
        turning = [(turn[0].inv() * other).as_rotvec() / SMALL for other in turn[1:]]
        return (
            turn[0],
            omega[0],
            np.stack(turning, axis=2),
            np.moveaxis((omega[1:] - omega[0]) / SMALL, 0, 2),
        )


def free_rotation(
    turns: Rotation, omegas: np.ndarray, since: np.ndarray, inertia: np.ndarray | None
) -> tuple[list[Rotation], np.ndarray]:
    """Of B starts the F orientations each, and omega (B, F, 3), at rising times `since` (F,).

    Equation: `R' = R [omega]x`, `I omega' = -omega x I omega` without torque, omega in the axes of
    the body.
    """
    if inertia is None:  # omega stays
        paths = [r * Rotation.from_rotvec(since[:, None] * w) for r, w in zip(turns, omegas)]
        return paths, np.tile(omegas[:, None], (1, len(since), 1))
    count, inverse = len(omegas), np.linalg.inv(inertia)

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        each = state.reshape(count, 4, 3)
        rows, w = each[:, :3], each[:, 3:]
        slope = -np.cross(w, w @ inertia) @ inverse  # both are symmetric
        return np.concatenate([np.cross(rows, w), slope], axis=1).ravel()

    start = np.concatenate([turns.as_matrix(), omegas[:, None]], axis=1).ravel()
    states = np.tile(start, (len(since), 1))
    for some in (since < 0, since > 0):
        if some.any():
            # outwards from 0
            order = np.flatnonzero(some)[:: -1 if since[some][0] < 0 else 1]
            span = (0.0, since[order[-1]])
            path = solve_ivp(rates, span, start, "DOP853", since[order], rtol=RTOL, atol=RTOL)
            states[order] = path.y.T
    states = states.reshape(len(since), count, 4, 3).swapaxes(0, 1)
    return [Rotation.from_matrix(x[:, :3]) for x in states], states[:, :, 3]


def fit_turning(
    t: np.ndarray, measured: Rotation, sigma: np.ndarray, inertia: np.ndarray | None
) -> tuple[Turning, np.ndarray]:
    """A flight by the orientations of its frames, and the turns (F, 3) [rad] that are left.

    Args:
        t: (F,), F >= 2.
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
