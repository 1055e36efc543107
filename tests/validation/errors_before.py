"""Fits with errors of v-: bias, coverage and chi^2 of simulated sets. `errors_before.py [SETS]`.

For each scene, number of shots and size of the errors it prints, over SETS sets (400 by default):
the mean of the fitted value less the truth, over its standard error (below 3 if there is no bias);
the share of 95 % intervals that hold the truth; and chi^2 per degree of freedom.
"""

import sys
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

import jimpact as ji

SIZES = (0.02, 0.05, 0.1, 0.2)  # sigma of every velocity over a typical one
SHOTS = (5, 40, 200)
TYPICAL = 1.0  # m/s


class Setting(NamedTuple):
    """A law with its true and its start values, a scene, and random v- of K shots."""

    name: str
    truth: ji.Law
    start: ji.Law
    scene: ji.Scene
    free: dict
    values: dict[str, float]
    before: Callable[[np.random.Generator, int], np.ndarray]
    uncertain: tuple[
        float, ...
    ]  # 1 of velocities before that have errors, 0 of exact ones


def wall(rng: np.random.Generator, shots: int) -> np.ndarray:
    """Approach to a wall on the left at .5 to 1.5 m/s."""
    return -TYPICAL * rng.uniform(0.5, 1.5, (shots, 1))


def at_rest(rng: np.random.Generator, shots: int) -> np.ndarray:
    """The first of three balls at .5 to 1.5 m/s, the others at rest, exactly."""
    speed = TYPICAL * rng.uniform(0.5, 1.5, shots)
    return np.stack([speed, 0 * speed, 0 * speed], axis=1)


def three(rng: np.random.Generator, shots: int) -> np.ndarray:
    """Three balls of which both pairs approach, at .5 to 1.5 m/s each."""
    first, second = TYPICAL * rng.uniform(0.5, 1.5, (2, shots))
    return np.stack([first, 0 * first, -second], axis=1)


def oblique(rng: np.random.Generator, shots: int) -> np.ndarray:
    """(x', y', R spin) of a sphere on a floor: it falls at .5 to 1.5 m/s and slips at 2 to 3."""
    fall = -TYPICAL * rng.uniform(0.5, 1.5, shots)
    along = TYPICAL * rng.uniform(2.0, 3.0, shots)
    spin = TYPICAL * rng.uniform(-0.3, 0.3, shots)
    return np.stack([along, fall, spin], axis=1)


FLOOR = ji.Scene([1.0, 1.0, 0.4], [[0.0], [1.0], [0.0]], tangents=[[1.0], [0.0], [1.0]])
SETTINGS = (
    Setting(
        name="ball on a wall",
        truth=ji.Newton(0.8),
        start=ji.Newton(0.6),
        scene=ji.chain([1.0], "left"),
        free={"restitution": True},
        values={"restitution": 0.8},
        before=wall,
        uncertain=(1.0,),
    ),
    Setting(
        name="three balls",
        truth=ji.LZB([0.9, 0.9], [1.0, 2.0]),
        start=ji.LZB([0.85, 0.85], [1.0, 1.5]),
        scene=ji.chain([1.0, 1.0, 1.0]),
        free={"restitution": [1, 1], "stiffness": [0, 1]},
        values={"restitution": 0.9, "stiffness[2]": 2.0},
        before=three,
        uncertain=(1.0, 1.0, 1.0),
    ),
    Setting(
        name="three balls, two at rest",
        truth=ji.LZB([0.9, 0.9], [1.0, 2.0]),
        start=ji.LZB([0.85, 0.85], [1.0, 1.5]),
        scene=ji.chain([1.0, 1.0, 1.0]),
        free={"restitution": [1, 1], "stiffness": [0, 1]},
        values={"restitution": 0.9, "stiffness[2]": 2.0},
        before=at_rest,
        uncertain=(1.0, 0.0, 0.0),
    ),
    Setting(
        name="sphere that slips",
        truth=ji.Poisson(0.8, friction=0.2),
        start=ji.Poisson(0.7, friction=0.25),
        scene=FLOOR,
        free={"restitution": True, "friction": True},
        values={"restitution": 0.8, "friction": 0.2},
        before=oblique,
        uncertain=(1.0, 1.0, 1.0),
    ),
)


def simulated(
    setting: Setting, shots: int, size: float, sets: int, rng: np.random.Generator
) -> list[ji.Experiments]:
    """Sets of shots with normally distributed errors of all velocities, before and after."""
    after_all = jax.jit(
        jax.vmap(lambda v: ji.impact(setting.truth, setting.scene, v).velocity)
    )
    sigma = size * TYPICAL
    data = []
    for _ in range(sets):
        before = setting.before(rng, shots)
        after = np.asarray(after_all(before))
        sigma_pre = sigma * np.tile(setting.uncertain, (shots, 1))
        before_measured = before + sigma_pre * rng.normal(size=before.shape)
        after_measured = after + sigma * rng.normal(size=after.shape)
        shot = ji.Experiments(
            before_measured, after_measured, sigma=sigma, sigma_pre=sigma_pre
        )
        data.append(shot)
    return data


def row(setting: Setting, shots: int, size: float, sets: int) -> list[float]:
    """Biases over their errors, coverages, and chi^2 per degree of freedom with its error."""
    rng = np.random.default_rng(int(1000 * size) + shots)
    data = simulated(setting, shots, size, sets, rng)
    fits = list(ji.fit_many(setting.start, setting.scene, data, setting.free))
    numbers = []
    for name, true in setting.values.items():
        i = fits[0].names.index(next(n for n in fits[0].names if n.startswith(name)))
        value = np.array([fit.value[i] for fit in fits])
        ends = np.array([fit.confidence_interval()[i] for fit in fits])
        inside = np.mean((ends[:, 0] <= true) & (true <= ends[:, 1]))
        error = value.std(ddof=1)
        numbers += [
            (value.mean() - true) / (error / np.sqrt(sets)),
            (value.mean() - true) / error,
        ]
        numbers.append(inside)
    squares = np.array([fit.chi_squared for fit in fits])
    freedom = fits[0].degrees_of_freedom
    ratio = squares.mean() / freedom
    return [*numbers, ratio, (ratio - 1) / np.sqrt(2 / (freedom * sets))]


def main(sets: int) -> None:
    """Print the table."""
    print(
        "scene, shots, sigma / v: for each parameter bias over its error, over the scatter of one"
    )
    print(
        "fit, coverage; then chi^2 per degree of freedom, and its distance from 1 in errors"
    )
    for setting in SETTINGS:
        print(f"{setting.name}: {', '.join(setting.values)}")
        for shots in SHOTS:
            for size in SIZES:
                numbers = " ".join(f"{x:7.3f}" for x in row(setting, shots, size, sets))
                print(f"{shots:5d} {size:5.2f}  {numbers}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
