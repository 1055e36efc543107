"""Piles of discs and spheres: pairs by the grid against all pairs, contacts against definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.bodies.neighbours import crowd_of, near_pairs


def brute_force(points, distance):
    """Pairs (i, j), i < j, nearer than the distance."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    return set(zip(*map(np.ndarray.tolist, np.nonzero(np.triu(apart < distance, 1)))))


@pytest.mark.parametrize("d", [2, 3])
def test_the_grid_meets_every_near_pair_once(d):
    rng = np.random.default_rng(d)
    pairs_of = jax.jit(lambda points, distance: near_pairs(points, distance, 60))
    clouds = (
        3 * rng.random((90, d)),
        np.concatenate([rng.random((60, d)), 1e7 * rng.standard_normal((30, d))]),  # some flew away
        0.25 * rng.integers(0, 6, (90, d)) + 1e-13 * rng.random((90, d)),  # on borders of cells
    )
    for points in clouds:
        for distance in (0.25, 0.6):
            pairs = pairs_of(points, distance)
            used = np.asarray(pairs.used)
            first, second = (np.asarray(x)[used].tolist() for x in (pairs.first, pairs.second))
            met = list(zip(first, second, strict=True))
            assert len(met) == len(set(met))
            assert brute_force(points, distance) <= set(met)
            assert not pairs.overflows
    assert len(met) < 90 * 89 / 2  # it leaves pairs out
    for together in (61, 62):  # in one row: the first one meets all others
        line = np.zeros((90, d))
        line[:, 0] = 1e3 * np.arange(90)
        line[:together, 0] = line[45, 0]
        line[:together, -1] += 0.1 * rng.random(together)
        assert bool(pairs_of(line, 1.0).overflows) is (together == 62)


def test_a_crowd_holds_the_densest_packing():
    """Hexagonal layers of discs, and cubic close packing of balls, moved over the cells."""
    rng = np.random.default_rng(0)
    i, j, k = (x.ravel().astype(float) for x in np.meshgrid(*[np.arange(-6, 7)] * 3))
    layer = np.unique(np.stack([i + j / 2, np.sqrt(0.75) * j], axis=1), axis=0)
    ball = np.stack([i + j / 2 + k / 2, np.sqrt(0.75) * (j + k / 3), np.sqrt(2 / 3) * k], axis=1)
    for points, d in ((layer, 2), (ball, 3)):  # spacing 1, cells of 1 or 2
        for ratio in (1, 2):
            most = 0
            for corner in rng.random((400, d)):
                size = np.array([ratio] * (d - 1) + [3 * ratio], float)
                inside = np.all((points >= corner - 2) & (points < corner - 2 + size), axis=1)
                most = max(most, int(inside.sum()))
            assert 2 < most <= crowd_of(0.5, 0.5 * ratio, d)


@pytest.fixture(scope="module")
def packing():
    """480 spheres without overlaps in a corner, and where they are a step later."""
    rng = np.random.default_rng(1)
    centres, radii = [], []
    while len(radii) < 480:
        c, r = 0.1 + 1.7 * rng.random(3), 0.05 * (1 + 0.1 * rng.random())
        if all(np.linalg.norm(c - x) > 0.98 * (r + s) for x, s in zip(centres, radii, strict=True)):
            centres.append(c)
            radii.append(r)
    walls = [[2.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 3.0, 4.0, 0.0]]
    spheres = ji.Spheres(1.0 + rng.random(480), radii, walls=walls)
    q = spheres.at(centres)
    later = q + 0.02 * rng.standard_normal(q.shape)
    return spheres, q, later


@jax.jit
def contacts(spheres, q, later):
    """Those with gaps up to 10 mm."""
    return spheres.active_pairs(q, later, jnp.asarray(0.01))


