"""The order in which advice tries laws."""

import numpy as np
from selection_cases import PAIR

import jimpact as ji
from jimpact.core.registry import simplest_first


def test_simplest_first_is_the_order_of_advise():
    from jimpact.methods.advice import situation_of, trials

    law = ji.LZB(0.8)
    situation = situation_of(PAIR, np.array([1.0, 0.0]), law, known=False)
    order = ("newton", "moreau", "poisson", "binary", "lzb", "compliant")
    assert tuple(trials(situation, law)) == order == simplest_first()
