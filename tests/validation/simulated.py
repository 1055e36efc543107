"""Coverage and false alarms of fits: intervals, false alarms, power. Writes `docs/coverage.md`.

`python tests/validation/simulated.py 500` simulates 500 data sets for each row.
"""

import sys
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from when_written import written

import jimpact as ji
from jimpact.fits.solve import Solver, minimize

PAGE = Path(__file__).parents[2] / "docs" / "coverage.md"
PAIR, BALLS = ji.chain([1.0, 2.0]), ji.chain([1.0, 1.0, 1.0])
UNEQUAL, WALLED = ji.chain([1.0, 2.0, 1.5]), ji.chain([1.0, 2.0], wall=True)
NOISE = 0.01  # of velocities of about 1 m/s


@dataclass(frozen=True)
class Row:
    """Data that `truth` made, `spoiled` perhaps, fitted by `law`."""

    what: str
    truth: Any
    law: Any
    scene: Any = PAIR
    shots: int = 6
    free: Any = "restitution"
    sigma: bool = False
    repeated: bool = False  # all shots begin alike
    noise: float = NOISE
    spoiled: Callable[[np.ndarray], np.ndarray] = lambda post: post
    swapped: bool = False
    loss: str = "squares"
    prior: float = (
        0.0  # standard deviation of what is known of the first parameter; 0: nothing
    )
    off: float = 0.0  # how many of these that knowledge is wrong by
    ends: bool = False  # every other shot comes from the other end
    expected: str = ""  # the warning that should come

    def data(self, count):
        """So many data sets."""
        rng, n = np.random.default_rng(zlib.crc32(self.what.encode())), self.scene.size
        impact = jax.jit(
            jax.vmap(lambda v: ji.impact(self.truth, self.scene, v).velocity)
        )
        pre = rng.uniform(-0.3, 0.3, (count, self.shots, n))
        pre[..., 0] = rng.uniform(0.5, 1.5, (count, self.shots))
        if self.scene is not WALLED:
            pre[..., -1] = rng.uniform(-1.0, 0.0, (count, self.shots))
        if self.repeated:
            pre[:] = np.eye(n)[0]
        if self.ends:
            pre[:, 1::2] = -pre[:, 1::2, ::-1]
        exact = np.asarray(impact(pre.reshape(-1, n))).reshape(pre.shape)
        post = exact + self.noise * rng.normal(size=exact.shape)
        pairs = [(a, self.spoiled(b)) for a, b in zip(pre, post)]
        pairs = [(b, a) for a, b in pairs] if self.swapped else pairs
        return [
            ji.Experiments(a, b, self.noise if self.sigma else None) for a, b in pairs
        ]


def misread(post):
    """The fourth shot loses 0.3 m/s in one ball; momentum is conserved."""
    post = post.copy()
    post[3, 0] -= 0.3
    post[3, -1] += 0.3
    return post


def misread_three(post):
    """Three shots lose 0.25 to 0.5 m/s in one ball of `PAIR`; momentum is conserved."""
    post = post.copy()
    post[[2, 5, 9]] += np.outer([0.25, -0.35, 0.5], [1.0, -0.5])
    return post


