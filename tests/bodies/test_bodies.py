"""Bodies on planes and on each other, in the plane and in space: gaps, tangents, ranges."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import piles
import pytest
from refusals import argument
from scipy.spatial.transform import Rotation

import jimpact as ji


def turned(points, angle, at=(0.0, 0.0)):
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[c, s], [-s, c]]) + at


# ------------------------------------------------------------------------------- over the ground


def test_a_block_keeps_all_its_corners():
    width, height, angle = 1.5, 2.0, 1.9  # overturned
    block = ji.Block(width, height, mass=2.0)
    scene = block.scene(block.touching(angle))
    own = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]]) * [width / 2, height / 2]
    lever = turned(own, angle)
    np.testing.assert_allclose(scene.gaps, lever[:, 1] - lever[:, 1].min(), atol=1e-15)
    ones = np.ones(4)
    np.testing.assert_allclose(scene.normals, [0 * ones, ones, lever[:, 0]], atol=1e-15)
    np.testing.assert_allclose(
        scene.tangents, [ones, 0 * ones, -lever[:, 1]], atol=1e-15
    )
    side = block.touching(np.pi / 2)
    assert side[1] == pytest.approx(width / 2, abs=1e-15)
    assert np.asarray(block.scene(side).closed).tolist() == [False, True, True, False]


def test_two_corners_have_a_range():
    """The block of the literature on rocking, until an upper corner reaches the ground."""
    block = ji.Block(1.0, 2.0, corners="base")
    assert block.gap_function(block.touching()).shape == (2,)
    assert float(block.valid(block.touching(0.3))) > 0
    fallen = jnp.array([0.0, 0.45, np.pi / 2])
    with pytest.raises(ValueError, match=argument("q", "-0.05")):
        block.scene(fallen)

    @jax.jit
    def lands(q):
        return ji.impact(
            ji.Newton(0.5), block.scene(q), jnp.array([0.0, -1.0, 0.0])
        ).status

    reported = [ji.STATUS[int(lands(q))].name for q in (block.touching(), fallen)]
    assert reported == ["ok", "not_finite"]


def test_polygons_find_their_centre_of_mass():
    """Moments of a triangle (m (a^2 + b^2 + c^2) / 36) and of a rectangle, however they are given."""
    corners = np.array([[0.0, 0.0], [1.2, 0.0], [0.3, 0.9]])
    sides = np.roll(corners, -1, axis=0) - corners
    far = ji.Polygon(turned(corners, 2.0, (300.0, -70.0)), mass=2.0)
    back = ji.Polygon(corners[::-1], mass=2.0)
    for body in (far, back):
        assert float(body.inertia) == pytest.approx(
            2 * np.sum(sides**2) / 36, rel=1e-11
        )
    np.testing.assert_allclose(
        back.corners, (corners - corners.mean(axis=0))[::-1], atol=1e-15
    )
    given = ji.Polygon(corners, inertia=0.3, centre=[0.5, 0.1])
    np.testing.assert_allclose(given.corners, corners - [0.5, 0.1], atol=1e-15)
    block, q = ji.Block(1.5, 2.0, 3.0), [0.1, 1.7, 0.4]
    same = ji.Polygon(block.corners, mass=3.0).scene(q)
    for a, b in zip(
        jax.tree.leaves(same), jax.tree.leaves(block.scene(q)), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-14)
    slope = jax.grad(lambda x: ji.Polygon(jnp.array(corners) * x, mass=2.0).inertia)(
        1.0
    )
    assert float(slope) == pytest.approx(2 * float(back.inertia), rel=1e-12)


def test_an_unbalanced_disc():
    """Its lowest point slides with the disc, at the lever arm that its centre of mass has."""
    r, off, angle = 0.5, np.array([0.1, -0.05]), 0.7
    disc = ji.Disc(r, mass=2.0, inertia=0.2, centre=off)
    scene = disc.scene(disc.touching(angle))
    lever = turned([-off], angle)[0] - [0, r]
    np.testing.assert_allclose(scene.normals[:, 0], [0, 1, lever[0]], atol=1e-15)
    np.testing.assert_allclose(scene.tangents[:, 0], [1, 0, -lever[1]], atol=1e-15)
    assert float(disc.touching(angle)[1]) == pytest.approx(-lever[1], abs=1e-15)


# ---------------------------------------------------------------- on planes and on each other

SIZES = {"low": (1.0, 0.4), "high": (0.8, 0.5)}


def wrenches(pairs, middle, directions, points):
    """(3 b, m) of unit forces (m, 2) on the first bodies, and against the second ones."""
    out = np.zeros((len(middle), 3, len(pairs)))
    for k, pair in enumerate(pairs):
        for body, sign in zip(pair, (1, -1)):
            if body >= 0:
                force, arm = directions[k], points[k] - middle[body]
                turn = arm[0] * force[1] - arm[1] * force[0]
                out[body, :, k] += sign * np.array([*force, turn])
    return out.reshape(-1, len(pairs))


def segment(p, a, b):
    share = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(p - a - share * (b - a))


def distance(first, second):
    """Of two polygons that are apart; of a point, too; None if a corner is inside."""
    ways = [(first, second), (second, first)]
    for points, other in ways:
        side = np.roll(other, -1, axis=0) - other
        for p in points:
            arm = p - other
            if len(other) > 2 and np.all(
                side[:, 0] * arm[:, 1] > side[:, 1] * arm[:, 0]
            ):
                return None
    ends = [
        (p, a, b)
        for points, c in ways
        for p in points
        for a, b in zip(c, np.roll(c, -1, 0))
    ]
    return min(segment(p, a, b) for p, a, b in ends if np.any(a != b))


@pytest.fixture(scope="module")
def heap():
    """Two blocks, a triangle, two discs: contacts of each kind at many configurations."""
    triangle = ji.Polygon([[0.0, 0.0], [1.2, 0.0], [0.3, 0.9]])
    bodies = [ji.Block(*SIZES["low"]), ji.Block(*SIZES["high"]), triangle, ji.Disc(0.2)]
    bodies += [ji.Disc(0.25, inertia=0.1, centre=[0.05, 0.02])]
    pairs = [(1, 0), (3, 4), (3, 2), (0, 4)]
    planes = [0.0, 0.3, (np.pi / 2, -3.0)]
    body = ji.Bodies(bodies, planes, pairs)
    rng = np.random.default_rng(3)
    q = rng.uniform(-1.5, 1.5, (400, 15))
    q[:, :3] = 0
    q[:, 3:5] *= [[0.8, 0.3]]
    q[:, 4] += 0.6

    def look(q):
        slopes = jax.jacobian(body.gap_function)(q)
        return body.contacts(q), slopes, body.tangents(q), body.valid(q)

    return body, triangle, q, jax.tree.map(np.asarray, jax.jit(jax.vmap(look))(q))


@pytest.mark.slow
def test_gaps_are_distances(heap):
    body, shape, q, (found, _, _, valid) = heap
    kinds = [k for k, (_, second) in enumerate(body.between) if second >= 0]
    assert [body.between[k] for k in kinds] == [(3, 4), (3, 2), (4, 0), (1, 0), (1, 0)]
    triangle, seen = np.asarray(shape.corners), 0
    for i, x in enumerate(q.reshape(-1, 5, 3)):
        at = turned(triangle, x[2, 2], x[2, :2])
        middle = x[4, :2] - turned([[0.05, 0.02]], x[4, 2])[0]
        boxes = [
            turned(
                np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(s) / 2,
                a[2],
                a[:2],
            )
            for s, a in zip(SIZES.values(), x)
        ]
        gaps = found.gap[i, kinds]
        assert gaps[0] == pytest.approx(
            np.linalg.norm(x[3, :2] - middle) - 0.45, abs=1e-14
        )
        for gap, disc, r, polygon in (
            (1, x[3, :2], 0.2, at),
            (2, middle, 0.25, boxes[0]),
        ):
            away = distance(disc[None], polygon)
            if away is not None:
                assert gaps[gap] == pytest.approx(away - r, abs=1e-14)
            else:
                assert gaps[gap] < -r
                assert valid[i] < 0
        apart = max(separation(*boxes), separation(*boxes[::-1]))
        if valid[i] >= 0 and apart > 0:
            seen += 1
            assert gaps[3:].min() == pytest.approx(polygon_distance(*boxes), abs=1e-14)
        elif valid[i] >= 0:
            assert gaps[3:].min() < 1e-12  # never reported open
    assert seen > 100


def test_forces_act_at_the_contacts(heap):
    """Gradients by differentiation are the wrenches of unit normals; tangents are across them."""
    body, _, q, (found, slopes, tangents, _) = heap
    for i in range(0, len(q), 20):
        middle, n = q[i].reshape(-1, 3)[:, :2], found.normal[i]
        np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-14)
        along = np.stack([n[:, 1], -n[:, 0]], axis=1)
        expected = [
            wrenches(body.between, middle, d, found.point[i]) for d in (n, along)
        ]
        np.testing.assert_allclose(slopes[i].T, expected[0], atol=1e-13)
        np.testing.assert_allclose(tangents[i], expected[1], atol=1e-13)


def test_a_block_on_a_slope():
    angle = 0.3
    slope = ji.Bodies([ji.Block(0.2, 0.1, mass=2.0)], [(angle, 0.4)])
    q = slope.touching(along=0.7)
    along, up = (
        np.array([np.cos(angle), np.sin(angle)]),
        np.array([-np.sin(angle), np.cos(angle)]),
    )
    np.testing.assert_allclose(q[:2], 0.7 * along + 0.45 * up, atol=1e-15)
    scene = slope.scene(q)
    np.testing.assert_allclose(scene.gaps, [0, 0, 0.1, 0.1], atol=1e-15)
    np.testing.assert_allclose(scene.normals[:, 0], [*up, 0.1], atol=1e-15)
    np.testing.assert_allclose(scene.tangents[:, 1], [*along, 0.05], atol=1e-15)
    weight = -jax.grad(slope.gravity(10.0))(q)
    np.testing.assert_allclose(weight, [0, -20, 0], atol=1e-14)


@pytest.mark.slow
def test_facing_sides_may_part():
    """A block hangs over; its contact moves to the edge below; beside it sides face sideways."""
    q = np.array([0.0, 0.5, 0.0, 0.3, 1.5, 0.0])
    stack = ji.Bodies([ji.Block(1.0, 1.0)] * 2, [0.0], [(0, 1)])
    scene = stack.scene(q)
    np.testing.assert_allclose(scene.gaps[-2:], 0, atol=1e-15)
    # the lower block's right end bears, and the upper one's left end
    levers = np.sort(np.abs(np.asarray(scene.normals)[[2, 5]][:, -2:]), axis=1)
    np.testing.assert_allclose(levers, [[0.2, 0.5], [0.2, 0.5]], atol=1e-15)
    off = np.array(
        [0.0, 0.5, 0.0, 1.2, 1.5, 0.0]
    )  # it has slid off: corner from corner
    np.testing.assert_allclose(np.min(stack.scene(off).gaps[-2:]), 0.2, atol=1e-15)
    off[4] = 0.6  # beside the other one
    np.testing.assert_allclose(np.min(stack.scene(off).gaps[-2:]), 0.2, atol=1e-15)


def segment_distance(point, begin, end):
    share = np.clip(
        (point - begin) @ (end - begin) / ((end - begin) @ (end - begin)), 0, 1
    )
    return np.linalg.norm(point - begin - share * (end - begin))


def polygon_distance(a, b):
    """Of two disjoint polygons (k, 2), from all corners to all sides."""
    return min(
        segment_distance(point, *side)
        for points, other in ((a, b), (b, a))
        for point in points
        for side in zip(other, np.roll(other, -1, axis=0))
    )


def separation(a, b):
    """The largest distance of the corners of b beyond the line of a side of a."""
    side = np.roll(a, -1, axis=0) - a
    normals = (
        np.stack([side[:, 1], -side[:, 0]], axis=1)
        / np.linalg.norm(side, axis=1)[:, None]
    )
    return max(min((b - x) @ n) for x, n in zip(a, normals))


@pytest.fixture(scope="module")
def polygons():
    """A block, a hexagon, a triangle, a pentagon, and gaps (k, 6) of three pairs of them."""
    angles = 0.2 + np.arange(6) * np.pi / 3
    around = 0.3 + np.arange(5) * 2 * np.pi / 5
    shapes = [
        ji.Block(1.0, 0.4),
        ji.Polygon(np.stack([0.5 * np.cos(angles), 0.3 * np.sin(angles)], axis=1)),
        ji.Polygon([[0, 0], [1.0, 0.1], [0.2, 0.8]]),
        ji.Polygon(np.stack([0.5 * np.cos(around), 0.4 * np.sin(around)], axis=1)),
    ]
    bodies = ji.Bodies(shapes, planes=(), pairs=[(0, 1), (2, 3), (2, 0)])

    def seen(q):
        return bodies.gap_function(q), bodies.valid(q)

    return bodies, shapes, jax.jit(jax.vmap(seen))


@pytest.mark.slow
def test_polygons_choose_their_sides(polygons):
    """Anywhere the least gap is the distance; where they overlap it is negative."""
    bodies, _, seen = polygons
    rng = np.random.default_rng(0)
    low, high = [-0.5, -0.5, 0], [0.5, 0.5, 6.3]
    q = rng.uniform(4 * low, 4 * high, (300, 12))
    apart = 0
    for x, gaps in zip(q, np.asarray(seen(jnp.asarray(q))[0]).reshape(-1, 3, 2)):
        curves = [curve[:-1] for curve in bodies.outlines(x, 0.0)]
        for (i, j), pair in zip(((0, 1), (2, 3), (2, 0)), gaps):
            a, b = curves[i], curves[j]
            between = max(separation(a, b), separation(b, a))
            if between > 0:
                apart += 1
                assert min(pair) == pytest.approx(polygon_distance(a, b), abs=1e-12)
            else:
                assert min(pair) <= between + 1e-12
    assert 50 < apart < 850


def corner_on_side(shapes, below, above, path):
    """q (k, 12) with a corner of one polygon in the middle of a side of another.

    `path`: the direction of the side's normal, and the angle of the polygon `above`. How often the
    corner has changed.
    """
    begin, end = np.asarray(shapes[below].points)[0, :2]
    slope = (
        np.arctan2(*(end - begin)[::-1]) - np.pi / 2
    )  # of its normal, in its own axes
    rows, corners = [], []
    for way, angle in path:
        own = turned(np.asarray(shapes[above].corners), angle)
        corners.append(int(np.argmin(own @ [np.cos(way), np.sin(way)])))
        q = 100.0 + 10 * np.arange(12.0)  # the others are far away
        q[3 * above : 3 * above + 3] = *-own[corners[-1]], angle
        middle = turned((begin + end) / 2, way - slope)
        q[3 * below : 3 * below + 3] = *-middle, way - slope
        rows.append(q)
    return np.array(rows), np.append(0, np.cumsum(np.diff(corners) != 0))


@pytest.mark.slow
def test_contacts_of_odd_polygons_keep_their_places(polygons):
    """Rolling through full turns: contacts change places only where the next corner touches."""
    _, shapes, seen = polygons
    s = np.linspace(0.0, 1.0, 300)[:, None]
    for below, above, column, begin, end in (
        (2, 3, 2, [0.1, 0.2], [14.0, -9.0]),  # both odd: any way around each other
        (3, 2, 2, [0.1, 0.2], [-14.0, 9.0]),
        (
            2,
            0,
            4,
            [2.1, 0.2],
            [2 * np.pi + 1.9, -15.0],
        ),  # at most once around the triangle
        (0, 2, 4, [2.1 - np.pi, 0.2], [np.pi + 1.9, -14.0]),
    ):
        q, count = corner_on_side(
            shapes, below, above, begin + s * (np.array(end) - begin)
        )
        gaps, margin = (np.asarray(x) for x in seen(jnp.asarray(q)))
        pair = np.abs(gaps[:, column : column + 2])
        np.testing.assert_allclose(pair.min(axis=1), 0.0, atol=1e-14)
        clear = pair.max(axis=1) > 1e-6
        assert clear.sum() > 290
        assert len(set(((np.argmin(pair, axis=1) + count) % 2)[clear])) == 1
        assert count[-1] > 6
        assert (margin > 0).all()
    at_cut, _ = corner_on_side(shapes, 2, 0, [[2.0, 0.2]])
    assert seen(jnp.asarray(np.repeat(at_cut, 300, axis=0)))[1][0] < 0


@pytest.mark.slow
def test_a_contact_keeps_its_place_where_sides_change():
    """A block turns about the edge of a table; beyond 45 degrees its base faces the table's side."""
    shapes = ji.Block(0.4, 0.2), ji.Block(2.0, 1.0)
    for first in ((0, 1), (1, 0)):
        pair = ji.Bodies([shapes[i] for i in first], planes=())
        places = []
        for turn in (
            -0.1,
            -0.7,
            -0.9,
            -1.5,
        ):  # its base, 0.05 m left of the middle, is at the edge
            c, s = np.cos(turn), np.sin(turn)
            middle = np.array([1.0, 0.5]) - np.array(
                [c * -0.05 - s * -0.1, s * -0.05 + c * -0.1]
            )
            q = np.stack([[*middle, turn], np.zeros(3)])[list(first)].ravel()
            gaps = np.asarray(pair.gap_function(jnp.asarray(q)))
            places.append(int(np.argmin(np.abs(gaps))))
            assert gaps[places[-1]] == pytest.approx(0.0, abs=1e-15)
            assert gaps[1 - places[-1]] > 0.01
        assert len(set(places)) == 1


