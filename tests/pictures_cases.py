"""What tests of pictures share."""

import numpy as np
import piles

import jimpact as ji
from jimpact.methods.advice_report import Advice, Candidate

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


def block_and_its_pictures():
    """A block on both corners, which turns and moves, and the pictures of one law for it."""
    block, before = ji.Block(0.2, 0.6, corners="base"), np.array([0.5, -1.0, 2.0])
    scene, law = block.scene(), ji.Newton(0.5)
    comparison = ji.compare(scene, before, {"newton": law})
    after = np.asarray(comparison.entries["newton"].outcome.velocity)
    row, none = Candidate(law, scene, after, after, after, 0.1, 0.2, "ok"), np.zeros(2)
    advice = Advice(
        "newton", 0.5, True, "newton", before, none, {"newton": row}, (), none, (), 1, None
    )
    pictures = (ji.plot.comparison, comparison), (ji.plot.advice, advice)
    return block, scene, after, pictures