N, P, M, L = ji.Newton, ji.Poisson, ji.Moreau, ji.LZB
BOTH = ("restitution", "stiffness")
HONEST = (
    Row("Newton, 2 balls, e = .8", N(0.8), N(0.9)),
    Row("Newton, e = .995, sigma", N(0.995), N(0.9), sigma=True),
    Row("Newton, 3 balls, 12 shots", N([0.8, 0.6]), N([0.9, 0.9]), UNEQUAL, 12),
    Row("Newton, e = .99 and .99", N([0.99, 0.99]), N([0.9, 0.9]), UNEQUAL, 12),
    Row("Moreau, wall, 12 shots", M([0.8, 0.6]), M([0.9, 0.9]), WALLED, 12),
    Row("Poisson, 12 shots, sigma", P([0.8, 0.6]), P([0.9, 0.9]), UNEQUAL, 12, sigma=True),
    Row("Newton, 10 repeats", N(0.8), N(0.9), UNEQUAL, 10, repeated=True),
    Row("Newton, from both ends, 8 shots", N(0.9), N(0.8), BALLS, 8, repeated=True, ends=True),
    Row(
        "Newton, 10 repeats read to .01",
        N(0.8), N(0.9), UNEQUAL, 10, noise=0.004, repeated=True, spoiled=lambda v: v.round(2),
    ),
    Row("Newton, e1, e2, prior of e1", N([0.8, 0.6]), N([0.9, 0.9]), UNEQUAL, 6, sigma=True, prior=0.01),
    Row("Newton, 12 shots, huber", N(0.8), N(0.9), PAIR, 12, loss="huber"),
    Row("LZB, e = .9", L(0.9), L(0.8), BALLS),
    Row("LZB, e = .995, sigma", L(0.995), L(0.8), BALLS, sigma=True),
    Row(
        "LZB, e1, e2, k2/k1, 12 shots, sigma",
        L([0.9, 0.7], [1.0, 2.0]), L([0.85, 0.75], [1.0, 1.5]), BALLS, 12, BOTH, sigma=True,
    ),
)  # fmt: skip
SPOILED = (
    Row("one e for .9 and .5", N([0.9, 0.5]), N(0.9), UNEQUAL, 12, expected="Lack of fit"),
    Row("the same with a wall", N([0.9, 0.5]), N(0.9), WALLED, 12, expected="Lack of fit"),
    Row(
        "the same, sigma",
        N([0.9, 0.5]), N(0.9), UNEQUAL, 12, sigma=True, expected="Lack of fit",
    ),
    Row(
        "Newton data by LZB, sigma",
        N([0.9, 0.5]), L([0.8, 0.8], [1.0, 1.0]), BALLS, 12, BOTH, True, expected="Lack of fit",
    ),
    Row(
        "one shot of 24 misread by .3 m/s",
        N([0.8, 0.6]), N([0.9, 0.9]), UNEQUAL, 24, spoiled=misread, expected="Suspicious",
    ),
    Row(
        "a prior of e1 that is wrong by 5 of its standard deviations",
        N([0.8, 0.6]), N([0.9, 0.9]), UNEQUAL, 6, sigma=True, prior=0.01, off=5.0,
        expected="The data contradict the prior",
    ),
    Row(
        "three shots of 12 misread by .25 to .5 m/s, huber",
        N(0.8), N(0.9), shots=12, loss="huber", spoiled=misread_three, expected="Suspicious",
    ),
    Row(
        "the last ball read 5 % too fast",
        N([0.8, 0.6]), N([0.9, 0.9]), UNEQUAL, 12, spoiled=lambda v: v * [1.0, 1.0, 1.05],
        expected="The data violate conservation of momentum",
    ),
    Row(
        "5 % lost, from both ends",
        N(0.9), N(0.8), BALLS, 8, repeated=True, ends=True, spoiled=lambda v: 0.95 * v,
        expected="The data violate conservation of momentum",
    ),
    Row(
        "two shots in cm/s",
        N(0.9), N(0.8), shots=2, spoiled=lambda v: 100 * v,
        expected="The data violate conservation of momentum",
    ),
    Row(
        "all velocities 10 % too large, e = .99",
        N([0.99, 0.99]), N([0.9, 0.9]), WALLED, 12, spoiled=lambda v: 1.1 * v,
        expected="The data gain energy",
    ),
    Row("before and after swapped", N(0.8), N(0.9), swapped=True, expected="No contact approaches"),
)  # fmt: skip
# starts of warnings that may be false alarms
ALARMS = (
    "Lack of fit",
    "Suspicious",
    "The data contradict the prior",
    "The data violate conservation of momentum",
    "The data gain energy",
    "No contact approaches",
    "The fit has not converged",
    "Left out",
)


def alarms(fits):
    """Share of the fits in which each warning comes."""
    found = Counter(
        alarm
        for fit in fits
        for alarm in ALARMS
        if any(line.startswith(alarm) for line in fit.warnings)
    )
    return {alarm: found[alarm] / len(fits) for alarm in ALARMS}


def truth_of(row, names):
    """True values of the parameters."""
    parameters = {
        "restitution": row.truth.restitution,
        "stiffness": getattr(row.truth, "stiffness", 1),
    }
    found = []
    for name in names:
        whole, _, index = name.rstrip("]").partition("[")
        value = np.asarray(parameters[whole], float)
        found.append(float(value[int(index) - 1] if index and value.ndim else value))
    return np.array(found)


def covered(row, fits):
    """Shares (P,) of linearized intervals and of profiles that hold the truth.

    A profile holds it if the deviance there is below the limit: one more fit, with it held.
    """
    truth = truth_of(row, fits[0].names)
    linear = np.array(
        [
            [any(a <= x <= b for a, b in p) for x, p in zip(truth, f.intervals())]
            for f in fits
        ]
    )
    if row.loss != "squares":  # has no profiles
        return linear.mean(axis=0), []
    problems, inside = [f.problem for f in fits], []
    best = np.array([f.problem.variables.point(f.value) for f in fits])
    for i in range(len(truth)):
        y = best.copy()
        y[:, i] = [f.problem.variables.point(truth)[i] for f in fits]
        fixed = np.broadcast_to(np.arange(y.shape[1]) == i, y.shape)
        squares = minimize(
            [p.least_squares() for p in problems], y, Solver(), fixed=fixed
        ).squares
        more = squares - [f.starts[0].sum_of_squares for f in fits]
        inside.append(more <= [(f.quantile(0.95) * f.noise) ** 2 for f in fits])
    return linear.mean(axis=0), np.mean(inside, axis=1)


