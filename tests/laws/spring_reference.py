"""Contacts with tangential springs by scipy's DOP853 from event to event, in SI units.

An own integration of `x' = -c gamma`, `M v' = N F + H lambda`: nothing is shared with the package.
"""

import numpy as np
from scipy.integrate import solve_ivp

OPEN, COMPRESSED, EXPANDS = 0, 1, 2
START = (
    1e-9  # [s] the first moment of contacts that slide from x = 0, where the force is 0
)


class Springs:
    """Contacts of masses (n,), normals (n, m), tangents (n, b m), and their parameters (m,)."""

    def __init__(self, mass, normals, tangents, mu, kappa, e, k, eta, rtol=1e-11):
        self.mass = np.asarray(mass)
        self.normals = np.asarray(normals)
        self.m = self.normals.shape[1]
        self.tangents = np.asarray(tangents).reshape(len(self.mass), self.m, -1)
        self.b = self.tangents.shape[2]
        parameters = (mu, kappa, e, k, eta)
        shaped = [np.broadcast_to(np.asarray(z, float), (self.m,)) for z in parameters]
        self.mu, self.kappa, self.e, self.k, self.eta = shaped
        self.rtol = rtol

    def split(self, y):
        """v (n,), x (m,), xi (m, b) of a state."""
        n, m = len(self.mass), self.m
        return y[:n], y[n : n + m], y[n + m :].reshape(m, self.b)

    def of(self, y):
        """gamma (m,), u (m, b), F (m,), and the radius mu x / (kappa eta) of the cone of xi."""
        v, x, _ = self.split(y)
        gamma = self.normals.T @ v
        u = np.einsum("nmb,n->mb", self.tangents, v)
        depth = np.maximum(x, 0.0)
        force = np.where(self.phase != OPEN, self.k * depth**self.eta, 0.0)
        return gamma, u, force, self.mu * depth / (self.kappa * self.eta)

    def sinks(self, gamma):
        """x' of each contact."""
        fast = np.where(self.phase == EXPANDS, 1 / self.e**2, 1.0)
        return np.where(self.phase == OPEN, 0.0, -fast * gamma)

    def rates(self, _, y):
        """dy/dt in the present modes."""
        _, x, xi = self.split(y)
        gamma, u, force, _ = self.of(y)
        sinks = self.sinks(gamma)
        rate, side = np.zeros_like(xi), np.zeros_like(xi)
        for j in np.flatnonzero(self.phase != OPEN):
            if self.slides[j]:
                size = np.linalg.norm(xi[j])
                n = xi[j] / size if size > 0 else np.zeros(self.b)
                rate[j] = self.mu[j] / (self.kappa[j] * self.eta[j]) * sinks[j] * n
                rate[j] += u[j] - n * (n @ u[j])
                side[j] = -self.mu[j] * force[j] * n
            else:
                rate[j] = u[j]
                depth = max(x[j], 1e-300)
                side[j] = -self.kappa[j] * self.eta[j] * force[j] / depth * xi[j]
        push = self.normals @ force + np.einsum("nmb,mb->n", self.tangents, side)
        return np.concatenate([push / self.mass, sinks, rate.ravel()])

    def margins(self):
        """Functions of (t, y), a name and a contact for each: they fall through 0 at its end."""

        def normal(j):
            phase = self.phase[j]
            if phase == OPEN:
                return [("closes", lambda t, y: self.of(y)[0][j] + 1e-13)]
            if phase == COMPRESSED:
                return [("turns", lambda t, y: -self.of(y)[0][j])]
            return [
                ("opens", lambda t, y: self.split(y)[1][j]),
                ("is compressed", lambda t, y: self.of(y)[0][j]),
            ]

        def slip(t, y, j):
            gamma, u, _, _ = self.of(y)
            xi = self.split(y)[2][j]
            along = xi @ u[j] / np.linalg.norm(xi)
            return (
                along
                - self.mu[j] / (self.kappa[j] * self.eta[j]) * self.sinks(gamma)[j]
            )

        def room(t, y, j):
            return self.of(y)[3][j] - np.linalg.norm(self.split(y)[2][j])

        for j in range(self.m):
            for name, function in normal(j):
                yield name, j, function
            if self.phase[j] == OPEN:
                continue
            if self.slides[j]:
                yield "holds", j, lambda t, y, j=j: slip(t, y, j)
            else:
                yield "slides", j, lambda t, y, j=j: room(t, y, j)

    def touched(self, y, j):
        """State where contact j, which has just closed, slides at once or holds."""
        v, x, xi = (z.copy() for z in self.split(y))
        gamma, u, _, _ = self.of(y)
        speed = np.linalg.norm(u[j])
        steep = self.kappa[j] * self.eta[j]
        self.slides[j] = steep * speed > self.mu[j] * abs(gamma[j])
        if self.slides[j]:  # a moment later
            x[j] = START * abs(gamma[j]) + START**2
            xi[j] = self.mu[j] * x[j] / steep * u[j] / speed
        return np.concatenate([v, x, xi.ravel()])

    def after(self, v, most=400):
        """v+ (n,) from v- (n,), and the greatest |lambda| / (mu F) seen at events."""
        y = np.concatenate([v, np.zeros(self.m), np.zeros(self.m * self.b)])
        gamma = self.normals.T @ np.asarray(v)
        self.phase = np.where(gamma <= 0, COMPRESSED, OPEN)
        self.slides = np.zeros(self.m, bool)
        for j in np.flatnonzero(self.phase == COMPRESSED):
            y = self.touched(y, j)
        for _ in range(most):
            if np.all(self.phase == OPEN) and np.all(
                self.normals.T @ self.split(y)[0] > -1e-12
            ):
                return self.split(y)[0]
            found = list(self.margins())
            events = [f for _, _, f in found]
            for f in events:
                f.terminal, f.direction = True, -1
            size = np.abs(v).max()
            run = solve_ivp(
                self.rates, (0, 1e3), y, "DOP853", events=events, rtol=self.rtol,
                atol=self.rtol * 1e-2 * size, first_step=1e-4 if self.m > 1 else None,
            )  # fmt: skip
            fired = [i for i, t in enumerate(run.t_events) if len(t)]
            if not fired:
                raise RuntimeError("no event")
            name, j, _ = found[fired[0]]
            y = self.switched(run.y[:, -1], name, j)
        raise RuntimeError("too many events")

    def switched(self, y, name, j):
        """State after an event of contact j."""
        v, x, xi = (z.copy() for z in self.split(y))
        if name == "turns":
            self.phase[j] = EXPANDS
        elif name == "is compressed":
            self.phase[j] = COMPRESSED
        elif name == "opens":
            self.phase[j], self.slides[j] = OPEN, False
            x[j], xi[j] = 0.0, 0.0
        elif name == "holds":
            self.slides[j] = False
            xi[j] *= (1 - 1e-13) * self.of(y)[3][j] / np.linalg.norm(xi[j])
        elif name == "slides":
            self.slides[j] = True
        y = np.concatenate([v, x, xi.ravel()])
        if name == "closes":
            self.phase[j] = COMPRESSED
            y = self.touched(y, j)
        return y
