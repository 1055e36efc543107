"""Piles of discs and spheres: pairs by the grid against all pairs, contacts against definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import piles
import pytest
from refusals import argument

import jimpact as ji


@pytest.fixture(scope="module")
def packing():
    """480 spheres without overlaps in a corner, and where they are a step later."""
    rng = np.random.default_rng(1)
    centres, radii = [], []
    while len(radii) < 480:
        c, r = 0.1 + 1.7 * rng.random(3), 0.05 * (1 + 0.1 * rng.random())
        if all(
            np.linalg.norm(c - x) > 0.98 * (r + s)
            for x, s in zip(centres, radii, strict=True)
        ):
            centres.append(c)
            radii.append(r)
    walls = [[2.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 3.0, 4.0, 0.0]]
    spheres = piles.spheres(1.0 + rng.random(480), radii, planes=walls)
    q = spheres.at(centres)
    later = q + 0.02 * rng.standard_normal(q.shape)
    return spheres, q, later


@jax.jit
def contacts(spheres, q, later):
    """Those with gaps up to 10 mm."""
    return spheres.active_pairs(q, later, jnp.asarray(0.01))


@pytest.mark.slow
def test_closed_contacts_are_those_with_small_gaps(packing):
    spheres, q, later = packing
    assert 0 < spheres.crowd < 60  # by the grid
    pairs = contacts(spheres, q, later)
    closed = np.asarray(pairs.closed)
    k, walls = spheres.count, len(spheres.planes)
    i, j = np.triu_indices(k, 1)
    numbers = np.concatenate(
        [
            (np.arange(k) * (k + walls) + k + np.arange(walls)[:, None]).ravel(),
            i * (k + walls) + j,
        ]
    )
    least = np.minimum(spheres.gap_function(q), spheres.gap_function(later))
    expected = numbers[least <= 0.01]
    assert sorted(np.asarray(pairs.number)[closed]) == sorted(expected)
    assert closed.sum() > 40
    assert not pairs.overflows


def test_pairs_that_meet_within_a_step_may_be_two_cells_apart():
    discs = piles.discs(1.0, [0.5] * 80)
    assert discs.crowd > 0
    q = discs.at([[1.4 * i, 0.0] for i in range(80)])
    later = q + discs.at([[0.2 * (-1) ** i, 0.0] for i in range(80)])
    pairs = contacts(discs, q, later)
    expected = [[i, i + 1] for i in range(0, 80, 2)]
    assert (
        sorted(np.asarray(pairs.bodies)[np.asarray(pairs.closed)].tolist()) == expected
    )


@pytest.mark.slow
def test_directions_are_velocities_of_the_points_that_touch(packing):
    """gamma and slip of both bodies at the middle of their gap or overlap, walls at rest."""
    spheres, q, _ = packing
    pairs = contacts(spheres, q, q)
    closed = np.asarray(pairs.closed)
    rng = np.random.default_rng(2)
    v = np.concatenate([rng.standard_normal((spheres.count, 6)), np.zeros((1, 6))])
    bodies, directions = (
        np.asarray(pairs.bodies)[closed],
        np.asarray(pairs.directions)[closed],
    )
    rates = np.einsum("kdbx,kbx->kd", directions, v[bodies])
    at = np.asarray(q).reshape(-1, 6)[:, :3]
    radii = np.append(np.asarray(spheres.rims), 0.0)
    for (a, b), number, found, way in zip(
        bodies, np.asarray(pairs.number)[closed], rates, directions, strict=True
    ):
        n, half = way[0, 0, :3], 0.0
        if b < spheres.count:
            half = 0.5 * (np.linalg.norm(at[a] - at[b]) - radii[a] - radii[b])
            np.testing.assert_allclose(
                n, (at[a] - at[b]) / np.linalg.norm(at[a] - at[b])
            )
        else:
            wall = np.asarray(spheres.planes)[
                number % (spheres.count + 3) - spheres.count
            ]
            np.testing.assert_array_equal(n, wall[:3])
        point = v[a, :3] - (radii[a] + half) * np.cross(v[a, 3:], n)
        point -= v[b, :3] + (radii[b] + half) * np.cross(v[b, 3:], n)
        t1, t2 = way[1:, 0, :3]
        np.testing.assert_allclose(
            np.stack([n, t1, t2]) @ np.stack([n, t1, t2]).T, np.eye(3), atol=1e-15
        )
        np.testing.assert_allclose(
            found, [point @ n, point @ t1, point @ t2], atol=1e-14
        )


def test_spheres_are_a_body_like_others():
    """Gradients of gaps and tangents are those of the closed contacts; mass by 2 m R^2 / 5."""
    spheres = piles.spheres([1.0, 2.0], [0.1, 0.2], planes=[[0.0, 0.0, 1.0, 0.0]])
    np.testing.assert_allclose(
        spheres.mass, [1] * 3 + [0.004] * 3 + [2] * 3 + [0.032] * 3
    )
    q = spheres.at([[0.0, 0.0, 0.1], [0.0, np.sqrt(0.08), 0.2]])
    gradients, tangents, pairs = jax.jit(
        lambda q: (
            jax.jacobian(spheres.gap_function)(q),
            spheres.tangents(q),
            spheres.active_pairs(q, q, jnp.asarray(1e-12)),
        )
    )(q)
    assert np.asarray(pairs.number)[:3].tolist() == [
        1,
        2,
        5,
    ]  # 3 i + j, j = 2 is the wall
    each = (
        np.asarray(gradients).reshape(3, 1, 2, 6),
        np.asarray(tangents).T.reshape(3, 2, 2, 6),
    )
    expected = np.concatenate(each, axis=1)[[2, 0, 1]]  # planes come first
    for row in range(3):
        for side, body in enumerate(np.asarray(pairs.bodies)[row]):
            if body < 2:
                ours = np.asarray(pairs.directions)[row, :, side]
                np.testing.assert_allclose(ours, expected[row, :, body], atol=1e-15)


def test_walls_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=argument("planes")):
        piles.spheres(1.0, [0.1], planes=[[0.0, 1.0, 0.0]])
    with pytest.raises(ValueError, match=argument("positions")):
        piles.spheres(1.0, [0.1]).at([[0.0, 1.0]])


@pytest.mark.slow
def test_a_sphere_slides_and_then_rolls():
    """It ends at 5/7 of its speed, whatever the friction, at the time 2 v / (7 mu g)."""
    spheres = piles.spheres(2.0, [0.1, 0.1], planes=[[0.0, 0.0, 1.0, 0.0]])
    system = ji.System(spheres, gravity=True)
    start = spheres.at([[0.0, 0.0, 0.1], [0.0, 5.0, 0.1]])
    v0 = np.zeros(12)
    v0[[0, 7]] = 1.0, 2.0  # along x, and twice as fast along y
    motion = ji.simulate(
        system,
        ji.Moreau(0.0, friction=0.3),
        start,
        v0,
        0.3,
        samples=4,
        method="time_stepping",
        step=1e-3,
    )
    v = np.asarray(motion.velocity[-1])
    np.testing.assert_allclose(v[:6], [5 / 7, 0, 0, 0, 50 / 7, 0], atol=1e-9)
    np.testing.assert_allclose(v[6:], [0, 10 / 7, 0, -100 / 7, 0, 0], atol=1e-9)


@pytest.mark.release
def test_spheres_fall_into_a_box_and_come_to_rest():
    grid = np.stack(np.meshgrid(*[np.arange(3)] * 3), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    radii = 0.01 * (1 + 0.2 * (rng.random(27) - 0.5))
    walls = [
        [0, 0, 1.0, 0],
        [1.0, 0, 0, 0],
        [-1.0, 0, 0, -0.08],
        [0, 1.0, 0, 0],
        [0, -1.0, 0, -0.08],
    ]
    spheres = piles.spheres(4e6 * radii**3, radii, planes=walls)
    system = ji.System(spheres, gravity=True)
    v0 = np.pad(0.1 * rng.standard_normal((27, 3)), ((0, 0), (0, 3))).reshape(-1)
    motion = ji.simulate(
        system, ji.Moreau(0.3, friction=0.5), spheres.at(0.014 + 0.024 * grid), v0, 1.5,
        samples=16, method="time_stepping", step=1e-3,
    )  # fmt: skip
    ji.raise_on_failure(motion)
    speed = np.abs(np.asarray(motion.velocity[-1]).reshape(-1, 6)[:, :3])
    assert np.median(speed) < 1e-6
    assert speed.max() < 2e-2  # a last sphere may roll
    assert np.diff(np.asarray(motion.energy)).max() < 1e-8 * motion.energy[0]
    assert -1e-3 < float(np.min(motion.gaps)) < 0


@pytest.mark.slow
def test_a_mixed_pile_has_the_contacts_of_planar_bodies():
    """The same gaps, normals and tangents, up to their sides; their order is another."""
    pentagon = 0.2 * np.stack(
        [np.cos(0.4 * np.pi * np.arange(5)), np.sin(0.4 * np.pi * np.arange(5))]
    )
    bodies = [
        ji.Block(0.4, 0.2, mass=2.0),
        ji.Disc(0.15, mass=1.5),
        ji.Polygon([[0, 0], [0.3, 0], [0.1, 0.3]], mass=0.7),
        ji.Disc(0.1),
        ji.Polygon(pentagon.T),
    ]
    pile = ji.Bodies(bodies, [[0.0, 2.0, 0.0], [1.0, 0.0, 0.5]], room=6 * len(bodies))
    pairs = list(zip(*np.triu_indices(5, 1)))
    every = ji.Bodies(bodies, planes=[0.0, (-np.pi / 2, 0.5)], pairs=pairs)
    np.testing.assert_array_equal(pile.mass, every.mass)
    x, y = [0.0, 0.4, 0.1, -0.3, 0.6], [0.2, 0.3, 0.6, 0.5, 0.75]
    q = np.stack([x, y, np.random.default_rng(0).random(5)], axis=1).reshape(-1)

    @jax.jit
    def parts(body, q):
        return body.directions(q)

    ours, theirs = (jax.tree.map(np.asarray, parts(body, q)) for body in (pile, every))
    order, expected = np.argsort(ours[0]), np.argsort(theirs[0])
    np.testing.assert_allclose(ours[0][order], theirs[0][expected], atol=1e-14)
    for found, right, signs in (
        (ours[1], theirs[1], (1,)),
        (ours[2], theirs[2], (1, -1)),
    ):
        found, right = found[:, order], right[:, expected]
        off = np.min(
            [np.abs(found - sign * right).max(axis=0) for sign in signs], axis=0
        )
        np.testing.assert_allclose(off, 0, atol=1e-14)


@pytest.mark.release
def test_a_mixed_pile_finds_its_contacts_by_the_grid():
    """Those of all pairs that are near, now or later, and the least gap of all."""
    rng = np.random.default_rng(3)
    bodies = [ji.Block(1.0, 1.0), ji.Disc(0.5)] * 60
    pile = ji.Bodies(bodies, [[0.0, 1.0, -0.8]], room=6 * len(bodies))
    cells = np.stack(np.meshgrid(np.arange(12), np.arange(10)), axis=-1).reshape(-1, 2)
    q = np.array(pile.at([1.4, 1.1] * cells)).reshape(-1, 3)
    q[:, 2] = rng.choice([0.0, np.pi / 2, 0.02], 120)
    later = q + rng.uniform(-0.03, 0.03, q.shape) * [0, 1, 0]
    later[:, 0] += np.tile([0.2, -0.2], 60)  # pairs meet
    q, later = q.reshape(-1), later.reshape(-1)
    assert 0 < pile.crowd < 40

    @jax.jit
    def found(q, later, far):
        pairs = pile.active_pairs(q, later, jnp.asarray(0.06))
        gaps = jax.lax.map(pile.gap_function, jnp.stack([q, later]))
        return pairs, gaps, jax.lax.map(pile.least_gap, jnp.stack([q, far]))

    far = np.asarray(pile.at(1.9 * cells + [0, 3]))
    pairs, gaps, (least, apart) = found(q, later, far)
    assert not pairs.overflows
    assert int(pairs.filled) == int((gaps.min(axis=0) <= 0.06).sum()) > 60
    assert least == gaps[0].min() < 0.2
    assert apart == pytest.approx(0.9)  # none are near each other, or the wall
    directions = np.asarray(pairs.directions)[: int(pairs.filled)]
    np.testing.assert_allclose(
        np.linalg.norm(directions[:, :, 0, :2], axis=2), 1, rtol=1e-12
    )


def test_bad_mixed_piles_are_named():
    with pytest.raises(TypeError, match=argument("bodies")):
        ji.Bodies([ji.Dimer(0.1, 0.5)], room=9)
    with pytest.raises(ValueError, match=argument("bodies")):
        ji.Bodies([], room=9)
    with pytest.raises(ValueError, match=r"`planes`"):
        ji.Bodies([ji.Disc(0.1)], [[0.0, 0.0, 1.0]], room=9)


@pytest.mark.release
def test_a_mixed_pile_comes_to_rest_and_goes_on():
    """Without kinetic energy, with the weight on the floor; the next motion begins where it ends."""
    bodies = [
        ji.Block(0.2, 0.1, mass=2.0),
        ji.Disc(0.06),
        ji.Polygon([[0, 0], [0.2, 0], [0.1, 0.1]]),
    ]
    pile = ji.Bodies(
        bodies * 2,
        room=12 * len(bodies),
        planes=[[0, 1.0, 0], [1.0, 0, -0.25], [-1.0, 0, -0.25]],
    )
    system, law = ji.System(pile, gravity=10.0), ji.Moreau(0.0, friction=0.5)
    places = [
        [-0.1, 0.06],
        [0.13, 0.07],
        [0.0, 0.2],
        [-0.1, 0.32],
        [0.13, 0.3],
        [0.0, 0.45],
    ]
    options = dict(samples=5, method="time_stepping", step=1e-3)
    motion = ji.simulate(system, law, pile.at(places), np.zeros(18), 1.5, **options)
    ji.raise_on_failure(motion)
    assert motion.kinetic_energy[-1] < 1e-9
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-10)
    assert (
        -2e-3 < float(motion.gaps.min()) < -1e-9
    )  # steps leave overlaps, with which it goes on
    later = ji.simulate(system, law, **motion.restart(1.7), **options)
    np.testing.assert_allclose(later.q[-1], motion.q[-1], atol=1e-6)
    at = ji.TimeStepping(1e-3).contacts(system, law, motion.q[-1], motion.velocity[-1])
    # everything that the walls give carries the weight
    push = at.impulse[:, None] * at.normals + at.tangential
    np.testing.assert_allclose(
        push[at.bodies[:, 1] < 0].sum(axis=0) / 1e-3, [0, 80], atol=1e-2
    )


@pytest.fixture(scope="module")
def struck():
    """Ball 1 strikes balls 2 and 3, which touch each other, on a table; ball 4 falls onto it.

    Four more make it too many contacts for the program that small scenes share.
    """
    h = np.sqrt(3)
    places = [
        [0, 0, 1.0],
        [h, 1.0, 1.0],
        [h, -1.0, 1.0],
        *([9.0 * i, 0, 1.0] for i in range(1, 6)),
    ]
    spheres = piles.spheres(
        [1.0, 1.0, 1.0, 2.0] + 4 * [1.0], [1.0] * 8, planes=[[0.0, 0.0, 2.0, 0.0]]
    )
    v = np.zeros(48)
    v[[0, 20]] = 1.0, -3.0
    return spheres, spheres.at(places), v


@pytest.mark.slow
def test_a_packing_has_the_contacts_of_its_body(struck):
    spheres, q, _ = struck
    scene, places, columns = (
        spheres.closed_scene(q),
        np.asarray(q).reshape(8, 6)[:, :3],
        [],
    )
    for i, j in [(0, 1), (0, 2), (1, 2)]:
        column = np.zeros((8, 6))
        column[i, :3] = (places[i] - places[j]) / 2
        column[j, :3] = -column[i, :3]
        columns.append(column.ravel())
    normals = np.array([*columns, *np.eye(48)[2::6]]).T  # and the table
    assert scene.contacts == 11
    assert scene.tangents is None
    np.testing.assert_allclose(scene.normals, normals, atol=1e-15)
    w = normals.T @ (normals / np.asarray(spheres.mass)[:, None])
    sparse = ji.delassus_matrix(scene)
    np.testing.assert_allclose(sparse.as_matrix(), w, atol=1e-15)
    x = np.arange(11.0)
    np.testing.assert_allclose(sparse @ x, w @ x, atol=1e-14)
    np.testing.assert_allclose(ji.gap_velocity(scene, q), normals.T @ q, atol=1e-13)
    np.testing.assert_allclose(
        ji.velocity_change(scene, x), normals @ x / spheres.mass, atol=1e-14
    )


def test_a_packing_is_struck(struck):
    """p (2 + cos 60) = (1 + e) cos 30, and contact 2, 3 opens. v+ is linear in v-: so its derivative."""
    spheres, q, v = struck
    scene, e = spheres.closed_scene(q), 0.5
    after, rate = jax.jvp(
        lambda v: ji.impact(ji.Moreau(e), scene, v).velocity, (v,), (v,)
    )
    p = (1 + e) * np.sqrt(0.75) / 2.5
    expected = np.zeros(48)
    expected[0] = 1 - 2 * p * np.sqrt(0.75)
    expected[[6, 12]] = p * np.sqrt(0.75)
    expected[[7, 13]] = p / 2, -p / 2
    expected[20] = 3 * e
    np.testing.assert_allclose(after, expected, atol=1e-12)
    np.testing.assert_allclose(rate, expected, atol=1e-12)


@pytest.mark.slow
def test_a_step_of_a_packing_is_an_impact(struck):
    """Without friction by Moreau's law; with it, ball 1 rubs on balls 2 and 3, all on the table."""
    spheres, q, v = struck
    system, scene = ji.System(spheres), spheres.closed_scene(q)
    smooth = ji.impact(ji.Moreau(0.5), scene, v)
    steps = ji.TimeStepping(1e-9)
    step = steps.contacts(system, ji.Moreau(0.5, friction=1e-12), q, v)
    np.testing.assert_allclose(step.velocity, smooth.velocity, atol=1e-6)
    np.testing.assert_array_equal(step.bodies[:4], [[0, 1], [0, 2], [1, 2], [0, -1]])
    np.testing.assert_allclose(step.impulse, smooth.impulse, atol=1e-6)
    np.testing.assert_allclose(step.scene.normals, scene.normals, atol=1e-8)
    v = v.copy()
    v[[0, 1, 20]] = 0.0, 2.0, -3.0  # past the others; and ball 4 falls
    v[18] = 9.0
    rough = steps.contacts(system, ji.Moreau(0.5, friction=0.1), q, v)
    falls = rough.bodies.tolist().index([3, -1])
    assert rough.impulse[falls] == pytest.approx(2 * 1.5 * 3, abs=1e-5)
    np.testing.assert_allclose(rough.tangential[falls], [-0.9, 0, 0], atol=1e-5)
    np.testing.assert_allclose(rough.velocity[[18, 20]], [9 - 0.45, 1.5], atol=1e-5)
    column = ji.System(ji.Column([1.0]), gravity=True)
    with pytest.raises(ValueError, match=argument("system")):
        steps.contacts(column, ji.Moreau(0.5), [0.0], [-1.0])
    with pytest.raises(ValueError, match=argument("q")):
        steps.contacts(system, ji.Moreau(0.5, friction=0.1), 9 * q, 0 * v)


