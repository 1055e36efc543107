"""Numbers by others: closed forms and published constants that no one here made up.

Each function computes the rows of one case; `docs/validation.md` and the tests are these rows.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import jv

import jimpact as ji


@dataclass(frozen=True)
class Row:
    """One number of a case: theirs, ours, and how far apart they may be (relative to `size`)."""

    what: str
    theirs: float
    ours: float
    allowed: float
    digits: int = 8

    @property
    def error(self):
        return abs(self.ours - self.theirs) / max(1.0, abs(self.theirs))


@dataclass(frozen=True)
class Case:
    title: str
    source: str
    rows: Any  # () -> list of rows
    note: str = ""


def number(x):
    """Numbers as they are written in the page."""
    return f"{x:g}"


# ------------------------------------------------------------------------- binary collisions


def galperin():
    """Light ball 1, wall on the left, heavy ball M coming: the digits of pi."""
    law = ji.Binary(1.0)

    @jax.jit
    @jax.vmap
    def collisions(mass):
        scene = ji.chain(jnp.stack([jnp.ones_like(mass), mass]), wall="left")
        v = jnp.array([0.0, -1.0])
        return law.collisions(scene, v), ji.impact(law, scene, v).velocity

    masses = np.array([1.0, 1e2, 1e4, 1e6])
    count, after = (np.asarray(x) for x in collisions(masses))
    rows = []
    for mass, n, v, known in zip(masses, count, after, (3, 31, 314, 3141)):
        rows.append(Row(f"collisions, M = {number(mass)}", known, int(n), 0.0, 0))
        # n reflections alternately at lines of angle a and 0, in (sqrt(M) v2, v1)
        a = np.arctan(1 / np.sqrt(mass))
        angle = np.pi - n * a if n % 2 == 0 else (n + 1) * a - np.pi
        rows.append(
            Row(f"v2+, M = {number(mass)}", np.cos(angle), float(v[1]), 1e-9, 9)
        )
    return rows


def inelastic_collapse():
    """Three equal balls: the largest e with endless collisions, by bisection."""
    balls, v = ji.chain([1.0, 1.0, 1.0]), jnp.array([1.0, 0.0, 0.0])
    endless = jax.jit(
        jax.vmap(
            lambda e: ji.impact(ji.Binary(e), balls, v).status == CODE["plastic_limit"]
        )
    )
    low, high = 0.05, 0.1
    for _ in range(5):
        e = np.linspace(low, high, 33)
        last = int(np.flatnonzero(endless(e))[-1])
        low, high = e[last], e[last + 1]
    return [Row("e", 7 - 4 * np.sqrt(3), low, 2e-6)]


CODE = {row.name: code for code, row in enumerate(ji.STATUS)}


def tapered_chain():
    """Hard spheres, radii shrinking by q: the last ball's velocity and energy."""
    known = {(5, 0.05): 1.34437863, (10, 0.1): 3.70778908, (20, 0.08): 9.28269735}
    most = max(n for n, _ in known)
    masses, start = np.ones((len(known), most)), np.full((len(known), most), 100.0)
    for i, (n, q) in enumerate(known):  # further balls are long gone
        masses[i, :n] = (1 - q) ** (3 * np.arange(n))
        start[i, :n] = np.eye(n)[0]
    after = jax.jit(
        jax.vmap(lambda m, v: ji.impact(ji.Binary(1.0), ji.chain(m), v).velocity)
    )(masses, start)
    rows = []
    for i, ((n, q), speed) in enumerate(known.items()):
        last, a = float(after[i, n - 1]), (1 - q) ** 3
        energy = (4 * a / (1 + a) ** 2) ** (n - 1)
        rows.append(Row(f"v_N, N = {n}, q = {q:g}", speed, last, 2e-9))
        rows.append(
            Row(
                f"energy, N = {n}, q = {q:g}", energy, masses[i, n - 1] * last**2, 1e-12
            )
        )
    return rows


