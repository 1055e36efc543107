"""The chooser table of `docs/laws.md`: how often a law breaks a property on random scenes.

`python tests/methods/chooser.py` prints it; a test holds the page to it. Per law 300 chains of four
balls (masses and stiffnesses over two decades, one e per contact) and 200 general scenes of two
contacts in three coordinates, all with random velocities in which something approaches.
"""

import operator

import jax

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import jimpact as ji

CHAINS, SCENES = 300, 200
COLUMNS = ("momentum", "p >= 0", "gamma+ >= 0", "energy", "scaling", "order", "end")
_SAME = 1e-5  # outcomes closer than this, relative to the velocities, are the same

LAWS = {
    "`LZB`": lambda e, k: ji.LZB(e, k, rtol=1e-7),
    "`Newton`": lambda e, k: ji.Newton(e),
    "`RestitutionMatrix`": lambda e, k: ji.RestitutionMatrix(jnp.diag(0.8 * e) + 0.2),
    "`Moreau`": lambda e, k: ji.Moreau(e),
    "`Poisson`": lambda e, k: ji.Poisson(e),
    "`Compliant`": lambda e, k: ji.Compliant(ji.Bistiffness(k, 1.5, e), rtol=1e-7),
    "`Binary`": lambda e, k: ji.Binary(e),
    "`Binary`, left to right": lambda e, k: ji.Binary(e, order="left_to_right"),
}


def approaching(v, normals):
    """Velocities turned round where nothing approaches."""
    gamma = np.einsum("kni,kn->ki", normals, v)
    return np.where((gamma < 0).any(axis=1, keepdims=True), v, -v)


def random_chains(rng):
    masses = 10.0 ** rng.uniform(-1, 1, size=(CHAINS, 4))
    normals = np.tile((np.eye(4)[1:] - np.eye(4)[:-1]).T, (CHAINS, 1, 1))
    mass = np.einsum("ki,ij->kij", masses, np.eye(4))
    return mass, normals, rng.normal(size=(CHAINS, 4))


def random_scenes(rng):
    x = rng.normal(size=(SCENES, 3, 3))
    mass = x @ x.transpose(0, 2, 1) + 0.2 * np.eye(3)
    return mass, rng.normal(size=(SCENES, 3, 2)), rng.normal(size=(SCENES, 3))


def broken(make):
    """Counts of violations by property, over all scenes, and how many no status reported."""

    @jax.jit
    @jax.vmap
    def outcome(mass, normals, v, e, k):
        scene = ji.Scene(mass, normals)
        out = ji.impact(make(e, k), scene, v)
        return out, ji.audit(out, scene, v)

    rng = np.random.default_rng(2016)
    counts, silent = np.zeros(len(COLUMNS), int), 0
    for mass, normals, v in (random_chains(rng), random_scenes(rng)):
        m, v = normals.shape[2], approaching(v, normals)
        e = rng.uniform(size=(len(v), m))
        k = 10.0 ** rng.uniform(-1, 1, size=(len(v), m))
        plain = (mass, normals, v, e, k)
        scaled = (1e-3 * mass, normals, 1e3 * v, e, k)
        backwards = (mass, normals[:, :, ::-1], v, e[:, ::-1], k[:, ::-1])
        out, found = jax.device_get(
            outcome(*(np.concatenate(x) for x in zip(plain, scaled, backwards)))
        )
        after, faster, turned = np.split(out.velocity, 3)
        found, status = jax.tree.map(
            operator.itemgetter(slice(len(v))), (found, out.status)
        )
        same = _SAME * np.abs(v).max(axis=1)
        bad = [
            ~found.momentum,
            ~found.kinetic,
            ~found.kinematic,
            ~found.energetic,
            np.abs(faster / 1e3 - after).max(axis=1) > same,
            np.abs(turned - after).max(axis=1) > same,
            np.isin(
                status,
                [ji.STATUS.index(row) for row in ji.STATUS if row.name in UNFINISHED],
            ),
        ]
        counts += np.sum(bad, axis=1)
        failure = np.array([row.failure for row in ji.STATUS])
        silent += int((~failure[status] & ~found.consistent).sum())
    return counts, silent


UNFINISHED = ("plastic_limit", "infeasible", "max_steps", "not_finite")


def table():
    """The table's lines, and how many violations no status reported."""
    head = " | ".join(COLUMNS)
    lines, silent = [f"| law | {head} |", "|" + "---|" * (len(COLUMNS) + 1)], 0
    for name, make in LAWS.items():
        counts, unreported = broken(make)
        lines.append(f"| {name} | " + " | ".join(str(n) for n in counts) + " |")
        silent += unreported
    return lines, silent


if __name__ == "__main__":
    lines, silent = table()
    print("\n".join(lines))
    print(f"not reported by a status: {silent}")
