"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import pytest
from refusals import refused

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]

REFUSED = [
    (
        lambda: ji.work_precision(BALLS, V, ji.LZB(0.5)),
        r"work_precision\(law, scene, velocity",
    ),
    (
        lambda: ji.advise(ji.chain([1.0, 1.0]), [1.0, 0.0], ji.Newton(0.5)),
        r"`tolerance` must be numeric, but has value Newton\(",
    ),
    (
        lambda: ji.compare(BALLS, V, [ji.LZB(0.9)]),
        r"`laws` .* is a list.* as in \{'a': \.\.\.\}",
    ),
    (
        lambda: ji.compare(BALLS, V, restitutoin=0.5),
        "'restitutoin'. Did you mean restitution",
    ),
    (lambda: ji.compare([1.0, 1.0], V), "`scene` must be of type Scene, but is"),
    (lambda: ji.compare(BALLS, V, e=0.9), "'e'. Did you mean restitution"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)
