"""Three Hertz balls under the LZB law with a fixed step, in numba: RK4 and velocity Verlet.

Masses 1, v- = (1, 0, 0); x' = -c g with c = 1 (g <= 0) or 1/e^2, g' = W F, x clamped at 0. One
impact after the other on one thread; `step` is a fraction of the time scale of the stiffer contact.
"""

import math

import numba
import numpy as np

MOST = 1_000_000  # steps of one impact


@numba.njit(inline="always")
def _force(k, x):
    return k * x * math.sqrt(x) if x > 0.0 else 0.0


@numba.njit(inline="always")
def _rate(x, g, e):
    if x <= 0.0 and g >= 0.0:
        return 0.0
    return -g if g <= 0.0 else -g / (e * e)


@numba.njit(inline="always")
def _over(x1, x2, g1, g2):
    return x1 <= 0.0 and x2 <= 0.0 and g1 >= 0.0 and g2 >= 0.0


@numba.njit(inline="always")
def _rates(x1, x2, g1, g2, k1, k2, e1, e2):
    f1, f2 = _force(k1, x1), _force(k2, x2)
    return _rate(x1, g1, e1), _rate(x2, g2, e2), 2.0 * f1 - f2, 2.0 * f2 - f1


@numba.njit
def _rk4(k1, k2, e1, e2, h):
    x1, x2, g1, g2 = 0.0, 0.0, -1.0, 0.0
    for _ in range(MOST):
        a1, a2, a3, a4 = _rates(x1, x2, g1, g2, k1, k2, e1, e2)
        s = 0.5 * h
        b1, b2, b3, b4 = _rates(
            x1 + s * a1, x2 + s * a2, g1 + s * a3, g2 + s * a4, k1, k2, e1, e2
        )
        c1, c2, c3, c4 = _rates(
            x1 + s * b1, x2 + s * b2, g1 + s * b3, g2 + s * b4, k1, k2, e1, e2
        )
        d1, d2, d3, d4 = _rates(
            x1 + h * c1, x2 + h * c2, g1 + h * c3, g2 + h * c4, k1, k2, e1, e2
        )
        x1 = max(x1 + h / 6 * (a1 + 2.0 * (b1 + c1) + d1), 0.0)
        x2 = max(x2 + h / 6 * (a2 + 2.0 * (b2 + c2) + d2), 0.0)
        g1 += h / 6 * (a3 + 2.0 * (b3 + c3) + d3)
        g2 += h / 6 * (a4 + 2.0 * (b4 + c4) + d4)
        if _over(x1, x2, g1, g2):
            break
    return g1, g2


@numba.njit
def _verlet(k1, k2, e1, e2, h):
    x1, x2, g1, g2 = 0.0, 0.0, -1.0, 0.0
    f1, f2 = 0.0, 0.0
    for _ in range(MOST):
        g1 += 0.5 * h * (2.0 * f1 - f2)
        g2 += 0.5 * h * (2.0 * f2 - f1)
        x1, x2 = (
            max(x1 + h * _rate(x1, g1, e1), 0.0),
            max(x2 + h * _rate(x2, g2, e2), 0.0),
        )
        f1, f2 = _force(k1, x1), _force(k2, x2)
        g1 += 0.5 * h * (2.0 * f1 - f2)
        g2 += 0.5 * h * (2.0 * f2 - f1)
        if _over(x1, x2, g1, g2):
            break
    return g1, g2


def _batch(one, parallel):
    span = numba.prange if parallel else range

    @numba.njit(parallel=parallel)
    def run(stiffness, restitution, step):
        out = np.empty((stiffness.shape[0], 3))
        for i in span(stiffness.shape[0]):
            k1, k2 = stiffness[i, 0], stiffness[i, 1]
            h = step * max(k1, k2) ** -0.4
            g1, g2 = one(k1, k2, restitution[i, 0], restitution[i, 1], h)
            d1, d2 = g1 + 1.0, g2
            p1, p2 = (2.0 * d1 + d2) / 3.0, (2.0 * d2 + d1) / 3.0
            out[i, 0], out[i, 1], out[i, 2] = 1.0 - p1, p1 - p2, p2
        return out

    return run


rk4 = _batch(_rk4, parallel=False)
rk4_threads = _batch(_rk4, parallel=True)
verlet = _batch(_verlet, parallel=False)
