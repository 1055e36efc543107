"""A block that rocks about A and hits with B: check values, the V, its tip, what happens next."""

import numpy as np
import pytest
from programs import CODE
from rocking_dispersion_cases import BOTH, CRITICAL, MU, E, solved

import jimpact as ji
from jimpact.theory import RockingDispersion, housner_restitution


@pytest.fixture(scope="module")
def found():
    return {eta: solved(BOTH, E, eta) for eta in (1.0, 1.5)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("a", "eta", "e", "expected"),
    [
        (1.0, 1.0, 1.0, (0.887201797217466964, 0.316885496822930086)),
        (1.0, 1.5, 1.0, (0.856592112501210409, 0.372372624592392268)),
        (1.0, 1.5, 0.8, (0.681255743233409859, 0.273725970322769726)),
        (0.5, 1.0, 0.8, (0.388601609987503532, 0.508931933435646960)),
        (0.5, 1.0, 0.9, (0.451190340860902387, 0.589848609570968933)),
        (2.0, 1.5, 0.8, (0.8, 0.45)),
    ],
)
def test_without_friction_as_the_check_values(found, a, eta, e, expected):
    i, k = BOTH.tolist().index(a), E.tolist().index(e)
    np.testing.assert_allclose(found[eta].gap_velocity[i, 0, k], expected, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("exponent", "stiffness"), [(1.0, None), (1.5, None), (1.5, (1.0, 4.0))]
)
def test_the_tip_depends_on_friction_alone(found, exponent, stiffness):
    out = solved(BOTH, E, exponent, stiffness) if stiffness else found[exponent]
    size = np.abs(out.dispersion)
    assert (np.asarray(out.dispersion) <= 1e-9).all()
    for j in range(3):
        np.testing.assert_allclose(
            size[4 + j, j], 0.0, atol=1e-8
        )  # at the tip, whatever e is
        others = np.delete(size[:, j], 4 + j, axis=0)
        assert others.min() > 0.005
    np.testing.assert_allclose(
        ji.theory.critical_kinetic_angle(MU),
        ji.theory.rocking_kinetic_angle(CRITICAL),
        rtol=1e-14,
    )


def test_critical_angles_in_degrees():
    """arccos of (2 - a^2) / (4 + a^2), a^2 + 3 mu a = 2; from mu = 1 / sqrt(2) on arccos(1 / 3)."""
    angles = np.degrees(ji.theory.critical_kinetic_angle([0.0, 0.1, 0.3, 0.8]))
    np.testing.assert_allclose(angles, [90.0, 86.105, 79.421, 70.529], atol=5e-4)


def test_record_and_words():
    gamma = np.array(
        [[0.0, 0.0], [0.0, 0.4], [0.5, 0.04], [0.5, 0.4], [np.nan, np.nan]]
    )
    a, one = np.array([0.4, 1.0, 2.0, 3.0, 4.0]), np.ones((5, 1, 1))
    record = RockingDispersion(
        a, np.array([0.3]), np.array([0.5]), gamma[:, None, None], one, one, one, one
    )
    assert record.outcomes().ravel().tolist() == [0, 1, 2, 3, 4]
    assert record.outcomes(separation_threshold=0.03).ravel().tolist() == [
        0,
        1,
        3,
        3,
        4,
    ]
    np.testing.assert_allclose(record.dispersion[:4, 0, 0], [0, -0.4, -0.04, -0.4])
    np.testing.assert_allclose(record.over_housner[:, 0, 0], 1 / housner_restitution(a))
    assert (
        "critical angle 79.42 degrees; 1 rest, 1 rocking, 1 half-rocking, 1 free"
        in str(record)
    )
    v = ji.plot.rocking_dispersion(record)
    np.testing.assert_allclose(v.axes[0].lines[0].get_ydata(), np.abs(gamma[:, 1]))
    np.testing.assert_allclose(v.axes[0].lines[1].get_xdata(), 79.42, atol=0.01)


def test_kinetic_angle_is_that_of_the_scene():
    scene = ji.Block(0.3, 0.21, 2.0, corners="base").scene()
    angle = ji.theory.kinetic_angles(scene)[0, 1]
    np.testing.assert_allclose(ji.theory.rocking_kinetic_angle(0.7), angle, rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"aspect": 0.0}, "`aspect`"),
        ({"aspect": [[1.0]]}, "`aspect`.*one axis"),
        ({"friction": -0.1}, "`friction`"),
        ({"restitution": [0.5, 1.1]}, "`restitution`.*index 1"),
        ({"restitution": np.nan}, "`restitution`"),
        ({"exponent": 0.5}, "`exponent`"),
        ({"stiffness": 0.0}, "`stiffness`"),
    ],
)
def test_bad_input(arguments, named):
    with pytest.raises(ValueError, match=named):
        ji.theory.rocking_dispersion(**{"aspect": 1.0, **arguments})


def test_bad_input_of_the_angles():
    with pytest.raises(ValueError, match="`friction`"):
        ji.theory.critical_kinetic_angle(-0.1)
    with pytest.raises(ValueError, match=r"`restitution`.*0, 1"):
        ji.theory.search_critical_angle(0.1, 0.0)


@pytest.mark.slow
def test_the_critical_angle_is_found_by_impacts_alone():
    """The kinetic angle of the least dispersion: that of the closed form for each mu,
    whatever e is.
    """
    mu = [0.0, 0.3, 1.0]
    e = [0.3, 0.8, 1.0]
    found = ji.theory.search_critical_angle(mu, e)  # (mu, e)
    exact = ji.theory.critical_kinetic_angle(mu)
    for of_e in found.T:
        np.testing.assert_allclose(of_e, exact, atol=1e-7)


@pytest.mark.slow
def test_it_is_a_v():
    a = np.linspace(0.3, 5.0, 60)
    out = ji.theory.rocking_dispersion(a, [0.0, 0.1, 0.3, 1.0], [0.5, 1.0])
    assert np.isin(np.asarray(out.status), [CODE["ok"], CODE["plastic_limit"]]).all()
    theta, size = np.asarray(out.kinetic_angle), np.abs(out.dispersion)
    for j, tip in enumerate(np.asarray(ji.theory.critical_kinetic_angle(out.friction))):
        left = theta < tip
        assert (np.diff(size[left, j], axis=0) < 0).all()
        assert (np.diff(size[~left, j], axis=0) > 0).all()
