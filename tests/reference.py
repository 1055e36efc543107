"""Oracles that share no code and no formulation with the package.

`lzb_oracle` integrates the *dimensional* LZB equations with scipy's DOP853 and its event
root-finding, restarting at every change of phase. Slow, plain, accurate to about 1e-11.
"""

import numpy as np
from scipy.integrate import solve_ivp


def chain_matrices(masses, wall=False):
    masses = np.asarray(masses, float)
    n = len(masses)
    left, right = wall in ("left", "both"), wall in (True, "right", "both")
    columns = []
    if left:
        columns.append(np.eye(n)[0])
    columns += [np.eye(n)[i + 1] - np.eye(n)[i] for i in range(n - 1)]
    if right:
        columns.append(-np.eye(n)[n - 1])
    normals = np.array(columns).T
    return np.diag(masses), normals


def lzb_oracle(
    mass, normals, velocity, k, e, eta, u0=0.0, tol=1e-12, slack=1e-11, max_phases=400
):
    """(v+, p, duration, maximum force) of the LZB law, by scipy."""
    mass, normals = np.asarray(mass, float), np.asarray(normals, float)
    m = normals.shape[1]
    k, e, eta, u0 = (
        np.broadcast_to(np.asarray(z, float), (m,)).copy() for z in (k, e, eta, u0)
    )
    w = normals.T @ np.linalg.solve(mass, normals)
    gamma0 = normals.T @ np.asarray(velocity, float)
    x = ((eta + 1) * u0 / k) ** (1 / (eta + 1))
    p, t, peak = np.zeros(m), 0.0, np.zeros(m)
    scale = max(np.abs(gamma0).max(), np.sqrt(2 * u0.max() * w.max()))
    open_, compression, expansion = 0, 1, 2
    phase = np.where((gamma0 <= 0) | (x > 0), compression, open_)
    phase = np.where((x > 0) & (gamma0 > 0), expansion, phase)

    def force(x):
        return k * np.maximum(x, 0.0) ** eta

    for _ in range(max_phases):
        gamma = gamma0 + w @ p
        if np.all(x <= 0) and np.all(gamma >= -slack * scale):
            return np.asarray(velocity) + np.linalg.solve(mass, normals @ p), p, t, peak
        c = np.where(phase == open_, 0.0, np.where(phase == compression, 1.0, 1 / e**2))

        def rhs(_, y, c=c):
            return np.concatenate([-c * (gamma0 + w @ y[m:]), force(y[:m])])

        events = []
        for j in range(m):

            def g(_, y, j=j):
                return (gamma0 + w @ y[m:])[j]

            def closing(_, y, j=j):
                return (gamma0 + w @ y[m:])[j] + slack * scale

            def indentation(_, y, j=j):
                return y[j]

            if phase[j] == compression:
                g.direction = 1
                events.append((j, g))
            elif phase[j] == expansion:
                g.direction, indentation.direction = -1, -1
                events += [(j, g), (j, indentation)]
            else:
                closing.direction = -1
                events.append((j, closing))
        for _, fun in events:
            fun.terminal = True
        working = force(x)[force(x) > 0] if np.any(x > 0) else None
        horizon = 1e6 if working is None else 1e8
        step = solve_ivp(
            rhs,
            (0, horizon),
            np.concatenate([x, p]),
            method="DOP853",
            events=[fun for _, fun in events],
            rtol=tol,
            atol=tol * 1e-4,
        )
        x, p, t = step.y[:m, -1], step.y[m:, -1], t + step.t[-1]
        peak = np.maximum(peak, force(x))
        hit = [i for i, times in enumerate(step.t_events) if len(times)]
        if not hit:
            raise RuntimeError("no event: the impact does not end")
        for i in hit:
            j, fun = events[i]
            if fun.__name__ == "indentation":
                phase[j], x[j] = open_, 0.0
            elif phase[j] == compression:
                phase[j] = expansion if x[j] > 1e-13 else open_
                x[j] = x[j] if x[j] > 1e-13 else 0.0
            else:
                phase[j] = compression
    raise RuntimeError("too many phases")


def pair(m1, m2, v1, v2, e):
    """Two bodies: Newton's textbook result."""
    p = (1 + e) * (v1 - v2) / (1 / m1 + 1 / m2)
    return v1 - p / m1, v2 + p / m2


def linear_three_balls(gamma, t):
    """Positions and velocities of (6.15), three equal balls, k1 = 1, k2 = gamma."""
    matrix = np.array([[-1, 1, 0], [1, -1 - gamma, gamma], [0, gamma, -gamma]], float)
    values, vectors = np.linalg.eigh(-matrix)
    omega = np.sqrt(np.maximum(values, 0))
    start = vectors.T @ np.array([1.0, 0, 0])
    moved = np.where(
        omega > 1e-12, np.sin(omega * t) / np.where(omega > 1e-12, omega, 1), t
    )
    return vectors @ (moved * start), vectors @ (np.cos(omega * t) * start)
