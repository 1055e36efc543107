"""Impacts whose outcome is known in closed form: state, outcome, slopes, and which laws claim it.

`after(v, e, k, eta)` is the formula; it takes complex numbers, so that its slopes by a complex step
are exact as well. Gap velocities are negative on approach, contact j joins balls j and j + 1.
"""

import numpy as np
from programs import State, chain

ALL = (
    "newton", "moreau", "poisson", "matrix",
    "binary", "binary-earliest", "binary-left", "correlation", "routh", "lzb",
    "compliant",
)  # fmt: skip
SEQUENTIAL = ("binary", "binary-earliest", "binary-left")
TINY = 1e-30  # of a complex step


class System:
    """One impact; subclasses give the state, the formula and the laws."""

    laws: tuple = ALL
    by = ("v", "e")  # what the formula may be differentiated in: v, e, k, eta
    status = "ok"
    accuracy = 0.0  # of the formula itself, where it is a limit

    def state(self):
        raise NotImplementedError

    def after(self, v, e, k, eta):
        raise NotImplementedError

    def arguments(self):
        state = self.state()
        m = state.size[1]
        per = [
            np.broadcast_to(np.asarray(x, float), m)
            for x in (state.e, state.k, state.eta)
        ]
        return np.asarray(state.velocity, float), *per

    def outcome(self):
        return np.real(self.after(*self.arguments()))

    def slopes(self):
        """{argument: (n, size)} of v+, exact."""
        given = [x.astype(complex) for x in self.arguments()]
        found = {}
        for name in self.by:
            i = ("v", "e", "k", "eta").index(name)
            columns = []
            for j in range(len(given[i])):
                moved = [x.copy() for x in given]
                moved[i][j] += 1j * TINY
                columns.append(np.imag(self.after(*moved)) / TINY)
            found[name] = np.stack(columns, axis=1)
        return found


class TwoBalls(System):
    """v1+ = v1 - p / m1, v2+ = v2 + p / m2 with p = (1 + e) (v1 - v2) m1 m2 / (m1 + m2)."""

    by = ("v", "e", "k", "eta")

    def __init__(self, e):
        self.e = e

    def state(self):
        return chain([1.0, 3.0], [2.0, 0.5], e=self.e, k=5.0)

    def after(self, v, e, k, eta):
        p = (1 + e[0]) * (v[0] - v[1]) * 0.75
        return np.stack([v[0] - p, v[1] + p / 3])


class BallAtWall(System):
    """v+ = -e v-."""

    by = ("v", "e", "k", "eta")

    def state(self):
        return chain([2.0], [1.5], True, e=0.7, k=3.0)

    def after(self, v, e, k, eta):
        return -e * v


class BySpeed(System):
    """v1 - v2 = 3, the e of a speed of 1.5 falls like the fourth root: p as of `TwoBalls`."""

    laws = ("velocity",)

    def state(self):
        return chain([1.0, 3.0], [2.5, -0.5], e=0.6)

    def after(self, v, e, k, eta):
        p = (1 + e[0] * ((v[0] - v[1]) / 1.5) ** -0.25) * (v[0] - v[1]) * 0.75
        return np.stack([v[0] - p, v[1] + p / 3])


class RightAngles(System):
    """Kinetic angle pi/2: W is diagonal, each contact is alone, gamma+ = -e gamma-."""

    laws = tuple(law for law in ALL if law != "routh")  # which has one e for both

    def state(self):
        normals = np.array([[1.0, 0], [0, 1], [0, 0]])
        return State(
            np.diag([1.0, 2, 3]), normals, [-1.0, -0.4, 0.3], e=[0.8, 0.5], k=[1, 30.0]
        )

    def after(self, v, e, k, eta):
        return np.concatenate([-e * v[:2], v[2:]])


class HeadOn(System):
    """Balls (m, M, m) at (u, 0, -u), equal e: both contacts act at once, v+ = (-e u, 0, e u)."""

    laws = ("newton", "moreau", "poisson", "matrix", "routh", "lzb", "compliant")
    by = ()

    def state(self):
        return chain([0.25, 1.0, 0.25], [1.0, 0, -1], e=0.8)

    def after(self, v, e, k, eta):
        return np.array([-0.8, 0, 0.8])


class Plastic(System):
    """e = 0, all contacts approach: the common velocity sum m v / sum m."""

    laws = (
        "newton",
        "moreau",
        "poisson",
        "matrix",
        "routh",
        "lzb",
        "compliant",
        "binary",
    )
    by = ("v",)
    status = None  # `ok`, or `plastic_limit` of the laws that come there in the limit

    def state(self):
        return chain([3.0, 1.0, 2.0], [1.0, 0.4, -0.5], e=0.0)

    def after(self, v, e, k, eta):
        return np.ones(3) * (np.array([3.0, 1, 2]) @ v) / 6


