"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import numpy as np
import pytest
from refusals import refused

import jimpact as ji

TRIANGLE = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
PENTAGRAM = [[np.cos(a), np.sin(a)] for a in 0.8 * np.pi * np.arange(5)]

REFUSED = [
    (lambda: ji.Block(-1.0, 1.0, corners="base").scene(), r"`width`"),
    (lambda: ji.Block(1.0, 0.0, corners="base").scene(), r"`height`"),
    (lambda: ji.Block(1.0, 1.0, np.nan, corners="base").scene(), r"`mass`"),
    (lambda: ji.Block(1.0, 1.0, inertia=-0.1, corners="base").scene(), r"`inertia`"),
    (lambda: ji.Block(1.0, 1.0).touching(np.inf), r"`turn`"),
    (lambda: ji.Block([1.0, 2.0], 1.0, corners="base").scene(), r"`width`.*one number"),
    (
        lambda: ji.Block(1.0, 1.0, corners="three"),
        r"`corners` must be one of all, base",
    ),
    (lambda: ji.Polygon([[0, 0], [1, 0]]), r"`corners` must have shape \(k, 2\)"),
    (
        lambda: ji.Polygon([[0, 0], [1, 0], [0.1, 0.1], [0, 1]]),
        r"convex polygon.*corner 2",
    ),
    (lambda: ji.Polygon([[0, 0], [1, 0], [2, 0], [0, 1]]), r"convex polygon.*corner 1"),
    (lambda: ji.Polygon([[0, 0], [0, 0], [1, 0], [0, 1]]), r"convex polygon"),
    (lambda: ji.Polygon(PENTAGRAM), r"more than once"),
    (lambda: ji.Polygon(TRIANGLE, mass=0.0), r"`mass`"),
    (
        lambda: ji.Polygon(TRIANGLE, centre=[0.2, 0.2]),
        r"`inertia` must be given with `centre`",
    ),
    (
        lambda: ji.Polygon(TRIANGLE, inertia=1.0, centre=[1, 1]),
        r"`centre` must lie inside",
    ),
    (lambda: ji.Disc(0.0), r"`radius`"),
    (lambda: ji.Disc(1.0, inertia=1.0, centre=[1.0, 0.1]), r"`centre`"),
    (
        lambda: ji.Disc(0.1, inertia=1.0, centre=[0.2, 0.0]),
        r"`centre` must be at most 0\.1 m",
    ),
    (lambda: ji.Bodies(ji.Disc(1.0)), r"`bodies` must be a list of bodies"),
    (lambda: ji.Bodies([ji.Disc(1.0)], planes=0.3), r"`planes` must be a list"),
    (lambda: ji.Bodies([ji.Disc(1.0)] * 2, pairs=[(0, 0.5)]), r"bodies 0 to 1"),
    (lambda: ji.Bodies([ji.Disc(1.0)]).touching(plane=3), r"`plane` must be one of 0"),
    (
        lambda: ji.Bodies([ji.Disc(1.0)]).at([0.0, 1.0]),
        r"`positions` must have shape \(1, 2\)",
    ),
    (
        lambda: ji.Bodies(
            [ji.Sphere(1.0)], fixed=[ji.Sphere(1.0)], places=[np.full(7, 2.0)]
        ),
        r"`quaternion` must have length 1",
    ),
    (
        lambda: ji.Bodies([ji.Coin(0.1, 0.02)]),
        r"a Coin with round rims: give it `corners`",
    ),
    (
        lambda: ji.Block(1.0, 1.0).at([0.0, 1.0, 0.0]),
        r"`position` must have shape \(2,\)",
    ),
    (
        lambda: ji.Bodies([ji.Column([1.0])]),
        r"`bodies` must hold bodies with contact points",
    ),
    (lambda: ji.Bodies([ji.Disc(1.0)], []), r"must give a contact"),
    (lambda: ji.Bodies([ji.Disc(1.0)], [np.nan]), r"`planes`"),
    (lambda: ji.Bodies([ji.Disc(1.0)], pairs=[(0, 1)]), r"bodies 0 to 0"),
    (lambda: ji.Bodies([ji.Disc(1.0)] * 2, pairs=[(1, 1)]), r"different bodies"),
    (
        lambda: ji.Bodies([ji.Disc(1.0), ji.Dimer(0.1, 1.0)], pairs=[(0, 1)]),
        r"body 1 is a Dimer",
    ),
    (
        lambda: ji.Bodies([ji.Block(1, 1)] * 2, pairs=[((0, 2), (1, 0))]),
        r"bodies 0 to 1",
    ),
    (lambda: ji.Box([1.0, 1.0, 0.0]), r"`sizes`"),
    (lambda: ji.Box([1.0, 1.0]), r"`sizes` must have shape \(3,\)"),
    (lambda: ji.Box([1.0, 1.0, 1.0], mass=0.0), r"`mass`"),
    (lambda: ji.Box([1.0, 1.0, 1.0], rounding=0.6), r"`rounding`"),
    (
        lambda: ji.Box([1.0, 1.0, 1.0], inertia=[1.0, 1.0, 2.5]),
        r"`inertia`.*sum of the others",
    ),
    (lambda: ji.Box([1.0, 1.0, 1.0], inertia=[1.0, 1.0, -1.0]), r"`inertia`"),
    (lambda: ji.Box([1.0, 1.0, 1.0], inertia=1.0), r"`inertia` must have shape"),
    (
        lambda: ji.Box([1.0, 1.0, 1.0], inertia=np.ones(3), centre=[0, 0, 0.6]),
        r"`centre`",
    ),
    (lambda: ji.Box([1.0, 1.0, 1.0], centre=[0, 0, 0.1]), r"`inertia` must be given"),
    (lambda: ji.Box([1.0, 1.0, 1.0], normal=[1.0, 0, 0]), r"`normal` must point up"),
    (lambda: ji.Sphere(-1.0), r"`radius`"),
    (
        lambda: ji.Sphere(1.0).touching([1.0, 1.0, 0, 0]),
        r"`turn` must have length 1",
    ),
    (lambda: ji.Sphere(1.0).scene([0, 0, 1.0, 1, 0, 0]), r"`q` must have shape \(7,\)"),
    (lambda: ji.Dimer(-0.1, 1.0).scene(), r"`radius`"),
    (lambda: ji.Dimer(0.1, -1.0).scene(), r"`length`"),
    (lambda: ji.Dimer(0.0, 0.0).scene(), r"`length`"),
    (lambda: ji.Dimer(0.1, 1.0, rod_mass=-1.0).scene(), r"`rod_mass`"),
    (lambda: ji.SpatialDimer(0.0, 1.0).scene(), r"`radius`"),
    (lambda: ji.SpatialDimer(0.1, 1.0).touching([1.0, 1.0, 0.0, 0.0]), r"`turn`"),
    (lambda: ji.Corner(np.pi).scene(), r"`angle`"),
    (lambda: ji.Corner(-0.1).scene(), r"`angle`"),
    (lambda: ji.Bodies([]), "`bodies` must hold one or more"),
    (lambda: ji.PendulumCradle([1.0], 1.0, 0.1).scene(), r"two balls"),
    (lambda: ji.PendulumCradle([1.0, 1.0], -1.0, 0.1).scene(), r"`length`"),
    (lambda: ji.PendulumCradle([1.0, 1.0], 1.0, [0.1] * 3).scene(), r"`radius`"),
    (lambda: ji.PendulumCradle([1.0, 1.0], 1.0, 0.1, [0.1, 0.1]).scene(), r"`gaps`"),
    (lambda: ji.PendulumCradle([1.0, 1.0], 1.0, 0.1).scene([0.0] * 3), r"`q`"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)
