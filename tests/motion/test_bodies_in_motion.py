"""Bodies in motion: energy under inertial forces, spheres over edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jimpact as ji


def test_inertial_forces_keep_the_energy():
    """`v . f = -v . M' v / 2` for a mass that depends on q: d(v^T M v / 2)/dt = 0 without loads."""

    def mass(q):  # a rod by its yaw and pitch
        return jnp.diag(jnp.stack([2.0, 2.0 * jnp.cos(q[2]) ** 2, 1.0 + 0 * q[0]]))

    rod = ji.System(lambda q: q[:1], mass).body
    q, v = jnp.array([1.0, 0.4, 0.5]), jnp.array([0.3, 1.0, -2.0])

    @jax.jit
    def powers(q, v):
        change = jax.jvp(lambda x: v @ rod.mass_matrix(x) @ v, (q,), (v,))[1]
        return v @ rod.inertial_force(q, v), change

    work, change = powers(q, v)
    assert float(work) == pytest.approx(-0.5 * float(change), rel=1e-13)
    assert float(change) != 0


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


def sphere_and_box(gap, point, normal):
    """A sphere over this point of a turned box, and q."""
    box = ji.Box(2 * HALF, mass=BOX, rounding=ROUNDING)
    ball = ji.Bodies([ji.Sphere(RADIUS, mass=SPHERE), box], planes=())
    away = np.asarray(point) + (ROUNDING + RADIUS + gap) * np.asarray(normal)
    places = [MIDDLE + TURN.apply(away), MIDDLE]
    return ball, ball.at(places, [quaternion(TURN.inv()), quaternion(TURN)])


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


def collided(restitution, gap, speed, point, normal, time):
    """Where the sphere and the box's middle are after a collision in closed form, box axes."""
    lever = np.cross(point, normal)
    inertia = BOX * (np.sum((2 * HALF) ** 2) - (2 * HALF) ** 2) / 12
    effective = 1 / (1 / SPHERE + 1 / BOX + lever @ (lever / inertia))
    p = (1 + restitution) * speed * effective
    late = time - gap / speed
    sphere = (p / SPHERE - speed) * late * normal
    return sphere, -p / BOX * late * normal, -p * lever / inertia


@pytest.mark.release
def test_a_sphere_strikes_a_face_an_edge_and_a_corner():
    """Velocities, places and the derivative in e: e = .8, 1 m/s, .05 m before the box at rest."""
    gap, speed, time, e = 0.05, 1.0, 0.2, 0.8
    rows = [(np.asarray(p), np.asarray(n)) for p, n in NEAREST.values()]
    made = [sphere_and_box(gap, p, n) for p, n in rows]
    bodies, q = made[0][0], jnp.stack([q for _, q in made])
    v = jnp.stack([jnp.zeros(12).at[:3].set(TURN.apply(-speed * n)) for _, n in rows])

    def run(e, q, v):
        motion = ji.simulate(
            ji.System(bodies), ji.Newton(e), q, v, time, samples=2, max_events=3
        )
        return (
            motion.q[-1],
            motion.events.velocity_after[0],
            motion.events.count,
            motion.status,
        )

    @jax.jit
    @jax.vmap
    def look(q, v):
        return jax.jvp(lambda e: run(e, q, v)[:2], (jnp.asarray(e),), (jnp.ones(()),))

    (end, after), (slope, _) = look(q, v)
    for lane, (p, n) in enumerate(rows):
        sphere, box, spin = collided(e, gap, speed, p, n, time)
        more = collided(1.0, gap, speed, p, n, time)[0]  # all of it is linear in 1 + e
        start = np.asarray(q[lane, :3]) - gap * TURN.apply(n)
        np.testing.assert_allclose(end[lane, :3], start + TURN.apply(sphere), atol=1e-9)
        np.testing.assert_allclose(end[lane, 7:10], MIDDLE + TURN.apply(box), atol=1e-9)
        np.testing.assert_allclose(after[lane, 9:], spin, atol=1e-9)
        expected = TURN.apply(more - sphere) / (1 - e)
        np.testing.assert_allclose(slope[lane, :3], expected, atol=1e-8)


@pytest.mark.release
def test_a_sphere_falls_over_the_edge_of_a_finite_wall_in_steps():
    """Beside the wall it passes; on its top it bounces to e^2 of its height."""
    wall = ji.Box([0.1, 2.0, 1.0])
    bodies = ji.Bodies(
        [ji.Sphere(RADIUS), ji.Sphere(RADIUS)],
        fixed=[wall],
        places=[wall.at([0.0, 0.0, 0.5])],
    )
    system = ji.System(bodies, gravity=10.0)
    q = bodies.at([[0.0, 0.5, 1.3], [0.0, 1.101, 1.3]])
    motion = ji.simulate(
        system,
        ji.Newton(0.5),
        q,
        np.zeros(12),
        0.3,
        samples=4,
        method="time_stepping",
        step=1e-3,
    )
    ji.raise_on_failure(motion)
    rebound = 0.5 * np.sqrt(2 * 10 * 0.2)
    assert motion.velocity[-1, 2] == pytest.approx(rebound - 10 * (0.3 - 0.2), abs=0.02)
    assert motion.q[-1, 9] == pytest.approx(1.3 - 0.5 * 10 * 0.3**2, abs=2e-3)
