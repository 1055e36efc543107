"""Scenes and bodies: contact space, kinetic angles, gaps and tangents against mechanics; statuses."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import programs
import pytest
import reference
from refusals import argument

import jimpact as ji


def dense(matrix):
    return np.asarray(matrix.as_matrix() if hasattr(matrix, "as_matrix") else matrix)


def dense_mass(scene):
    mass = np.asarray(scene.mass)
    return np.diag(mass) if mass.ndim == 1 else mass


@pytest.mark.parametrize("wall", [False, True, "left", "right", "both"])
def test_chain_is_the_dense_scene(wall):
    masses, v = [1.0, 2.0, 3.0, 0.5], np.array([1.0, -2.0, 0.5, 0.3])
    chain = ji.chain(masses, wall=wall)
    mass, normals = reference.chain_matrices(masses, wall)
    np.testing.assert_array_equal(chain.normals, normals)
    assert chain.contacts == normals.shape[1]
    p = np.linspace(0.1, 1.0, chain.contacts)
    w = normals.T @ np.linalg.solve(mass, normals)
    np.testing.assert_allclose(dense(ji.delassus_matrix(chain)), w, atol=1e-14)
    np.testing.assert_allclose(ji.delassus_matrix(chain) @ p, w @ p, atol=1e-14)
    np.testing.assert_allclose(ji.gap_velocity(chain, v), normals.T @ v)
    np.testing.assert_allclose(
        ji.velocity_change(chain, p), np.linalg.solve(mass, normals @ p)
    )
    np.testing.assert_allclose(ji.kinetic_energy(chain, v), 0.5 * v @ mass @ v)
    np.testing.assert_allclose(ji.momentum(chain, v), mass @ v)
    np.testing.assert_allclose(
        dense(ji.delassus_matrix(ji.Scene(mass, normals))), w, atol=1e-14
    )
    if wall == "right":
        np.testing.assert_array_equal(ji.chain(masses, wall="right").normals, normals)


def test_an_indefinite_mass_has_no_outcome_inside_jit():
    """On the host `Scene` refuses it."""
    normals = np.asarray(ji.chain([1.0, 1.0, 1.0]).normals)

    @jax.jit
    def status(mass):
        return ji.impact(
            ji.Newton(0.5), ji.Scene(mass, normals), [1.0, 0.0, 0.0]
        ).status

    assert ji.STATUS[int(status(np.eye(3)))].name == "ok"
    assert ji.STATUS[
        int(status(np.eye(3) - 1.5 * np.outer([0, 0, 1], [0, 0, 1])))
    ].failure


def test_kinetic_angles_of_tied_bodies():
    """Pairs 1-2 and 3-4, 2 tied to 3: cos = (1/2) / (1 + 1/2); by the masses alone (6.66) pi/2."""
    mass, pairs = [1.0] * 4, [[-1.0, 0], [1, 0], [0, -1], [0, 1]]
    tied = ji.Scene(mass, pairs, constraints=[[0.0], [1], [-1], [0]])
    assert float(ji.theory.kinetic_angles(tied)[0, 1]) == pytest.approx(
        np.arccos(1 / 3), abs=1e-12
    )
    free = ji.theory.kinetic_angles(ji.Scene(mass, pairs))
    assert float(free[0, 1]) == pytest.approx(np.pi / 2, abs=1e-12)


@pytest.mark.parametrize(
    "name",
    [
        "newton",
        pytest.param("poisson", marks=pytest.mark.release),
        "binary",
        pytest.param("lzb", marks=pytest.mark.release),
    ],
)
def test_welded_bodies_are_one(name):
    """Four balls, the middle two welded together: three balls, in every kind of law."""
    welded = jnp.array([[0.0], [-1], [1], [0]])
    normals = jnp.array([[-1.0, 0], [1, 0], [0, -1], [0, 1]])
    make = programs.LAWS[name].make

    @jax.jit
    def out(v, e, k):
        law = make(e, k, jnp.full(2, 1.5), jnp.zeros(2))
        scene = ji.Scene(jnp.array([1.0, 2.0, 0.5, 0.7]), normals, constraints=welded)
        return ji.impact(law, scene, v), ji.audit(
            ji.impact(law, scene, v), scene, v
        ).momentum

    e, k = np.array([0.9, 0.6]), np.array([1.0, 2.5])
    got, momentum = out(np.array([1.0, 0.1, 0.1, -0.4]), e, k)
    same, _ = programs.values(name)(
        [programs.chain([1, 2.5, 0.7], [1, 0.1, -0.4], e=e, k=k)]
    )
    np.testing.assert_allclose(
        np.asarray(got.velocity)[[0, 1, 3]], same.velocity[0, :3], atol=2e-8
    )
    np.testing.assert_allclose(got.velocity[1], got.velocity[2], atol=1e-13)
    np.testing.assert_allclose(got.impulse, same.impulse[0, :2], atol=4e-8)
    assert bool(momentum)


HOLDS = {
    "newton": lambda: ji.Newton(0.4),
    "moreau": lambda: ji.Moreau(0.4, friction=0.3),
    "poisson": lambda: ji.Poisson(0.4, friction=0.3),
    "lzb": lambda: ji.LZB(0.4, friction=0.3, initial_energy=jnp.array([0.0, 0.2])),
    "binary": lambda: ji.Binary(0.4),
    "compliant": lambda: ji.Compliant(ji.Bistiffness(3.0, 1.5, 0.4), friction=0.3),
}


@pytest.mark.parametrize(
    "name",
    [x if x == "moreau" else pytest.param(x, marks=pytest.mark.slow) for x in HOLDS],
)
def test_contacts_that_constraints_hold_take_no_part(name):
    """A foot welded to the ground that it touches, exactly and by rounding, beside a ball."""
    rng = np.random.default_rng(7)
    held = rng.normal(size=(20, 3, 2))
    held[0] = [[0.0, 1.0], [1.0, 0.0], [0.0, 0.0]]
    weights = np.concatenate([[[0.0, 1.0]], rng.normal(size=(19, 2))])

    @jax.jit
    @jax.vmap
    def run(
        held, weights
    ):  # coordinates: position and height of the ball, three of the foot
        constraints = jnp.concatenate([jnp.zeros((2, 2)), held])
        foot = jnp.concatenate([jnp.zeros(2), held @ weights])
        normals = jnp.stack([jnp.array([0.0, 1.0, 0.0, 0.0, 0.0]), foot], axis=1)
        tangents = jnp.zeros((5, 2)).at[0, 0].set(1.0).at[4, 1].set(1.0)
        mass = jnp.diag(jnp.array([1.5, 1.5, 0.7, 0.9, 2.0])) + 0.1
        scene = ji.Scene(mass, normals, tangents, constraints=constraints)
        return ji.impact(HOLDS[name](), scene, [0.8, -1.2, 0.0, 0.0, 0.0])

    out = run(held, weights)
    assert set(np.asarray(out.status)) == {0}
    np.testing.assert_array_equal(out.impulse[:, 1], 0.0)
    np.testing.assert_allclose(out.velocity[:, 1], 0.4 * 1.2, atol=1e-7)


def built(make, *given, at=(), **options):
    """Scene of a body, touching at this angle, .., made in one program."""

    def scene():
        body = make(*given, **options)
        return body.scene(body.touching(*at)) if isinstance(body, ji.Body) else body

    return jax.jit(scene)()


def around_a_disc(phi, masses, m0, radius=1.0, radii=(1.0,) * 3, gaps=(0.0,) * 3):
    """Balls around a disc, contact i with ball i."""
    balls = [ji.Disc(r, m, 0.4 * m * r**2) for r, m in zip(radii, masses)]
    pairs = [(i + 1, 0) for i in range(len(phi))]
    bodies = ji.Bodies([ji.Disc(radius, m0), *balls], planes=[], pairs=pairs)
    far = [radius + r + gap for r, gap in zip(radii, gaps)]
    q = [[x * np.cos(a), x * np.sin(a), 0.0] for x, a in zip(far, phi)]
    return bodies.scene(np.ravel([[0.0] * 3, *q]))


@pytest.mark.slow
def test_scene_from_gaps_is_the_block():
    width, height = 1.0, 2.0

    def gaps(q):  # q = (x, y, theta): corners of a block on the ground
        _, y, t = q
        return jnp.stack(
            [
                y - height / 2 * jnp.cos(t) + s * width / 2 * jnp.sin(t)
                for s in (1.0, -1.0)
            ]
        )

    def mass(q):
        return jnp.diag(jnp.array([1.0, 1.0, (width**2 + height**2) / 12])) + 0 * q[0]

    scene = ji.scene_from_gaps(gaps, mass, [0.0, height / 2, 0.0])
    np.testing.assert_allclose(
        scene.normals,
        ji.Block(width, height, corners="base").scene().normals,
        atol=1e-15,
    )
    assert not np.asarray(scene.gaps).any()
    lifted = ji.scene_from_gaps(gaps, mass, [0.0, height / 2 + 1e-3, 0.0])
    np.testing.assert_allclose(lifted.gaps, 1e-3, rtol=1e-9)
    with pytest.raises(ValueError, match="penetration"):
        ji.scene_from_gaps(gaps, mass, [0.0, 0.4 * height, 0.0])
    slope = jax.grad(
        lambda t: ji.scene_from_gaps(gaps, mass, jnp.stack([0.0, 1.2, t])).normals[2, 0]
    )(0.1)
    assert float(slope) == pytest.approx(
        height / 2 * np.cos(0.1) - width / 2 * np.sin(0.1)
    )


# ---------------------------------------------------------------- gaps and tangents of bodies


def test_block_away_from_rest():
    """Equation of moments: each corner's lever arms, at an angle."""
    width, height, angle = 1.5, 2.0, 0.3
    scene = built(ji.Block, width, height, 2.0, corners="base", at=(angle,))
    s, c = np.sin(angle), np.cos(angle)
    np.testing.assert_allclose(scene.gaps, [width * s, 0.0], atol=1e-15)
    normals = [
        [0, 0],
        [1, 1],
        [height / 2 * s + width / 2 * c, height / 2 * s - width / 2 * c],
    ]
    tangents = [
        [1, 1],
        [0, 0],
        [height / 2 * c - width / 2 * s, height / 2 * c + width / 2 * s],
    ]
    np.testing.assert_allclose(scene.normals, normals, atol=1e-15)
    np.testing.assert_allclose(scene.tangents, tangents, atol=1e-15)
    np.testing.assert_allclose(scene.mass, [2.0, 2.0, 2 * (4 + 2.25) / 12])
    left = built(ji.Block, width, height, corners="base", at=(-angle,))
    np.testing.assert_allclose(left.gaps, [0.0, width * s], atol=1e-15)
    assert float(ji.Block(1.0, 1.0, inertia=0.7, corners="base").scene().mass[2]) == 0.7


