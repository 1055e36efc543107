"""Han and Gilmore's tree: every elastic outcome, against closed forms and exact fractions."""

import itertools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import argument

import jimpact as ji
from jimpact import han_gilmore


def solve(a, b):
    """Gauss-Jordan in fractions; None where singular."""
    rows = [[*r, x] for r, x in zip(a, b)]
    for i in range(len(rows)):
        pivot = next((k for k in range(i, len(rows)) if rows[k][i] != 0), None)
        if pivot is None:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for k in range(len(rows)):
            if k != i:
                rows[k] = [x - rows[k][i] * y for x, y in zip(rows[k], rows[i])]
    return [r[-1] for r in rows]


def exact_tree(masses, v, e=1):
    """All outcomes of a chain without walls, in exact arithmetic and without merging."""
    m = [Fraction(x) for x in masses]
    n = len(m)
    found = set()

    def gaps(v):
        return [b - a for a, b in itertools.pairwise(v)]

    w = [
        [
            (1 / m[i] + 1 / m[i + 1])
            if i == j
            else (-1 / m[max(i, j)] if abs(i - j) == 1 else 0)
            for j in range(n - 1)
        ]
        for i in range(n - 1)
    ]

    def visit(v):
        gamma = gaps(v)
        if min(gamma) >= 0:
            found.add(v)
            return
        must = [j for j, x in enumerate(gamma) if x < 0]
        may = [j for j, x in enumerate(gamma) if x == 0]
        for k in range(len(may) + 1):
            for extra in itertools.combinations(may, k):
                active = sorted([*must, *extra])
                p = solve(
                    [[w[i][j] for j in active] for i in active],
                    [-(1 + e) * gamma[j] for j in active],
                )
                if p is None or min(p) <= 0:
                    continue
                after = list(v)
                for j, x in zip(active, p):
                    after[j] -= x / m[j]
                    after[j + 1] += x / m[j + 1]
                visit(tuple(after))

    visit(tuple(Fraction(x) for x in v))
    return found


def as_set(outcomes):
    return {tuple(np.round(o.velocity, 8) + 0.0) for o in outcomes}


@pytest.mark.parametrize(
    ("masses", "v", "count"),
    [
        ((1, 1, 1), (1, 0, 0), 2),
        ((1, 1, 1, 1), (1, 0, 0, 0), 4),
        ((1, 1, 1, 1, 1), (1, 0, 0, 0, 0), 12),
        ((1, 1, 1, 1, 1), (1, 1, 0, 0, 0), None),
        ((2, 1, 3, 1), (1, 0, 0, -1), None),
        ((1, 2, 1, 2), (3, 1, 1, 0), None),
    ],
)
def test_the_tree_is_exhaustive(masses, v, count):
    exact = exact_tree(masses, v)
    found = han_gilmore(ji.chain(np.array(masses, float)), np.array(v, float))
    assert count is None or len(found) == count
    assert len(found) == len(as_set(found)) == len(exact) > 1
    assert as_set(found) == {
        tuple(np.round([float(x) for x in v], 8) + 0.0) for v in exact
    }


def test_three_balls_and_the_rules_that_led_there():
    together, one_by_one = han_gilmore(ji.chain(jnp.ones(3)), [1.0, 0.0, 0.0])
    np.testing.assert_allclose(together.velocity, [-1 / 3, 2 / 3, 2 / 3], atol=1e-14)
    np.testing.assert_allclose(together.impulse, [4 / 3, 2 / 3], atol=1e-14)
    assert together.rules == ("p > 0 at 0 (approaching), 1 (at rest)",)
    np.testing.assert_allclose(one_by_one.velocity, [0, 0, 1], atol=1e-14)
    np.testing.assert_allclose(one_by_one.impulse, [1, 1], atol=1e-14)
    assert one_by_one.rules == (
        "p > 0 at 0 (approaching); p = 0 at 1 (at rest)",
        "p > 0 at 1 (approaching); p = 0 at 0 (separating)",
    )


def check(scene, v, outcomes):
    """What every outcome must satisfy on the contacts that take part."""
    energy = float(ji.kinetic_energy(scene, v))
    for found in outcomes:
        assert float(ji.kinetic_energy(scene, found.velocity)) == pytest.approx(
            energy, rel=1e-12
        )
        gamma = np.asarray(ji.gap_velocity(scene, found.velocity))
        assert (gamma[np.asarray(scene.closed)] >= -1e-9).all()
        assert (found.impulse >= 0).all()
        assert not found.impulse[~np.asarray(scene.closed)].any()
        jump = np.asarray(ji.velocity_change(scene, jnp.asarray(found.impulse)))
        np.testing.assert_allclose(np.asarray(v) + jump, found.velocity, atol=1e-10)


