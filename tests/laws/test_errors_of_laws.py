"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]
WELDED = ji.Scene([1.0] * 3, [[-1.0], [1.0], [0.0]], constraints=[[0.0], [-1.0], [1.0]])

REFUSED = [
    (lambda: ji.LZB(1.3), r"`restitution` must lie in \[0, 1\], but has value 1\.3"),
    (lambda: ji.LZB([0.5, -0.1]), r"`restitution`.*-0\.1 at index 1"),
    (lambda: ji.LZB(np.nan), r"`restitution`.*nan"),
    (
        lambda: ji.LZB(0.9, stiffness=0.0),
        r"`stiffness` must lie in \(0, inf\), but has value 0",
    ),
    (lambda: ji.LZB(0.9, stiffness=[1.0, np.inf]), r"`stiffness`.*inf at index 1"),
    (lambda: ji.LZB(0.9, exponent=0.5), r"`exponent` must lie in \[1, inf\)"),
    (lambda: ji.LZB(0.9, exponent=(1.5, 0.9)), r"`exponent`.*0\.9 at index 1"),
    (lambda: ji.LZB(0.9, initial_energy=-1.0), r"`initial_energy`.*-1"),
    (lambda: ji.LZB(0.9, rtol=0.0), r"`rtol`"),
    (lambda: ji.LZB(0.9, method="euler"), r"`method` must be one of .*'euler'"),
    (lambda: ji.LZB("high"), r"`restitution` must be numeric"),
    (lambda: ji.LZB(None), r"`restitution` must be numeric, but has value None"),
    (lambda: ji.Newton(-0.1), r"`restitution`"),
    (
        lambda: ji.Moreau(-0.1),
        r"`restitution` must lie in \[0, 1\], but has value -0\.1",
    ),
    (
        lambda: ji.Moreau([[0.5, 0.1]]),
        r"`restitution` must be a square matrix.*\(1, 2\)",
    ),
    (
        lambda: ji.Moreau([[0.5, np.nan], [0, 0.5]]),
        r"`restitution`.*nan at index \(0, 1\)",
    ),
    (lambda: ji.Poisson([0.5, 1.2]), r"`restitution`.*1\.2 at index 1"),
    (
        lambda: ji.Poisson(-1.0, allow_above_one=True),
        r"`restitution` must lie in \[0, inf\)",
    ),
    (lambda: ji.Binary(1.1), r"`restitution`.*1\.1"),
    (lambda: ji.Binary(0.5, "slowest"), r"`order`.*'slowest'"),
    (lambda: ji.Binary(0.5, ()), r"`order`"),
    (lambda: ji.Binary(0.5, (0, 1.0)), r"`order`"),
    (lambda: ji.Binary(0.5, max_collisions=0), r"`max_collisions`"),
    (lambda: ji.Binary(0.5, max_collisions=2.5), r"`max_collisions`"),
    (lambda: ji.RestitutionMatrix([[0.5, 0.1]]), r"must be square"),
    (lambda: ji.RestitutionMatrix(0.5), r"must be square"),
    (lambda: ji.RestitutionMatrix([[0.5, np.nan], [0, 0.5]]), r"`matrix`.*\(0, 1\)"),
    (lambda: ji.RestitutionMatrix([["a"]]), r"must be numeric"),
    (lambda: ji.Compliant(1.0), r"`force`"),
    (lambda: ji.Compliant(ji.Hertz(1.0), rtol=0.0), r"`rtol`"),
    (lambda: ji.KelvinVoigt(1.0, -0.1), r"`damping`.*-0\.1"),
    (lambda: ji.HuntCrossley(0.0, 0.1), r"`stiffness`"),
    (lambda: ji.KuwabaraKono(jnp.nan, 0.1), r"`stiffness`"),
    (lambda: ji.HuntCrossley(1.0, 0.1, 0.5), r"`exponent`"),
    (
        lambda: ji.ElastoPlastic(1.0, 0.0),
        r"`yield_force` must lie in \(0, inf\), but has value 0",
    ),
    (
        lambda: ji.Compliant(ji.ElastoPlastic(1.0, 1.0), friction=0.1),
        r"`force` must not yield",
    ),
    (
        lambda: ji.Compliant(ji.ElastoPlastic(1.0, 1.0), method="implicit"),
        r"must not yield",
    ),
    (
        lambda: ji.Compliant(ji.ElastoPlastic(1.0, 1.0), initial_energy=1.0),
        r"`initial_energy`",
    ),
    (lambda: ji.Bistiffness(1.0, 0.9), r"`exponent`"),
    (lambda: ji.Bistiffness(1.0, 1.5, 1.2), r"`restitution`"),
    (lambda: ji.LinearSpring("hard"), r"`stiffness`"),
    (lambda: ji.UserForce(3.0), r"`function`"),
    (lambda: ji.UserForce(lambda x, rate, p: x, "hard"), r"`parameters`"),
    (
        lambda: ji.history(ji.LZB(0.5), WELDED, [1.0, 0.0, 0.5]),
        "satisfy the bilateral constraints",
    ),
    (lambda: ji.LZB(0.9, friction=np.nan), r"`friction` must lie in \[0, inf\).*nan"),
    (lambda: ji.Moreau(0.9, friction=[0.1, -0.1]), r"`friction`.*-0\.1 at index 1"),
    (lambda: ji.history(ji.Newton(0.9), BALLS, V), r"`law`"),
    (lambda: ji.history(ji.LZB(0.9), BALLS, V, samples=1), r"`samples`"),
    (lambda: ji.calibrate(ji.KelvinVoigt(1.0, 0.0), 0.01, 1.0, 1.0), r"`restitution`"),
    (lambda: ji.calibrate(ji.KelvinVoigt(1.0, 0.0), 0.5, -1.0, 1.0), r"`mass`"),
    (
        lambda: ji.calibrate(ji.UserForce(lambda x, rate, p: x), 0.5, 1.0, 1.0),
        r"`force`",
    ),
    (
        lambda: ji.calibrate(
            ji.UserForce(lambda x, rate, p: x + p["damping"] * rate, {"damping": 1e-6}),
            0.5,
            1,
            1,
        ),
        r"`restitution` must be one that the force reaches",
    ),
    (lambda: ji.measured_restitution(ji.Hertz(1.0), 1.0, 0.0), r"`speed`"),
    (lambda: ji.LZB(restituton=0.9), "no `restituton`. Did you mean restitution"),
    (lambda: ji.LZB(0.9, mu=0.3), "no `mu`. Did you mean friction"),
    (lambda: ji.history("LZB", BALLS, V), "`law` must be of type Law, but is 'LZB'"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)
