"""Contacts that W does not couple, solved in groups, beside the same scene solved whole."""

from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact import impacts
from jimpact.contact import coupled_groups
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.status import CODE


def normals_of(*chains):
    """Normals of separate chains `(balls, wall)` in one scene."""
    columns, first = [], 0
    bodies = sum(balls for balls, _ in chains)
    for balls, wall in chains:
        for left in range(first, first + balls - 1 + wall):
            columns.append(np.zeros(bodies))
            columns[-1][left] = -1.0
            if left + 1 < first + balls:
                columns[-1][left + 1] = 1.0
        first += balls
    return np.stack(columns, axis=1)


def groups_of(scene):
    """Groups as sets, from all arrays; what only fills a row up is left out."""
    rows = [row for array in coupled_groups(scene) for row in array.tolist()]
    return sorted(sorted(i for i in row if i < scene.contacts) for row in rows)


# a pair, three balls, a ball at a wall, another pair; contacts in any order
ORDER = np.array([3, 1, 4, 0, 2])
NORMALS = normals_of((2, False), (3, False), (1, True), (2, False))[:, ORDER]
MASS = np.linspace(1.0, 2.0, 8)
MIXED = ji.Scene(MASS, NORMALS)
V = jnp.array(
    [
        [1.0, -0.5, 1.0, 0.2, -1.0, 0.7, 0.1, 0.5],  # the last pair separates
        [-1.0, 0.5, 0.0, 0.0, -1.0, -0.7, 1.0, 0.5],  # the first one and the ball at the wall, too
        [0.1, 0.2, 0.3, 0.4, 0.5, -0.6, 0.7, 0.8],  # all of them
    ]
)
E = jnp.array([0.9, 0.5, 0.7, 0.3, 0.8])
K = jnp.array([1.0, 2.0, 0.5, 3.0, 1.5])
STORED = jnp.array([0.0, 0.0, 0.1, 0.0, 0.0])  # in the last pair
SLOW = {"lzb-reverse", "moreau-forward", "poisson"}  # to compile


def lzb(e, k):
    return ji.LZB(e, k, 1.5, initial_energy=STORED)


LAWS = {  # makers, tolerance of their outcome, mode of the derivatives compared
    "lzb": (lzb, 1e-7, None),
    "lzb-reverse": (lzb, 1e-7, jax.grad),
    "newton": (lambda e, k: ji.Newton(e), 1e-12, jax.grad),
    "newton-forward": (lambda e, k: ji.Newton(e), 1e-12, jax.jacfwd),
    "moreau": (lambda e, k: ji.Moreau(e), 1e-12, None),
    "moreau-forward": (lambda e, k: ji.Moreau(e), 1e-12, jax.jacfwd),
    "poisson": (lambda e, k: ji.Poisson(e), 1e-12, None),
}


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.slow] * (x in SLOW)) for x in LAWS]
)
def test_by_groups_as_whole(name):
    make, tolerance, derivative = LAWS[name]

    def result(v, mass, scene):
        def one(e, k, mass, v):
            out = ji.impact(make(e, k), of_mass(scene, mass), v)
            return jnp.vdot(jnp.linspace(1.0, 2.0, len(v)), out.velocity), out

        if derivative is None:
            return (), one(E, K, mass, v)[1]
        return derivative(one, (0, 1, 2, 3), has_aux=True)(E, K, mass, v)

    batch = jax.vmap(result, in_axes=(0, None, None))
    slopes, out = jax.jit(lambda v, mass: batch(v, mass, MIXED))(V, MASS)
    slopes_whole, out_whole = jax.jit(batch)(V, MASS, MIXED)
    for a, b in zip(jax.tree.leaves(out), jax.tree.leaves(out_whole)):
        np.testing.assert_allclose(a, b, atol=tolerance)
    for a, b in zip(slopes, slopes_whole):
        np.testing.assert_allclose(a, b, atol=10 * tolerance)
    np.testing.assert_array_equal(out.status, out_whole.status)


def of_mass(scene, mass):
    """The scene with another mass; what is known of its normals stays known."""
    return eqx.tree_at(lambda s: s.mass, scene, mass)


def test_groups_are_found():
    assert groups_of(MIXED) == [[0], [1, 4], [2], [3]]