def test_random_scenes():
    rng = np.random.default_rng(3)
    for _ in range(20):
        n = int(rng.integers(2, 5))
        scene = ji.chain(10.0 ** rng.uniform(-1, 1, n), wall=bool(rng.integers(2)))
        v = rng.integers(-1, 2, n).astype(float)  # many contacts at rest
        outcomes = han_gilmore(scene, v)
        assert outcomes
        check(scene, v, outcomes)


def test_wall_and_constraint_and_general_mass():
    wall = ji.chain([2.0, 1.0], wall=True)
    outcomes = han_gilmore(wall, [1.0, 1.0])
    check(wall, [1.0, 1.0], outcomes)
    assert len(outcomes) == 2
    np.testing.assert_allclose(outcomes[0].velocity, [-1, -1], atol=1e-14)
    np.testing.assert_allclose(outcomes[1].velocity, [-11 / 9, -1 / 9], atol=1e-14)
    full = ji.Scene(
        np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[1.0, -0.4], [-0.3, 0.9]])
    )
    check(full, [-1.0, 0.2], han_gilmore(full, [-1.0, 0.2]))
    # two bodies tied together act as one: a ball of mass 1 hits a pair of mass 2
    tied = ji.Scene(
        [1.0, 1.0, 1.0], [[-1.0], [1.0], [0.0]], constraints=[[0.0], [1.0], [-1.0]]
    )
    (found,) = han_gilmore(tied, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.velocity, [-1 / 3, 2 / 3, 2 / 3], atol=1e-14)


def test_open_contacts_are_left_out_and_nothing_may_happen():
    scene = ji.chain(jnp.ones(3), gaps=jnp.array([0.0, 0.1]))
    (found,) = han_gilmore(scene, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.velocity, [0, 1, 0], atol=1e-14)
    assert found.rules == ("p > 0 at 0 (approaching)",)
    (still,) = han_gilmore(scene, [0.0, 0.0, -1.0])
    assert still.rules == ()
    assert list(still.velocity) == [0.0, 0.0, -1.0]
    assert not still.impulse.any()


def test_redundant_contacts_share_the_impulse():
    twice = ji.Scene([1.0, 1.0], [[-1.0, -1.0], [1.0, 1.0]])
    (found,) = han_gilmore(twice, [1.0, 0.0])
    np.testing.assert_allclose(found.velocity, [0, 1], atol=1e-14)
    np.testing.assert_allclose(found.impulse, [0.5, 0.5], atol=1e-14)


def test_where_the_rules_leave_nothing():
    # obtuse kinetic angle: the slowly approaching contact would have to pull
    cosine = 0.25
    scene = ji.Scene([1.0, 1.0], [[1.0, cosine], [0.0, np.sqrt(1 - cosine**2)]])
    v = np.linalg.solve(np.asarray(scene.normals).T, [-1.0, -0.1])
    assert han_gilmore(scene, v) == []
    # a ball between two walls: back and forth
    assert han_gilmore(ji.chain([1.0], wall="both"), [1.0]) == []


def test_scale_does_not_matter():
    masses, v = np.array([1.0, 2.0, 0.5, 1.0]), np.array([1.0, 0.0, 0.0, -0.5])
    base = han_gilmore(ji.chain(masses), v)
    for speed, mass in [(1e6, 1.0), (1e-6, 1e6), (1.0, 1e-6)]:
        other = han_gilmore(ji.chain(masses * mass), v * speed)
        assert len(other) == len(base)
        for a, b in zip(base, other):
            np.testing.assert_allclose(b.velocity / speed, a.velocity, atol=1e-12)
            assert a.rules == b.rules


def test_single_precision_scenes_are_resolved_in_double():
    masses, v = np.full(5, 0.1, np.float32), np.eye(5, dtype=np.float32)[0]
    single = ji.chain(jnp.asarray(masses))
    assert single.mass.dtype == jnp.float32
    assert len(han_gilmore(single, v)) == 12


def test_bad_input():
    balls = ji.chain(jnp.ones(3))
    with pytest.raises(ValueError, match="velocity"):
        han_gilmore(balls, [1.0, 0.0])
    with pytest.raises(ValueError, match="velocity"):
        han_gilmore(balls, [1.0, np.nan, 0.0])
    for depth in (0, -1, 2.5, True):
        with pytest.raises(ValueError, match="max_depth"):
            han_gilmore(balls, [1.0, 0.0, 0.0], max_depth=depth)
    with pytest.raises(RuntimeError, match="max_depth"):
        han_gilmore(balls, [1.0, 0.0, 0.0], max_depth=1)
    assert len(han_gilmore(balls, [1.0, 0.0, 0.0], max_depth=2)) == 2
    with pytest.raises(TypeError, match="host"):
        jax.jit(lambda v: han_gilmore(balls, v)[0].velocity)(jnp.ones(3))


