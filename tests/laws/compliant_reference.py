"""Oracles of the compliant law by scipy: dimensional, in velocities, restarted at every event.

`elastic_plastic` keeps contacts in phases (open, compression, expansion); `viscous` takes any force
f(x, x'), zero where it would pull. Both follow the real gaps. Slow, accurate to about 1e-11.
"""

import numpy as np
from scipy.integrate import solve_ivp

HORIZON = 1e9  # no event later than this: the impact does not end
ROUNDING = 1e-14  # events closer than this to the present are at hand


def _run(rates, y, events, tol):
    """Integrate to the first of `events` [(value(y), direction)]; returns y and those that rang."""
    functions = []
    for value, direction in events:

        def f(_, y, value=value):
            return value(y)

        f.terminal, f.direction = True, direction
        functions.append(f)
    done = solve_ivp(
        lambda _, y: rates(y),
        (0, HORIZON),
        y,
        "DOP853",
        events=functions,
        rtol=tol,
        atol=tol * 1e-3,
    )
    if done.status != 1:
        raise RuntimeError("no event: the impact does not end")
    return done.y[:, -1], [len(times) > 0 for times in done.t_events]


def _fly(x, gamma):
    """Gaps after the free flight to the next contact that closes, and which."""
    closing = gamma < 0
    due = np.where(closing, -x / np.where(closing, -gamma, 1.0), np.inf)
    j = int(np.argmin(due))
    x = x - gamma * due[j]
    x[j] = 0.0
    return x, j


def elastic_plastic(mass, normals, velocity, k, eta, e, gaps, tol=1e-12, phases=500):
    """v+ and largest forces of bistiffness contacts; an open one re-closes at its residual x."""
    m, inverse = normals.shape[1], np.linalg.inv(mass)
    k, eta, e = (np.broadcast_to(np.asarray(z, float), (m,)) for z in (k, eta, e))
    x, v = -np.asarray(gaps, float) * np.ones(m), np.asarray(velocity, float)
    peak = np.zeros(m)
    gamma = normals.T @ v
    loading = (x == 0) & (gamma <= 0)
    unloading = np.zeros(m, bool)
    for _ in range(phases):
        working = loading | unloading
        gamma = normals.T @ v
        if not (working & (x > 0)).any() and (gamma >= -1e-12).all():
            return v, peak
        if not working.any():
            x, j = _fly(x, gamma)
            loading = loading | (np.arange(m) == j)
            continue
        slow = np.where(unloading, 1 / np.where(e > 0, e, 1.0) ** 2, 1.0)

        def force(x, working=working):
            return np.where(working, k * np.maximum(x, 0) ** eta, 0.0)

        def rates(y, slow=slow, force=force):
            return np.concatenate(
                [-slow * (normals.T @ y[m:]), inverse @ (normals @ force(y[:m]))]
            )

        events, what = [], []
        for j in range(m):
            if loading[j]:
                events.append((lambda y, j=j: normals[:, j] @ y[m:], 1))
                what.append((j, "turn"))
            elif unloading[j]:
                events += [
                    (lambda y, j=j: normals[:, j] @ y[m:], -1),
                    (lambda y, j=j: y[j] + ROUNDING, -1),
                ]
                what += [(j, "reload"), (j, "open")]
            else:
                events.append((lambda y, j=j: y[j] - ROUNDING, 1))
                what.append((j, "close"))
        y, rang = _run(rates, np.concatenate([x, v]), events, tol)
        x, v = y[:m], y[m:]
        peak = np.maximum(peak, force(x))
        for (j, kind), now in zip(what, rang):
            if not now:
                continue
            loading[j], unloading[j] = (
                kind in ("close", "reload"),
                kind == "turn" and x[j] > 1e-13,
            )
            if kind in ("open", "close") or (kind == "turn" and not unloading[j]):
                x[j] = 0.0
    raise RuntimeError("too many phases")


def viscous(mass, normals, velocity, force, gaps, tol=1e-12, phases=500, onset=None):
    """v+ of contacts with `force(x, x')` for arrays (m,), cut at 0; `onset`: its smooth sign."""
    m, inverse = normals.shape[1], np.linalg.inv(mass)
    onset = force if onset is None else onset
    x, v = -np.asarray(gaps, float) * np.ones(m), np.asarray(velocity, float)
    gamma = normals.T @ v
    pushing = (x >= 0) & (gamma < 0)
    for _ in range(phases):
        gamma = normals.T @ v
        if not pushing.any():
            if (gamma >= -1e-12).all():
                return v
            if not ((x > 0) & (gamma < 0)).any():
                x, j = _fly(x, gamma)
                pushing = np.arange(m) == j
                continue

        def rates(y, pushing=pushing):
            rate = -(normals.T @ y[m:])
            f = np.where(pushing, np.maximum(force(np.maximum(y[:m], 0), rate), 0), 0.0)
            return np.concatenate([rate, inverse @ (normals @ f)])

        def sign(y, j):
            return onset(y[:m], -(normals.T @ y[m:]))[j]

        events, what = [], []
        for j in range(m):
            if pushing[j]:
                events.append(
                    (
                        lambda y, j=j: (
                            max(sign(y, j), -(1.0 if y[j] > 0 else 0.0))
                            if y[j] > ROUNDING
                            else 1.0
                        ),
                        -1,
                    )
                )
                events.append((lambda y, j=j: y[j] + ROUNDING, -1))
                what += [(j, False), (j, False)]
            else:
                gap = x[j] < 0
                events.append(
                    (
                        lambda y, j=j, gap=gap: (
                            y[j] - ROUNDING if y[j] < 0 or gap else 1.0
                        ),
                        1,
                    )
                )
                events.append(
                    (lambda y, j=j: sign(y, j) if y[j] > ROUNDING else -1.0, 1)
                )
                what += [(j, True), (j, True)]
        y, rang = _run(rates, np.concatenate([x, v]), events, tol)
        x, v = y[:m], y[m:]
        for (j, now_pushing), now in zip(what, rang):
            if now:
                pushing[j] = now_pushing
    raise RuntimeError("too many phases")
