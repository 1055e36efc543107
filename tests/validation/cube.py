"""The table of laws on the tossed cube: `python tests/validation/cube.py` writes `docs/cube.md`.

All laws are fitted jointly to the same measured impacts on one and on two corners, and predict those
of tosses that they were not fitted to. Some ten minutes on one core; MuJoCo takes part if it is
installed. `python tests/validation/cube.py LZB Moreau` prints the table of these laws only.
"""

import csv
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation
from scipy.special import gammaln
from scipy.stats import f as f_distribution
from when_written import written

import jimpact as ji

PAGE = Path(__file__).parents[2] / "docs" / "cube.md"
BOX = (
    [0.102] * 3,
    0.37,
    [9.57e-4, 9.57e-4, 9.09e-4],
)  # sizes [m], mass [kg], inertia [kg m^2]
CENTRE, ROUNDING = 0.0057, 0.0036  # of mass above the middle, of the corners [m]
NEAR = 2e-3  # [m] a corner so far above the lowest one counts as the second; board and cube are flat to 1.4
FOLDS = 5  # groups of tosses; one is predicted by a fit to the others
# Error beyond which an impact pulls as its absolute value, not as its square: that of the best law.
# Ten times more would let a few impacts on two corners, 30 % off, decide the fit.
SOFT = 0.03
RTOL = 1e-4  # of impacts, a twentieth of noise over speed
# Logarithms of scatter, of noise over that of the camera and of nu, where they are sought. A scatter
# of 1e-3 is none; nu = 150 is normal.
SIZES = (-7.0, 5.0)
RESAMPLES = (
    2000  # of the tosses; ten times more change the intervals by less than .05 %
)
# Tosses that are in the source twice, turned about the vertical: the second one is the first.
COPIES = {
    **{
        370: 41,
        371: 42,
        327: 162,
        528: 163,
        530: 165,
        531: 166,
        532: 167,
        301: 172,
        302: 173,
    },
    **{453: 226, 457: 230, 413: 321, 415: 323, 546: 363, 558: 492},
}


class Impacts(NamedTuple):
    """Measured impacts of the cube, each on one or two corners."""

    data: (
        ji.Experiments
    )  # its sigma makes |residual| of an impact the error: |dv| / |v-|, by energy
    q: np.ndarray  # (K, 7)
    noise: np.ndarray  # (K, 6) of v+ and v-, over sigma
    two: np.ndarray  # (K,) whether a second corner is near
    toss: np.ndarray  # (K,) copies have the same


def cube() -> ji.Box:
    """The measured cube."""
    return ji.Box(*BOX, centre=[0, 0, CENTRE], rounding=ROUNDING)


def tosses(labels: Any) -> np.ndarray:
    """Number of the toss of each label "toss:frame", copies by that of their original."""
    numbers = [int(label.split(":")[0]) for label in labels]
    return np.array([COPIES.get(number, number) for number in numbers])


def impacts() -> Impacts:
    """All clean impacts on one corner, clean and nearly clean ones on two."""
    measured = ji.data.cube_impacts((1, 2), NEAR, nearly_clean=True)
    poses = {}
    for name in ("cube_impacts.csv", "cube_nearly_clean.csv"):
        with (files("jimpact") / "data" / name).open() as file:
            for row in csv.reader(file):
                poses[row[0]] = row[1:8]
    mass = np.array([BOX[1]] * 3 + BOX[2])
    pre = np.asarray(measured.pre)
    sigma = np.sqrt(np.sum(mass * pre**2, axis=1))[:, None] / np.sqrt(mass)
    q = np.array([poses[label] for label in measured.shots], float)
    noise = np.hypot(measured.sigma, measured.sigma_pre) / sigma
    data = ji.Experiments(pre, measured.post, sigma, measured.scenes, measured.shots)
    return Impacts(data, q, noise, data.contacts == 2, tosses(data.shots))


def heights(q: np.ndarray) -> np.ndarray:
    """Of all corners (K, 8) above the lowest one [m]."""
    found = np.asarray(jax.vmap(cube().gap_function)(q))
    return found - found.min(axis=1, keepdims=True)


def with_measured_gaps(all_impacts: Impacts) -> ji.Experiments:
    """The same impacts; the second corner begins where it was, above the lowest one."""
    data, scenes = all_impacts.data, []
    for scene, height in zip(data.scenes, heights(all_impacts.q)):
        gaps = height[height <= NEAR]  # contacts are in the order of the corners
        scenes.append(ji.Scene(scene.mass, scene.normals, scene.tangents, gaps))
    return ji.Experiments(data.pre, data.post, data.sigma, scenes, data.shots)