def test_closed_contacts_are_those_with_small_gaps(packing):
    spheres, q, later = packing
    assert 0 < spheres.crowd < 60  # by the grid
    pairs = contacts(spheres, q, later)
    closed = np.asarray(pairs.closed)
    k, walls = spheres.count, len(spheres.walls)
    i, j = np.triu_indices(k, 1)
    numbers = np.concatenate(
        [i * (k + walls) + j, (np.arange(k)[:, None] * (k + walls) + k + np.arange(walls)).ravel()]
    )
    least = np.minimum(spheres.gap_function(q), spheres.gap_function(later))
    expected = numbers[least <= 0.01]
    assert sorted(np.asarray(pairs.number)[closed]) == sorted(expected)
    assert closed.sum() > 40
    assert not pairs.overflows


def test_directions_are_velocities_of_the_points_that_touch(packing):
    """gamma and slip by (v_i - w_i x R_i n) - (v_j + w_j x R_j n), walls at rest."""
    spheres, q, _ = packing
    pairs = contacts(spheres, q, q)
    closed = np.asarray(pairs.closed)
    rng = np.random.default_rng(2)
    v = np.concatenate([rng.standard_normal((spheres.count, 6)), np.zeros((1, 6))])
    bodies, directions = np.asarray(pairs.bodies)[closed], np.asarray(pairs.directions)[closed]
    rates = np.einsum("kdbx,kbx->kd", directions, v[bodies])
    at = np.asarray(q).reshape(-1, 6)[:, :3]
    radii = np.append(np.asarray(spheres.radii), 0.0)
    for (a, b), number, found, way in zip(
        bodies, np.asarray(pairs.number)[closed], rates, directions, strict=True
    ):
        n = way[0, 0, :3]
        if b < spheres.count:
            np.testing.assert_allclose(n, (at[a] - at[b]) / np.linalg.norm(at[a] - at[b]))
        else:
            wall = np.asarray(spheres.walls)[number % (spheres.count + 3) - spheres.count]
            np.testing.assert_array_equal(n, wall[:3])
        point = v[a, :3] - radii[a] * np.cross(v[a, 3:], n)
        point -= v[b, :3] + radii[b] * np.cross(v[b, 3:], n)
        t1, t2 = way[1:, 0, :3]
        np.testing.assert_allclose(
            np.stack([n, t1, t2]) @ np.stack([n, t1, t2]).T, np.eye(3), atol=1e-15
        )
        np.testing.assert_allclose(found, [point @ n, point @ t1, point @ t2], atol=1e-14)


def test_spheres_are_a_body_like_others():
    """Gradients of gaps and tangents are those of the closed contacts; mass by 2 m R^2 / 5."""
    spheres = ji.Spheres([1.0, 2.0], [0.1, 0.2], walls=[[0.0, 0.0, 1.0, 0.0]])
    np.testing.assert_allclose(spheres.mass, [1] * 3 + [0.004] * 3 + [2] * 3 + [0.032] * 3)
    q = spheres.at([[0.0, 0.0, 0.1], [0.0, np.sqrt(0.08), 0.2]])
    gradients, tangents, pairs = jax.jit(
        lambda q: (
            jax.jacobian(spheres.gap_function)(q),
            spheres.tangents(q),
            spheres.active_pairs(q, q, jnp.asarray(1e-12)),
        )
    )(q)
    assert np.asarray(pairs.number)[:3].tolist() == [1, 2, 5]  # 3 i + j, j = 2 is the wall
    each = np.asarray(gradients).reshape(3, 1, 2, 6), np.asarray(tangents).T.reshape(3, 2, 2, 6)
    expected = np.concatenate(each, axis=1)
    for row in range(3):
        for side, body in enumerate(np.asarray(pairs.bodies)[row]):
            if body < 2:
                ours = np.asarray(pairs.directions)[row, :, side]
                np.testing.assert_allclose(ours, expected[row, :, body], atol=1e-15)


def test_walls_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"`walls` must have shape \(w, 4\)"):
        ji.Spheres(1.0, [0.1], walls=[[0.0, 1.0, 0.0]])
    with pytest.raises(ValueError, match=r"`centres` must have shape \(1, 3\)"):
        ji.Spheres(1.0, [0.1]).at([[0.0, 1.0]])