class Kinematic(System):
    """gamma+ = -e gamma- at every contact: p = -W^-1 (1 + E) gamma-, all p > 0 here."""

    laws = ("newton", "matrix", "moreau")

    def state(self):
        return chain([1.0, 2.0, 1.5, 0.7], [1.0, 0.4, 0.1, -0.6], e=[0.9, 0.7, 0.8])

    def after(self, v, e, k, eta):
        mass, n = np.array([1.0, 2.0, 1.5, 0.7]), self.state().normals
        gamma = n.T @ v
        p = -np.linalg.solve(n.T @ (n / mass[:, None]), (1 + e) * gamma)
        return v + (n @ p) / mass


class MoreauAtRest(System):
    """Equal balls, the others at rest: ((1 - 2 e) / 3, (1 + e) / 3, (1 + e) / 3)."""

    laws = ("moreau", "routh")
    by = ()

    def state(self):
        return chain([1.0, 1, 1], [1.0, 0, 0], e=0.3)

    def after(self, v, e, k, eta):
        return np.stack([(1 - 2 * e[0]), (1 + e[0]), (1 + e[0])]) / 3


class Correlated(System):
    """Equal balls, the others at rest, p2 = r p1: `A p1^2 / 2 - p1 + (1 - e^2) / (2 (2 - r)) = 0`.

    A = 2 - 2 r + 2 r^2; contact 2 is never compressed where r > 1/2.
    """

    laws = ("correlation",)
    by = ("e",)
    ratio = 0.6  # of tests/programs.py

    def state(self):
        return chain([1.0, 1, 1], [1.0, 0, 0], e=0.8)

    def after(self, v, e, k, eta):
        r = self.ratio
        a = 2 - 2 * r + 2 * r**2
        p = (1 + np.sqrt(1 - a * (1 - e[0] ** 2) / (2 - r))) / a
        return np.stack([1 - p, (1 - r) * p, r * p])


class PoissonAtRest(System):
    """Compression ends at p_c = (2/3, 1/3); p = p_c (1 + e)."""

    laws = ("poisson",)
    by = ("e",)

    def __init__(self, e1, e2):
        self.e = [e1, e2]

    def state(self):
        return chain([1.0, 1, 1], [1.0, 0, 0], e=self.e)

    def after(self, v, e, k, eta):
        p = np.stack([2 * (1 + e[0]), 1 + e[1]]) / 3
        return np.stack([1 - p[0], p[0] - p[1], p[1]])


class PoissonAtWall(System):
    """Two equal balls pressed to a wall, v- = (1, 0): p_c = (1, 1); by the order of e1 and e2.

    e2 <= e1: (-e1, 0); e1 <= e2 <= 2 e1: (-e1, e1 - e2); beyond: (-e2 / 2, -e2 / 2).
    """

    laws = ("poisson",)
    by = ("e",)

    def __init__(self, e1, e2):
        self.e = [e1, e2]

    def state(self):
        return chain([1.0, 1], [1.0, 0], True, e=self.e)

    def after(self, v, e, k, eta):
        e1, e2 = e
        if e2.real <= e1.real:
            return np.stack([-e1, 0 * e1])
        if e2.real <= 2 * e1.real:
            return np.stack([-e1, e1 - e2])
        return np.stack([-e2 / 2, -e2 / 2])


class Chebyshev(System):
    """Binary collisions of three balls, the last two at rest (Towne and Hadlock).

    `w_n = e^((n-1)/2) sin(n phi) / sin(phi) * (1 or sqrt(a1/a2))` is the closing speed before
    collision n, `cos(phi) = (1 + e) sqrt(a1 a2) / (2 sqrt(e))`, `a1 = 1 / (1 + m2/m1)`,
    `a2 = 1 / (1 + m2/m3)`; N = ceil(pi / phi) - 1 collisions, contacts 1 and 2 in turn.
    """

    laws = SEQUENTIAL

    def __init__(self, masses, e):
        self.masses, self.e = np.array(masses, float), e

    def state(self):
        return chain(self.masses, [1.0, 0, 0], e=self.e)

    def after(self, v, e, k, eta):
        m = self.masses
        a = [1 / (1 + m[1] / m[0]), 1 / (1 + m[1] / m[2])]
        phi = np.arccos((1 + self.e) * np.sqrt(a[0] * a[1]) / (2 * np.sqrt(self.e)))
        w = [-(v[1] - v[0]), None]  # closing speeds of both contacts
        w[1] = -(v[2] - v[1])
        v = list(v)
        for n in range(1, int(np.ceil(np.pi / phi))):
            i = (n - 1) % 2
            if np.iscomplexobj(e) and not any(np.imag(np.concatenate([e, [w[i]]]))):
                known = self.e ** ((n - 1) / 2) * np.sin(n * phi) / np.sin(phi)
                known *= 1 if n % 2 else np.sqrt(a[0] / a[1])
                assert abs(v[i] - v[i + 1] - known) < 1e-12
            p = (1 + e[i]) * (v[i] - v[i + 1]) / (1 / m[i] + 1 / m[i + 1])
            v[i], v[i + 1] = v[i] - p / m[i], v[i + 1] + p / m[i + 1]
        return np.stack(v)


