"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import numpy as np
import pytest
from refusals import refused

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]
PAIR = ji.chain([1.0, 1.0])


def fit_of_a_ball(**options):
    """A fit of three positions of a ball that bounces."""
    ball = ji.System(ji.Column([1.0]), gravity=True)
    given = {"measured": np.ones((3, 1)), "q0": [1.0], "v0": [0.0], "t_end": 0.3}
    return ji.fit_motion(ball, ji.Newton(0.8), **(given | options))


REFUSED = [
    (
        lambda: ji.Search("levenberg"),
        r"`method` must be one of .*Did you mean levenberg-marq",
    ),
    (
        lambda: ji.Search(loss="hubber"),
        r"`loss` must be one of .*'hubber'. Did you mean huber",
    ),
    (
        lambda: ji.Search("newton", max_steps=5),
        r"must be one of 'levenberg-marquardt', .*'newton'",
    ),
    (lambda: ji.Search(max_steps=0), r"`max_steps` must be an int >= 1"),
    (lambda: ji.Search(seed=-1), r"`seed` must be an int >= 0"),
    (lambda: ji.Search(limit=-1.0), r"`limit` must lie in \[0, inf\)"),
    (
        lambda: ji.fit(ji.LZB(0.9), BALLS, [V, V]),
        r"`experiments` must be of type Experiments",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True),
            ji.Newton(0.7),
            [1.0, 2.0],
            [1.0],
            [0.0],
            1.0,
        ),
        r"`measured` must have shape \(S, 1\)",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True),
            ji.Newton(0.7),
            [[1.0]],
            [[1.0]],
            [[0.0]],
            1.0,
        ),
        r"`measured` must have shape \(1, S, 1\)",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True),
            ji.Newton(0.7),
            [[1.0]],
            [[1.0]],
            [0.0],
            1.0,
        ),
        r"`v0` must have shape \(n,\), or \(K, n\)",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True),
            ji.Newton(0.7),
            [[np.nan]],
            [1.0],
            [0.0],
            1.0,
        ),
        "at least one value",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True),
            ji.Newton(0.7),
            [[1.0]],
            [1.0],
            [0.0],
            1.0,
            "stiffness",
        ),
        "must name parameters of Newton",
    ),
    (lambda: fit_of_a_ball(q0=[-1.0]), r"`q0` must have no penetration"),
    (lambda: fit_of_a_ball(t_end=-0.5), "`t_end` must be after the start"),
    (lambda: fit_of_a_ball(measured="a"), "`measured` must be numeric"),
    (
        lambda: fit_of_a_ball(observe=lambda m: [m.q[0, 0]]),
        "`observe` must give an array",
    ),
    (lambda: fit_of_a_ball(free=None), "`free` must be of type Iterable"),
    (lambda: fit_of_a_ball(bounds=[(0, 1)]), "`bounds` must be of type Mapping"),
    (
        lambda: fit_of_a_ball(sigma=np.full(3, 0.01)),
        r"`sigma` must have shape \(3, 1\)",
    ),
    (lambda: fit_of_a_ball(observe="q"), "`observe` must be a function, but is 'q'"),
    (
        lambda: fit_of_a_ball(search="adam"),
        "`search` must be of type Search, but is 'adam'",
    ),
    (
        lambda: ji.fit(ji.Newton(0.5), PAIR, "a.csv"),
        r"'a\.csv'. `ji\.read_experiments\(path\)`",
    ),
    (
        lambda: ji.fit(ji.Newton(0.5), PAIR, {}),
        r"is {}. `ji\.Experiments\(pre, post\)`",
    ),
    (
        lambda: ji.fit(ji.Newton(0.5), ji.Block(0.2, 0.6), ji.Experiments([V], [V])),
        "`scene` must be of type Scene, but is Block.*A body has a scene",
    ),
    (lambda: fit_of_a_ball(search="sgd"), r"Give ji\.Search\('sgd'\)"),
    (
        lambda: fit_of_a_ball(search=ji.Search(limit=-1)),
        r"`limit` must lie in \[0, inf\)",
    ),
    (lambda: fit_of_a_ball(search=ji.Search(limit=np.nan)), "`limit`.*nan"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)