@dataclass
class Model:
    """A law with numbers x: the residual (6 K,) of all impacts, and its Jacobian."""

    names: tuple[str, ...]
    start: np.ndarray  # (P,), or (S, P) of several starts
    bounds: tuple[np.ndarray, np.ndarray]
    residual: Callable[[Any], Any]
    jacobian: Any  # a function, or a word of scipy's

    def fitted(self, weight: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Numbers with which the impacts of weight 1 are predicted best, of one or several starts."""
        each = np.repeat(weight, 6)
        slopes = self.jacobian
        if callable(slopes):
            slopes = lambda x: np.asarray(self.jacobian(x)) * each[:, None]  # noqa: E731
        fits = [
            least_squares(
                lambda x: np.asarray(self.residual(x)) * each,
                start, slopes, self.bounds, loss="soft_l1", f_scale=SOFT, x_scale=np.abs(start),
                xtol=1e-3, ftol=1e-5, diff_step=0.02, max_nfev=30,
            )
            for start in np.atleast_2d(starts)
        ]  # fmt: skip
        return min(fits, key=lambda fit: fit.cost).x

    def errors(self, x: np.ndarray) -> np.ndarray:
        """Of every impact (K,) [%]."""
        return 100 * np.linalg.norm(np.asarray(self.residual(x)).reshape(-1, 6), axis=1)


def of_law(law: ji.Law, data: ji.Experiments, free: tuple[str, ...]) -> Model:
    """A law of jimpact."""
    problem = ji.FitProblem.from_shots(law, None, data, free)
    low, high = problem.domains.T
    bounds = (low, high)
    return Model(
        problem.names,
        np.asarray(problem.start),
        bounds,
        problem.residual,
        problem.jacobian,
    )


def models(all_impacts: Impacts) -> dict[str, Callable[[], Model]]:
    """What is compared; the second ones are extensions of the first."""
    data, gaps = all_impacts.data, with_measured_gaps(all_impacts)
    options: Any = {"rtol": RTOL, "method": "implicit"}
    lzb = ji.LZB(0.28, friction=0.16, **options)
    soft = ji.Compliant(ji.Bistiffness(1.2e7, 1.5, 0.28), friction=0.16, **options)
    three = ("restitution", "friction", "tangential_restitution")
    pair, stiff, falls = ("restitution", "friction"), "stiffness", "speed_exponent"

    def falling(law: ji.Law) -> ji.Law:
        """With e that falls by a power of the speed of approach."""
        return ji.VelocityDependent(law, speed_exponent=0.2)

    return {
        "Newton": lambda: of_law(ji.Newton(0.28, 0.16, 0.6), data, three),
        "Moreau": lambda: of_law(ji.Moreau(0.28, 0.16, 0.6), data, three),
        "LZB": lambda: of_law(lzb, data, pair),
        "Compliant": lambda: of_law(soft, gaps, (*pair, stiff)),
        "LZB, e falls": lambda: of_law(falling(lzb), data, (*pair, falls)),
        "Compliant, e falls": lambda: of_law(
            falling(soft), gaps, (*pair, stiff, falls)
        ),
    }


def held_out(model: Model, whole: np.ndarray, toss: np.ndarray) -> np.ndarray:
    """Errors (K,) of impacts predicted by fits to the tosses of the other groups [%]."""
    error = np.empty(len(toss))
    group = groups(toss)
    for k in range(FOLDS):
        x = model.fitted((group != k).astype(float), whole)
        error[group == k] = model.errors(x)[group == k]
    return error


def groups(toss: np.ndarray) -> np.ndarray:
    """Group of each impact (K,): tosses in turn, all impacts of one in the same."""
    return np.unique(toss, return_inverse=True)[1] % FOLDS


def resampled(toss: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """Impacts of as many tosses, drawn with replacement."""
    members = [np.flatnonzero(toss == t) for t in np.unique(toss)]
    rng = np.random.default_rng(seed)
    draws = rng.integers(len(members), size=(RESAMPLES, len(members)))
    return [np.concatenate([members[i] for i in draw]) for draw in draws]


def median_and_interval(
    error: np.ndarray, draws: list[np.ndarray]
) -> tuple[float, float, float]:
    """Median, and the 95 % interval of the medians of the draws."""
    low, high = np.quantile([np.median(error[draw]) for draw in draws], [0.025, 0.975])
    return float(np.median(error)), float(low), float(high)


def difference(
    a: np.ndarray, b: np.ndarray, draws: list[np.ndarray]
) -> tuple[float, float, float]:
    """Median of b minus that of a, and its 95 % interval: the same draws for both."""
    each = [np.median(b[draw]) - np.median(a[draw]) for draw in draws]
    low, high = np.quantile(each, [0.025, 0.975])
    return float(np.median(b) - np.median(a)), float(low), float(high)


def scatter_of(
    residual: np.ndarray, slopes: np.ndarray, noise: np.ndarray, toss: np.ndarray
) -> tuple[np.ndarray, dict[float, float]]:
    """Scatter of parameters between impacts, and how many impacts lie in regions of each chance.

    `r_k = J_k b_k + c noise_k`, together Student's t with nu degrees of freedom: normal, but for
    more that is far off. Sizes are those of b, c, and nu, the most likely ones for the other groups
    of tosses. Regions are those of `r^T C^-1 r / 6`, which is F(6, nu).
    """
    size = residual.shape[1]

    def squares(log: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """r^T C^-1 r and log det C of every impact, and nu."""
        *scatter, factor, nu = np.exp(np.clip(log, *SIZES))
        scaled = slopes * scatter
        covariance = scaled @ scaled.swapaxes(1, 2)
        covariance += (factor * noise)[:, :, None] ** 2 * np.eye(size)
        solved = np.linalg.solve(covariance, residual[:, :, None])[..., 0]
        return np.sum(residual * solved, axis=1), np.linalg.slogdet(covariance)[1], nu

    def cost(log: np.ndarray, chosen: np.ndarray) -> float:
        """Minus the logarithm of the likelihood of the chosen impacts."""
        square, volume, nu = squares(log)
        each = volume / 2 + (nu + size) / 2 * np.log1p(square / nu)
        each += gammaln(nu / 2) - gammaln((nu + size) / 2) + size / 2 * np.log(nu)
        return float(each[chosen].sum())

    def sizes(chosen: np.ndarray) -> np.ndarray:
        """Logarithms that make the chosen impacts most likely."""
        start = np.log([*np.full(slopes.shape[2], 0.03), 1.0, 10.0])
        return minimize(cost, start, chosen, "Nelder-Mead", options={"maxiter": 600}).x

    group, inside = groups(toss), np.empty(len(toss))
    for k in range(FOLDS):
        square, _, nu = squares(sizes(group != k))
        inside[group == k] = f_distribution.cdf(square / size, size, nu)[group == k]
    return np.exp(np.clip(sizes(group >= 0), *SIZES)), {
        p: 100 * np.mean(inside < p) for p in (0.5, 0.9, 0.95)
    }


HEAD = """# Laws on a tossed cube

Written by `python tests/validation/cube.py`. The data are measured: {one} impacts on one corner and {two} on two,
of {tosses} tosses of an acrylic cube (`ji.data.cube_impacts(nearly_clean=True)`). They are all impacts on one corner that
are clean, and all on two (the second one up to 2 mm above the first) that are clean or nearly so: the flights
before and after meet within 0.5 mm.

Every law is fitted to one and two corners together, by the same cost. The error of an impact is
`|v+ predicted - v+ measured| / |v-|` in the energy norm. *Held out*: the tosses are divided into {folds} groups;
each is predicted by a fit to the others. (15 pairs of tosses are copies, turned about the vertical; they stay
together.) Medians in percent, with 95 % intervals of a bootstrap over tosses; the last column is that of the fit to
all.

LZB, Newton and Moreau take a second corner up to 2 mm above the first as closed; `Compliant` (`Bistiffness`,
exponent 1.5, stiffness in N/m^1.5) and MuJoCo begin with the measured gap, which decides in each impact whether the
corners strike together. "e falls": by a power of the speed of approach (`VelocityDependent`). MuJoCo: soft spheres
at the corners, one `solref` (s, 1) and mu, steps of 0.05 ms, fitted by finite differences, the best of four starts.
Seven numbers: `solimp` (least and largest impedance, width in m) and torsional friction (m), too.

"""


TORSION = """## Torsion

A moment about the vertical that is free in each impact would explain {one:.1f} % of the squares that LZB leaves on
one corner, and {two:.1f} % on two. Of errors that prefer no direction it would explain a sixth, 17 %: the cube shows no
torsional friction.

"""


SCATTER = """## Scatter of e and mu

`Compliant, e falls` with an e and a mu that each impact draws anew, and the noise of the camera times a factor; all
together Student's t with nu degrees of freedom (few: some impacts are far off; above 30: normal). Share of the
impacts, held out, that lie in the region predicted for v+ [%].

Two corners have heavy tails: 16 of 105 impacts are off by more than 10 %. The four that are off by more than half of
|v-| have the second corner 1.4 to 1.8 mm above the first, where it may strike or not. No force beyond the corners is
needed: the best impulses at the corners leave 0.4 % of |v-| on two and 0.6 % on one (medians), so torsional and rolling
friction have little to explain, and on two corners what is left does not go with the error (correlation -.1).

"""


def page(
    all_impacts: Impacts, made: dict[str, Callable[[], Model]], print: Any = print
) -> str:
    """Text of the page."""
    two, toss = all_impacts.two, all_impacts.toss
    kinds = {"one corner": ~two, "two corners": two}
    draws = {kind: resampled(toss[chosen]) for kind, chosen in kinds.items()}
    text = HEAD.format(
        one=(~two).sum(), two=two.sum(), tosses=len(set(toss)), folds=FOLDS
    )
    rows = [
        "| law | numbers, fitted to all | one corner | two corners | two, fitted |",
        "|---" * 5 + "|",
    ]
    errors, scattered = {}, ""
    for name, make in made.items():
        model = make()
        whole = model.fitted(np.ones(len(two)), model.start)
        errors[name] = error = held_out(model, whole, toss)
        cells = [
            "{:.2f} ({:.2f} to {:.2f})".format(
                *median_and_interval(error[chosen], draws[kind])
            )
            for kind, chosen in kinds.items()
        ]
        numbers = ", ".join(f"{n} {v:.3g}" for n, v in zip(model.names, whole))
        fitted = np.median(model.errors(whole)[two])
        rows.append(f"| {name} | {numbers} | {' | '.join(cells)} | {fitted:.2f} |")
        print(rows[-1], flush=True)
        if name == "LZB":
            scattered += torsion_section(
                all_impacts, np.asarray(model.residual(whole)).reshape(-1, 6)
            )
        if name == "Compliant, e falls":
            scattered += scatter_section(all_impacts, model, whole)
            print(scattered)
    return "\n".join(
        [text + "\n".join(rows), "", differences(errors, kinds, draws), scattered]
    )


def differences(
    errors: dict[str, np.ndarray], kinds: dict[str, Any], draws: dict[str, Any]
) -> str:
    """Section: each law beside LZB."""
    rows = [
        "## Differences from LZB",
        "",
        "Of the medians held out, paired: the same tosses are drawn for both",
    ]
    rows[-1] += (
        " laws. An interval\nthat contains 0 does not show which law is better.\n"
    )
    rows += ["| law | one corner | two corners |", "|---" * 3 + "|"]
    for name, error in errors.items():
        if name != "LZB" and "LZB" in errors:
            cells = [
                "{:+.2f} ({:+.2f} to {:+.2f})".format(
                    *difference(errors["LZB"][chosen], error[chosen], draws[kind])
                )
                for kind, chosen in kinds.items()
            ]
            rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def torsion_section(all_impacts: Impacts, residual: np.ndarray) -> str:
    """Section: what a free moment about the normal would explain of residuals (K, 6) by energy."""
    up = Rotation.from_quat(np.roll(all_impacts.q[:, 3:], -1, axis=1)).as_matrix()[:, 2]
    moment = up / np.sqrt(
        np.array(BOX[2])
    )  # in the body's frame, as the angular velocity
    moment /= np.linalg.norm(moment, axis=1, keepdims=True)
    explained = np.sum(residual[:, 3:] * moment, axis=1) ** 2
    squares, two = np.sum(residual**2, axis=1), all_impacts.two
    shares = [100 * explained[kind].sum() / squares[kind].sum() for kind in (~two, two)]
    return TORSION.format(one=shares[0], two=shares[1])


def scatter_section(all_impacts: Impacts, model: Model, x: np.ndarray) -> str:
    """Section: the scatter of e and mu between impacts, and the regions that it predicts."""
    which = [model.names.index(name) for name in ("restitution", "friction")]
    residual = np.asarray(model.residual(x)).reshape(-1, 6)
    slopes = np.asarray(model.jacobian(x)).reshape(len(residual), 6, -1)[:, :, which]
    parts = (residual, slopes, all_impacts.noise, all_impacts.toss)
    rows = [
        "| corners | sd of e | sd of mu | noise | nu | in 50 % | in 90 % | in 95 % |",
        "|---" * 8 + "|",
    ]
    for kind, chosen in (("one", ~all_impacts.two), ("two", all_impacts.two)):
        sizes, inside = scatter_of(*(part[chosen] for part in parts))
        cells = [
            kind,
            *(f"{s:.3f}" for s in sizes),
            *(f"{p:.1f}" for p in inside.values()),
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return SCATTER + "\n".join(rows) + "\n"


def main(names: list[str]) -> None:
    """Write the page, or print the table of some laws."""
    all_impacts = impacts()
    made = models(all_impacts)
    try:
        from cube_mujoco import of_mujoco

        for name, numbers in (("MuJoCo", 3), ("MuJoCo, seven numbers", 7)):
            made[name] = partial(
                of_mujoco, all_impacts, heights(all_impacts.q), numbers
            )
    except ImportError:
        print("MuJoCo is not installed: its row is left out.")
    text = page(all_impacts, {name: made[name] for name in names or made})
    if names:
        print(text)
    else:
        PAGE.write_text(f"{text}\n{written()}", encoding="utf-8")
        print(f"written: {PAGE}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1:])