class LinearBalls(System):
    """Three equal balls on linear springs, e = 1, k1 = 1, k2 = g: (6.15), corrected.

    `alpha_{1,2}^2 = 1 + g -/+ Delta`, `Delta = sqrt(g^2 - g + 1)`. Contact 2 opens first for
    g >= 2.2413, and ball 3 keeps the velocity it has then; there its force is 0, so that the slope
    of that velocity is the partial one, at fixed time. Only v3+ is known in closed form.
    """

    laws = ("lzb", "compliant")
    by = ("k",)

    def __init__(self, ratio):
        self.ratio = ratio

    def state(self):
        return chain([1.0, 1, 1], [1.0, 0, 0], k=[1.0, self.ratio], eta=1.0)

    @staticmethod
    def motion(g, t):
        """x2 - x3 (the indentation of contact 2) and v3 while nothing has opened."""
        delta = np.sqrt(g * g - g + 1)
        w1, w2 = np.sqrt(1 + g - delta), np.sqrt(1 + g + delta)
        squeeze = (np.sin(w1 * t) / w1 - np.sin(w2 * t) / w2) / (2 * delta)
        v3 = (
            g
            / (2 * delta)
            * ((1 - np.cos(w1 * t)) / w1**2 - (1 - np.cos(w2 * t)) / w2**2)
        )
        return squeeze, v3

    def after(self, v, e, k, eta):
        g = k[1] / k[0]
        t = self.opening(g.real)
        return np.stack([np.nan * g, np.nan * g, self.motion(g * k[0] / k[0], t)[1]])

    def opening(self, g):
        from scipy.optimize import brentq

        return brentq(lambda t: self.motion(g, t)[0], 1.5, 3.2, xtol=1e-14)


class Newby(System):
    """Both linear contacts open together at `g_n = [3 n^4 - 2 n^2 + 3 + sqrt(...)] / (8 n^2)`.

    n odd: B = (-1/3, 2/3, 2/3); n = 2: v3 = 8/9.
    """

    laws = ("lzb", "compliant")
    by = ()

    def __init__(self, n):
        self.n = n
        root = np.sqrt(9 * n**8 - 12 * n**6 - 42 * n**4 - 12 * n**2 + 9)
        self.ratio = (3 * n**4 - 2 * n**2 + 3 + root) / (8 * n**2)

    def state(self):
        return chain([1.0, 1, 1], [1.0, 0, 0], k=[1.0, self.ratio], eta=1.0)

    def after(self, v, e, k, eta):
        if self.n % 2:
            return np.array([-1, 2, 2]) / 3
        return np.array([-0.263586813696557148, 0.374697924807668259, 8 / 9])


class Reinsch(System):
    """k1 = k2 and m2 = 2 m / 3: omega_2 = 2 omega_1, the ends exchange velocities."""

    laws = ("lzb", "compliant")
    by = ()

    def state(self):
        return chain([1.0, 2 / 3, 1.0], [1.0, 0, 0], eta=1.0)

    def after(self, v, e, k, eta):
        return np.array([0.0, 0, 1])


SYSTEMS = {
    **{f"two balls, e={e}": TwoBalls(e) for e in (0.3, 0.9)},
    "ball at a wall": BallAtWall(),
    "e by speed": BySpeed(),
    "right angles": RightAngles(),
    "head on": HeadOn(),
    "plastic": Plastic(),
    "kinematic": Kinematic(),
    "Moreau at rest": MoreauAtRest(),
    "correlated": Correlated(),
    **{f"Poisson at rest, {e}": PoissonAtRest(*e) for e in ((0.4, 0.95), (0.5, 0.9))},
    **{
        f"Poisson at a wall, {e}": PoissonAtWall(*e)
        for e in ((0.8, 0.6), (0.5, 0.8), (0.3, 0.9))
    },
    **{
        f"Chebyshev {m}, e={e}": Chebyshev(m, e)
        for m, e in (
            ((1, 1, 1), 0.9), ((1, 1, 1), 0.5), ((1, 1, 1), 0.2), ((1, 4, 1), 0.95),
            ((4, 1, 4), 0.97), ((10, 1, 10), 0.99), ((1, 2, 3), 0.8), ((2, 1, 2), 0.4),
        )
    },
    **{f"linear balls, k2/k1={g}": LinearBalls(g) for g in (2.7, 4.0)},
    **{f"Newby {n}": Newby(n) for n in (2, 3, 5)},
    "Reinsch": Reinsch(),
}  # fmt: skip
