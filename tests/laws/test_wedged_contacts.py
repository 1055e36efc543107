"""Contacts that friction wedges: their velocities decay without end, to a closed form.

Impulses act along normals and tangents A alone. Where all gap velocities and slips A^T v
end at 0, v+ is the part of v- that A does not reach, whatever the course was:

    v+ = v- - M^-1 A (A^T M^-1 A)^+ A^T v-
"""

import jax
import numpy as np
import pytest

import jimpact as ji

RTOL = 1e-8


def planar_scenes(seed, number, coordinates):
    """Random pairs of contacts: masses, normals, tangents, v-, e and mu."""
    rng = np.random.default_rng(seed)
    mass = 10 ** rng.uniform(-0.5, 0.5, (number, coordinates))
    normals, tangents = rng.normal(size=(2, number, coordinates, 2))
    overlap = np.einsum("nim,nim->nm", normals, tangents / mass[..., None])
    square = np.einsum("nim,nim->nm", normals, normals / mass[..., None])
    tangents -= normals * (overlap / square)[:, None]
    length = np.einsum("nim,nim->nm", tangents, tangents / mass[..., None])
    tangents *= np.sqrt(square / length)[:, None]
    v = rng.normal(size=(number, coordinates))
    approach = np.einsum("nim,ni->nm", normals, v).min(axis=1)
    v *= np.where(approach < 0, 1.0, -1.0)[:, None]
    e = rng.uniform(0, 1, (number, 2))
    mu = rng.uniform(0, 3, (number, 2))
    return mass, normals, tangents, v, e, mu


def impact(mass, normals, tangents, v, e, mu):
    law = ji.LZB(e, [1.0, 1.0], friction=mu, rtol=RTOL)
    return ji.impact(law, ji.Scene(mass, normals, tangents=tangents), v)


def unreached(mass, normals, tangents):
    """The matrix from v- to the part of it that impulses do not reach."""
    along = np.concatenate([normals, tangents], axis=1)
    pushed = along / mass[:, None]
    inverse = np.linalg.pinv(along.T @ pushed, rcond=1e-10)
    return np.eye(len(mass)) - pushed @ inverse @ along.T


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "coordinates"),
    [(3, 3), pytest.param(4, 4, marks=pytest.mark.release)],
)
def test_wedged_contacts_end_at_their_limit(seed, coordinates):
    scenes = planar_scenes(seed, 400, coordinates)
    out = jax.jit(jax.vmap(impact))(*scenes)
    mass, normals, tangents, v, _, _ = scenes
    names = np.array([ji.STATUS[int(s)].name for s in out.status])
    assert set(names) == {"ok", "plastic_limit"}
    after = np.asarray(out.velocity)
    along = np.concatenate([normals, tangents], axis=2)
    left = np.abs(np.einsum("nim,ni->nm", along, after)).max(axis=1)
    at_rest = (names == "plastic_limit") & (left < 1e-4)
    assert at_rest.sum() >= 5
    for i in np.flatnonzero(at_rest):
        expected = unreached(mass[i], normals[i], tangents[i]) @ v[i]
        allowed = 2 * RTOL * np.abs(v[i]).max()
        np.testing.assert_allclose(after[i], expected, atol=allowed)
    # their slopes in v-, which pass thousands of events
    chosen = np.flatnonzero(at_rest)[:5]
    slopes = jax.jit(jax.vmap(jax.jacfwd(velocity_after)))
    found = slopes(v[chosen], *(z[chosen] for z in scenes if z is not v))
    for i, slope in zip(chosen, found):
        expected = unreached(mass[i], normals[i], tangents[i])
        np.testing.assert_allclose(slope, expected, atol=1e-6)


def velocity_after(v, mass, normals, tangents, e, mu):
    return impact(mass, normals, tangents, v, e, mu).velocity


@pytest.mark.slow
def test_impulses_of_wedged_contacts_are_in_their_cones():
    scenes = planar_scenes(3, 400, 3)
    out = jax.jit(jax.vmap(impact))(*scenes)
    normal = np.asarray(out.impulse)
    side = np.abs(np.asarray(out.tangential_impulse))
    cone = scenes[-1] * normal
    assert (normal >= -1e-7).all()
    assert (side <= cone + 1e-5 * (1 + cone)).all()