def test_a_wrong_group_shows():
    law, v, found = ji.Newton(0.5), V[0], coupled_groups(MIXED)
    whole = impacts._impact(law, MIXED, v, None).velocity
    np.testing.assert_allclose(impacts._impact(law, MIXED, v, found).velocity, whole, atol=1e-14)
    apart = np.array([4, 1, 2, 3, 0])  # one contact of the three balls in another's group
    wrong = tuple(apart[array % 5] + array // 5 * 5 for array in found)
    assert jnp.abs(impacts._impact(law, MIXED, v, wrong).velocity - whole).max() > 0.01


def test_what_couples():
    pairs = normals_of((2, False), (2, False), (2, False))
    assert groups_of(ji.Scene(np.ones(6), pairs)) == [[0], [1], [2]]
    mass = np.eye(6)
    mass[1, 4] = mass[4, 1] = 0.5  # a body of the first pair with one of the last
    assert groups_of(ji.Scene(mass, pairs)) == [[0, 2], [1]]
    held = np.array([[0.0], [1.0], [-1.0], [0.0], [0.0], [0.0]])
    assert groups_of(ji.Scene(np.ones(6), pairs, constraints=held)) == [[0, 1], [2]]
    row = np.asarray(ji.chain(jnp.ones(6)).normals)
    assert coupled_groups(ji.Scene(np.ones(6), row)) is None
    assert groups_of(ji.Scene(np.ones(6), row, gaps=[0.0, 0, 1, 0, 0])) == [[0, 1], [3, 4]]
    assert groups_of(ji.Scene(np.ones(6), row, gaps=[0.0, 0, 0, 0, 1])) == [[0, 1, 2, 3]]
    assert coupled_groups(ji.Scene(np.ones(6), row, gaps=np.ones(5))) is None
    assert coupled_groups(ji.chain(jnp.ones(6), gaps=[0.0, 0, 1, 0, 0])) is None


def test_long_chains_hang_together_in_any_order():
    order = np.random.default_rng(0).permutation(61)
    normals = normals_of((41, False), (21, True))[:, order]
    parts = [sorted(np.flatnonzero(order < 40)), sorted(np.flatnonzero(order >= 40))]
    assert groups_of(ji.Scene(np.ones(62), normals)) == sorted(parts)


def test_small_groups_do_not_grow_as_large_as_one_large_group():
    normals = normals_of(*[(2, False)] * 6, (9, False), (3, False))
    shapes = [array.shape for array in coupled_groups(ji.Scene(np.ones(24), normals))]
    assert shapes == [(7, 2), (1, 8)]


def test_traced_scenes_are_solved_whole():
    seen = []

    def look(mass, scene):
        seen.append(coupled_groups(of_mass(scene, mass)))
        return mass

    jax.eval_shape(look, MASS, MIXED)
    jax.eval_shape(lambda mass: look(mass, MIXED), MASS)  # no entry of a diagonal mass couples
    jax.eval_shape(lambda mass: look(mass, MIXED), np.diag(MASS))
    assert [found is None for found in seen] == [True, False, True]


def test_the_gravest_status_of_all_groups():
    twice = normals_of((2, False), (2, False), (2, False))[:, [0, 0, 1, 1, 2]]  # redundant contacts
    scene, v = ji.Scene(np.ones(6), twice), jnp.array([1.0, 0.0] * 3)

    @jax.jit
    @jax.vmap
    def status(e):
        return ji.impact(ji.Newton(e), scene, v).status

    same, contradiction = [0.5, 0.5, 0.4, 0.4, 0.3], [0.5, 0.5, 0.2, 0.9, 0.3]
    found = status(jnp.array([same, contradiction]))
    assert found.tolist() == [CODE["impulse_not_unique"], CODE["infeasible"]]


def test_open_contacts_take_no_part_by_gaps_known_or_not():
    row = ji.chain(jnp.ones(6)).normals
    v, gaps = jnp.array([1.0, 0.5, 0.5, 1.0, -0.5, -1.0]), jnp.array([0.0, 0, 1, 0, 0])

    def velocity(gaps):
        return ji.impact(ji.Newton(0.5), ji.Scene(np.ones(6), row, gaps=gaps), v).velocity

    known, chain = velocity(gaps), ji.impact(ji.Newton(0.5), ji.chain(jnp.ones(6), gaps=gaps), v)
    np.testing.assert_allclose(known, chain.velocity, atol=1e-14)
    np.testing.assert_allclose(jax.jit(velocity)(gaps), known, atol=1e-14)


def test_the_whole_delassus_matrix_is_not_formed():
    scene = ji.Scene(np.ones(14), normals_of(*[(2, False)] * 7))
    with mock.patch.object(impacts, "delassus_matrix", None):
        v = ji.impact(ji.Newton(0.5), scene, jnp.array([1.0, 0.0] * 7)).velocity
    np.testing.assert_allclose(v, [0.25, 0.75] * 7)


def test_laws_that_couple_contacts_are_solved_whole():
    scene, v = ji.Scene(np.ones(4), normals_of((2, False), (2, False))), jnp.array([1.0, 0, 0, 0])
    e = np.array([[0.5, 0.0], [0.25, 0.5]])  # the first contact's approach opens the second
    out = ji.impact(RestitutionMatrix(e), scene, v)
    np.testing.assert_allclose(out.velocity, [0.25, 0.75, -0.125, 0.125], atol=1e-14)
    for law in (
        ji.Moreau(e),
        ji.LZB(0.5, exponent=(1.0, 1.5)),
        ji.Compliant(ji.Hertz(1.0)),
        ji.Binary(0.5),
    ):
        assert not law.by_blocks()