@pytest.mark.slow
def test_a_sphere_slides_and_then_rolls():
    """It ends at 5/7 of its speed, whatever the friction, at the time 2 v / (7 mu g)."""
    spheres = ji.Spheres(2.0, [0.1, 0.1], walls=[[0.0, 0.0, 1.0, 0.0]])
    system = ji.System(spheres, potential=ji.gravity(spheres))
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
    spheres = ji.Spheres(4e6 * radii**3, radii, walls=walls)
    system = ji.System(spheres, potential=ji.gravity(spheres))
    v0 = np.pad(0.1 * rng.standard_normal((27, 3)), ((0, 0), (0, 3))).reshape(-1)
    motion = ji.simulate(
        system, ji.Moreau(0.3, friction=0.5), spheres.at(0.014 + 0.024 * grid), v0, 1.5,
        samples=16, method="time_stepping", step=1e-3,
    )  # fmt: skip
    ji.raise_on_failed_motion(motion)
    speed = np.abs(np.asarray(motion.velocity[-1]).reshape(-1, 6)[:, :3])
    assert np.median(speed) < 1e-6
    assert speed.max() < 2e-2  # a last sphere may roll
    assert np.diff(np.asarray(motion.energy)).max() < 1e-8 * motion.energy[0]
    assert -1e-3 < float(np.min(motion.gaps)) < 0


# ------------------------------------------------------------------------ impacts on packings


@pytest.fixture(scope="module")
def struck():
    """Ball 1 strikes balls 2 and 3, which touch each other, on a table; ball 4 falls onto it.

    Four more make it too many contacts for the program that small scenes share.
    """
    h = np.sqrt(3)
    places = [[0, 0, 1.0], [h, 1.0, 1.0], [h, -1.0, 1.0], *([9.0 * i, 0, 1.0] for i in range(1, 6))]
    spheres = ji.Spheres([1.0, 1.0, 1.0, 2.0] + 4 * [1.0], [1.0] * 8, walls=[[0.0, 0.0, 2.0, 0.0]])
    v = np.zeros(48)
    v[[0, 20]] = 1.0, -3.0
    return spheres, spheres.at(places), v


def test_a_packing_has_the_contacts_of_its_body(struck):
    spheres, q, _ = struck
    scene, places, columns = spheres.touching(q), np.asarray(q).reshape(8, 6)[:, :3], []
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
    np.testing.assert_allclose(ji.velocity_change(scene, x), normals @ x / spheres.mass, atol=1e-14)


def test_a_packing_is_struck(struck):
    """p (2 + cos 60) = (1 + e) cos 30, and contact 2, 3 opens. v+ is linear in v-: so its derivative."""
    spheres, q, v = struck
    scene, e = spheres.touching(q), 0.5
    after, rate = jax.jvp(lambda v: ji.impact(ji.Moreau(e), scene, v).velocity, (v,), (v,))
    p = (1 + e) * np.sqrt(0.75) / 2.5
    expected = np.zeros(48)
    expected[0] = 1 - 2 * p * np.sqrt(0.75)
    expected[[6, 12]] = p * np.sqrt(0.75)
    expected[[7, 13]] = p / 2, -p / 2
    expected[20] = 3 * e
    np.testing.assert_allclose(after, expected, atol=1e-12)
    np.testing.assert_allclose(rate, expected, atol=1e-12)


def test_bad_packings_are_named(struck):
    spheres, q, _ = struck
    with pytest.raises(ValueError, match="`q` must hold bodies that touch"):
        spheres.touching(10 * q)
    with pytest.raises(ValueError, match="below"):
        spheres.touching(q, below=-1.0)
    with pytest.raises(ValueError, match="`q` must have shape"):
        spheres.touching(q[1:])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["time", "implicit"])
def test_dynamics_of_a_packing_are_those_of_the_dense_scene(struck, method):
    spheres, q, v = struck
    scene = spheres.touching(q)
    law = ji.LZB([0.9, 0.9, 0.5] + 8 * [0.7], 1e4, rtol=1e-7, method=method)
    dense = ji.impact(law, ji.Scene(scene.mass, scene.normals), v)
    sparse = ji.impact(law, scene, v)
    np.testing.assert_allclose(sparse.velocity, dense.velocity, atol=1e-6)
    assert sparse.velocity[20] == pytest.approx(2.1, abs=1e-5)
