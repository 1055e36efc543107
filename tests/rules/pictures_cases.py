"""What tests of pictures share."""

import numpy as np
import piles

import jimpact as ji

BALLS, STRIKE = ji.chain([1.0, 1.0, 1.0]), np.array([1.0, 0.0, 0.0])


def samples(gaps):
    law, options = ji.Binary(0.5, order="earliest"), {"samples": 64, "chunk": 64}
    if not gaps:  # two equal balls of which one is struck with a random speed
        pair, speeds = ji.chain([1.0, 1.0]), ji.Uniform([1.0, 0.0], [2.0, 0.0])
        return ji.plot.monte_carlo(ji.monte_carlo(law, pair, speeds, **options))
    result = ji.monte_carlo(law, BALLS, STRIKE, gaps=ji.Uniform(0.0, 1e-5), **options)
    return ji.plot.monte_carlo(result, "gaps of micrometres")


def force_chains():
    """A disc on two others on a floor, whose left contact carries twice as much."""
    discs = piles.discs(1.0, [1.0] * 3, planes=[[0.0, 1.0, 0.0]])
    q = discs.at([[0.0, 1.0], [2.0, 1.0], [1.0, 1.0 + np.sqrt(3)]])
    impulse = [0.0, 2.0, 1.0, np.sqrt(3), np.sqrt(0.75)]  # 1-2, 1-3, 2-3, the floor
    return ji.plot.force_chains(discs, q, discs.closed_scene(q), impulse, "three discs")
