"""Writes `tests/held/stability_points.npz`: 300 Latin-hypercube points over all axes, and the
outcomes of `lzb_oracle.cpp` there (80-bit precision, another formulation, no shared code).

    python tests/benchmarks/stability_reference.py        (needs g++; half an hour)

The point of axes (kappa, mu, e, eta, N) is the chain of `jimpact.methods.stability.chain_of`: N balls,
the first strikes the others with v = 1; contacts of the right half have stiffness kappa, the others
1; the middle ball has mass mu, the others 1. `uncertainty` is the difference between runs at local
tolerances 1e-12 and 1e-14; NaN where the oracle gave up after SECONDS.
"""

import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from scipy.integrate._ivp import dop853_coefficients
from scipy.stats import qmc

HERE = Path(__file__).parent
DATA = HERE.parent / "held" / "stability_points.npz"
SIZES, SHARES = (2, 3, 6, 20, 100), (0.08, 0.37, 0.3, 0.2, 0.05)
POINTS, SEED = 300, 5
TOLERANCES, STEPS, SECONDS = ("1e-12", "1e-14"), 100_000_000, 20.0


def points():
    """(POINTS, 5): kappa, mu, e, eta, N."""
    u = qmc.LatinHypercube(5, seed=SEED).random(POINTS)
    size = np.asarray(SIZES)[np.searchsorted(np.cumsum(SHARES), u[:, 4] * 0.999999)]
    kappa, mu = (10 ** (most * middling(u[:, i])) for i, most in ((0, 8.0), (1, 6.0)))
    return np.stack([kappa, mu, restitution(u[:, 2]), 1 + 4 * u[:, 3], size], axis=1)


def middling(u):
    """From -1 to 1, half of it within 1/4: most scenes are not at the corners."""
    return (2 * u - 1) * np.abs(2 * u - 1)


def restitution(u):
    """A tenth each exactly 0 and exactly 1, three tenths 1e-3 to 0.1 (log), half 0.1 to 1."""
    small, large = 10 ** (-3 + 2 * (u - 0.1) / 0.3), 0.1 + 0.9 * (u - 0.4) / 0.5
    return np.select([u < 0.1, u < 0.4, u < 0.9], [0.0, small, large], 1.0)


def chain_of(kappa, mu, n):
    """Masses (n,) and stiffnesses (n - 1,)."""
    mass, k = np.ones(n), np.ones(n - 1)
    mass[n // 2] = mu
    k[n // 2 :] = kappa
    return mass, k


def line_of(point):
    """One line of input for the oracle."""
    kappa, mu, e, eta, n = point
    mass, k = chain_of(kappa, mu, int(n))
    numbers = [eta, e, *mass, *k, *np.eye(int(n))[0]]
    return " ".join([str(int(n)), *(repr(float(x)) for x in numbers)])


def build(folder):
    """The oracle's program, compiled with scipy's coefficients of DOP853."""
    stages = dop853_coefficients.N_STAGES

    def written(name, rows):
        rows = np.atleast_2d(rows)
        text = ",".join(
            "{" + ",".join(f"{x!r}L" for x in map(float, row)) + "}" for row in rows
        )
        shape = f"[{len(rows)}][{stages}]" if len(rows) > 1 else f"[{stages}]"
        return f"const long double {name}{shape} = {'{' + text + '}' if len(rows) > 1 else text};\n"

    d = dop853_coefficients
    text = f"const int STAGES = {stages};\n" + written("A", d.A[:stages, :stages])
    text += (
        written("B", d.B) + written("E3", d.E3[:stages]) + written("E5", d.E5[:stages])
    )
    (folder / "dop853.h").write_text(text)
    program = folder / "oracle"
    source = str(HERE / "lzb_oracle.cpp")
    subprocess.run(
        ["g++", "-O3", "-std=c++17", f"-I{folder}", source, "-o", str(program)],
        check=True,
    )
    return program


def ask(program, point, tolerance, seconds=SECONDS):
    """End (0 over, 1 over after endless closing, 2 given up), velocities after (n,)."""
    said = subprocess.run(
        [str(program), tolerance, str(STEPS), str(seconds)],
        input=line_of(point) + "\n",
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    return int(said[0]), np.array(said[3:], float)


def main():
    """Points and outcomes to DATA; outcomes that are there already are kept."""
    chosen = points()
    velocity = np.full((POINTS, max(SIZES)), np.nan)
    uncertainty, end = np.full(POINTS, np.nan), np.full(POINTS, 2)
    if DATA.exists() and np.array_equal(np.load(DATA)["points"], chosen):
        held = np.load(DATA)
        velocity, uncertainty, end = (
            held[name] for name in ("velocity", "uncertainty", "end")
        )
    missing = sorted(np.flatnonzero(end == 2), key=lambda i: chosen[i, 4])
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        program = build(Path(folder))

        def solve(i):
            velocities = []
            for tolerance in TOLERANCES:
                code, v = ask(program, chosen[i], tolerance)
                if code == 2:
                    return i, 2, v, np.nan
                velocities.append(v)
            return i, code, v, np.abs(velocities[1] - velocities[0]).max()

        for done, (i, code, v, apart) in enumerate(pool.map(solve, missing), 1):
            end[i], uncertainty[i] = code, apart
            if code != 2:
                velocity[i, : len(v)] = v
            if done % 10 == 0 or done == len(missing):
                outcome = {"velocity": velocity, "uncertainty": uncertainty, "end": end}
                np.savez_compressed(DATA, points=chosen, **outcome)
                print(f"{done} of {len(missing)}", file=sys.stderr)
    print(f"given up: {(end == 2).sum()}, endless: {(end == 1).sum()}")
    spread = np.nanmedian(uncertainty), np.nanmax(uncertainty)
    print("uncertainty: median {:.1e}, largest {:.1e}".format(*spread))


if __name__ == "__main__":
    main()