# ------------------------------------------------------------------------------------- in space


@pytest.fixture(scope="module")
def brick():
    """A box with its mass off its middle over a tilted plane, at a random attitude."""
    normal = np.array([0.3, -0.2, 1.0])
    box = ji.Box(
        [0.3, 0.2, 0.1],
        mass=2.0,
        inertia=[[0.02, 0.001, 0], [0.001, 0.03, 0], [0, 0, 0.04]],
        centre=[0.02, -0.01, 0.03],
        rounding=0.02,
        normal=normal,
    )
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7])
    e = np.roll(turn.as_quat(), 1)  # scipy's scalar is the last
    q = box.at([0.1, 0.2, 0.9], e)

    @jax.jit
    def look(q, v):
        spun = (box.moved(q, v), box.rates(q, v), box.inertial_force(q, v))
        step = [box.gap_function(box.moved(q, s * v)) for s in (1e-6, -1e-6)]
        parts = (
            box.mass_matrix(q),
            box.normals(q),
            box.tangents(q),
            box.gap_function(q),
            box.valid(q),
        )
        return parts, spun, (step[0] - step[1]) / 2e-6

    v = np.array([0.3, -0.2, 0.5, 2.0, -1.0, 3.0])
    return box, turn, normal / np.linalg.norm(normal), q, v, look(q, v)