# --------------------------------------------------------------------------- one compliant pair


def at_a_wall(force, values, speed=1.0):
    """Restitution of a unit mass that meets a wall; `force(value)`, all values in one program."""

    @jax.jit
    @jax.vmap
    def restitution(x):
        out = ji.impact(
            ji.Compliant(force(x), rtol=1e-11), ji.chain([1.0], wall=True), [speed]
        )
        return -out.velocity[0] / speed

    return np.asarray(restitution(jnp.asarray(values, float)))


def spring_and_dashpot():
    known = {
        0.05: 0.8587581, 0.2: 0.57174003, 0.6: 0.24884058, 0.95: 0.14481273,
        1.0: 0.13533528, 1.5: 0.07558831, 3.0: 0.02376951,
    }  # fmt: skip
    e = at_a_wall(lambda zeta: ji.KelvinVoigt(1.0, 2 * zeta), [*known])
    return [Row(f"e, zeta = {z:g}", known[z], x, 1e-7) for z, x in zip(known, e)]


def hunt_crossley():
    known = {0.05: 0.94635681, 0.3: 0.74463248, 1.0: 0.45417645, 4.0: 0.14658732}
    e = at_a_wall(lambda d: ji.HuntCrossley(2.0, d), [*known], speed=1.7)
    rows = [Row(f"e, d = {d:g}, v = 1.7", known[d], x, 1e-8) for d, x in zip(known, e)]
    v = 1.7
    for d, x in zip(known, e):
        left = d * v * (1 + x)
        rows.append(
            Row(
                f"ln(...), d = {d:g}",
                left,
                float(np.log((1 + d * v) / (1 - d * x * v))),
                1e-7,
            )
        )
    return rows


def viscoelastic_spheres():
    q = np.array([1e-3, 3e-3, 1e-2])
    e = at_a_wall(lambda a: ji.KuwabaraKono(1.0, a), q / 1.5)
    series = 1 - 1.15344 * q + 0.79826 * q**2
    return [
        Row(f"e, q = {small:g}", known, x, 4 * small**3 + 1e-8)
        for small, known, x in zip(q, series, e)
    ]


def hertz_spheres():
    """Two spheres of masses 1 and 3, k = 7, meeting at v = 2."""
    m, k, v = 0.75, 7.0, 2.0
    deepest = (1.25 * m * v**2 / k) ** 0.4
    h = ji.history(ji.LZB(1.0, k, 1.5), ji.chain([1.0, 3.0]), [v, 0.0])
    return [
        Row(
            "duration v / delta_max", 2.94328, float(h.duration) * v / deepest, 2e-6, 5
        ),
        Row(
            "F_max / (k delta_max^1.5)",
            1.0,
            float(h.maximum_force[0]) / (k * deepest**1.5),
            1e-7,
        ),
        Row("delta_max", deepest, float((h.maximum_force[0] / k) ** (2 / 3)), 1e-7),
    ]


def oblique_sphere():
    """A homogeneous sphere on a plate, unit speed, angle theta from the normal."""
    e, mu = 0.98, 0.092
    scene = ji.Scene(
        [1.0, 1.0, 0.4], [[0.0], [1.0], [0.0]], tangents=[[1.0], [0.0], [1.0]]
    )
    degrees = np.array([5.0, 20.0, 30.0, 32.0, 33.0, 45.0, 70.0, 85.0])
    theta = np.radians(degrees)
    v = np.stack([np.sin(theta), -np.cos(theta), 0 * theta], axis=1)
    law = ji.Newton(e, friction=mu)
    after = np.asarray(
        jax.jit(jax.vmap(lambda v: ji.impact(law, scene, v).velocity))(v)
    )
    rolls = np.tan(theta) < 3.5 * mu * (1 + e)
    expected = np.where(rolls, 5 / 7 * v[:, 0], v[:, 0] + mu * (1 + e) * v[:, 1])
    return [
        Row(f"v_t+ / v-, {d:g} degrees ({'rolls' if r else 'slides'})", x, y, 1e-12)
        for d, r, x, y in zip(degrees, rolls, expected, after[:, 0])
    ]


