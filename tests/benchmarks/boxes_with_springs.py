"""Random boxes under contact forces with tangential springs: how they end, and beside Radau.

    python tests/benchmarks/boxes_with_springs.py [--boxes 100] [--compared 6]

Boxes fall on a plane flat, on an edge or on a corner, in turn: edges .05 to .2 m, .1 to 3 kg, k 3e3 to
1e5 N/m, mu .1 to 1, kappa = .8, e = .6; 1 s each. `--compared`: the first .06 s of that many boxes of
e = 1 beside scipy's Radau (see tests/motion/spring_cases.py), largest error of the velocities.
"""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import jax
import numpy as np

import jimpact as ji

KAPPA = 0.8
KINDS = ("flat", "edge", "corner")


def box(i):
    """Size, mass, k, mu, q and v of box i."""
    rng = np.random.default_rng([66, i])
    size = rng.uniform(0.05, 0.2, 3)
    mass = 10 ** rng.uniform(-1, 0.5)
    k = 10 ** rng.uniform(3.5, 5)
    mu = rng.uniform(0.1, 1)
    lean = {"flat": [0, 0], "edge": [1, 0], "corner": [1, 1]}[KINDS[i % 3]]
    tilt = rng.uniform(0.1, 0.7, 2) * lean
    yaw = rng.uniform(-3, 3)
    turn = quaternion(2, yaw)
    for axis in (0, 1):
        turn = product(turn, quaternion(axis, tilt[axis]))
    s, a, b, c = turn
    vertical = np.array(
        [2 * (a * c - s * b), 2 * (b * c + s * a), 1 - 2 * (a * a + b * b)]
    )
    height = np.abs(vertical) @ size / 2 + rng.uniform(0.001, 0.02)
    v = rng.normal(size=6) * [0.5, 0.5, 0.3, 2, 2, 2]
    v[2] = -0.1 - abs(v[2])
    if KINDS[i % 3] == "flat":
        v[3:5] = 0.0
    return size, mass, k, mu, np.array([0, 0, height, *turn]), v


def quaternion(axis, angle):
    """A turn about an axis."""
    turn = np.zeros(4)
    turn[0] = np.cos(angle / 2)
    turn[1 + axis] = np.sin(angle / 2)
    return turn


def product(e, f):
    """Quaternion of the turn f, then e."""
    s = e[0] * f[0] - e[1:] @ f[1:]
    return np.array([s, *(e[0] * f[1:] + f[0] * e[1:] + np.cross(e[1:], f[1:]))])


@jax.jit
def moved(size, mass, k, mu, e, q, v, end):
    """The motion of one box."""
    force = ji.Bistiffness(k, 1.0, e)
    law = ji.Compliant(force, friction=mu, tangential_stiffness=KAPPA)
    system = ji.System(ji.Box(size, mass=mass), gravity=True)
    return ji.simulate(
        system, law, q, v, end, method="contact_forces", samples=21, max_events=6000
    )


def main(boxes, compared):
    """Print statuses, steps, times and energies; then the errors."""
    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, str(Path(__file__).parents[1] / "motion"))
    from spring_cases import SpringBox

    ends = Counter()
    steps = []
    seconds = []
    residuals = []
    for i in range(boxes):
        size, mass, k, mu, q, v = box(i)
        begin = time.perf_counter()
        motion = jax.block_until_ready(moved(size, mass, k, mu, 0.6, q, v, 1.0))
        seconds.append(time.perf_counter() - begin)
        ends[ji.STATUS[int(motion.status)].name] += 1
        steps.append(int(motion.steps))
        residuals.append(
            float(np.max(np.abs(motion.ledger_residual) / motion.energy[0]))
        )
        if int(motion.status) != 0:
            print(
                i,
                KINDS[i % 3],
                ji.STATUS[int(motion.status)].name,
                steps[-1],
                flush=True,
            )
    print(dict(ends), "steps", np.median(steps), max(steps))
    print("seconds", np.median(seconds[1:]), max(seconds[1:]), "first", seconds[0])
    print("ledger", max(residuals))
    for i in range(compared):
        size, mass, k, mu, q, v = box(i)
        motion = moved(size, mass, k, mu, 1.0, q, v, 0.06)
        exact = SpringBox(size, mass, k, mu, KAPPA).velocity(q, v, 0.06)
        error = np.abs(np.asarray(motion.velocity[-1]) - exact).max()
        print(i, KINDS[i % 3], f"{error:.1e} of {np.abs(exact).max():.2g}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--boxes", type=int, default=100)
    parser.add_argument("--compared", type=int, default=6)
    given = parser.parse_args()
    main(given.boxes, given.compared)
