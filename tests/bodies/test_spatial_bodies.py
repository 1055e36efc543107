"""Spheres on each other, on boxes and on finite walls: geometry, collisions in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jimpact as ji

HALF, ROUNDING, RADIUS = np.array([0.2, 0.3, 0.1]), 0.02, 0.1
MASSES = SPHERE, BOX = 1.0, 3.0
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7])
MIDDLE = np.array([0.3, -0.2, 0.5])
CORE = HALF - ROUNDING
# Points of the core of the box and the outward normals there: of a face, an edge, a corner.
NEAREST = {
    "face": ([0.05, -0.1, CORE[2]], [0.0, 0.0, 1.0]),
    "edge": ([-CORE[0], 0.12, CORE[2]], [-0.6, 0.0, 0.8]),
    "corner": ([CORE[0], -CORE[1], CORE[2]], np.array([2.0, -1.0, 2.0]) / 3),
}


def quaternion(turn):
    return np.roll(turn.as_quat(), 1)  # scipy's scalar is the last


@pytest.fixture(scope="module")
def places():
    """Gaps and directions of a ball off its middle and a box over two planes and at a wall."""
    wall = ji.Box([0.1, 4.0, 2.0])
    moment = [0.004, 0.004, 0.004]
    bodies = ji.Bodies(
        [ji.Sphere(RADIUS, inertia=moment, centre=[0.02, 0.01, -0.03]),
         ji.Sphere(0.2), ji.Box(2 * HALF, mass=BOX, rounding=ROUNDING)],
        planes=[(0.0, 0.0, 2.0, -1.0), (0.6, 0.0, 0.8, -9.0)],
        pairs=[(0, 1), (2, 0), (2, 1), (0, 3)], fixed=[wall], places=[wall.at([-2.0, 0.0, 1.0])],
    )  # fmt: skip
    rows = list(NEAREST.values())
    rows.append(
        ([0.0, 0.0, CORE[2] - 0.15], [0.0, 0.0, 1.0])
    )  # the middle inside, .03 m deep
    q = [
        bodies.at(
            [
                MIDDLE + TURN.apply(np.asarray(p) + 0.12 * np.asarray(n)),
                [-1.75, 2.3, 1.4],
                MIDDLE,
            ],
            [quaternion(TURN.inv()), [1, 0, 0, 0], quaternion(TURN)],
        )
        for p, n in rows
    ]

    rest = jnp.zeros(18)

    @jax.jit
    @jax.vmap
    def look(q):
        slope = jax.jacfwd(lambda u: bodies.gap_function(bodies.nearby(q, u)))(rest).T
        return bodies.contacts(q), bodies.normals(q), bodies.tangents(q), slope

    return bodies, look(jnp.stack(q))


@pytest.mark.slow
def test_gaps_of_spheres_boxes_planes_and_walls(places):
    """Faces, edges and corners by the nearest point; within a box the depth below a face."""
    bodies, (contacts, normals, _, slope) = places
    kinds = [(b, -1) for _ in range(2) for b in (0, 1, *[2] * 8)]
    assert bodies.between == (*kinds, (0, 1), (0, 2), (1, 2), (0, 3))
    gap = np.asarray(contacts.gap)
    np.testing.assert_allclose(gap[:, 21], [0.0, 0.0, 0.0, -0.15], atol=1e-15)
    for lane, (_, n) in enumerate(NEAREST.values()):
        np.testing.assert_allclose(contacts.normal[lane, 21], TURN.apply(n), atol=1e-14)
    ball = MIDDLE + TURN.apply([0.05, -0.1, CORE[2] + 0.12])
    np.testing.assert_allclose(gap[0, [0, 1]], [ball[2] + 0.9, 2.2], atol=1e-14)
    sloping = [0.6 * ball[0] + 0.8 * ball[2] + 8.9, 0.8 * 1.4 - 0.6 * 1.75 + 8.8]
    np.testing.assert_allclose(gap[0, [10, 11]], sloping, atol=1e-14)
    np.testing.assert_allclose(
        gap[0, 20], np.linalg.norm(ball - [-1.75, 2.3, 1.4]) - 0.3
    )
    np.testing.assert_allclose(gap[0, 23], ball[0] + 2.0 - 0.05 - 0.1, atol=1e-14)
    np.testing.assert_allclose(normals, slope, atol=1e-13)
    assert np.abs(normals).max() > 0.99


@pytest.mark.slow
def test_slip_is_that_of_the_points_in_contact(places):
    """H_t^T v for random velocities: what the bodies' points at the contact do, across n."""
    bodies, (contacts, _, tangents, _) = places
    v = np.random.default_rng(0).normal(size=18)
    slip = np.asarray(jnp.swapaxes(tangents, 1, 2) @ v).reshape(4, -1, 2)
    turns = {0: TURN.inv(), 1: Rotation.identity(), 2: TURN}
    centre = {0: TURN.inv().apply([0.02, 0.01, -0.03]), 1: np.zeros(3), 2: np.zeros(3)}
    middle = {1: np.array([-1.75, 2.3, 1.4]), 2: MIDDLE}
    for lane, (p, n) in enumerate(NEAREST.values()):
        middle[0] = MIDDLE + TURN.apply(np.asarray(p) + 0.12 * np.asarray(n))
        for c in (0, 5, 20, 21, 22, 23):
            point, normal = (
                np.asarray(contacts.point[lane, c]),
                np.asarray(contacts.normal[lane, c]),
            )
            moves = np.zeros(3)
            for body, sign in zip(bodies.between[c], (1, -1)):
                if body in turns:
                    spin = turns[body].apply(v[6 * body + 3 : 6 * body + 6])
                    arm = point - middle[body] - centre[body]
                    moves += sign * (v[6 * body : 6 * body + 3] + np.cross(spin, arm))
            across = moves - (moves @ normal) * normal
            assert np.linalg.norm(slip[lane, c]) == pytest.approx(
                np.linalg.norm(across), abs=1e-12
            )


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (
            lambda: ji.Bodies([ji.Sphere(1.0), ji.Disc(1.0)]),
            TypeError,
            r"holds a Disc\.$",
        ),
        (
            lambda: ji.Bodies([ji.Disc(1.0), ji.Sphere(1.0)]),
            TypeError,
            r"holds a Sphere\.$",
        ),
        (lambda: ji.Bodies([ji.Disc(1.0)], pairs=[], room=9), ValueError, "`room`"),
        (lambda: ji.Bodies([ji.Dimer(0.1, 1.0)], room=9), TypeError, "not Dimer"),
        (
            lambda: ji.Bodies([ji.Disc(1.0)], fixed=[ji.Disc(1.0)]),
            ValueError,
            "`fixed`",
        ),
        (
            lambda: ji.Bodies([ji.Box([1, 1, 1])] * 2),
            ValueError,
            r"the pair \(0, 1\): two boxes have no gap function\. .* `jimpact\.from_mujoco`",
        ),
        (lambda: ji.Bodies([ji.Sphere(1.0)], pairs=[(0, 1)]), ValueError, r"`pairs`"),
        (
            lambda: ji.Bodies([ji.Sphere(1.0)], planes=()),
            ValueError,
            r"must give a contact",
        ),
        (
            lambda: ji.Bodies([ji.Sphere(1.0)], planes=[[0, 0, 0, 1]]),
            ValueError,
            r"`planes`",
        ),
        (lambda: ji.Bodies([], planes=()), ValueError, r"`bodies`"),
        (
            lambda: ji.Bodies([ji.Sphere(1.0)], fixed=[ji.Box([1, 1, 1])]),
            ValueError,
            r"`places` must have shape \(1, 7\)",
        ),
        (lambda: ji.Bodies([ji.Sphere(1.0)]).at([0, 0, 1]), ValueError, r"`positions`"),
    ],
)
def test_bad_input(call, error, words):
    with pytest.raises(error, match=words):
        call()