def test_contacts_of_a_box(brick):
    """Gaps, normals and tangents from rigid-body mechanics, velocities in the body's axes."""
    box, turn, n, q, _, ((mass, normals, tangents, gaps, margin), _, _) = brick
    r, off = turn.as_matrix(), np.array([0.02, -0.01, 0.03])
    signs = np.array([*itertools.product((-1, 1), repeat=3)])
    own = signs * (np.array([0.3, 0.2, 0.1]) / 2 - 0.02) - off
    np.testing.assert_allclose(q[:3], [0.1, 0.2, 0.9] + r @ off, atol=1e-15)
    np.testing.assert_allclose(
        gaps, (np.asarray(q[:3]) + own @ r.T) @ n - 0.02, atol=1e-15
    )
    first = np.array([n[2], 0, -n[0]]) / np.hypot(n[0], n[2])
    axes = {0: first, 1: np.cross(n, first)}
    for i, c in enumerate(own @ r.T):
        np.testing.assert_allclose(
            normals[:, i], [*n, *(r.T @ np.cross(c, n))], atol=1e-15
        )
        for k, t in axes.items():
            arm = r.T @ np.cross(c - 0.02 * n, t)
            np.testing.assert_allclose(tangents[:, 2 * i + k], [*t, *arm], atol=1e-15)
    np.testing.assert_allclose(mass[:3, :3], 2 * np.eye(3))
    np.testing.assert_allclose(mass[3:, 3:], box.inertia)
    assert float(margin) >= 0


