"""The friction solver against brute force: every outcome, how many there are, and derivatives.

Scenes of fewer contacts are padded with contacts that take no part, so that all planar questions
share one compiled program for each of the two laws, and all spatial ones another.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import CODE, OPTIMIZED
from spatial_scenes import random_boxes

from jimpact.numerics import dense
from jimpact.numerics.friction import distribute, solve
from jimpact.numerics.many_contacts import solve_many

pytestmark = pytest.mark.slow  # they compile programs of their own

PLANAR, SPATIAL, LANES = 3, 2, 128


CONTACTS = {1: PLANAR, 2: SPATIAL}


# Of the random boxes; at number 7 the first attempt finds no impulses, at the others sweeps do not.
NEARLY_FLAT = (2, 3, 5, 7, 12, 15, 16, 29, 40, 43, 53, 58, 59, 62, 76, 427)


close = np.testing.assert_allclose


def question(complementary):
    """The solver on many problems at once.

    With little optimization and without its newer fusions XLA 0.10 compiles the planar program
    wrongly: slips came out that vanish as soon as they are printed. With all optimizations both
    kinds of fusion agree.
    """
    batch = jax.vmap(lambda *problem: solve(*problem, complementary=complementary))
    return jax.jit(batch, compiler_options=OPTIMIZED)


ASK = {key: question(key[1]) for key in itertools.product((1, 2), (True, False))}


def test_friction_of_many_contacts_has_a_round_cone():
    """In space it is against the slip (3, 4), of length mu p, in every direction."""
    one = jnp.ones((1, 3))
    rate, mu, start = jnp.array([[-1.0, 3.0, 4.0]]), jnp.array(0.5), 0 * one
    solution = solve_many(lambda x: x, one, rate, mu, start, jnp.array(1.0), 1e-9, 1000)
    close(solution.impulse, [[1.0, -0.3, -0.4]], atol=1e-8)


def padded(rows, scenes):
    """Lanes of (A, a, b, mu) from scenes of (A, a, b, mu) with fewer contacts."""
    most = CONTACTS[rows]
    lanes = []
    for a, normal, slip, mu in scenes:
        m = len(normal)
        index = np.concatenate([np.arange(m), most + np.arange(rows * m)])
        matrix = np.eye((1 + rows) * most)
        matrix[np.ix_(index, index)] = a
        lanes.append(
            (
                matrix,
                np.pad(normal, (0, most - m)),
                np.pad(slip, (0, rows * (most - m))),
                np.pad(mu, (0, most - m)),
            )
        )
    lanes += [lanes[-1]] * (LANES - len(lanes))
    return [np.stack(x) for x in zip(*lanes, strict=True)]


def random_scene(rng, m, rows, most_mu=1.5):
    size = (1 + rows) * m
    directions = rng.normal(size=(size + 1, size))
    v = rng.normal(size=size + 1)
    gap = directions.T @ v
    return (
        directions.T @ directions,
        1.5 * gap[:m],
        1.1 * gap[m:],
        rng.uniform(0, most_mu, m),
    )


def random_scenes(rows, seed=1):
    rng = np.random.default_rng(seed)
    counts = np.arange(LANES) % CONTACTS[rows] + 1
    return padded(rows, [random_scene(rng, m, rows) for m in counts])


def rates(lanes, found):
    x = np.concatenate([found.normal, found.tangential], axis=1)
    return x, np.concatenate(lanes[1:3], axis=1) + np.einsum("bij,bj->bi", lanes[0], x)


def outcomes(a, normal, slip, mu, complementary):
    """Velocities of all planar modes that are consistent."""
    m, given, found = len(mu), np.concatenate([normal, slip]), []
    for modes in itertools.product((0, 1, -1, None), repeat=m):
        matrix, right, unit = a.copy(), -given, np.eye(2 * m)
        for i, xi in enumerate(modes):
            if xi != 0:
                matrix[m + i], right[m + i] = unit[m + i], 0.0
                matrix[m + i, i] = 0.0 if xi is None else mu[i] * xi
            if xi is None and complementary:
                matrix[i], right[i] = unit[i], 0.0
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        x = np.linalg.solve(matrix, right)
        w = a @ x + given
        room = 1e-9 * (1 + np.abs(x).max())
        p, side, r, s = x[:m], x[m:], w[:m], w[m:]
        fits = all(
            (r[i] >= -room if complementary else p[i] <= room)
            if xi is None
            else p[i] >= -room
            and (xi * s[i] >= -room if xi else abs(side[i]) <= mu[i] * p[i] + room)
            for i, xi in enumerate(modes)
        )
        if fits and not any(np.abs(w - other).max() < 1e3 * room for other in found):
            found.append(w)
    return found


@pytest.mark.parametrize(
    "complementary", [pytest.param(True, marks=pytest.mark.release), False]
)
def test_planar_outcomes_are_those_of_brute_force(complementary):
    seen = {"several_outcomes": 0, "ok": 0, "infeasible": 0}
    rng = np.random.default_rng(2)
    scenes = [random_scene(rng, 1 + i % 3, 1, 3.0) for i in range(LANES)]
    lanes = padded(1, scenes)
    found = ASK[1, complementary](*lanes)
    x, w = rates(lanes, found)
    for i, (a, normal, slip, mu) in enumerate(scenes):
        m, all_of_them = len(mu), outcomes(a, normal, slip, mu, complementary)
        expected = ("infeasible", "ok", "several_outcomes")[min(len(all_of_them), 2)]
        assert int(found.status[i]) == CODE[expected]
        seen[expected] += 1
        if all_of_them:
            own = w[i][np.r_[:m, PLANAR : PLANAR + m]]
            assert (
                min(np.abs(own - one).max() for one in all_of_them)
                <= 1e-11 * np.abs(x[i]).max()
            )
    assert seen["several_outcomes"] >= 3


def misfit(lanes, found, rows, complementary):
    """How far outcomes are from the law: complementarity, the disc, and greatest dissipation."""
    x, w = rates(lanes, found)
    m = lanes[3].shape[1]
    p, r = x[:, :m], w[:, :m]
    side, slip = (y[:, m:].reshape(-1, m, rows) for y in (x, w))
    bound = lanes[3] * np.maximum(p, 0)
    normal = np.abs(np.minimum(p, r) if complementary else r)
    outside = np.linalg.norm(side, axis=2) - bound
    power = np.abs(bound * np.linalg.norm(slip, axis=2) + np.sum(side * slip, axis=2))
    return np.maximum(np.maximum(normal, outside), power).max(axis=1) / (
        1 + np.abs(x).max(axis=1)
    )


@pytest.mark.release
@pytest.mark.parametrize(
    "complementary", [True, pytest.param(False, marks=pytest.mark.release)]
)
def test_spatial_outcomes_satisfy_the_law(complementary):
    lanes = random_scenes(2)
    found = ASK[2, complementary](*lanes)
    solved = np.asarray(found.status) <= CODE["several_outcomes"]
    assert solved.mean() > 0.98
    assert misfit(lanes, found, 2, complementary)[solved].max() < 1e-10
    side = np.linalg.norm(
        np.asarray(found.tangential).reshape(LANES, SPATIAL, 2), axis=2
    )
    sticks = (side < 0.99 * lanes[3] * found.normal).sum()
    assert 20 < sticks < LANES  # both modes are there


def test_a_scene_in_space_may_have_several_outcomes():
    """Planar scenes that do, with a second tangential direction that nothing moves along."""
    rng = np.random.default_rng(4)
    scenes = []
    while len(scenes) < 8:
        a, normal, slip, mu = random_scene(rng, 2, 1, 3.0)
        if len(outcomes(a, normal, slip, mu, True)) > 1:
            index = np.array([0, 1, 2, 4])
            matrix = np.eye(6)
            matrix[np.ix_(index, index)] = a
            scenes.append((matrix, normal, np.array([slip[0], 0, slip[1], 0]), mu))
    found = ASK[2, True](*padded(2, scenes))
    assert (np.asarray(found.status)[:8] == CODE["several_outcomes"]).all()


def test_a_block_lying_flat_shares_by_its_load():
    """Both tangential directions are the same: only the sum of what the corners hold counts."""
    rng = np.random.default_rng(5)
    for rows in (1, 2):
        scenes, loads = [], rng.uniform(0.2, 1, (LANES, 2))
        hold = 0.5 * loads.sum(axis=1)  # with mu = 1 half of what friction could
        for load, push in zip(loads, hold, strict=True):
            side = np.kron(np.ones((2, 2)), np.eye(rows))
            a = np.block(
                [[np.eye(2), np.zeros((2, 2 * rows))], [np.zeros((2 * rows, 2)), side]]
            )
            scenes.append((a, -load, -push * np.tile(np.eye(rows)[0], 2), np.ones(2)))
        found = ASK[rows, True](*padded(rows, scenes))
        assert (np.asarray(found.status) == CODE["impulse_not_unique"]).all()
        close(found.normal[:, :2], loads, rtol=1e-13)
        side = np.asarray(found.tangential)[:, [0, rows]]
        close(side, 0.5 * loads, rtol=1e-12)


def test_redundant_supports_press_least():
    """Three contacts in a line under one body, no slip: p of least norm, where it may push."""
    x = np.array([-1.0, 0.0, 1.0])
    normals = np.stack([np.ones(3), x])  # height and turn
    a = np.eye(6)
    a[:3, :3] = normals.T @ normals
    rng = np.random.default_rng(6)
    loads = normals.T @ np.stack([-np.ones(LANES), rng.uniform(-1.4, 1.4, LANES)])
    zero = np.zeros(3)
    lanes = padded(1, [(a, load, zero, zero) for load in loads.T])
    found = ASK[1, True](*lanes)
    norm = np.sqrt(np.diag(a)[:3])  # least are the normalized impulses |grad f| p
    least = -np.linalg.pinv(a[:3, :3] / norm) @ loads / norm[:, None]
    pushes = (least > 0).all(axis=0)
    close(np.asarray(found.normal)[pushes], least.T[pushes], atol=1e-12)
    assert misfit(lanes, found, 1, True).max() < 1e-10
    assert 0 < pushes.sum() < LANES


def nearly_flat(i):
    """A, (a, b) and mu of four corners, contact by contact, and of a fifth that takes no part."""
    mass, normals, tangents, velocity, e, mu = (
        x[i] for x in random_boxes("nearly flat", i + 1)
    )
    ways = np.concatenate(
        [normals[:, :, None], tangents.reshape(6, 4, 2)], axis=2
    ).reshape(6, 12)
    speed = (ways.T @ velocity).reshape(4, 3) * [1 + e, 1, 1]
    a = ways.T @ np.linalg.solve(mass, ways)
    whole = np.eye(15)
    whole[:12, :12] = a / np.diag(a).mean()
    rate = np.pad(speed / np.abs(speed).max(), ((0, 1), (0, 0)))
    return whole.reshape(5, 3, 5, 3), rate, np.append(np.full(4, mu), 0.3)


@pytest.mark.release
def test_four_corners_that_nearly_stick_have_impulses():
    """They must slip, by as little as 1e-6 of their speed: sweeps over the contacts find none."""
    lanes = [np.stack(x) for x in zip(*map(nearly_flat, NEARLY_FLAT), strict=True)]

    order = np.concatenate([np.arange(0, 15, 3), np.delete(np.arange(15), np.s_[::3])])
    matrix = lanes[0].reshape(-1, 15, 15)[:, order[:, None], order]
    rate = lanes[1].reshape(-1, 15)[:, order]
    found = ASK[2, True](matrix, rate[:, :5], rate[:, 5:], lanes[2])
    assert np.asarray(found.status).max() <= CODE["several_outcomes"]
    lanes = matrix, rate[:, :5], rate[:, 5:], lanes[2]
    assert misfit(lanes, found, 2, True).max() < 1e-9
    assert np.asarray(found.normal)[:, 4].max() < 1e-9


def along(rows):
    """First and second derivatives of a weighted sum along a direction: reverse, and its forward."""

    def one(start, way, weight):
        def at(h):
            given = jax.tree.map(lambda x, dx: x + h * dx, start, way)
            found = solve(*given, complementary=True)
            return jnp.concatenate([found.normal, found.tangential]) @ weight

        return jax.jvp(jax.grad(at), (jnp.zeros(()),), (jnp.ones(()),))

    return jax.jit(jax.vmap(one))


@pytest.mark.release
@pytest.mark.parametrize("rows", [1, pytest.param(2, marks=pytest.mark.release)])
def test_derivatives(rows):
    rng = np.random.default_rng(7)
    lanes = random_scenes(rows, seed=8)
    m = CONTACTS[rows]
    there = lanes[3] > 0
    every = np.concatenate([there, np.repeat(there, rows, axis=1)], axis=1)
    way = [rng.normal(size=x.shape) for x in lanes]
    way[0] = (way[0] + way[0].transpose(0, 2, 1)) * every[:, :, None] * every[:, None]
    way = [way[0], way[1] * there, way[2] * every[:, m:], way[3] * there]
    weight = rng.normal(size=every.shape)
    slope, bend = along(rows)(lanes, way, weight)

    def values(h):
        found = ASK[rows, True](*(x + h * dx for x, dx in zip(lanes, way, strict=True)))
        x = np.concatenate([found.normal, found.tangential], axis=1)
        return np.sum(x * weight, axis=1), np.asarray(found.status)

    h = 2e-4
    (low2, s0), (low, _), (mid, s1), (high, _), (high2, s2) = (
        values(k * h) for k in (-2, -1, 0, 1, 2)
    )
    first = (8 * (high - low) - (high2 - low2)) / (12 * h)
    second = (16 * (high + low) - (high2 + low2) - 30 * mid) / (12 * h**2)
    # generic lanes: one outcome, and no change of modes within the differences
    size = 1 + np.abs(second)
    rough = (high - 2 * mid + low) / h**2
    smooth = (np.abs(rough - second) < 1e-3 * size) & ((s0 + s1 + s2) == 0)
    assert smooth.mean() > 0.8
    close((slope / size)[smooth], (first / size)[smooth], atol=1e-8)
    close((bend / size)[smooth], (second / size)[smooth], atol=1e-4)


def definite(rng, n, count):
    """Random symmetric positive definite matrices (n, n, count)."""
    a = rng.normal(size=(count, n, n))
    return np.moveaxis(a @ a.transpose(0, 2, 1) + 0.1 * np.eye(n), 0, -1)


@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_dense_solves_are_those_of_numpy(n):
    """In a batch; systems, inverses, products and least solutions of singular systems."""
    rng = np.random.default_rng(n)
    k, right = definite(rng, n, 5), rng.normal(size=(n, 2, 5))
    thin = rng.normal(size=(5, n, max(n - 1, 1)))
    singular = np.moveaxis(thin @ thin.transpose(0, 2, 1), 0, -1)
    held = np.ones((n, 5), bool)
    held[0, 2:] = n == 1
    each = range(5)

    @jax.jit
    def run(k, right, singular, held):
        one = dense.solve_definite(k[..., 0], right[..., 0])
        pseudo = dense.pseudoinverse(singular, held)
        return (
            dense.solve(k, right),
            dense.inverse(k),
            dense.product(k, right),
            one,
            pseudo,
        )

    x, inverse, product, one, pseudo = run(k, right, singular, held)
    for i in each:
        close(k[..., i] @ x[..., i], right[..., i], atol=1e-10)
        close(inverse[..., i] @ k[..., i], np.eye(n), atol=1e-10)
        close(product[..., i], k[..., i] @ right[..., i], atol=1e-12)
        matrix = singular[..., i] * np.outer(held[:, i], held[:, i])
        close(
            matrix @ pseudo[..., i] @ matrix, matrix, atol=1e-6
        )  # what velocities depend on
        # the shares of redundant forces are the least ones to some percent: a null space of
        # rounding is divided by its root
        least = np.linalg.pinv(matrix, rcond=1e-9) @ matrix
        close(pseudo[..., i] @ matrix, least, atol=0.05)
    close(one, x[..., 0], atol=1e-10)


def test_shares_of_redundant_forces():
    """In proportion to the load; none below the least, none without load."""
    limit = jnp.array([[2.0, 0.0], [0.5, 0.0]])
    close(dense.load_shares(limit), [[1.0, 0.0], [0.25, 0.0]])
    close(dense.load_shares(limit, 0.3), [[1.0, 0.3], [0.3, 0.3]])


def test_programs_do_not_grow_with_the_contacts():
    """Beyond products that are written out, more contacts need no more operations."""

    def operations(n):
        k, x = jnp.ones((n, n, 3)), jnp.ones((n, 3))
        asked = jnp.ones((n, 3), bool)
        programs = (
            (lambda k, x: dense.solve(k, x[:, None]), k, x),
            (lambda k, x: dense.pseudoinverse(k, x > 0), k, x),
            (lambda k, x: distribute(k, x, x, asked), k, x),
        )
        return [jax.jit(f).lower(*given).as_text().count("=") for f, *given in programs]

    written_out = dense.COLUMNS_WRITTEN_OUT
    assert operations(written_out + 4) == operations(written_out + 1)
    assert written_out <= 12
