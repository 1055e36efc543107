"""The laws nearest to a velocity after an impact, and their columns in the table of engines.

The velocities in `jimpact/data/engine_impacts.csv` were measured with the engines. Beside each
stand the two nearest laws, in the energy norm, among those of `LAWS` with every coefficient of
restitution from 0 to 1 in steps of .01. `run.py` calls it; `python tests/validation/engines/nearest.py` writes
these columns anew, `--check` fails if that changes one.
"""

import csv
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jimpact as ji

TABLE = (
    Path(__file__).parents[3] / "jimpact" / "data" / "engine_impacts.csv"
)  # of this checkout
SCENES = ji.data.ENGINE_SCENES
LAWS = {
    "Moreau": ji.Moreau,
    "Binary": ji.Binary,
    "LZB, Hertz": lambda e: ji.LZB(e, exponent=1.5),
    "LZB, linear springs": lambda e: ji.LZB(e, exponent=1.0),
}
COEFFICIENTS = np.linspace(0, 1, 101)
ROUNDING = 2e-3  # of velocities in the table: what is plastic within it is called so


def outcomes(name):
    """Law -> v+ (101, n) in the scene of this name; NaN where the law fails."""
    masses, wall, _ = SCENES[name]
    scene, v = ji.chain(masses, wall=wall), jnp.zeros(len(masses)).at[0].set(1.0)
    found = {}
    for law, make in LAWS.items():
        run = jax.jit(jax.vmap(lambda e, make=make: ji.impact(make(e), scene, v)))
        out = run(COEFFICIENTS)
        usable = ~np.array([status.failure for status in ji.STATUS])[
            np.asarray(out.status)
        ]
        found[law] = np.where(usable[:, None], out.velocity, np.nan)
    return found


def ranked(v, masses, laws):
    """(distance, law, e) of each law, the nearest first; of equals the one with the largest e."""
    weight = np.sqrt(np.array(masses) / masses[0])  # over |v-| in the energy norm
    rows = []
    for law, after in laws.items():
        distance = np.linalg.norm(weight * (after - v), axis=1)
        k = len(distance) - 1 - int(np.nanargmin(distance[::-1]))
        rows.append((float(distance[k]), law, float(COEFFICIENTS[k])))
    return sorted(rows)


def nearest(velocity, masses, laws):
    """The columns of laws for one v+ (n,) over v1-; `laws` as `outcomes` gives them."""
    v = np.asarray(velocity, float)
    order = ranked(v, masses, laws)
    plastic = ranked(v, masses, {"plastic": laws["Moreau"][:1]})
    if plastic[0][0] <= order[0][0] + ROUNDING:
        order = plastic + order
    first, second = order[:2]
    return {
        "nearest_law": first[1],
        "nearest_e": f"{first[2]:.2f}",
        "distance": f"{first[0]:.4f}",
        "second_law": second[1],
        "second_distance": f"{second[0]:.4f}",
    }


def with_laws(rows):
    """Rows of the table, each a dict, with the columns of laws computed anew."""
    jax.config.update("jax_enable_x64", True)
    found = {
        name: outcomes(name) for name in dict.fromkeys(row["scene"] for row in rows)
    }
    for row in rows:
        masses = SCENES[row["scene"]].masses
        velocity = [row[f"v{i + 1}"] for i in range(len(masses))]
        yield row | nearest(velocity, masses, found[row["scene"]])


def read_table(path=TABLE):
    """The rows of a table, each a dict of texts."""
    with Path(path).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_table(rows):
    """Write the package's table."""
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main():
    before = read_table()
    rows = list(with_laws(before))
    changed = sum(old != new for old, new in zip(before, rows))
    write_table(rows)
    print(f"{len(rows)} rows, {changed} of them changed")
    return changed


if __name__ == "__main__":
    sys.exit(main() > 0 and "--check" in sys.argv)