# ---------------------------------------------------------------------------------- long chains

BALLS, TIME = 24, 12.0


def waves(eta):
    """Time and velocities (samples, balls) of a chain struck at its end; k = m = 1."""
    law = ji.LZB(
        jnp.asarray(1.0), jnp.asarray(1.0), jnp.asarray(float(eta)), jnp.asarray(0.0)
    )
    v = jnp.eye(BALLS)[0]
    h = ji.history(law, ji.chain(jnp.ones(BALLS)), v, samples=4001)
    return np.asarray(h.time), np.asarray(h.velocity), np.asarray(h.force)


def solitary_wave():
    """Speed between the peaks of balls 11 and 17, in diameters; v_max of ball 14."""
    time, v, _ = waves(1.5)

    def peak(ball):
        i = int(v[:, ball].argmax())
        a, b, c = np.polyfit(time[i - 3 : i + 4] - time[i], v[i - 3 : i + 4, ball], 2)
        return time[i] - b / (2 * a), c - b * b / (4 * a)

    (first, _), (_, largest), (last, _) = peak(11), peak(14), peak(17)
    return [
        Row(
            "c / ((k/m)^.4 v_max^.2)",
            0.9146,
            6 / (last - first) / largest**0.2,
            0.009,
            4,
        )
    ]


