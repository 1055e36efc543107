"""What comparisons say where nothing approaches."""

import numpy as np

import jimpact as ji


def test_summary_says_that_nothing_approaches():
    pair = ji.chain([1.0, 1.0])
    law, v = ji.Newton(0.5), np.array([-1.0, 0.0])
    reported = ji.summary(ji.impact(law, pair, v), pair, v)
    assert "nothing approaches" in reported
    assert "none:" not in ji.summary(ji.impact(law, pair, -v), pair, -v)
    gapped = ji.chain([1.0, 1.0], gaps=[0.1])
    assert "only open ones do" in ji.summary(ji.impact(law, gapped, -v), gapped, -v)
    assert "nothing approaches" in str(ji.compare(pair, v, {"newton": law}))
