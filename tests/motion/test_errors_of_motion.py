"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]


MOTIONS = [
    ({"t_end": 0.0}, "`t_end` must be after the start at 0 s"),
    (
        {"t_end": (1.0, 0.5)},
        "`t_end` must be after the start at 1 s, but has value 0.5",
    ),
    (
        {"t_end": [0.0, 1.0, 2.0]},
        r"`t_end` must be a time or a pair \(t_start, t_end\)",
    ),
    ({"t_end": ([0.0], 1.0)}, r"`t_end` must have shape \(\) \(a time, or a pair"),
    ({"t_end": np.nan}, "`t_end` must be finite"),
    ({"q0": [-0.1]}, "no penetration"),
    ({"q0": [np.nan]}, "`q0` must be finite"),
    ({"q0": [[1.0]]}, r"`q0` must have shape \(n,\)"),
    ({"v0": [0.0, 0.0]}, r"`v0` must have shape \(1,\)"),
    ({"q0": [1.0, 2.0], "v0": [0.0, 0.0]}, r"`q0` must have shape \(1,\)"),
    ({"samples": 1}, "`samples` must be an int >= 2"),
    ({"max_events": 0}, "`max_events` must be an int >= 1"),
    ({"method": "euler"}, "`method` must be one of"),
    ({"method": "time_stepping"}, "`step` must be a number"),
    ({"method": ji.EventDriven(rtol=1e-17)}, "`rtol` must be at least"),
]

REFUSED = [
    (
        lambda: ji.plot.system(ji.Block(1.0, 1.0), [np.nan] * 3),
        r"`state` must be finite",
    ),
    (
        lambda: ji.simulate(
            ji.Newton(0.5), ji.System(ji.Column([1.0]), gravity=True), [1.0], [0.0], 1.0
        ),
        r"`system` must be of type System",
    ),
    (
        lambda: ji.simulate(
            ji.System(
                ji.Column([1.0]),
                gravity=True,
                base=lambda t: jnp.where(t < 0.5, 0.0, jnp.nan),
            ),
            ji.Newton(0.5),
            [1.0],
            [0.0],
            1.0,
        ),
        r"finite base motion.* at t = 0\.5",
    ),
    (
        lambda: ji.System(lambda q: q, [1.0], base=lambda t: t),
        "`base_directions` must be given",
    ),
    (
        lambda: ji.System(lambda q: q, [[1.0, 2.0], [2.0, 1.0]]),
        "`mass` must be positive definite",
    ),
    (lambda: ji.System(None, [1.0]), "`gap_function` must be a body or a function"),
    (
        lambda: ji.simulate(
            ji.System(ji.Block(1.0, 1.0), gravity=True, friction=[0.1, 0.2]),
            ji.Moreau(0.5),
            [0, 1, 0],
            [0] * 3,
            1.0,
        ),
        r"`friction` must have shape \(\) or \(4,\)",
    ),
    (lambda: ji.TimeStepping([0.1]), r"`step` must have shape \(\)"),
    (
        lambda: ji.simulate(
            ji.Block(0.2, 0.6), ji.Newton(0.5), [0, 1, 0], [0, 0, 0], 1.0
        ),
        r"but is Block.*ji\.System\(body, gravity=True\)",
    ),
    (
        lambda: ji.System(lambda q: q),
        "`mass` must be given where `gap_function` is a function",
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)


@pytest.mark.parametrize(("change", "message"), MOTIONS)
def test_bad_motions(change, message):
    arguments = {"q0": [1.0], "v0": [0.0], "t_end": 1.0} | change
    with pytest.raises(ValueError, match=message):
        ji.simulate(
            ji.System(ji.Column([1.0]), gravity=True), ji.Newton(0.5), **arguments
        )
