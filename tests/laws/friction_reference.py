"""Frictional impacts by other means than the package's: closed form, small steps, regularization.

One planar contact: while slip keeps its sign, velocities are linear and the work is quadratic in
the normal impulse (Routh, Keller, Stronge), so that all of it is a sequence of closed forms.
Several contacts: a symmetric step of fixed length with Coulomb's law solved in each by projected
Gauss-Seidel; first order, no events. `regularized` integrates Coulomb's law with |u| replaced by
sqrt(|u|^2 + eps^2), in SI units, from one change of phase to the next, and extrapolates eps to 0:
what `tests/held/friction_space.npz` holds.
"""

import numpy as np
from scipy.integrate import solve_ivp


def blocks(scene, v):
    """W_nn, W_nt, W_tt, gap velocities, slip velocities."""
    mass = np.asarray(scene.mass)
    inverse = np.diag(1 / mass) if mass.ndim == 1 else np.linalg.inv(mass)
    n, h, v = (
        np.asarray(scene.normals),
        np.asarray(scene.tangents),
        np.asarray(v, float),
    )
    return n.T @ inverse @ n, n.T @ inverse @ h, h.T @ inverse @ h, n.T @ v, h.T @ v


def routh(scene, v, mu, e):
    """(p, p_t) of one planar contact with energetic restitution e > 0."""
    wn, wnt, wt, g, u = (float(x.ravel()[0]) for x in blocks(scene, v))
    if g >= 0:
        return 0.0, 0.0
    p = side = stored = 0.0
    compression = True

    def rest():  # stick, or slip against what friction cannot hold
        return 0.0 if abs(wnt) <= mu * wt else float(np.sign(wnt))

    s = float(np.sign(u)) if u else rest()
    while True:
        ratio = -mu * s if s else -wnt / wt
        dg, du = wn + wnt * ratio, (wnt + wt * ratio if s else 0.0)
        ends = [(-u / du, "stop")] if s and u and -u / du > 0 else []
        if compression and dg > 0:
            ends.append((-g / dg, "turn"))
        if not compression:
            a, b = dg / 2 / e**2, g / e**2
            ends.append(((-b + np.sqrt(b * b + 4 * a * stored)) / (2 * a), "end"))
        step, what = min(ends)
        work = g * step + dg * step**2 / 2
        stored -= work if compression else work / e**2
        g, u, p, side = g + dg * step, u + du * step, p + step, side + ratio * step
        if what == "end":
            return p, side
        if what == "stop":
            u, s = 0.0, rest()
        else:
            compression, g = False, 0.0


def small_steps(scene, v, stiffness, exponent, e, mu, steps=3000):
    """v+ of several contacts; `steps` in ten periods of the stiffest."""
    mass = np.asarray(scene.mass)
    inverse = np.diag(1 / mass) if mass.ndim == 1 else np.linalg.inv(mass)
    n, h = np.asarray(scene.normals), np.asarray(scene.tangents)
    m, rows = n.shape[1], h.shape[1] // n.shape[1]
    k, e, mu = (np.broadcast_to(x, (m,)).astype(float) for x in (stiffness, e, mu))
    along = h.T @ inverse @ h
    at = [slice(rows * j, rows * j + rows) for j in range(m)]
    relax = [1 / np.trace(along[i, i]) for i in at]
    dt = 10 / np.sqrt((np.diag(n.T @ inverse @ n) * k).max()) / steps
    v, x, side = np.array(v, float), np.zeros(m), np.zeros(rows * m)
    for _ in range(20 * steps):
        g = n.T @ v
        middle = np.maximum(x - np.where(g <= 0, 1.0, e**-2.0) * g * dt / 2, 0)
        p = dt * k * middle**exponent
        pushed = v + inverse @ n @ p
        slip = h.T @ pushed
        for _ in range(60):
            before = side.copy()
            for j, i in enumerate(at):
                tried = side[i] - relax[j] * (slip[i] + along[i] @ side)
                length = np.linalg.norm(tried)
                side[i] = (
                    tried if length <= mu[j] * p[j] else tried * (mu[j] * p[j] / length)
                )
            if np.abs(side - before).max() <= 1e-14 * np.abs(side).max():
                break
        after = pushed + inverse @ h @ side
        g = n.T @ (v + after) / 2
        x, v = np.maximum(x - np.where(g <= 0, 1.0, e**-2.0) * g * dt, 0), after
        if not x.any() and (n.T @ v >= -1e-12).all():
            return v
    raise RuntimeError("the impact did not end")


# ---------------------------------------------------------------- regularized friction

OPEN, CLOSES, OPENS = range(3)  # phases of a contact: no force; compression; expansion
RTOL = 1e-12
LONGEST = 1e3  # times the stroke of the softest contact


