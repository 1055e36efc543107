"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import numpy as np
import pytest
from refusals import refused

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]

REFUSED = [
    (
        lambda: ji.Experiments([[1.0, 0.0], [1.0]], np.eye(2)),
        r"`pre`.*rows are equally long",
    ),
    (
        lambda: ji.read_experiments({"pre_1[m/s]": [1.0]}),
        r"`path`.*make `Experiments\(pre=",
    ),
    (
        lambda: ji.Experiments([V], [V], scenes=BALLS),
        "`scenes` must be of type Sequence",
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)
