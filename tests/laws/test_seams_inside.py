"""What lies between a law and a scene: rounding, no approach, redundant contacts, padded shots."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import CODE

import jimpact as ji
from jimpact.core.contact import contact_of, coupled_groups
from jimpact.core.scene import pad_scene

pytestmark = pytest.mark.slow  # they compile programs of their own

PAIRS = np.array([[-1.0, 0.0, 0], [1, 0, 0], [0, -1, -1], [0, 1, 0], [0, 0, 1]])


def test_contacts_that_do_not_feel_each_other_are_solved_apart():
    """A pair and three balls in one scene; concrete it is solved in groups, traced as a whole."""
    balls = ji.Scene([1.0, 2.0, 1.0, 0.5, 0.7], PAIRS)
    assert [g.tolist() for g in coupled_groups(balls)] == [[[0, 3], [1, 2]]]
    assert coupled_groups(ji.Scene(np.ones(3), [[-1.0, 0], [1, -1], [0, 1]])) is None
    v, e = np.array([1.0, 0.2, 0.5, 0.1, -0.3]), np.array([0.9, 0.5, 0.3])
    whole = jax.jit(lambda scene: ji.impact(ji.Newton(e), scene, v))(balls)
    apart = ji.impact(ji.Newton(e), balls, v)
    np.testing.assert_allclose(apart.velocity, whole.velocity, atol=1e-14)
    np.testing.assert_allclose(apart.impulse, whole.impulse, atol=1e-14)


def test_open_contacts_in_space_have_no_slip():
    """Contact-major rows, two for each contact: the first contact is open, the second closed."""
    rng = np.random.default_rng(2)
    normals, tangents, v = (
        rng.normal(size=(4, 2)),
        rng.normal(size=(4, 4)),
        rng.normal(size=4),
    )
    scene = ji.Scene(np.ones(4), normals, tangents=tangents, gaps=[0.1, 0.0])
    block = contact_of(scene, jnp.asarray(v)).tangential_block
    np.testing.assert_allclose(
        block.slip, [0.0, 0.0, *(tangents[:, 2:].T @ v)], atol=1e-15
    )
    np.testing.assert_allclose(block.normal_tangent[0], 0.0)
    np.testing.assert_allclose(
        block.normal_tangent[1, 2:], normals[:, 1] @ tangents[:, 2:]
    )


class Gains(ji.Law):
    """gamma+ = -(1 + share) gamma-: more energy than before."""

    separable = True
    share: jax.Array = ji.parameter(low=0.0)

    def impulses(self, contact):
        change = -(2 + self.share) * contact.gap_velocity
        return ji.Impulses(jnp.linalg.solve(contact.delassus, change))


@pytest.mark.parametrize(
    ("share", "status"), [(1e-3, "energy_gain"), (1e-6, "energy_gain"), (1e-9, "ok")]
)
def test_groups_are_judged_on_the_scale_of_their_impact(share, status):
    """Solvers leave a ten-millionth; a gain of a millionth is the law's."""
    pairs = ji.Scene(np.ones(4), [[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    assert coupled_groups(pairs) is not None
    out = ji.impact(Gains(share), pairs, [1.0, 0.0, 1.0, 0.5])
    assert int(out.status) == CODE[status]


@pytest.mark.parametrize("wall", [False, "left", "right"])
def test_a_padded_chain_contains_itself(wall):
    """Its masses, gaps and parameters are at its own places; what is added is open."""
    masses = [1.0, 2.0, 5.0]
    chain = ji.chain(masses, wall=wall, gaps=np.linspace(0.0, 0.2, 2 + bool(wall)))
    padded = pad_scene(chain, 8)
    np.testing.assert_array_equal(padded.scene.mass[padded.coordinates], masses)
    np.testing.assert_array_equal(padded.scene.gaps[padded.contacts], chain.gaps)
    np.testing.assert_array_equal(
        padded.copied[padded.contacts], np.arange(chain.contacts)
    )
    whole = np.asarray(padded.scene.normals)[padded.coordinates, padded.contacts]
    np.testing.assert_array_equal(whole, chain.normals)
    assert (
        np.delete(padded.scene.gaps, np.r_[: padded.scene.contacts][padded.contacts])
        > 0
    ).all()


@pytest.mark.slow
def test_groups_with_friction_and_open_contacts():
    normals, tangents = np.zeros((6, 3)), np.zeros((6, 3))
    for j in range(3):
        normals[2 * j + 1, j] = tangents[2 * j, j] = 1.0
    tangents[1, 0] = 0.3
    three = ji.Scene(
        np.linspace(1.0, 2.0, 6), normals, tangents=tangents, gaps=[0.0, 0.0, 0.1]
    )
    assert [g.tolist() for g in coupled_groups(three)] == [[[0], [1]]]
    v = np.array([0.5, -1.0, 0.1, -1.0, 1.0, -1.0])
    law = ji.Moreau([0.5, 0.2, 0.1], [0.3, 0.2, 0.1])
    whole = jax.jit(lambda scene: ji.impact(law, scene, v))(three)
    apart = ji.impact(law, three, v)
    for name in ("velocity", "impulse", "tangential_impulse", "energy_change"):
        np.testing.assert_allclose(
            getattr(apart, name), getattr(whole, name), atol=1e-14
        )
    assert apart.velocity[4:].tolist() == [1.0, -1.0]