def test_moments_of_inertia_of_homogeneous_solids():
    """m (b^2 + c^2) / 12 about the axis along a; 2 m r^2 / 5."""
    box = ji.Box([1.0, 2.0, 3.0], mass=6.0)
    np.testing.assert_allclose(box.inertia, [6.5, 5.0, 2.5], rtol=1e-15)
    np.testing.assert_allclose(ji.Sphere(0.5, mass=4.0).inertia, [0.4] * 3, rtol=1e-15)


def test_turning_is_exact(brick):
    """`moved` is a rotation about the body's axes, `rates` its derivative, spin does no work."""
    box, turn, _, q, v, (parts, (after, rates, spin), slopes) = brick
    e = np.roll((turn * Rotation.from_rotvec(v[3:])).as_quat(), 1)
    np.testing.assert_allclose(
        after, [*(q[:3] + v[:3]), *(e * np.sign(e @ after[3:]))], atol=1e-14
    )
    step = (
        np.asarray(box.moved(q, 1e-6 * v)) - np.asarray(box.moved(q, -1e-6 * v))
    ) / 2e-6
    np.testing.assert_allclose(rates, step, atol=1e-9)
    np.testing.assert_allclose(parts[1].T @ v, slopes, atol=1e-9)
    np.testing.assert_allclose(
        spin[3:], -np.cross(v[3:], np.asarray(box.inertia) @ v[3:])
    )
    assert abs(float(spin @ v)) < 1e-15
    small = [
        np.asarray(box.moved(q, s * v)) for s in (0.0267, 0.0268)
    ]  # the series ends between
    assert np.abs(small[1] - small[0] - 1e-4 * rates).max() < 2e-5
    weight = box.pulled(q, jax.grad(box.gravity(10.0))(q))
    np.testing.assert_allclose(weight, [0, 0, 20, 0, 0, 0], atol=1e-15)


