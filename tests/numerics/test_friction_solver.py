"""The friction solver against brute force: every outcome, how many there are, and derivatives.

Scenes of fewer contacts are padded with contacts that take no part, so that all planar questions
share one compiled program for each of the two laws, and all spatial ones another.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import CODE

import jimpact as ji


def test_three_solutions_of_moreau():
    """25 of 381 random scenes with two contacts were like this one, and said ok."""
    scene = ji.Scene(
        [1.0] * 4,
        [[2.0, 0.0], [0.0, 0.0], [2.0, 1.0], [0.0, 1.0]],
        tangents=[[-2.0, 2.0], [0.0, 1.0], [0.0, 1.0], [0.0, 2.0]],
    )
    v = np.array([-2.0, 2.0, -2.0, 1.0])
    out = ji.impact(ji.Moreau(0.0, friction=1.0), scene, v)
    assert int(out.status) == CODE["several_outcomes"]


@pytest.mark.slow
def test_a_spinning_cube_flat_on_four_corners_has_several_outcomes():
    """How the corners share p decides how friction turns it: the order of the contacts, else."""
    corners = np.array([[x, y, -0.5] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    way = [
        np.concatenate([np.tile(d, (4, 1)), np.cross(corners, d)], axis=1)
        for d in np.eye(3)
    ]
    tangents = np.stack(way[:2], axis=1).reshape(8, 6).T
    cube = ji.Scene([1.0] * 3 + [1 / 6] * 3, way[2].T, tangents=tangents)
    v = {
        "several_outcomes": [0.3, 0.1, -1, 0, 0, 2.0],
        "impulse_not_unique": [0.3, 0.1, -1, 0, 0, 0],
    }
    found = jax.jit(jax.vmap(lambda v: ji.impact(ji.Moreau(0.5, 0.1), cube, v).status))
    assert found(jnp.array(list(v.values()))).tolist() == [CODE[name] for name in v]