def with_priors(row, count):
    """Fits with a prior each, whose mean is the true value with an error, perhaps a wrong one."""
    rng, fits = np.random.default_rng(zlib.crc32(row.what.encode()) + 1), []
    for data in row.data(count):
        start = ji.FitProblem.from_shots(row.law, row.scene, data, row.free)
        mean = truth_of(row, start.names[:1])[0] + row.prior * (rng.normal() + row.off)
        known = {start.names[0]: (mean, row.prior)}
        options = {"starts": 1, "profiles": False}
        fits.append(ji.fit(row.law, row.scene, data, row.free, priors=known, **options))
    return fits


def fitted(row, count):
    """Fits of so many data sets."""
    if row.prior:
        return with_priors(row, count)
    if row.loss != "squares":
        options = {"search": ji.Search(loss=row.loss), "starts": 1, "profiles": False}
        return [
            ji.fit(row.law, row.scene, data, row.free, **options)
            for data in row.data(count)
        ]
    return ji.fit_many(row.law, row.scene, row.data(count), row.free)


def percent(shares):
    return ", ".join(f"{100 * x:.1f}" for x in np.ravel(shares))


def preimages(gamma, count, sigma=1e-3):
    """Share of one-shot fits of the stiffness ratio whose pieces hold the truth; pieces, a fit."""
    law, start = L([1.0, 1.0], [1.0, gamma]), L([1.0, 1.0], [1.0, 1.0])
    exact = np.asarray(ji.impact(law, BALLS, jnp.eye(3)[0]).velocity)
    rng, inside, pieces = np.random.default_rng(0), 0, 0
    for _ in range(count):
        data = ji.Experiments(np.eye(3)[0], exact + sigma * rng.normal(size=3), sigma)
        (found,) = ji.fit(start, BALLS, data, {"stiffness": [False, True]}).intervals()
        inside += any(a <= gamma <= b for a, b in found)
        pieces += len(found)
    return inside / count, pieces / count


def page(count, honest=HONEST, spoiled=SPOILED, ratios=(8.0, 40.0), print=print):
    """Text of the page, with so many data sets a row."""
    first = ["| simulated | intervals | profiles |", "|---|---|---|"]
    second = [f"| simulated | {' | '.join(ALARMS)} |", "|---" * (len(ALARMS) + 1) + "|"]
    for row in honest:
        fits = fitted(row, count)
        linear, profiled = covered(row, fits)
        first.append(f"| {row.what} | {percent(linear)} | {percent(profiled)} |")
        second.append(
            f"| {row.what} | {' | '.join(percent(x) for x in alarms(fits).values())} |"
        )
        print(first[-1], second[-1])
    third = ["| simulated | warning | how often |", "|---|---|---|"]
    for row in spoiled:
        share = alarms(fitted(row, count))[row.expected]
        third.append(f"| {row.what} | {row.expected} | {percent(share)} |")
        print(third[-1])
    fourth = ["| k2/k1 | contained | pieces, on average |", "|---|---|---|"]
    few = -(-count // 5)
    for gamma in ratios:
        share, pieces = preimages(gamma, few)
        fourth.append(f"| {gamma:g} | {percent(share)} | {pieces:.1f} |")
        print(fourth[-1])
    return TEXT.format(
        count=count,
        few=few,
        **{
            name: "\n".join(t)
            for name, t in zip(
                ("first", "second", "third", "fourth"), (first, second, third, fourth)
            )
        },
    )


TEXT = """# Coverage and false alarms of fits

Written by `python tests/validation/simulated.py {count}`: {count} simulated data sets for each row, of 6 shots unless
stated otherwise, with noise of 0.01 m/s on velocities of about 1 m/s. All numbers are percentages.

## Intervals

The share of 95 % intervals that contain the true value, for each parameter: intervals of `Fit.intervals()`
without profiles, and of `ji.profile` (the deviance of the true value, with all others free, is below the
limit).

{first}

One shot of three equal elastic balls, sigma = 0.001 m/s: several stiffness ratios give the same
velocities. The share of {few} unions of intervals that contain the true one:

{fourth}

## False alarms

The data come from the fitted law, so each warning is a false alarm:

{second}

## Power

{third}
"""


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    PAGE.write_text(f"{page(int(sys.argv[1]))}\n{written()}", encoding="utf-8")
    print(f"written: {PAGE}")