# ------------------------------------------------------------------------ losses and friction


@pytest.mark.parametrize("masses", [(1, 1, 1), (2, 1, 3), (1, 2, 1)])
def test_losses_in_exact_arithmetic(masses):
    e = Fraction(1, 2)
    exact = exact_tree(masses, (1, 0, 0), e)
    found = han_gilmore(ji.chain(np.array(masses, float)), [1.0, 0, 0], 0.5)
    assert as_set(found) == {
        tuple(np.round([float(x) for x in v], 8) + 0.0) for v in exact
    }
    assert not any(outcome.endless for outcome in found)
    energies = [
        float(ji.kinetic_energy(ji.chain(np.array(masses, float)), o.velocity))
        for o in found
    ]
    assert max(energies) < 0.5 * masses[0]


def test_plastic_balls_collide_without_end_and_it_says_so():
    """e = 0: both contacts at once end at 1/3 each; one after another there in the limit."""
    (found,) = han_gilmore(ji.chain(jnp.ones(3)), [1.0, 0, 0], 0.0)
    np.testing.assert_allclose(found.velocity, 1 / 3, atol=1e-9)
    assert found.endless
    (pair,) = han_gilmore(ji.chain(jnp.ones(2)), [1.0, 0], 0.0)
    assert not pair.endless
    (walls,) = han_gilmore(ji.chain([1.0], wall="both"), [1.0], 0.5)
    assert walls.endless


def test_friction_of_one_contact():
    """A disc of radius 1 that falls on its rim: it slides if mu is less than half of that of sticking."""
    inertia = 0.5
    scene = ji.Scene([1.0, 1.0, inertia], [[0.0], [1], [0]], tangents=[[1.0], [0], [1]])
    v = np.array([1.0, -1.0, 0.2])
    slip, ease = 1.2, 1 + 1 / inertia
    for mu, p_t in ((0.1, -0.1 * 1.5), (1.0, -slip / ease)):
        (found,) = han_gilmore(scene, v, 0.5, mu)
        np.testing.assert_allclose(
            found.velocity, [1 + p_t, 0.5, 0.2 + p_t / inertia], atol=1e-12
        )
        np.testing.assert_allclose(found.tangential_impulse, [p_t], atol=1e-12)
        assert ("slides forward" in found.rules[0]) == (mu == 0.1)
        assert ("sticks" in found.rules[0]) == (mu == 1.0)


def test_friction_of_a_block_on_two_corners():
    """Impulses in Coulomb's cones, admissible ends; without friction the tree of no friction."""
    block, v = ji.Block(1.0, 2.0, corners="base").scene(), [0.4, -1.0, 0.6]
    without = han_gilmore(block, v, 0.6)
    assert as_set(han_gilmore(block, v, 0.6, 0.0)) == as_set(without)
    found = han_gilmore(block, v, 0.6, [0.3, 0.5])
    assert found
    start = float(ji.kinetic_energy(block, v))
    for outcome in found:
        assert (
            np.abs(outcome.tangential_impulse) <= [0.3, 0.5] * outcome.impulse + 1e-9
        ).all()
        assert (ji.gap_velocity(block, outcome.velocity) >= -1e-9).all()
        assert float(ji.kinetic_energy(block, outcome.velocity)) < start
        push = np.asarray(block.normals) @ outcome.impulse
        push += np.asarray(block.tangents) @ outcome.tangential_impulse
        np.testing.assert_allclose(
            v + push / np.asarray(block.mass), outcome.velocity, atol=1e-12
        )
    assert np.abs(found[0].velocity - without[0].velocity).max() > 0.01


def test_bad_coefficients():
    balls = ji.chain(jnp.ones(3))
    with pytest.raises(ValueError, match=argument("restitution", "1.2")):
        han_gilmore(balls, [1.0, 0, 0], 1.2)
    with pytest.raises(ValueError, match=argument("restitution")):
        han_gilmore(balls, [1.0, 0, 0], [0.5] * 3)
    with pytest.raises(ValueError, match=argument("scene")):
        han_gilmore(balls, [1.0, 0, 0], 0.5, 0.1)
    with pytest.raises(ValueError, match="`friction`"):
        han_gilmore(ji.Block(1.0, 2.0, corners="base").scene(), [0.0, -1, 0], 0.5, -0.1)
