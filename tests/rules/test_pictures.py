"""Pictures of every kind, on small records made by hand: nothing overlaps, every axis is labelled.

Nothing is simulated here but some figures of the chapter (slow), so that the layout of all pictures
costs seconds.
"""

import numpy as np
import pytest
from pictures_cases import force_chains, samples


def test_force_chains_are_as_thick_as_impulses():
    (lines,) = force_chains().axes[0].collections
    thickness = np.asarray(lines.get_linewidths()) / lines.get_linewidths()[-1]
    np.testing.assert_allclose(
        thickness, np.array([np.sqrt(0.75), 1, np.sqrt(3), 2]) / 2
    )
    ends = np.array([sorted(line.round(6).tolist()) for line in lines.get_segments()])
    np.testing.assert_allclose(ends[0], [[2.0, 0.0], [2.0, 1.0]])  # a disc on the floor
    np.testing.assert_allclose(ends[-1], [[0.0, 1.0], [1.0, 1 + np.sqrt(3)]], atol=1e-5)


def test_a_histogram_is_in_per_cent():
    bars = samples(True).axes[0].patches[0].get_data().values
    assert bars.sum() == pytest.approx(100.0)