@pytest.mark.slow
def test_a_quaternion_must_have_length_one():
    ball = ji.Sphere(0.1)
    with pytest.raises(ValueError, match=argument("turn")):
        ball.touching([2.0, 0, 0, 0])
    q = ball.touching()
    with pytest.raises(ValueError, match=argument("q")):
        ball.scene(q.at[3].set(1.01))

    @jax.jit
    def lands(q):
        v = jnp.array([1.0, 0, -1, 0, 0, 0])
        out = ji.impact(ji.Newton(0.5, friction=0.1), ball.scene(q), v)
        return out.status, out.velocity

    code, v = lands(q)
    np.testing.assert_allclose(v, [0.85, 0, 0.5, 0, 0.15 * 0.1 / 0.004, 0], atol=1e-14)
    reported = [ji.STATUS[int(x)].name for x in (code, lands(q.at[3].set(1.01))[0])]
    assert reported == ["ok", "not_finite"]


def test_other_ranges():
    """A cradle whose first ball is swung over into the third."""
    cradle = ji.PendulumCradle([1.0] * 3, 1.0, 0.1)
    assert float(cradle.valid(jnp.zeros(3))) == pytest.approx(0.2, abs=1e-15)
    assert float(cradle.valid(jnp.array([0.5, -0.9, 0.1]))) < 0


