"""Writes `tests/held/friction_space.npz`: impacts of boxes and of the measured cube with friction in
space on 1, 2 and 4 contacts, by an integration that shares no code with the package (`regularized`
in tests/laws/friction_reference.py), and slopes in mu, e and the first stiffness by its differences.

    python tests/benchmarks/space_reference.py        (minutes)

Arrays `NAME_1`, `NAME_2`, `NAME_4` by the number of contacts: mass, normals, tangents, velocity,
restitution, friction, stiffness (.., m) of Hertz contacts; `after` (.., n) and its `uncertainty`
(..,): what another eps gives; `slopes` (.., 3, n) of `after`, NaN where there is none (the only
stiffness), and `slope_uncertainty` (.., 3): what half the order gives.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np

TESTS = Path(__file__).parent.parent
sys.path[:0] = [str(TESTS / "bodies"), str(TESTS / "laws")]
import friction_reference  # noqa: E402
import spatial_scenes  # noqa: E402

DATA = TESTS / "held" / "friction_space.npz"
KINDS = {1: ("corner",), 2: ("edge",), 4: ("flat", "nearly flat")}
BOXES, CUBES = 4, 2  # of a number of contacts; impacts of the measured cube
RESTITUTIONS, FRICTIONS = (0.2, 0.5, 0.9), (0.1, 0.3, 0.6, 1.0)
EXPONENT = 1.5
EPS, EPS_OF_SLOPES = 1e-6, 1e-7  # over the fastest approach
RTOL = 1e-10
STEP = 1e-3  # of the differences, in mu, e and ln k
OUTPUTS = ("after", "uncertainty", "slopes", "slope_uncertainty")


def impacts(contacts):
    """Rows of `INPUTS`: boxes, and the cube where the file has such impacts."""
    rng, rows = np.random.default_rng([7, contacts]), []
    for kind in KINDS[contacts]:
        draw = spatial_scenes.random_boxes(kind, BOXES // len(KINDS[contacts]), seed=7)
        for i, pressed in enumerate(zip(*draw[:4])):
            e, mu = RESTITUTIONS[i % len(RESTITUTIONS)], FRICTIONS[i % len(FRICTIONS)]
            rows.append((*pressed, e, mu, 2.0 ** rng.uniform(-1, 1, contacts)))
    if contacts <= 2:
        for *pressed, e, mu in list(zip(*spatial_scenes.cube_draw(contacts)))[
            : 4 * CUBES : 4
        ]:
            rows.append((*pressed, e, mu, np.ones(contacts)))
    return rows


def after(row, eps, mu=0.0, e=0.0, log_k=0.0):
    """v+ with regularized friction, at changes of the parameters."""
    mass, normals, tangents, velocity, restitution, friction, stiffness = row
    scene = SimpleNamespace(mass=mass, normals=normals, tangents=tangents)
    k = stiffness * np.exp(log_k * np.eye(len(stiffness))[0])
    given = (k, EXPONENT, restitution + e, friction + mu)
    speed = np.abs(normals.T @ velocity).max()
    run = friction_reference.Regularized(scene, *given, eps * speed, rtol=RTOL)
    return run.after(velocity)


def solved(row):
    """OUTPUTS of a row."""
    a, b, c = (after(row, part * EPS) for part in (1, 2, 4))
    limit, other = 2 * a - b, 2 * b - c
    slopes, uncertain = np.full((3, len(limit)), np.nan), np.full(3, np.nan)
    for i, name in enumerate(("mu", "e", "log_k")[: 2 + (len(row[-1]) > 1)]):
        at = {s: after(row, EPS_OF_SLOPES, **{name: s * STEP}) for s in (-2, -1, 1, 2)}
        low, wide = (at[1] - at[-1]) / (2 * STEP), (at[2] - at[-2]) / (4 * STEP)
        slopes[i] = (4 * low - wide) / 3
        uncertain[i] = np.abs(slopes[i] - low).max()
    return limit, np.abs(limit - other).max(), slopes, uncertain


def main():
    """The file, from all processors."""
    table = {}
    with ProcessPoolExecutor(2) as pool:
        for contacts in KINDS:
            rows = impacts(contacts)
            outcomes = list(pool.map(solved, rows))
            columns = [*zip(*rows), *zip(*outcomes)]
            for name, column in zip((*spatial_scenes.INPUTS, *OUTPUTS), columns):
                table[f"{name}_{contacts}"] = np.stack(column)
            np.savez_compressed(DATA, **table)
            print(contacts, table[f"uncertainty_{contacts}"])
            print(table[f"slope_uncertainty_{contacts}"], flush=True)


if __name__ == "__main__":
    main()
