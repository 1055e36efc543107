"""Shared heads: Methods of integration: their order, speed against accuracy, hard points, the advice."""

import numpy as np

import jimpact as ji

BALLS, STRIKE = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
HERTZ = ji.LZB([0.9, 0.9], [1.0, 1.0], 1.5)
# of a disc on the ground that slides as it falls: mass 2, inertia 0.2, radius 0.5
DISC = ji.Scene([2.0, 2.0, 0.2], [[0.0], [1.0], [0.0]], tangents=[[1.0], [0.0], [0.5]])
SLIDES, SLIP = [2.0, -1.0, 0.0], 2.0


def rod(angle):
    """A rod that falls on its lower end in the plane."""
    across, up = -0.5 * np.cos(angle), 0.5 * np.sin(angle)
    return ji.Scene(
        [1, 1, 1 / 12], [[0.0], [1.0], [across]], tangents=[[1.0], [0.0], [up]]
    )
