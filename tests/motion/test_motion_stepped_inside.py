"""Worked motions by time stepping: blocks that overturn, bricks and cubes in space."""

import csv
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.bodies.rigid import rotation

pytestmark = pytest.mark.release  # they compile programs of their own

CUBE = Path(__file__).parents[1] / "held" / "cube_pairs.csv"


@pytest.mark.release
def test_a_free_brick_keeps_its_momentum():
    """Far from the plane: a ball falls, and the angular momentum in space stays; order 2."""
    brick, spin = ji.Box([0.1, 0.06, 0.04]), jnp.array([3.0, 12.0, 5.0])
    inertia = np.asarray(brick.mass)[3:]
    wrong = []
    for step in (2e-3, 1e-3):
        motion = ji.simulate(
            ji.System(brick), ji.Moreau(0.3, friction=0.4), brick.at([0.0, 0.0, 1.0]),
            jnp.concatenate([jnp.zeros(3), spin]), 1.0,
            samples=2, method="time_stepping", step=step,
        )  # fmt: skip
        turned = np.asarray(rotation(motion.q[-1][3:])) @ (
            inertia * np.asarray(motion.velocity[-1, 3:])
        )
        wrong.append(np.abs(turned / (inertia * np.asarray(spin)) - 1).max())
    assert wrong[1] < 1e-4
    assert 3.5 < wrong[0] / wrong[1] < 4.5


@pytest.mark.release
def test_a_tossed_cube_makes_its_second_impact_where_it_was_measured():
    """From the measured state at one impact to the next; e and mu are medians over all tosses."""
    rows = list(csv.DictReader(CUBE.open()))

    def numbers(row, name, axes, tail):
        return np.array([float(row[f"{name}_{x}{tail}"]) for x in axes])

    def velocities(row):
        return numbers(row, "v", "xyz", "_pre_m_s"), numbers(
            row, "omega", "xyz", "_pre_rad_s"
        )

    cube = ji.Box(
        [0.102] * 3, mass=0.37, inertia=[9.57e-4, 9.57e-4, 9.09e-4], centre=[0, 0, 0.0057],
        rounding=0.0036,
    )  # fmt: skip
    system, law = ji.System(cube, gravity=9.604), ji.Moreau(0.27, friction=0.16)
    misses = []
    for first, second in zip(rows[::2], rows[1::2], strict=True):
        e, (v, spin), (v2, spin2) = (
            numbers(first, "quat", "wxyz", ""), velocities(first), velocities(second)
        )  # fmt: skip
        x = numbers(first, "com", "xyz", "_m")
        q0 = jnp.asarray(np.concatenate([x, e / np.linalg.norm(e)]))
        q0 = q0.at[2].add(-jnp.min(cube.gap_function(q0)))
        motion = ji.simulate(
            system, law, q0, np.concatenate([v, np.asarray(rotation(q0[3:])).T @ spin]), 0.25,
            samples=2, method="time_stepping", step=1e-4,
        )  # fmt: skip
        events, wait = motion.events, float(second["t_s"]) - float(first["t_s"])
        times = np.asarray(events.time)[: int(events.count)]
        k = int(np.argmax(times > 0.5 * wait))
        found = np.asarray(events.velocity_before[k])
        turned = np.asarray(rotation(events.q[k][3:])) @ found[3:]
        misses.append(
            [
                abs(times[k] - wait) / wait,
                np.linalg.norm(found[:3] - v2) / np.linalg.norm(v2),
                np.linalg.norm(turned - spin2) / np.linalg.norm(spin2),
            ]
        )
    assert (np.median(misses, axis=0) < [0.1, 0.1, 0.2]).all(), np.median(
        misses, axis=0
    )
