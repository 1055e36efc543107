"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import numpy as np
import pytest
from refusals import refused

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]
PAIR = ji.chain([1.0, 1.0])

REFUSED = [
    (lambda: ji.theory.distributing_rule([-1.0, 1.0], 1.0, 1.5), r"`energy`"),
    (lambda: ji.theory.precompression_energy(-1.0, 1.0), r"`force`"),
    (lambda: ji.theory.precompression_energy(1.0, 0.0), r"`stiffness`"),
    (lambda: ji.theory.hertz_stiffness(-1.0, 0.3, 1.0), r"`modulus"),
    (lambda: ji.theory.hertz_stiffness(1.0, 0.6, 1.0), r"`poisson"),
    (lambda: ji.theory.pair_restitution(1.1, 0.5, "mean"), r"`first"),
    (lambda: ji.theory.pair_restitution(0.5, 0.5, "average"), r"`rule"),
    (lambda: ji.theory.pair_restitution(0.5, 0.5, "energy", 1.0), r"`stiffness2"),
    (
        lambda: ji.theory.pair_restitution(0.5, 0.5, "mean", 1.0),
        r"`stiffness` must be left out",
    ),
    (
        lambda: ji.theory.pair_restitution(0.5, 0.5, "energy", np.inf, np.inf),
        r"`stiffness",
    ),
    (lambda: ji.theory.pair_restitution(0.5, 0.5, "energy", 0.0, 1.0), r"`stiffness"),
    (lambda: ji.theory.hertz_stiffness(1.0, 0.3, 1.0, radius2=0.0), r"`radius2"),
    (lambda: ji.theory.gap_scale(PAIR, ji.Newton(1.0), [1.0, 0.0]), r"`law`"),
    (lambda: ji.theory.gap_scale(PAIR, ji.LZB(1.0), [1.0]), r"`velocity`"),
    (
        lambda: ji.theory.crossover(
            PAIR, ji.Compliant(ji.Hertz(1.0)), [1.0, 0.0], [0.0]
        ),
        r"two contacts",
    ),
    (
        lambda: ji.theory.crossover(BALLS, ji.Compliant(ji.Hertz(1.0)), V, [[0.0]]),
        r"`offset`",
    ),
    (lambda: ji.theory.rocking_dispersion(0.0), r"`aspect`"),
    (lambda: ji.theory.rocking_dispersion([[1.0]]), r"`aspect`.*one axis"),
    (lambda: ji.theory.rocking_dispersion(1.0, friction=-0.1), r"`friction`"),
    (
        lambda: ji.theory.rocking_dispersion(1.0, restitution=[0.5, 1.1]),
        r"`restitution`.*index 1",
    ),
    (lambda: ji.theory.rocking_dispersion(1.0, exponent=0.5), r"`exponent`"),
    (lambda: ji.theory.critical_kinetic_angle(-0.1), r"`friction`"),
    (lambda: ji.theory.search_critical_angle(0.1, 0.0), r"`restitution`.*0, 1"),
    (lambda: ji.theory.rocking_matrix(1.5), r"must lie in"),
    (lambda: ji.theory.housner_restitution(0.0), r"`aspect` must lie in"),
    (lambda: ji.theory.newby_ratio(1), r"`n`"),
    (lambda: ji.theory.newby_ratio(2.5), r"`n`"),
    (
        lambda: ji.theory.restitution_inclusion([[1.0]], [[1.0]], 0.5, [1.0, 2.0]),
        r"`velocity`",
    ),
    (
        lambda: ji.theory.restitution_inclusion([1.0], [[1.0]], 0.5, [1.0]),
        r"`coupling` must be a matrix",
    ),
    (
        lambda: ji.theory.restitution_inclusion([[np.nan]], [[1.0]], 0.5, [1.0]),
        r"`coupling`",
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)
