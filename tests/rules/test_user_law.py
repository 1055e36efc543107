"""A law in a user's own file: a study and the command line import it (see test_own_law.py)."""

import numpy as np
import pytest
from refusals import argument

import jimpact as ji


def test_register_refuses():
    with pytest.raises(ValueError, match=argument("name")):
        ji.register("newton", ji.Moreau)
    with pytest.raises(TypeError, match=argument("law")):
        ji.register("nothing", int)
    with pytest.raises(ValueError, match=argument("promises", "'beauty'")):
        ji.register("mine", ji.Newton, promises={"beauty"})
    with pytest.raises(ValueError, match=argument("name", "'Mine'")):
        ji.register("Mine", ji.Newton)


def test_promises_may_come_from_an_iterator():
    promises = ("energy", "mass_scaling")
    try:
        ji.register("promising", ji.Moreau, promises=iter(promises))
        assert ji.REGISTRY["promising"].promises == set(promises)
    finally:
        ji.REGISTRY.pop("promising", None)


@pytest.mark.slow
def test_contact_for_a_law_of_ones_own():
    contact = ji.Contact([[2.0, -1.0], [-1.0, 2.0]], [-1.0, 0.0])
    p = ji.Moreau(0.5).impulses(contact).normal
    np.testing.assert_allclose(p, [1.0, 0.5])
    np.testing.assert_allclose(
        contact.gap_velocity_after(p, None), [0.5, 0.0], atol=1e-15
    )
    assert contact.tangents == 0
    np.testing.assert_allclose(contact.energy_change(p), -0.25)
    np.testing.assert_allclose(contact.kinetic_angles[0, 1], np.pi / 3)
    assert bool(contact.happens)
    assert float(contact.size) == pytest.approx(np.sqrt(0.5))
    np.testing.assert_allclose(contact.normalized_delassus, [[1.0, -0.5], [-0.5, 1.0]])