def test_dimer_tangents_are_the_slip_of_the_lowest_points():
    radius, length, angle = 0.3, 1.1, 0.4
    scene = built(ji.Dimer, radius, length, 2.0, 0.5, at=(angle,))
    arm = length / 2 + radius
    for contact, side in enumerate((arm, -arm)):
        lever = np.array([side * np.cos(angle), side * np.sin(angle) - radius])
        slip = np.array([1.0, 0.0, -lever[1]])  # v + omega x lever, along x
        np.testing.assert_allclose(scene.tangents[:, contact], slip, atol=1e-14)
        np.testing.assert_allclose(
            scene.normals[:, contact], [0, 1, lever[0]], atol=1e-14
        )
    inertia = 2 * 2.0 * (0.4 * radius**2 + arm**2) + 0.5 * length**2 / 12
    np.testing.assert_allclose(scene.mass, [4.5, 4.5, inertia])


def test_dimer_in_space():
    """M and H_t against rigid-body mechanics, angular velocity in the body's axes."""
    pitch, yaw, radius, length = 0.4, 1.1, 0.3, 1.1
    axis = np.array(
        [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
    )
    up, across = np.array([0.0, 0.0, 1.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    turning = np.stack(
        [axis, across, np.cross(axis, across)], axis=1
    )  # the body's axes
    (a, b), (c, s) = np.cos([yaw / 2, pitch / 2]), np.sin([yaw / 2, pitch / 2])
    e = np.array([a * b, c * s, -a * s, c * b])  # yaw about z, then -pitch about y
    scene = built(ji.SpatialDimer, radius, length, 2.0, 0.5, at=(e,))
    arm, about = length / 2 + radius, 0.8 * 2.0 * radius**2
    planar = 2 * 2.0 * (0.4 * radius**2 + arm**2) + 0.5 * length**2 / 12
    np.testing.assert_allclose(
        scene.mass, [*3 * [4.5], about, planar, planar], atol=1e-14
    )
    for contact, side in enumerate((arm, -arm)):
        lever = side * axis - radius * up
        velocity = np.concatenate([np.eye(3), np.cross(turning.T, lever).T], axis=1)
        np.testing.assert_allclose(scene.normals[:, contact], velocity[2], atol=1e-14)
        own = scene.tangents[:, 2 * contact : 2 * contact + 2]
        np.testing.assert_allclose(own, velocity[:2].T, atol=1e-14)
    np.testing.assert_allclose(scene.gaps, [2 * arm * np.sin(pitch), 0.0], atol=1e-14)


def test_bodies_that_are_chains():
    """Balls around a disc, pendulums at rest."""
    scene = built(around_a_disc, [np.pi, 0.0], [1.0, 3.0], 2.0)
    chain = ji.chain([1.0, 2.0, 3.0])
    w = dense(ji.delassus_matrix(chain))
    np.testing.assert_allclose(dense(ji.delassus_matrix(scene)), w, atol=1e-14)
    off = built(around_a_disc, [np.pi, 0.0], [1.0, 1.0], 1.0, gaps=[0.0, 0.25])
    np.testing.assert_allclose(off.gaps, [0.0, 0.25], atol=1e-12)
    assert np.asarray(off.closed).tolist() == [True, False]
    scene = built(ji.PendulumCradle, [1.0, 2.0, 3.0], 0.3, 0.02)
    np.testing.assert_allclose(scene.normals, 0.3 * chain.normals, atol=1e-15)
    np.testing.assert_allclose(dense(ji.delassus_matrix(scene)), w, atol=1e-13)


def test_balls_roll_around_a_disc():
    """Sliding is the difference of the two bodies' velocities where they touch."""
    phi, disc, ball = np.array([0.3, 1.9]), 0.3, np.array([0.1, 0.2])
    scene = built(around_a_disc, phi, [1.0, 1.0], 1.0, disc, ball)
    v = np.array([0.2, -0.5, 3.0, 0.7, 0.1, -2.0, -0.3, 0.4, 5.0])
    for contact, angle in enumerate(phi):
        along = np.array([-np.sin(angle), np.cos(angle)])
        rolling = v[3 * contact + 3 : 3 * contact + 6]
        slip = (rolling[:2] - v[:2]) @ along - ball[contact] * rolling[2] - disc * v[2]
        np.testing.assert_allclose(scene.tangents[:, contact] @ v, -slip, atol=1e-14)


def test_cradle_gaps():
    length, radius, gaps = 0.4, jnp.array([0.02, 0.03, 0.02]), [0.0, 1e-3]
    cradle = ji.PendulumCradle([1.0, 1.0, 1.0], length, radius, gaps)
    np.testing.assert_allclose(cradle.gap_function(jnp.zeros(3)), gaps, atol=1e-17)
    q = jnp.array([-0.7, 0.1, 0.4])
    at = np.array([0.0, 0.05, 0.101]) + length * np.sin(q)
    apart = np.hypot(np.diff(at), np.diff(length * np.cos(q))) - [0.05, 0.05]
    np.testing.assert_allclose(cradle.gap_function(q), apart, atol=1e-15)
    with pytest.raises(ValueError, match=argument("q")):
        cradle.scene([0.2, 0.0, 0.0])


@pytest.mark.slow
def test_scenes_are_differentiable_in_their_arguments():
    """d/d(width, height, angle) of an impact on a tilted block, against differences."""

    def outcome(x):
        block = ji.Block(x[0], x[1], 1.3, corners="base")
        scene = block.scene(block.touching(x[2]))
        return ji.impact(ji.Moreau(0.5), scene, jnp.array([0.3, -1.0, 0.2])).velocity[2]

    x, step = jnp.array([1.0, 1.7, 0.2]), 1e-6 * jnp.eye(3)
    moved = jnp.concatenate([x[None] + step, x[None] - step])
    slope, values = jax.jit(lambda x, y: (jax.grad(outcome)(x), jax.vmap(outcome)(y)))(
        x, moved
    )
    np.testing.assert_allclose(
        slope, (values[:3] - values[3:]) / 2e-6, rtol=1e-7, atol=1e-8
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["newton", "moreau", "poisson", "binary", "lzb"])
def test_float32_is_kept(name):
    """Scene, law and velocities in single precision; mixed with Python numbers and with float64."""
    f = np.float32
    scene = jax.tree.map(lambda x: jnp.asarray(x, f), ji.chain([1.0, 2.0, 0.7]))
    law = programs.LAWS[name].make(*(jnp.full(2, x, f) for x in (0.9, 1.0, 1.5, 0.0)))
    out = ji.impact(law, scene, jnp.array([1.0, 0.1, -0.4], f))
    assert {x.dtype for x in jax.tree.leaves(out)} == {np.dtype(f), np.dtype(np.int32)}
    full, _ = programs.values(name)(
        [programs.chain([1, 2, 0.7], [1, 0.1, -0.4], e=0.9)]
    )
    np.testing.assert_allclose(out.velocity, full.velocity[0, :3], atol=1e-4)
    assert programs.names(out.status) == programs.names(full.status)


# -------------------------------------------------------------------------------- in words


@pytest.fixture(scope="module")
def three():
    scene, v = ji.chain([1.0] * 3), jnp.array([1.0, 0.0, 0.0])
    return scene, v, ji.impact(ji.Moreau(0.9), scene, v)


def test_audit_reads_measured_outcomes(three):
    import dataclasses

    scene, v, out = three
    measured = dataclasses.replace(out, velocity=jnp.array([-0.0605, 0.1049, 0.9978]))
    audit = jax.jit(lambda out: (a := ji.audit(out, scene, v), a.consistent))
    found, consistent = audit(measured)
    assert not bool(found.momentum)
    assert not bool(found.energetic)
    assert not bool(consistent)
    assert bool(audit(out)[1])


def test_summary_speaks(three):
    import dataclasses

    scene, v, out = three
    text = ji.summary(out, scene, v)
    assert "87.33 % kept" in text  # (.2667^2 + 2 .6333^2)
    assert text.count("ok") >= 5
    bad = dataclasses.replace(out, status=jnp.asarray(len(ji.STATUS) - 1, jnp.int32))
    assert ji.STATUS[-1].name in ji.summary(bad, scene, v)
    gapped = ji.chain([1.0] * 3, gaps=[0.0, 1e-3])
    assert "open" in ji.summary(out, gapped, v)


def test_statuses_go_from_mild_to_grave():
    reported = [row.name for row in ji.STATUS]
    assert reported[0] == "ok"
    assert len(set(reported)) == len(reported)
    failures = [row.failure for row in ji.STATUS]
    assert failures == sorted(failures)
    wanted = "max_steps out_of_range not_finite infeasible inadmissible_velocity negative_impulse energy_gain"
    wanted += " impulse_not_unique order_dependent plastic_limit several_outcomes ill_conditioned"
    assert set(wanted.split()) <= set(reported)


FLAT = [
    [0.0, 0.0],
    [1.0, 1.0],
    [0.5, -0.5],
]  # normals of a block of width 1, (x, y, angle)
UPRIGHT = [[1.0, 1.0], [0.0, 0.0], [0.7, 0.7]]


@pytest.mark.parametrize(
    ("mass", "normals", "tangents", "message"),
    [
        (
            [2.0, 2.0, 0.4],
            FLAT,
            [[1, 1.0], [0, 0.2], [0.7, 0.7]],
            r"contact 2 are not at right",
        ),
        (
            [2.0, 2.0, 0.4],
            FLAT,
            [[1, 2.0], [0, 0.0], [0.7, 1.4]],
            r"contact 2 are not .*length",
        ),
        (
            [2.0, 2.0, 0.4],
            FLAT,
            np.array(FLAT)[:, [1, 1]],
            r"contact 2 depend on each other",
        ),
        (
            [2.0, 2.0, 0.4],
            FLAT,
            [[1, 0.0], [0, 0.0], [0.7, 0.0]],
            r"contact 2 depend on each",
        ),
        (
            [1.0] * 3,
            [[0.0], [0.0], [1.0]],
            [[1, 1.0], [0, 0], [0, 0]],
            r"contact 1 depend on each",
        ),
        (
            [1.0] * 3,
            [[0.0], [0.0], [1.0]],
            [[1, 0.6], [0, 0.8], [0, 0]],
            r"contact 1 are not at",
        ),
        (
            np.eye(3) + np.eye(3)[::-1] / 2,
            FLAT,
            [[1, 1], [0.2] * 2, [0.7] * 2],
            None,
        ),  # coupled
        ([2.0, 2.0, 0.4], FLAT, UPRIGHT, None),
        (
            [2.0, 2.0, 2.0],
            FLAT,
            UPRIGHT,
            None,
        ),  # an inertia that happens to be the mass
        ([2.0], [[1.0]], [[0.5]], None),  # one coordinate, a pendulum
    ],
)
def test_tangents_that_distort_friction_are_reported(mass, normals, tangents, message):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ji.Scene(mass, normals, tangents=tangents)
    assert len(caught) == (message is not None)
    assert message is None or re.search(message, str(caught[0].message))


@pytest.mark.parametrize("rounding", [7e-17, -3e-16, 9e-13, -9e-13])
def test_gaps_of_rounding_are_closed(rounding):
    """Four balls in a row by Moreau's law: (1, 0, 0, 0) becomes (-1, 1, 1, 1) / 2."""
    gaps = np.array([0.0, rounding, -rounding])
    masses, v = np.ones(4), [1.0, 0, 0, 0]
    normals = np.eye(4)[:, 1:] - np.eye(4)[:, :-1]
    row = ji.chain(masses, gaps=gaps)
    for scene in (row, ji.Scene(masses, normals, gaps=gaps)):
        assert np.asarray(scene.closed).all()
    after = ji.impact(ji.Moreau(1.0), row, v).velocity
    np.testing.assert_allclose(after, [-0.5, 0.5, 0.5, 0.5], atol=1e-12)
    inside = jax.jit(lambda g: ji.chain(masses, gaps=g).gaps)(gaps)
    assert not np.asarray(inside).any()
    slope = jax.jacfwd(lambda g: ji.chain(masses, gaps=g).gaps)(gaps)
    np.testing.assert_array_equal(slope, np.eye(3))


@pytest.mark.parametrize(
    ("gap", "said"), [(-1e-6, "-1e-06 at index 1"), (np.nan, "nan at index 1")]
)
def test_overlap_is_no_gap(gap, said):
    with pytest.raises(ValueError, match=f"`gaps` must .*{said}"):
        ji.chain([1.0] * 3, gaps=[0.0, gap])


def test_tangents_of_bodies_are_not_reported():
    box, turned = ji.Box([1.0, 1.2, 0.8]), [0.9, 0.1, 0.3, 0.3]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        box.scene(box.touching(np.array(turned)))
        block = ji.Block(1.0, 2.0)
        block.scene(block.touching(0.3))
        ji.Dimer(0.1, 1.0).scene()
        ji.SpatialDimer(0.1, 1.0).scene()