def test_every_body_can_be_drawn():
    """Outlines are curves in the plane; those of space in projection, z points up."""
    at = np.array([0.0, 0.25, 0.0, 0.5, 1.0, 0.3])
    heap = ji.Bodies([ji.Block(1.0, 0.5), ji.Disc(0.2)], [0.0, (1.57, -3.0)])
    drawn = {
        1: (ji.Polygon([[0, 0], [1, 0], [0, 1]]), np.zeros(3)),
        2: (heap, at),
        3: (ji.SpatialDimer(0.1, 0.5), np.array([0, 0, 0.5, 1, 0, 0, 0])),
    }
    sphere = (ji.Sphere(0.1), np.array([0, 0, 0.5, 1, 0, 0, 0]))
    for count, (body, q) in (*drawn.items(), (2, sphere)):
        curves = body.outlines(q, 0.01)
        assert len(curves) == count
        assert len(body.shadows(q)) == (len(q) == 7)
        assert all(curve.ndim == 2 and curve.shape[1] == 2 for curve in curves)
        owners = body.outlines_by_body(q, 0.01)
        assert len(owners) == getattr(body, "count", 1)
        assert sum(map(len, owners)) == count
    np.testing.assert_allclose(heap.floors, [[0.0, 0.0], [1.57, -3.0]], rtol=1e-15)
    box = ji.Box([0.2, 0.2, 0.2])
    aloft = np.array([0, 0, 1.0, 1, 0, 0, 0])
    (edges,) = box.outlines(aloft, 0.01)
    (shadow,) = box.shadows(aloft)
    lengths = np.linalg.norm(np.diff(edges, axis=0), axis=1)
    ends = map(tuple, edges.round(9).tolist())
    assert len({tuple(sorted(x)) for x in itertools.pairwise(ends)}) == 12
    assert lengths.max() <= 0.2
    assert shadow[:, 1].max() < edges[:, 1].min()


def test_bodies_without_contacts_and_gaps_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=argument("gap_function")):
        piles.discs(1.0, [0.1]).scene([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=argument("gap_function")):
        ji.scene_from_gaps(lambda q: q[None], [1.0], [0.5])


@pytest.mark.parametrize("q", [[0.0, 1.0, 0.0], np.zeros((0, 3))])
def test_scenes_need_rows_of_configurations(q):
    with pytest.raises(ValueError, match=argument("q")):
        ji.Block(1.0, 2.0).scenes(q)
