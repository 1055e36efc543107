"""Which coefficients mechanics allows: matrices of a block, unequal e, re-entrant corners."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

import jimpact as ji
from jimpact.theory import (
    audit_coefficients,
    audit_matrix,
    reentrant_corner,
    rocking_domain,
    separation_times,
)


def test_separation_times():
    """Against (6.16) at 20 digits, limits of a soft and of a stiff second spring, Newby's ratio."""
    expected = {
        0.3: (2.3104357319154176, 4.5785561388309802),
        1.0: (2.5548129111974903, 3.3820850513035804),
        2.7: (2.7494001239988593, 2.6351145226216572),
        5.0: (2.6536174294728242, 2.3349646645862461),
    }
    for ratio, times in expected.items():
        np.testing.assert_allclose(separation_times(ratio), times, rtol=1e-13)
    assert separation_times(0.0) == (
        pytest.approx(np.pi / np.sqrt(2), rel=1e-15),
        np.inf,
    )
    np.testing.assert_allclose(separation_times(1e-8)[0], np.pi / np.sqrt(2), rtol=1e-8)
    np.testing.assert_allclose(separation_times(1e8), np.pi * np.sqrt(2 / 3), rtol=1e-4)
    both = separation_times(ji.theory.newby_ratio(2))
    assert both.first == pytest.approx(both.second, rel=1e-12)
    for bad in (-1.0, 1e-9, 1e9, np.nan):
        with pytest.raises(ValueError, match="`stiffness_ratio`"):
            separation_times(bad)


@pytest.mark.parametrize(
    ("aspect", "sliding"),
    [(0.8, True), (2.0, True), (3.0, True), (0.5, False), (1.0, False)],
)
def test_the_domain_of_a_block_is_that_of_the_audit(aspect, sliding):
    """On a grid. Corners that stick: a turning block carries the mass m (h / 2)^2 besides."""
    inertia = (1 + aspect**2) / 12 + (0 if sliding else aspect**2 / 4)
    block = ji.Block(1.0, aspect, inertia=inertia, corners="base").scene()
    domain = rocking_domain(aspect, sliding)
    assert float(ji.theory.normalized_delassus(block)[0, 1]) == pytest.approx(
        domain.coupling, abs=1e-12
    )
    for own in np.linspace(0.01, 1.11, 7):
        for cross in np.linspace(-0.09, 1.11, 7):
            admissible = audit_matrix(block, [[own, cross], [cross, own]]).admissible
            assert admissible == bool(domain.contains(own, cross)), (own, cross)
    middle = domain.corners.mean(axis=0)
    assert domain.contains(*middle)
    for corner in domain.corners:
        assert domain.contains(*(corner + 1e-9 * (middle - corner)))
        assert not domain.contains(*(corner + 1e-9 * (corner - middle)))


def test_classes_of_rocking():
    slender, wide = rocking_domain(3.0), rocking_domain(1.0)
    assert slender.half_rocking is None
    assert wide.half_rocking == (0.0, 1.0)
    assert wide.rocking == (0.0, 1.0)
    assert slender.rocking == (pytest.approx(7 / 13), 1.0)
    # Housner's block: with both corners sticking it is the least restitution of rocking
    assert rocking_domain(3.0, sliding=False).rocking[0] == pytest.approx(0.85)
    with pytest.raises(ValueError, match="`aspect`"):
        rocking_domain(0.0)


def test_picture_of_the_domains():
    domains = [
        rocking_domain(a, sliding) for a in (1.0, 2.0) for sliding in (True, False)
    ]
    figure = ji.plot.rocking_domains(domains)
    filled = [axes.patches[0].get_xy()[:-1] for axes in figure.axes]
    for domain, corners in zip(domains, filled):
        np.testing.assert_allclose(corners, domain.corners)
    with pytest.raises(ValueError, match="`domains`"):
        ji.plot.rocking_domains([])
    plt.close(figure)


def moreau(w, gamma, e):
    """p of two contacts: the complementarity problem by its four cases."""
    b = (1 + e) * gamma
    for active in ([], [0], [1], [0, 1]):
        p = np.zeros(2)
        if active:
            p[active] = np.linalg.solve(w[np.ix_(active, active)], -b[active])
        if (p >= -1e-12).all() and (w @ p + b >= -1e-12).all():
            return p
    raise RuntimeError


def test_unequal_coefficients_of_moreau():
    """The verdict against many impacts, and the witness: it does gain."""
    rng = np.random.default_rng(4)
    verdicts = set()
    for _ in range(60):
        masses, e = rng.uniform(0.2, 4, 3), rng.choice([0.0, 0.3, 0.9, 1.0], 2)
        scene = ji.chain(masses)
        w = np.asarray(ji.delassus_matrix(scene).as_matrix())
        found = audit_coefficients(scene, e)
        gains = []
        for gamma in rng.normal(size=(100, 2)):
            p = moreau(w, gamma, e)
            gains.append(p @ (gamma + w @ p / 2))
        verdicts.add(found.energetic.answer)
        if found.energetic:
            assert max(gains) < 1e-9
        if found.spread <= found.spread_allowed:
            assert found.energetic
        if found.energetic.answer == "no":
            p = found.energetic.witness / np.sqrt(np.diag(w))
            gamma = -(w @ p) / (1 + e)
            np.testing.assert_allclose(moreau(w, gamma, e), p, atol=1e-9)
            assert p @ (gamma + w @ p / 2) > 0
    assert verdicts == {"yes", "no", "boundary"}
    assert "GAIN" in str(audit_coefficients(ji.chain([1.0] * 3), [1.0, 0.0]))
    assert "holds" in str(audit_coefficients(ji.chain([1.0] * 3), 0.5))
    with pytest.raises(ValueError, match="`restitution`"):
        audit_coefficients(ji.chain([1.0] * 3), [0.5, 1.5])


def test_poisson_never_gains_energy():
    """At least (1 - e_max^2) p_c^T W p_c / 2 is lost, without friction, whatever the e_j."""
    rng = np.random.default_rng(6)
    zero = np.zeros(2)
    for _ in range(300):
        a = rng.normal(size=(2, 2))
        w, gamma, e = (
            a @ a.T + 0.1 * np.eye(2),
            rng.normal(size=2),
            rng.uniform(0, 1, 2),
        )
        p_c = moreau(w, gamma, zero)
        at_rest = gamma + w @ p_c
        p = (1 + e) * p_c + moreau(w, at_rest + w @ (e * p_c), zero)
        change = p @ (gamma + w @ p / 2)
        assert change <= -(1 - e.max() ** 2) * p_c @ w @ p_c / 2 + 1e-12


def test_reentrant_corner():
    """One contact acts, the nearest; both where they are equally near; none if one is satisfied."""
    corner = ji.Scene([2.0, 2.0], [[1.0, 0.0], [0.0, 3.0]])
    first, second = reentrant_corner(corner, [-1.0, -0.2], [0.5, 1.0])
    assert (first.contact, first.nearest, second.contact, second.nearest) == (
        1,
        True,
        0,
        False,
    )
    np.testing.assert_allclose(first.velocity, [-1.0, 0.2], atol=1e-15)  # gamma / 3
    np.testing.assert_allclose(second.velocity, [0.5, -0.2], atol=1e-15)
    assert second.impulse == pytest.approx(3.0)
    assert [x.nearest for x in reentrant_corner(corner, [-1.0, -1.0], 0.5)] == [
        True,
        True,
    ]
    assert reentrant_corner(corner, [-1.0, 0.0], 0.5) == []
    with pytest.raises(ValueError, match="`velocity`"):
        reentrant_corner(corner, [-1.0], 0.5)
