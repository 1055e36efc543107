"""A block that rocks about A and hits with B: check values, the V, its tip, what happens next."""

import numpy as np
import pytest
from rocking_dispersion_cases import BOTH, MU, E, solved

from jimpact.theory.rocking import OUTCOMES

pytestmark = pytest.mark.slow  # they compile programs of their own


RIGHT = np.array([1.6, 1.8, 2.0, 2.5, 3.0, 4.0, 6.0])


@pytest.fixture(scope="module")
def found():
    return {eta: solved(BOTH, E, eta) for eta in (1.0, 1.5)}


def right_of_the_tip(a, mu, e):
    """gamma+ of B and A where B alone is pressed; it slips one way or sticks throughout."""
    slips = (a**2 - 2 + 3 * mu * a) / (a**2 + 4 - 3 * mu * a)
    sticks = (2 * a**2 - 1) / (2 * a**2 + 2)
    r = np.where(mu < 3 * a / (4 * a**2 + 1), slips, sticks)
    return np.stack(np.broadcast_arrays(e, (1 + e) * r), axis=-1)


def test_right_of_the_tip_by_closed_forms():
    e = np.array([0.0, 0.3, 0.8, 1.0])
    out = solved(RIGHT, e, 1.5)
    assert (np.asarray(out.status) == 0).all()
    expected = right_of_the_tip(
        RIGHT[:, None, None], MU[None, :, None], e[None, None, :]
    )
    np.testing.assert_allclose(out.gap_velocity, expected, atol=2e-9)
    # sticking and plastic is Housner's block; without friction it loses more
    np.testing.assert_allclose(out.over_housner[:, 2, 0], 1.0, atol=1e-8)
    np.testing.assert_allclose(out.slip_velocity[:, 2], 0.0, atol=1e-12)
    assert (np.asarray(out.over_housner[:, 0, 0]) < 0.98).all()
    # e < 1 loses, and friction alone takes energy only where it slips
    kept = np.asarray(out.energy_ratio[..., 3])
    np.testing.assert_allclose(kept[:, [0, 2]], 1.0, atol=1e-8)
    assert (kept[:2, 1] < 0.999).all()
    assert np.array(OUTCOMES)[out.outcomes()[:, :, 0]].tolist() == [["rocking"] * 3] * 7
    assert (
        np.array(OUTCOMES)[out.outcomes()[:, :, 1:]].tolist()
        == [[["free"] * 3] * 3] * 7
    )


def test_it_is_half_rocking_at_the_tip_and_free_beside_it(found):
    names = np.array(OUTCOMES)[found[1.5].outcomes()]
    for j in range(3):
        assert (names[4 + j, j] == "half-rocking").all()
        assert (names[2:4, j] == "free").all()
