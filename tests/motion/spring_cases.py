"""Shared: a box on a plane by scipy's Radau, on linear springs with friction."""

import numpy as np
from scipy.integrate import solve_ivp

G = 9.80665


class SpringBox:
    """A box of `size` [m] and `mass` [kg] whose corners have springs k and kappa k, and mu."""

    def __init__(self, size, mass, stiffness, mu, kappa):
        self.size = np.asarray(size)
        self.mass = mass
        self.stiffness = stiffness
        self.mu = mu
        self.kappa = kappa
        square = self.size**2
        self.inertia = mass / 12 * (np.sum(square) - square)
        ends = (-0.5, 0.5)
        corners = np.array([[a, b, c] for a in ends for b in ends for c in ends])
        self.corners = corners * self.size

    def field(self, y, lag):
        """Rates of place, quaternion, velocity, spin and springs of the corners.

        Springs beyond mu F are drawn back within `lag` [s].
        """
        place = y[:3]
        s = y[3]
        a = y[4:7]
        v = y[7:10]
        spin = y[10:13]
        xi = y[13:].reshape(8, 2)
        length = s * s + a @ a
        cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
        turn = np.eye(3) + 2 * (s * cross + cross @ cross) / length
        arms = self.corners @ turn.T
        depth = np.maximum(-(place[2] + arms[:, 2]), 0.0)
        slip = v + np.cross(turn @ spin, arms)
        stretched = np.linalg.norm(xi, axis=1)
        over = np.maximum(stretched - self.mu * depth / self.kappa, 0.0) / lag
        drawn = over / np.maximum(stretched, 1e-30)
        touches = (depth > 0)[:, None]
        side = -self.kappa * self.stiffness * xi * touches
        force = np.concatenate([side, self.stiffness * depth[:, None]], axis=1)
        torque = turn.T @ np.sum(np.cross(arms, force), axis=0)
        rate = np.where(touches, slip[:, :2], 0.0) - drawn[:, None] * xi
        parts = [
            v,
            [-0.5 * a @ spin],
            0.5 * (s * spin + np.cross(a, spin)),
            np.sum(force, axis=0) / self.mass - [0, 0, G],
            (torque - np.cross(spin, self.inertia * spin)) / self.inertia,
            rate.reshape(-1),
        ]
        return np.concatenate(parts)

    def late(self, q, v, end, lag):
        """Velocities at the end, with springs that are drawn back `lag` too late."""
        start = np.concatenate([q, v, np.zeros(16)])
        options = {"rtol": 1e-8, "atol": 1e-11, "max_step": 1e-3}
        run = solve_ivp(
            lambda t, y: self.field(y, lag), (0, end), start, "Radau", **options
        )
        return run.y[7:13, -1]

    def velocity(self, q, v, end):
        """Velocities at the end: the error of a lag is of order 1, and removed."""
        late = self.late(q, v, end, 1e-7)
        later = self.late(q, v, end, 1e-6)
        return late + (late - later) / 9
