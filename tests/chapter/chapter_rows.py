"""The source chapter, section by section: what to call, what is printed there, what comes out.

`docs/chapter.md` is written of these rows (`python tests/chapter/chapter_page.py`), and the tests run each.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from chapter_figures import FIGURES
from scipy.special import gamma

THIRD, TWO_THIRDS = 1 / 3, 2 / 3
# A bead at the wall, in closed form: deepest indentation, time to it, and back e times faster. The
# largest force under two is 1.3448 (m v^2)^(3/5) k^(2/5), by a series of order 30.
SPEED = (2 * 9.80665 * 3.1e-3) ** 0.5
DEEPEST = (1.25 * 2.05e-3 * SPEED**2 / 9.858e9) ** 0.4
PRESSES = (1 + 0.92) * np.sqrt(np.pi) * gamma(1.4) / gamma(0.9) * DEEPEST / SPEED
LARGEST = 1.344782469 * (2.05e-3 * SPEED**2) ** 0.6 * 6.9716e9**0.4
# What the calls of the page take for granted; the page prints these lines.
BEFORE = """\
import jax

jax.config.update("jax_enable_x64", True)
import numpy as np
import jimpact as ji

two, three = ji.chain([1.0, 1.0]), ji.chain([1.0, 1.0, 1.0])
wall = ji.chain([1.0, 1.0], wall=True)
uneven, hit = ji.chain([1.0, 2.0, 3.0]), [1.0, 0.0, 0.0]
"""


@dataclass(frozen=True)
class Row:
    """A formula, system or number of the chapter; `exact`: what is right, computed elsewhere.

    `printed` is in words; `erratum` says what is wrong with it. `slow`: its programs belong to no
    other default test. Numbers agree to `allowed`, relative to 1 or to the number.
    """

    where: str
    what: str
    call: str
    printed: str = ""
    exact: object = None
    erratum: str = ""
    slow: bool = False
    allowed: float = 1e-7


@dataclass(frozen=True)
class Figure:
    """A figure of the chapter."""

    number: str

    @property
    def cells(self):
        command = f'`chapter_figures.draw("{self.number}")`'
        return [
            f"Fig. {self.number}",
            FIGURES[self.number][0],
            command,
            "",
            "drawn",
            "",
        ]


@cache
def space():
    """The names that calls may use."""
    names: dict = {}
    exec(BEFORE, names)
    return names


def run(call):
    """What a call gives."""
    return eval(call, space())


def flat(value):
    """Its numbers."""
    return np.concatenate([np.ravel(np.asarray(x, float)) for x in as_parts(value)])


def as_parts(value):
    return value if isinstance(value, list | tuple) else [value]


ARC = "ji.theory.admissible_set(three, hit).conserving_arc(2)"
SECTIONS = {
    "6.1 Multiple impacts": [
        Row("Def. 6.1", "balls on the ground: number of contacts", "ji.chain([1.0] * 5, wall='right').contacts",
            "N - 1 for N balls, l >= 0", 5, "N contacts, an N-impact; l >= 1"),
        Row("6.1.1", "stiffness of two steel beads [N/m^1.5]",
            "ji.theory.hertz_stiffness(21.6e10, 0.276, 4e-3)", "6.9716e9 of E = 210 GPa", 6.97089e9,
            "needs E = 216 GPa", allowed=1e-5),
        Row("6.1.1", "of a bead at the wall",
            "ji.theory.hertz_stiffness(21.6e10, 0.276, 4e-3, radius2=np.inf)", "9.858e9", 9.85833e9,
            allowed=1e-5),
        Figure("6.1"),
        Figure("6.2"),
        Row(
            "(6.1), (6.2)",
            "gradients of the gaps of two balls at a wall",
            "wall.normals",
            "two balls",
            [-1, 0, 1, -1],
        ),
        Row(
            "6.1.1",
            "largest force at the wall, 2 beads [N]; one: 51.65",
            "ji.history(ji.LZB([0.96, 0.92], [6.9716e9, 9.858e9]), ji.chain([2.05e-3] * 2, wall='right'),"
            " [(2 * 9.80665 * 3.1e-3) ** 0.5] * 2).maximum_force[-1]",
            "almost independent of N",
            LARGEST,
            slow=True,
            allowed=2e-4,
        ),
        Row("6.1.1", "how long one bead presses [µs]",
            "ji.history(ji.LZB(0.92, [9.858e9]), ji.chain([2.05e-3], wall='right'),"
            " [(2 * 9.80665 * 3.1e-3) ** 0.5]).duration * 1e6",
            "less than 32", 1e6 * PRESSES, "34.6 for N = 1, 225.5 for 8, 316 for 12 at 5.1 mm",
            slow=True, allowed=1e-6),
        Row("(6.3), (6.4)", "ball, ground, ball, with m = (2, 5), e = (.8, .7)",
            "-ji.impact(ji.Binary([0.8, 0.7], order='left_to_right'),"
            " ji.chain([2.0, 5.0], wall=True), [1.0, 0.5]).velocity",
            "(6.4)", [3839 / 4900, 1807 / 24500], "ground first, (6.3), is no complete sequence",
            slow=True),
        Row("6.1.1.1", "masses (1/4, 1, 1/4), from both sides; contact 1 closes first",
            "ji.impact(ji.Binary(1.0, order='earliest'),"
            " ji.chain([0.25, 1.0, 0.25], gaps=[0.0, 1e-6]), [1.0, 0.0, -1.0]).velocity",
            "(-6/10, -4/25, 31/25)", [-3 / 5, -4 / 25, 31 / 25], slow=True),
        Row("6.1.1.1", "the same at once",
            "ji.impact(ji.LZB(1.0, [1.0, 1.0]), ji.chain([0.25, 1.0, 0.25]),"
            " [1.0, 0.0, -1.0]).velocity",
            "(-1, 0, 1)", [-1, 0, 1], slow=True),
        Row(
            "(6.5)", "gradients of the gaps of three balls", "three.normals", "three balls",
            [-1, 0, 1, -1, 0, 1],
        ),
        Row("6.1.1.2", "momentum of balls in flight is no law of impact: what a wall takes",
            "ji.momentum(wall, ji.impact(ji.Newton(1.0), wall, [1.0, 1.0]).velocity).sum()",
            "not conserved", -2.0, slow=True),
        Row("(6.6), (6.7)", "ends A and B of the outcomes that keep the energy", ARC,
            "(0, 0, 1), (-1/3, 2/3, 2/3)", [0, 0, 1, -THIRD, TWO_THIRDS, TWO_THIRDS]),
        Row("(6.8)", "two balls", "ji.impact(ji.Newton(1.0), two, [1.0, 0.0]).velocity",
            "(0, 1)", [0, 1], slow=True),
        Figure("6.3a"),
        Figure("6.3b"),
        Row(
            "6.1.1.4",
            "2 balls hit 8: balls that move forward",
            "int((ji.impact(ji.LZB(1.0, np.ones(9)), ji.chain(np.ones(10)), np.r_[1.0, 1.0, np.zeros(8)]).velocity > 0).sum())",
            "M + 2",
            4,
            "so for M <= 6 of ten balls; 13 of 20 at M = 9",
            slow=True,
        ),
        Row(
            "6.1.1.4",
            "N (2M/(N + M))^2 / M at M = 9, N = 11",
            "11 * (2 * 9 / 20) ** 2 / 9",
            "0.99",
            0.99,
        ),
        Row(
            "6.1.1.4",
            "length of the wave [contacts], speed for v = 1 [contacts/s]: see [Waves](waves.md)",
            "(np.pi * 2.5**0.5, ji.theory.nesterenko_speed(1.0, 1.0, 1.0))",
            "five balls",
            [4.967294, 0.9146101],
        ),
        Row("6.1.1.4", "3 glued balls hit 2 that are glued",
            "ji.impact(ji.Newton(1.0), ji.chain([3.0, 2.0]), [1.0, 0.0]).velocity",
            "(M - N)/(M + N), 2M/(M + N)", [1 / 5, 6 / 5], slow=True),
        Row("(6.9)-(6.12)", "all outcomes of Han and Gilmore",
            "[x.velocity for x in ji.han_gilmore(three, hit)]",
            "(6.10) and (6.12)", [-THIRD, TWO_THIRDS, TWO_THIRDS, 0, 0, 1]),
        Figure("6.4"),
        Row("6.1.2", "measured shot: momentum and energy, after over before",
            "(lambda shot: (shot.momentum_ratio(three), shot.energy_ratio(three)))("
            "ji.Experiments(pre=[hit], post=[[-0.0605, 0.1049, 0.9978]]))",
            "a shot of steel balls", [1.0422, 1.01026910], "breaks momentum by 4.2 %"),
        Row("(6.13)", "binary collisions, m = (1, 2, 3), e = (.9, .8)",
            "ji.impact(ji.Binary([0.9, 0.8]), uneven, hit).velocity",
            "(-4/15, -14/75, ...)", [-4 / 15, -19 / 375, 57 / 125],
            "factors (1 + e1) and (1 + m32) are wrong or missing", slow=True),
        Figure("6.5"),
        Row("(6.14), (6.15)", "displacements at k2/k1 = 2.7, t = 2.1",
            "ji.theory.bilateral_motion(three, [1.0, 2.7], hit, 2.1)[0]",
            "(6.15)", [1.0564388537, 0.6202288629, 0.4233322834], slow=True),
        Row(
            "(6.16)",
            "first roots t1 and t2 at k2/k1 = 2.7",
            "ji.theory.separation_times(2.7)",
            "2.66333 of the first row",
            [2.7494001240, 2.6351145226],
            "Delta - 1 + gamma in the first row",
        ),
        Row("6.1.3", "limit k2/k1 to 0", "ji.impact(ji.LZB(1.0, [1.0, 1e-8], 1.0), three, hit)"
            ".velocity", "(0, 0, 1)", [0, 0, 1], allowed=1e-3, slow=True),
        Row("6.1.3", "limit k2/k1 to infinity",
            "ji.impact(ji.LZB(1.0, [1.0, 1e6], 1.0), three, hit).velocity",
            "(-1/3, 2/3, 2/3), at pi/omega", [-THIRD, TWO_THIRDS, TWO_THIRDS],
            "at pi sqrt(2/3)/omega", allowed=1e-3, slow=True),
        Row(
            "Rem. 6.4",
            "Reinsch's chains of any length: masses of 4, stiffnesses",
            "ji.theory.reinsch_chain(4)",
            "three balls",
            [1, 0.6, 0.6, 1, 1, 1.2, 1],
        ),
        Row("Rem. 6.4", "Reinsch: masses (1, 2/3, 1), equal springs",
            "ji.impact(ji.LZB(1.0, [1.0, 1.0], 1.0), ji.chain([1.0, 2 / 3, 1.0]), hit).velocity",
            "(0, 0, 1)", [0, 0, 1], allowed=1e-6, slow=True),
        Row("Rem. 6.4", "Newby's ratios for n = 2 and 3",
            "(ji.theory.newby_ratio(2), ji.theory.newby_ratio(3))",
            "formula; the outcome B is periodic", [2.2413379135, 6.1712927296],
            "B comes back at 6.17, 18.2, 36.2, ...: not in equal steps"),
        Row("(6.17)-(6.20)", "number of collisions at e = .5",
            "ji.Binary(0.5).collisions(three, hit)", "floor(...) = 2", 3,
            "ceil; and N >= 3 where z > 1/2"),
        Row("(6.21)", "endless collisions: e = .07",
            "ji.impact(ji.Binary(0.07), three, hit).velocity", "z >= 1", [THIRD, THIRD, THIRD]),
    ],
    "6.2 Kinematic laws": [
        Row("(6.22), (6.23)", "Example 6.1: quasi-velocities of four balls of 2 kg",
            "ji.theory.to_quasi_velocities(ji.chain([2.0] * 4), [0.3, -0.2, 0.5, 0.7])",
            "(v2 - v1)/sqrt(2m) = -0.25", [-0.5, 0.7, 0.2, 0.9192388155],
            "sqrt(m/2) (v2 - v1)"),
        Row("(6.31)-(6.34)", "the energy in quasi-velocities",
            "sum(ji.theory.kinetic_energy_split(ji.chain([2.0] * 4), [0.3, -0.2, 0.5, 0.7]))",
            "(6.34)", 0.87),
        Row(
            "(6.24)-(6.27)",
            "quasi-normal forces of a resting block, kinetic angle pi/2, g = 10",
            "ji.theory.quasi_lagrange(ji.System(ji.Block(1.0, 2.0**0.5, corners='base'), gravity=10.0),"
            " [0.0, 0.5**0.5, 0.0], [0.0, 0.0, 0.0]).normal",
            "(6.26)",
            [50**0.5, 50**0.5],
            slow=True,
        ),
        Row(
            "(6.28)-(6.30)",
            "forces of the contact LCP on a resting block of 1 kg",
            "ji.theory.contact_problem(ji.System(ji.Block(1.0, 2.0, corners='base'), gravity=10.0),"
            " [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]).forces()",
            "(6.74)",
            [5.0, 5.0],
            slow=True,
        ),
        Row(
            "(6.35)",
            "kinetic angle of contacts 1-2 and 3-4 of equal balls where v2 = v3: of (1, 2, 1)",
            "ji.theory.kinetic_angles(ji.Scene([1.0] * 4, [[-1.0, 0], [1, 0], [0, -1], [0, 1]],"
            " constraints=[[0.0], [1.0], [-1.0], [0.0]]))[0, 1]",
            "Schur complement",
            np.arccos(1 / 3),
        ),
        Row("(6.36)-(6.40)", "power of a contact force of 3 N at a gap velocity of -1 m/s",
            "ji.theory.contact_power(two, [1.5, 0.5], [3.0]).total", "(6.36)", -3.0),
        Row("(6.44)-(6.46)", "a restitution matrix: energy change of m = (1, 2, 3)",
            "ji.impact(ji.RestitutionMatrix([[0.7, 0.1], [0.25, 0.6]]), uneven,"
            " ji.theory.from_quasi_velocities(uneven, [-1.0, -0.3], [0.0])).energy_change",
            "(6.46), (6.47), (6.48)", -0.2248546638, "(6.49) lacks (I + E)^-1", slow=True),
        Row(
            "Prop. 6.1",
            "a matrix for LZB's outcome",
            "ji.impact(ji.RestitutionMatrix([[0.14735539269, 0.0], [0.91814627551, 0.0]]), three,"
            " hit).velocity",
            "there is one",
            [-0.0709523537, 0.0764030391, 0.9945493146],
            slow=True,
        ),
        Row("Prop. 6.2, 6.3", "is diag(.5, .5) admissible for three balls?",
            "ji.theory.audit_matrix(three, 0.5 * np.eye(2)).admissible", "yes", True),
        Row("Prop. 6.4, 6.5", "(I - E)^T G^-1 (I + E) of e = .5",
            "ji.theory.dissipation_matrix(np.eye(2), 0.5 * np.eye(2))",
            "sigma(E) < 1 follows", [0.75, 0, 0, 0.75], "sigma(E) <= 1; spectral radius"),
        Row("(6.51), (6.52)", "Moreau's law, e = .5, m = (1, 2, 3)",
            "ji.impact(ji.Moreau(0.5), uneven, hit).velocity", "(I + E qn-)",
            [-0.25, 0.25, 0.25], "(I + E) qn-", slow=True),
        Row("Th. 6.1", "Carnot: energy lost by two balls that stay together",
            "ji.theory.carnot_energy_loss(two, [-0.5, 0.5])", "positive", 0.25),
        Row("(6.53)-(6.59)", "energy change of a particle that slides, e = .5, mu = .3",
            "(lambda s: ji.theory.friction_energy_change(s, [1.0, -1.0], [3.0], [-0.9]))("
            "ji.Scene([2.0, 2.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]]))",
            "(6.58)", -1.4475, "G^-1 in the place of G; M of (6.59) is G^-1"),
        Row("(6.62)", "Example 6.2: least ratio of velocities, e = .5, mu = .3",
            "ji.theory.friction_bounds(ji.Scene([1.0, 1.0], [[0.0], [1.0]],"
            " tangents=[[1.0], [0.0]]), [[0.5]], 0.3).least_ratio",
            "2 mu/(1 - e - mu^2 (1 + e))", 1.6438356164),
        Row("(6.63)-(6.65)", "Fremond's inclusion",
            "ji.theory.restitution_inclusion([[1.0, 0.3], [0.3, 1.0]], [[2.0, 0.5], [0.5, 1.0]], [[0.6, 0.0], [0.0, 0.4]], [-1.0, 0.2]).velocity",
            "(6.65)", [0.3456066946, 0.6036820084], slow=True),
        Row(
            "6.2.7",
            "e_theta of a block that rocks without sliding, l = 2 L: from Housner's",
            "ji.theory.rocking_domain(2.0, sliding=False).rocking",
            "domains in [228]",
            [0.7, 1.0],
        ),
        Row("(6.66)", "kinetic angle of m = (1, 2, 3) [rad]",
            "ji.theory.kinetic_angles(uneven)[0, 1]", "(6.66)", 1.1071487178),
    ],
    "6.3 The law of Liu, Zhao and Brogliato": [
        Row("(6.67)-(6.73)", "three Hertz balls, e = 1, k2/k1 = 4",
            "ji.impact(ji.LZB(1.0, [1.0, 4.0]), three, hit).velocity", "(6.69)-(6.73)",
            [-0.2545012501, 0.3549067060, 0.8995945440],
            "indentation rate -grad f^T v; compression ends at its zero"),
        Row("(6.68)", "distributing rule, E2/E1 = .3, k2/k1 = 2",
            "ji.theory.distributing_rule([1.0, 0.3], [1.0, 2.0], 1.5)[1, 0]", "(6.68)", 0.6407442995),
        Row("6.3.1", "E0 of F0 = .328634, k = 2, eta = 1.5",
            "ji.theory.precompression_energy(0.328633534503099668, 2.0, 1.5)", "exponent 1/(eta + 1) of k",
            0.0394360241403719602, "exponent 1/eta"),
        Figure("6.6"),
        Row("(6.74)", "gaps of the block, q = (0, 1.5, 0)",
            "ji.Block(1.0, 2.0, corners='base').gap_function(np.array([0.0, 1.5, 0.0]))",
            "f1, f2", [0.5, 0.5]),
        Row("(6.74)", "determinant of D_nn: L^2 cos^2(theta)/(m I), m = 3, theta = .3",
            "np.linalg.det(ji.delassus_matrix(ji.Block(1.0, 2.0, 3.0, corners='base')"
            ".scene([0.0, 2.0, 0.3])))", "D_nn > 0", np.cos(0.3) ** 2 / (3 * 3 * 5 / 12), slow=True),
        Figure("6.7a"),
        Figure("6.7b"),
        Row("(6.75)", "kinetic angle at l = sqrt(2) L, and of a flat block [rad]",
            "(ji.theory.rocking_kinetic_angle(2**0.5), ji.theory.rocking_kinetic_angle(1e-6))",
            "pi/2, pi/4", [np.pi / 2, np.pi / 3], "pi/3 for the flat one"),
        Figure("6.8a"),
        Row("Rem. 6.11", "dimer: L = infinity, L = 0, and R/L = 5/24 [rad]",
            "[ji.theory.kinetic_angles(ji.Dimer(r, length).scene())[0, 1] for r, length in"
            " ((1e-9, 1.0), (1.0, 0.0), (5.0, 24.0))]",
            "1.445, 1.536, between", [1.4454684956, 1.5363067308, 1.4242044517],
            "not monotone: least at 5/24", slow=True),
        Figure("6.8b"),
        Row("Fig. 6.8b", "critical kinetic angle, mu = 0, .1, .3, .8 [degrees]",
            "np.degrees(ji.theory.critical_kinetic_angle([0.0, 0.1, 0.3, 0.8]))",
            "the curve", [90, 86.105, 79.421, 70.529], allowed=1e-5),
        Row("6.3.2.2", "rocking matrix, e = .7", "ji.theory.rocking_matrix(0.7)",
            "[[0, -e, 0], [-e, 0, 0], [0, 0, e]]", [0, 0.7, 0, 0.7, 0, 0, 0, 0, -0.7],
            "the signs are those of v+ = +E v-"),
        Row("6.3.3", "C_KE at A and B", "[ji.theory.energy_dispersion(three, v) for v in " + ARC + "]",
            "Moreau least", [2**0.5, 2**0.5 / 3]),
        Row("6.3.3", "C_KE of LZB, k2/k1 = 1, eta = 1, 1.5, 2, 3",
            "[ji.theory.energy_dispersion(three, ji.impact(ji.LZB(1.0, [1.0, 1.0], eta), three, hit)"
            ".velocity) for eta in (1.0, 1.5, 2.0, 3.0)]",
            "Fig. 6.9", [1.33036, 1.39115, 1.40788, 1.41375], allowed=5e-6, slow=True),
        Figure("5.5"),
        Figure("6.9"),
    ],
    "6.4 Further reading": [
        Row("(6.76)-(6.79)", "Poisson: two balls at a wall, e = (1, 1)",
            "-ji.impact(ji.Poisson([1.0, 1.0]), wall, [1.0, 0.0]).velocity", "(1, 0)", [1, 0],
            "(6.79) mixes t_c and t_f", slow=True),
        Row(
            "6.4.2",
            "re-entrant corner: one of the outcomes of a point that meets an edge, e = .5",
            "ji.theory.reentrant_corner(ji.Scene([1.0, 1.0], [[1.0, 0.0], [0.0, 1.0]]),"
            " [-1.0, -0.4], 0.5)[0].velocity",
            "excluded by Moreau",
            [-1.0, 0.2],
        ),
        Row("6.4.1", "Poisson: (0, 0, 1) needs e > 1",
            "ji.impact(ji.Poisson([0.5, 2.0], allow_above_one=True), three, hit).velocity",
            "e > 1", [0, 0, 1], slow=True),
        Row("6.4.3", "Routh's increments, energetic coefficient .8 (Bowling and Rodriguez)",
            "ji.Routh(0.8).impulses(ji.Contact([[2.0, -1.0], [-1.0, 2.0]], [-1.0, 0.0])).normal",
            "cited", [1.2, 0.6], slow=True),
        Row("6.4.3", "impulse correlation: the ratio p2/p1 of LZB, eta = 1.5, e = .9",
            "(lambda p: p[1] / p[0])(ji.impact(ji.LZB(0.9, [1.0, 1.0]), three, hit).impulse)",
            "ratios are not constant", 0.8967468,
            "`ji.ImpulseCorrelation` takes such ratios"),
    ],
}  # fmt: skip
