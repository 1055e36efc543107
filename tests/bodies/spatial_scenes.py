"""Rigid bodies that meet the ground in space, in NumPy: the five of the tables, and random ones.

A body has the velocity of its centre of mass and its angular velocity, both in the axes of the
ground (z up); contact i lies at `arms[i]` from the centre of mass.
"""

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np

CUBE_CSV = Path(__file__).parents[1] / "held" / "cube_impacts.csv"
CUBE_MASS, CUBE_INERTIA = 0.37, (9.57e-4, 9.57e-4, 9.09e-4)  # kg, kg m^2
CUBE_HALF, CUBE_CENTRE, CUBE_LOW = 0.0474, 0.0057, 0.0036  # m
CUBE_MU = (0.16, 0.3, 0.6)
# arrays of held/friction_space.npz: the arguments of an impact
INPUTS = (
    "mass",
    "normals",
    "tangents",
    "velocity",
    "restitution",
    "friction",
    "stiffness",
)
CORNERS = np.array(
    [[i, j, k] for i in (-1.0, 1.0) for j in (-1.0, 1.0) for k in (-1.0, 1.0)]
)


class Pressed(NamedTuple):
    """A body against the ground: mass matrix (n, n), normals (n, m), tangents (n, 2 m), v- (n,)."""

    mass: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray
    velocity: np.ndarray


def cross_matrix(r):
    """(3, 3): `cross_matrix(r) @ a` is r x a."""
    x, y, z = r
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def turned(axis, angle):
    """Rotation matrix by `angle` [rad] about an axis (3,)."""
    x = cross_matrix(np.asarray(axis, float) / np.linalg.norm(axis))
    return np.eye(3) + np.sin(angle) * x + (1 - np.cos(angle)) * x @ x


def point_rows(arms):
    """Velocities (m, 3, 6) of points at `arms` (m, 3) from those of the body."""
    return np.array([np.hstack([np.eye(3), -cross_matrix(arm)]) for arm in arms])


def body(mass, inertia, arms, velocity):
    """A free body with moments of inertia (3, 3) in the axes of the ground."""
    whole = np.zeros((6, 6))
    whole[:3, :3], whole[3:, 3:] = mass * np.eye(3), inertia
    rows = point_rows(arms)
    normals, tangents = rows[:, 2].T, rows[:, :2].reshape(-1, 6).T
    return Pressed(whole, normals, tangents, np.asarray(velocity, float))


def box(sizes, turn, contacts, velocity, mass=1.0):
    """A homogeneous box, turned by a matrix, on its `contacts` lowest corners."""
    square = np.square(sizes)
    inertia = turn @ np.diag(mass / 12 * (square.sum() - square)) @ turn.T
    corners = (CORNERS * sizes / 2) @ turn.T
    lowest = np.sort(np.argsort(corners[:, 2], kind="stable")[:contacts])
    return body(mass, inertia, corners[lowest], velocity)


# ------------------------------------------------------------------------------ the five

SIZES = (0.6, 0.4, 0.3)  # m
FALLING = (1.0, 0.3, -1.0, 0.5, -0.4, 0.2)  # m/s, rad/s
TIPPED = turned((1, 0, 0), 0.6)
LEGS = [[x, y, -0.2] for x in (-0.3, -0.1, 0.1, 0.3) for y in (-0.2, 0.2)]
COORDINATES = 27


def many_coordinates():
    """Two feet of four corners each at the ends of a body of 27 coordinates, seed 0."""
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(COORDINATES, COORDINATES)) / np.sqrt(COORDINATES)
    mass = np.eye(COORDINATES) + spread @ spread.T
    sole = [[x, y, -0.05] for x in (-0.1, 0.1) for y in (-0.05, 0.05)]
    joints = rng.normal(size=(2, 6, COORDINATES - 6)) / np.sqrt(6)
    feet = []
    for side, free in zip((-0.15, 0.15), joints):
        place = np.eye(6)
        place[:3, 3:] = -cross_matrix([0.0, side, -0.8])
        feet.append(point_rows(sole) @ np.hstack([place, free]))
    rows = np.concatenate(feet)
    velocity = np.zeros(COORDINATES)
    velocity[:6] = 0.3, 0.1, -1.0, 0.05, -0.1, 0.02
    return Pressed(mass, rows[:, 2].T, rows[:, :2].reshape(-1, COORDINATES).T, velocity)


