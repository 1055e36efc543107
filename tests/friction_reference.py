"""Frictional impacts by other means than the package's: closed form, and small steps.

One planar contact: while slip keeps its sign, velocities are linear and the work is quadratic in
the normal impulse (Routh, Keller, Stronge), so that all of it is a sequence of closed forms.
Several contacts: a symmetric step of fixed length with Coulomb's law solved in each by projected
Gauss-Seidel; first order, no events.
"""

import numpy as np


def blocks(scene, v):
    """W_nn, W_nt, W_tt, gap velocities, slip velocities."""
    mass = np.asarray(scene.mass)
    inverse = np.diag(1 / mass) if mass.ndim == 1 else np.linalg.inv(mass)
    n, h, v = np.asarray(scene.normals), np.asarray(scene.tangents), np.asarray(v, float)
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
                side[i] = tried if length <= mu[j] * p[j] else tried * (mu[j] * p[j] / length)
            if np.abs(side - before).max() <= 1e-14 * np.abs(side).max():
                break
        after = pushed + inverse @ h @ side
        g = n.T @ (v + after) / 2
        x, v = np.maximum(x - np.where(g <= 0, 1.0, e**-2.0) * g * dt, 0), after
        if not x.any() and (n.T @ v >= -1e-12).all():
            return v
    raise RuntimeError("the impact did not end")
