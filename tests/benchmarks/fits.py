"""`ji.fit` beside scipy on random problems: `python tests/benchmarks/fits.py`.

40 problems: 3 to 6 balls with and without a wall, 6 to 16 shots with noise of 0.01 m/s, which is
known; LZB, Compliant, Moreau, restitution matrix; 2 to 7 free parameters. `ji.fit` begins at a
start of its own (e = 0.8, equal stiffnesses); `scipy.optimize.least_squares` at the truth, on the
same compiled residual and Jacobian. CPU seconds without compiling; those of the first call are
apart (a program that an earlier problem compiled is not compiled again). `--only 1,8`: some of
them. About ten minutes.
"""

import time

from harness import arguments, show, write_csv

import jax  # isort: skip
import numpy as np
from scipy.optimize import least_squares

import jimpact as ji
from jimpact.fits.solve import Solver, minimize

PROBLEMS, SIGMA = 40, 0.01
LAWS = ("lzb", "lzb", "lzb", "compliant", "moreau", "matrix")
COLUMNS = (
    *(
        "problem",
        "law",
        "balls",
        "wall",
        "shots",
        "free",
        "chi2",
        "chi2_scipy",
        "from_truth",
    ),
    *(
        "minima",
        "lost",
        "evaluations",
        "evaluations_scipy",
        "cpu",
        "cpu_first",
        "cpu_scipy",
    ),
)


def laws(kind, rng, contacts):
    """The law that makes the data, the one to start from, and what is free."""
    e = float(rng.uniform(0.6, 0.95))
    if kind == "lzb":
        ratios = np.exp(rng.uniform(-1, 1, contacts))
        ratios[0] = 1
        several = rng.integers(2) and contacts <= 4
        truth = ji.LZB(rng.uniform(0.6, 0.95, contacts) if several else e, ratios)
        start = ji.LZB(np.full(contacts, 0.8) if several else 0.8, np.ones(contacts))
        return truth, start, ("restitution", "stiffness")
    if kind == "compliant":
        ratios = np.exp(rng.uniform(-1, 1, contacts))
        ratios[0] = 1
        truth = ji.Compliant(ji.Bistiffness(1e9 * ratios, 1.5, e))
        start = ji.Compliant(ji.Bistiffness(1e9 * np.ones(contacts), 1.5, 0.8))
        return truth, start, ("restitution", "stiffness")
    if kind == "moreau":
        truth = ji.Moreau(rng.uniform(0.5, 0.95, contacts))
        return truth, ji.Moreau(np.full(contacts, 0.8)), ("restitution",)
    truth = ji.RestitutionMatrix([[0.6, 0.1], [0.05, 0.5]])
    return truth, ji.RestitutionMatrix([[0.5, 0.0], [0.0, 0.5]]), ("matrix",)


def problem(k):
    """Law by name, scene, start, truth, what is free, and shots of the k-th problem."""
    rng, kind = np.random.default_rng(1000 + k), LAWS[k % len(LAWS)]
    matrix = kind == "matrix"
    balls = 3 if matrix else int(rng.integers(3, 7))
    wall = False if matrix else bool(rng.integers(2))
    shots = int(rng.integers(6, 17))
    scene = ji.chain(rng.choice([0.1, 0.15, 0.2, 0.3], balls), wall=wall)
    pre = np.zeros((shots, balls))
    pre[:, 0] = rng.uniform(0.5, 2, shots)
    half = shots // 2
    pre[half:, 1] = pre[half:, 0] * rng.choice([0, 0.5], shots - half)
    if matrix:
        rng.uniform(0.6, 0.95)  # as for the other laws
        pre[half:, 2] = -rng.uniform(0.2, 1, shots - half)
        truth, start, free = laws(kind, np.random.default_rng(0), 2)
    else:
        truth, start, free = laws(kind, rng, balls - 1 + wall)
    after = jax.jit(jax.vmap(lambda v: ji.impact(truth, scene, v).velocity))(pre)
    post = np.asarray(after) + SIGMA * rng.normal(size=pre.shape)
    return kind, scene, start, truth, free, ji.Experiments(pre, post, SIGMA)


def by_scipy(start, scene, data, free, truth):
    """The minimum next to the truth, on the residual and Jacobian that `ji.fit` compiles."""
    fitted = ji.FitProblem.from_shots(start, scene, data, free)
    low, high = (end[: len(fitted.names)] for end in (fitted.low, fitted.high))
    known = {}

    def at(y):
        """Residual and Jacobian, computed once a point."""
        if y.tobytes() not in known:
            point = np.zeros((1, len(fitted.low)))
            point[0, : len(y)] = y
            everything = np.ones(point.shape, bool)
            ends = minimize(
                [fitted.least_squares()], point, Solver(max_steps=1), fixed=everything
            )
            known[y.tobytes()] = ends.residual[0], ends.jacobian[0, :, : len(y)]
        return known[y.tobytes()]

    own = ji.FitProblem.from_shots(truth, scene, data, free)
    first = np.clip(fitted.variables.point(own.start)[: len(low)], low, high)
    at(first)
    began = time.process_time()
    scale = "jac" if fitted.matrix is None else 1.0
    found = least_squares(
        lambda y: at(y)[0], first, lambda y: at(y)[1], (low, high), x_scale=scale
    )
    return 2 * found.cost, found.nfev, time.process_time() - began


def row(k):
    """The k-th problem by both."""
    kind, scene, start, truth, free, data = problem(k)
    began = time.process_time()
    ji.fit(start, scene, data, free, profiles=False, search=ji.Search(max_steps=1))
    first = time.process_time() - began
    began = time.process_time()
    found = ji.fit(start, scene, data, free, profiles=False)
    cpu = time.process_time() - began
    from_truth = ji.fit(truth, scene, data, free, profiles=False, starts=1)
    least, evaluations, cpu_scipy = by_scipy(start, scene, data, free, truth)
    answers = "" if found.converged and from_truth.converged else " no answer"
    return {
        "problem": k,
        "law": kind,
        "balls": scene.size,
        "wall": "yes" if scene.walls[1] else "no",
        "shots": len(data.shots),
        "free": len(found.names),
        "chi2": found.chi_squared,
        "chi2_scipy": least,
        "from_truth": f"{from_truth.chi_squared - least:+.1e}{answers}",
        "minima": len(found.starts),
        "lost": found.lost_starts,
        "evaluations": found.steps,
        "evaluations_scipy": evaluations,
        "cpu": cpu,
        "cpu_first": first,
        "cpu_scipy": cpu_scipy,
    }


def add(parser):
    parser.add_argument("--only", help="numbers of problems, as in 1,8")


def main():
    options = arguments(__doc__, add)
    which = range(2, 3) if options.quick else range(PROBLEMS)
    which = map(int, options.only.split(",")) if options.only else which
    rows = []
    for k in which:
        rows.append(row(k))
        print(
            *(
                f"{rows[-1][key]:.5g}"
                if isinstance(rows[-1][key], float)
                else rows[-1][key]
                for key in COLUMNS
            ),
            flush=True,
        )
        write_csv(options.out / "fits.csv", rows)
    show("ji.fit beside scipy from the truth", rows, COLUMNS)


if __name__ == "__main__":
    main()