def schroedinger():
    time, v, force = waves(1.0)
    opens = np.flatnonzero((force[1:, 0] <= 0) & (time[1:] > 0.5))
    before = time[int(opens[0])] if len(opens) else TIME
    at = int(np.searchsorted(time, min(before, TIME))) - 1
    rows = []
    for i in (at // 2, at):
        t = time[i]
        for n in (0, 1, 2):
            known = jv(2 * n, 2 * t) + jv(2 * n + 2, 2 * t)
            rows.append(Row(f"v_{n}, t = {t:.3f}", float(known), float(v[i, n]), 2e-6))
    return rows


# ---------------------------------------------------------------------------------- blocks, wheels


@jax.jit
def rough(mass, normals, tangents, v):
    """v+ of a plastic impact on rough ground: what strikes does not slip."""
    law = ji.Moreau(0.0, friction=10.0)
    return ji.impact(law, ji.Scene(mass, normals, tangents=tangents), v).velocity


def housner():
    """A block that rocks about A and hits with B: plastic, rough ground, no slip."""
    rows = []
    for aspect in (1.0, 2.0, 3.0, 5.0):
        scene = ji.Block(1.0, aspect, corners="base").scene()
        rate = -1.0
        v = rate * np.array([-aspect / 2, 0.5, 1.0])
        ratio = float(rough(scene.mass, scene.normals, scene.tangents, v)[2]) / rate
        sine = 1 / np.sqrt(1 + aspect**2)
        rows.append(Row(f"ratio, h/w = {aspect:g}", 1 - 1.5 * sine**2, ratio, 1e-12))
    return rows


def rimless_wheel():
    """Rear foot on the ground, front foot strikes; legs of length 1, mass 1, inertia r^2."""
    rows = []
    for n, inertia in ((5, 0.01), (6, 0.01), (8, 0.01), (12, 0.01), (8, 0.25)):
        half = np.pi / n
        feet = np.array([[-np.sin(half), -np.cos(half)], [np.sin(half), -np.cos(half)]])
        normals = np.stack([[0.0, 1.0, x] for x, _ in feet], axis=1)
        tangents = np.stack([[1.0, 0.0, -y] for _, y in feet], axis=1)
        rate = -1.0  # clockwise about the rear foot
        v = rate * np.array([feet[0, 1], -feet[0, 0], 1.0])
        ratio = (
            float(rough(np.array([1.0, 1.0, inertia]), normals, tangents, v)[2]) / rate
        )
        known = (np.cos(2 * np.pi / n) + inertia) / (1 + inertia)
        rows.append(Row(f"ratio, {n} spokes, r^2 = {inertia:g}", known, ratio, 1e-12))
    return rows


# ---------------------------------------------------------------------------------------- motions

G = 9.80665


def bouncing_ball():
    e = 0.8
    motion = ji.simulate(
        ji.System(ji.Column([1.0]), gravity=True),
        ji.Newton(e),
        [1.0],
        [0.0],
        5.0,
        samples=101,
        max_events=100,
    )
    first, times = np.sqrt(2 / G), motion.event_times()
    rows = []
    for i in (0, 1, 5, 15):
        known = first * (1 + 2 * sum(e**j for j in range(1, i + 1)))
        rows.append(
            Row(f"time of bounce {i + 1} [s]", known, float(times[i]), 1e-11, 10)
        )
    for i in (0, 4):
        top = 0.5 * float(motion.events.velocity_after[i, 0]) ** 2 / G
        rows.append(
            Row(f"height after bounce {i + 1} [m]", e ** (2 * i + 2), top, 1e-10, 10)
        )
    last = int(motion.events.count) - 1
    end = float(motion.events.accumulation_end[last])
    rows.append(
        Row("end of the accumulation [s]", first * (1 + e) / (1 - e), end, 1e-10, 10)
    )
    return rows


def vibrating_plate():
    """Where an eigenvalue of the map from bounce to bounce passes -1, e = .8."""
    e, frequency = 0.8, 10.0
    w = 2 * np.pi * frequency
    period = 1 / frequency

    def bounce(x, strength):
        """(time, velocity after) of one bounce -> of the next."""
        amplitude = strength * G / w**2
        base = ji.HarmonicBase(amplitude, frequency)
        start = base(x[0])
        motion = ji.simulate(
            ji.System(ji.Column([1.0]), gravity=True, base=base), ji.Newton(e), start, x[1:],
            (x[0], x[0] + 1.5 * period), samples=2, max_events=2,
        )  # fmt: skip
        events = motion.events
        return jnp.stack([events.time[0], events.velocity_after[0, 0]])

    @jax.jit
    @jax.vmap
    def passes(strength):
        # period one: back after one period, at the phase where the plate makes up the loss
        phase = jnp.arccos(np.pi * (1 - e) / (1 + e) / strength)
        x = jnp.stack([phase / w, jnp.full_like(phase, G * period / 2)])
        slope = jax.jacfwd(bounce)(x, strength)
        again = bounce(x, strength) - x
        back = jnp.abs(again[0] - period) * w + jnp.abs(again[1]) / x[1]
        return 1 + jnp.trace(slope) + jnp.linalg.det(slope), back

    strength = np.linspace(1.05, 1.09, 5)
    value, back = (np.asarray(x) for x in passes(strength))
    edge = np.interp(0.0, value[::-1], strength[::-1])
    for _ in range(1):  # once more, narrow
        near = edge + np.linspace(-2e-4, 2e-4, 5)
        value, _ = (np.asarray(x) for x in passes(near))
        edge = float(np.interp(0.0, value[::-1], near[::-1]))
    known = np.hypot(np.pi * (1 - e) / (1 + e), 2 * (1 + e**2) / (1 + e) ** 2)
    return [
        Row("Gamma_2", known, edge, 1e-7),
        Row("Gamma_2, as printed", 1.07084, edge, 5e-6, 5),
        Row("period one comes back (phase, speed)", 0.0, float(back.max()), 1e-9),
    ]


CASES = [
    Case(
        "Two balls and a wall count the digits of pi",
        "Galperin, Regul. Chaotic Dyn. 8 (2003) 375",
        galperin,
        "`Binary(1)`: light ball 1, wall on one side, heavy ball M coming; v2+ is the reflection.",
    ),
    Case(
        "Three equal balls: infinitely many collisions below e = 7 - 4 sqrt 3",
        "McNamara and Young, Phys. Fluids A 4 (1992) 496",
        inelastic_collapse,
        "`Binary(e)`, status `plastic_limit`.",
    ),
    Case(
        "Tapered chain of hard spheres",
        "Doney and Sen, Phys. Rev. E 72 (2005) 041304",
        tapered_chain,
        "Energy of the last ball over the first's: `(4 A / (1 + A)^2)^(N - 1)`, `A = (1 - q)^3`.",
    ),
    Case(
        "Spring and dashpot, cut where the force vanishes",
        "Schwager and Poeschel, Granular Matter 9 (2007) 465",
        spring_and_dashpot,
        "`Compliant(KelvinVoigt)` at a wall, damping ratio zeta.",
    ),
    Case(
        "Hunt and Crossley's contact",
        "Marhefka and Orin, IEEE Trans. SMC A 29 (1999) 566",
        hunt_crossley,
        "`d v (1 + e) = ln((1 + d v) / (1 - d e v))`.",
    ),
    Case(
        "Viscoelastic spheres",
        "Schwager and Poeschel, Phys. Rev. E 57 (1998) 650; Ramirez et al., Phys. Rev. E 60 (1999)"
        " 4465",
        viscoelastic_spheres,
        "`e = 1 - 1.15344 q + .79826 q^2 - ...`, `q = 1.5 A (k/m)^.4 v^.2`; what is left is of the"
        " order q^3, and that a contact here does not pull.",
    ),
    Case(
        "Hertz impact of two spheres",
        "Hertz (1882); as in the benchmark of Chung and Ooi, Granular Matter 13 (2011) 643",
        hertz_spheres,
    ),
    Case(
        "Sphere obliquely on a plate, e = .98, mu = .092",
        "Walton; Kharaz, Gorham and Salman, Powder Technol. 120 (2001) 281",
        oblique_sphere,
        "Rolls while tan(theta) < 3.5 mu (1 + e). Real spheres recover tangential energy at small"
        " angles, which `tangential_restitution` of the kinematic laws can hold.",
    ),
    Case(
        "Solitary wave in Hertz balls",
        "Nesterenko (1983); Coste, Falcon and Fauve, Phys. Rev. E 56 (1997) 6104",
        solitary_wave,
        "The long-wave limit; the exact value of the discrete chain is about .8 % lower.",
    ),
    Case(
        "Linear chain struck at its free end, before any contact opens",
        "Schroedinger, Ann. Phys. 44 (1914) 916",
        schroedinger,
        "`v_n(t) = J_2n(2 t) + J_2n+2(2 t)`, k = m = 1.",
    ),
    Case(
        "Rocking block, first impact, plastic, no slip",
        "Housner, Bull. Seism. Soc. Am. 53 (1963) 403",
        housner,
        "omega+ / omega- = 1 - 1.5 sin^2(alpha), by `Moreau(0, friction=10)`.",
    ),
    Case(
        "Rimless wheel at a heel strike",
        "McGeer, Int. J. Robot. Res. 9 (1990) 62",
        rimless_wheel,
        "omega+ / omega- = (cos(2 pi / n) + r^2) / (1 + r^2), r the radius of gyration; cos(2 pi / n) for"
        " a point mass at the hub.",
    ),
    Case(
        "Ball on a vibrating plate, e = .8: end of period one",
        "Luck and Mehta, Phys. Rev. E 48 (1993) 3988; Tufillaro",
        vibrating_plate,
        "`Gamma_2 = sqrt((pi (1 - e) / (1 + e))^2 + (2 (1 + e^2) / (1 + e)^2)^2)`, by the derivative"
        " of `ji.simulate` from bounce to bounce.",
    ),
    Case(
        "Bouncing ball",
        "elementary",
        bouncing_ball,
        "Dropped from 1 m, e = .8; the accumulation ends at `t_1 (1 + e) / (1 - e)`.",
    ),
]