class Regularized:
    """Bistiffness contacts, `F = k x^eta`, with `lambda = -mu F u / sqrt(|u|^2 + eps^2)`.

    The state is (v, x); phases are frozen between events, so that the field is smooth there.
    """

    def __init__(
        self, scene, stiffness, exponent, e, mu, eps, method="Radau", rtol=RTOL
    ):
        mass = np.asarray(scene.mass, float)
        self.inverse = np.linalg.inv(np.diag(mass) if mass.ndim == 1 else mass)
        self.n, self.h = np.asarray(scene.normals), np.asarray(scene.tangents)
        m = self.m = self.n.shape[1]
        given = (stiffness, exponent, e, mu)
        self.k, self.eta, self.e, self.mu = (
            np.broadcast_to(x, (m,)).astype(float) for x in given
        )
        self.eps, self.method, self.rtol, self.phase = (
            eps,
            method,
            rtol,
            np.full(m, OPEN),
        )

    def rates(self, _, state):
        """(v', x')."""
        v, x = state[: -self.m], np.maximum(state[-self.m :], 0.0)
        force = np.where(self.phase == OPEN, 0.0, self.k * x**self.eta)
        u = (self.h.T @ v).reshape(self.m, -1)
        size = np.sqrt((u**2).sum(axis=1) + self.eps**2)
        side = -(self.mu * force / size)[:, None] * u
        pushed = self.inverse @ (self.n @ force + self.h @ side.ravel())
        slope = np.select(
            [self.phase == CLOSES, self.phase == OPENS], [1.0, self.e**-2.0], 0.0
        )
        return np.concatenate([pushed, -slope * (self.n.T @ v)])

    def events(self):
        """Gap velocities through 0 in either direction, and indentations that end."""
        found = []
        for j in range(self.m):

            def turns(_, state, j=j):
                return self.n[:, j] @ state[: -self.m]

            turns.terminal, turns.direction = (
                True,
                1.0 if self.phase[j] == CLOSES else -1.0,
            )
            found.append(turns)
            if self.phase[j] == OPENS:

                def ends(_, state, j=j):
                    return state[j - self.m]

                ends.terminal, ends.direction = True, -1.0
                found.append(ends)
        return found

    def follow(self, state):
        """The phases after an event, and the state with what has ended set to 0."""
        v, x = state[: -self.m].copy(), state[-self.m :].copy()
        gamma = self.n.T @ v
        # an event is located to rounding: what is within it goes on as the acceleration does
        rate = self.n.T @ self.rates(0.0, state)[: -self.m]
        small = np.abs(gamma) <= 1e-11 * self.speed
        closing = np.where(small, rate < 0, gamma < 0)
        x[(x <= 1e-13 * self.stroke) & ~closing] = 0.0
        self.phase = np.where(closing, CLOSES, np.where(x > 0, OPENS, OPEN))
        return np.concatenate([v, x])

    def after(self, v):
        """v+ (n,)."""
        v = np.asarray(v, float)
        gamma, w = self.n.T @ v, np.einsum("nj,nk,kj->j", self.n, self.inverse, self.n)
        self.speed = np.abs(gamma).max()
        strokes = ((self.eta + 1) * self.speed**2 / (2 * w * self.k)) ** (
            1 / (self.eta + 1)
        )
        self.stroke, time = strokes.max(), LONGEST * strokes.max() / self.speed
        state = np.concatenate([v, np.zeros(self.m)])
        self.phase = np.where(gamma < 0, CLOSES, OPEN)
        atol = self.rtol * np.append(
            np.full(len(v), self.speed), np.full(self.m, self.stroke)
        )
        for _ in range(1000):
            if (self.phase == OPEN).all():
                return state[: -self.m]
            options = {
                "method": self.method,
                "rtol": self.rtol,
                "atol": atol,
                "events": self.events(),
            }
            run = solve_ivp(self.rates, (0.0, time), state, **options)
            if run.status != 1:
                break
            state = self.follow(run.y[:, -1])
        raise RuntimeError("the impact did not end")


def regularized(scene, v, stiffness, exponent, e, mu, eps=1e-6, method="Radau"):
    """v+ (n,) for eps -> 0, and how far it is from what eps and 2 eps gave.

    Errors are of first order in eps [1 over the fastest approach]: twice the one less the other.
    """
    speed = np.abs(np.asarray(scene.normals).T @ np.asarray(v, float)).max()
    runs = [
        Regularized(
            scene, stiffness, exponent, e, mu, part * eps * speed, method
        ).after(v)
        for part in (1.0, 2.0)
    ]
    limit = 2 * runs[0] - runs[1]
    return limit, np.abs(limit - runs[0]).max()