NAMED = {  # what the tables of speed show; contacts: 1, 2, 4, 8, 8
    "corner": lambda: box(SIZES, turned((1, 0.6, 0), 0.7), 1, FALLING),
    "edge": lambda: box(SIZES, TIPPED, 2, FALLING),
    "flat": lambda: box(SIZES, np.eye(3), 4, FALLING),
    "legs": lambda: body(1.0, np.diag([0.03, 0.05, 0.07]), LEGS, FALLING),
    "27 coordinates": many_coordinates,
}


# -------------------------------------------------------------------------- random ones

KINDS = ("corner", "edge", "flat", "nearly flat")
CONTACTS = {"corner": 1, "edge": 2, "flat": 4, "nearly flat": 4}
MOST_MU = 1.5


class Draw(NamedTuple):
    """Impacts of bodies with equally many contacts: arrays with a leading axis."""

    mass: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray
    velocity: np.ndarray
    restitution: np.ndarray
    friction: np.ndarray


def random_turn(kind, rng):
    """A rotation that lays a box on a corner, an edge, a side, or nearly on a side."""
    about = turned((0, 0, 1), rng.uniform(0, 2 * np.pi))
    if kind == "corner":
        q, r = np.linalg.qr(rng.normal(size=(3, 3)))
        q = q * np.sign(np.diag(r))
        return q * np.sign(np.linalg.det(q))
    if kind == "edge":
        return about @ turned((1, 0, 0), rng.uniform(0.05, 1.5))
    tilt = 10 ** rng.uniform(-4, -1) if kind == "nearly flat" else 0.0
    way = rng.uniform(0, 2 * np.pi)
    return turned((np.cos(way), np.sin(way), 0), tilt) @ about


def random_boxes(kind, count, seed=0):
    """A `Draw` of boxes that fall at random; mu 0 to 1.5, e 0 to 1, a twentieth at either end."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    rows = []
    while len(rows) < count:
        velocity = rng.normal(size=6) * [1, 1, 0.3, 2, 2, 2] - [0, 0, 1, 0, 0, 0]
        pressed = box(
            rng.uniform(0.2, 1.0, 3), random_turn(kind, rng), CONTACTS[kind], velocity
        )
        if (pressed.normals.T @ velocity).min() < -0.1:
            rows.append(pressed)
    e = with_ends(rng.uniform(size=count), rng)
    mu = MOST_MU * with_ends(rng.uniform(size=count), rng)
    return Draw(*map(np.stack, zip(*rows)), e, mu)


def with_ends(values, rng):
    """The same numbers from 0 to 1, a twentieth of them 0 and a twentieth 1."""
    u = rng.uniform(size=len(values))
    return np.select([u < 0.05, u > 0.95], [0.0, 1.0], values)


def cube(row):
    """An impact of the measured cube on its lowest corners, from a row of the file."""
    w, x, y, z = np.array([float(row[f"quat_{c}"]) for c in "wxyz"])
    length = np.sqrt(w * w + x * x + y * y + z * z)
    half = cross_matrix([x, y, z]) / length
    turn = np.eye(3) + 2 * (w / length * half + half @ half)
    gaps = [float(row[f"corner_{i}_gap_m"]) for i in range(1, 9)]
    lowest = np.sort(np.argsort(gaps, kind="stable")[: int(row["contacts"])])
    arms = CUBE_HALF * CORNERS[lowest] - [0, 0, CUBE_CENTRE]
    rates = [f"v_{c}_pre_m_s" for c in "xyz"] + [f"omega_{c}_pre_rad_s" for c in "xyz"]
    velocity = [float(row[name]) for name in rates]
    inertia = turn @ np.diag(CUBE_INERTIA) @ turn.T
    return body(CUBE_MASS, inertia, arms @ turn.T - [0, 0, CUBE_LOW], velocity)


def cube_draw(contacts, restitution=0.27):
    """A `Draw` of the measured cube's impacts on this number of corners, at each of CUBE_MU."""
    with CUBE_CSV.open() as file:
        rows = [row for row in csv.DictReader(file) if int(row["contacts"]) == contacts]
    # the file holds an impact once for each mu at which it was solved
    unique = {(row["toss"], row["frame"]): cube(row) for row in rows}.values()
    each = [pressed for pressed in unique for _ in CUBE_MU]
    mu = np.tile(CUBE_MU, len(unique))
    return Draw(*map(np.stack, zip(*each)), np.full(len(mu), restitution), mu)