def test_bad_packings_are_named(struck):
    spheres, q, _ = struck
    row = piles.spheres(1.0, [0.1] * 3, room=1)
    with pytest.raises(ValueError, match=argument("q")):
        row.closed_scene(row.at([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.4, 0.0, 0.0]]))
    with pytest.warns(UserWarning, match=r"`q` holds bodies that overlap by 0\.05 m"):
        row.closed_scene(row.at([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.4, 0.0, 0.0]]))
    with pytest.raises(ValueError, match=argument("q")):
        spheres.closed_scene(10 * q)
    with pytest.raises(ValueError, match="below"):
        spheres.closed_scene(q, below=-1.0)
    with pytest.raises(ValueError, match=argument("q")):
        spheres.closed_scene(q[1:])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["time", "implicit"])
def test_dynamics_of_a_packing_are_those_of_the_dense_scene(struck, method):
    spheres, q, v = struck
    scene = spheres.closed_scene(q)
    law = ji.LZB([0.9, 0.9, 0.5] + 8 * [0.7], 1e4, rtol=1e-7, method=method)
    dense = ji.impact(law, ji.Scene(scene.mass, scene.normals), v)
    sparse = ji.impact(law, scene, v)
    np.testing.assert_allclose(sparse.velocity, dense.velocity, atol=1e-6)
    assert sparse.velocity[20] == pytest.approx(2.1, abs=1e-5)


@pytest.mark.slow
def test_piles_by_events_are_refused_with_friction():
    pile = ji.Bodies([ji.Disc(0.1)] * 2, (), room=12)
    at = pile.at([[0.0, 0.0], [0.3, 0.0]])
    law = ji.Compliant(ji.Hertz(1e6), friction=0.1)
    for method in ("events", "contact_forces"):
        with pytest.raises(ValueError, match=argument("friction")):
            ji.simulate(ji.System(pile), law, at, np.zeros(6), 1.0, method=method)
