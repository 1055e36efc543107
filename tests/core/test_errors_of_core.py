"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]
PAIR = ji.chain([1.0, 1.0])
MANY = ji.Scene(np.ones(402), np.eye(402)[:, ::2], tangents=np.eye(402)[:, 1::2])
WELDED = ji.Scene([1.0] * 3, [[-1.0], [1.0], [0.0]], constraints=[[0.0], [-1.0], [1.0]])

REFUSED = [
    (
        lambda: ji.audit(BALLS, V, ji.impact(ji.Newton(0.5), BALLS, V)),
        r"audit\(out, scene, velocity\)",
    ),
    (lambda: ji.chain([1.0, -1.0]), r"`masses` must lie in \(0, inf\).*-1 at index 1"),
    (lambda: ji.chain([1.0, np.nan]), r"`masses`"),
    (lambda: ji.chain([[1.0, 1.0]]), r"`masses` must have shape \(n,\)"),
    (lambda: ji.chain([1.0]), r"at least one contact"),
    (lambda: ji.chain([1.0, 1.0], wall="up"), r"`wall` must be one of .*'up'"),
    (lambda: ji.chain([1.0, 1.0], gaps=[-1e-6]), r"`gaps`.*-1e-06"),
    (lambda: ji.chain([1.0, 1.0], gaps=[0.0, 0.0]), r"`gaps` must have shape \(1,\)"),
    (
        lambda: ji.Scene([[1.0, 0.5], [0.0, 1.0]], [[1.0], [0.0]]),
        r"`mass` must be symmetric",
    ),
    (lambda: ji.Scene([[1.0, 1.0], [1.0, 1.0]], [[1.0], [0.0]]), r"positive definite"),
    (lambda: ji.Scene([1.0, -1.0], [[1.0], [0.0]]), r"`mass`.*-1"),
    (lambda: ji.Scene([1.0, 1.0], [1.0, 0.0]), r"`normals` must have shape \(n, m\)"),
    (
        lambda: ji.Scene([1.0, 1.0], [[1.0, 0.0], [0.0, 0.0]]),
        r"`normals` must have no zero column.* contact 2 is zero",
    ),
    (lambda: ji.Scene([1.0, 1.0], [[np.nan], [0.0]]), r"`normals`"),
    (lambda: ji.Scene([1.0], [[1.0]], tangents=[[1.0, 0.0, 0.0]]), r"`tangents`"),
    (lambda: ji.Scene([1.0], [[1.0]], constraints=[1.0]), r"`constraints`"),
    (
        lambda: ji.Scene(
            [1.0, 1.0], [[1.0], [0.0]], constraints=[[1.0, 2.0], [0.0, 0.0]]
        ),
        r"`constraints` must have independent columns",
    ),
    (lambda: ji.gap_velocity(BALLS, [1.0, 0.0]), r"`velocity` must have shape \(3,\)"),
    (lambda: ji.velocity_change(BALLS, [1.0]), r"`impulse` must have shape \(2,\)"),
    (
        lambda: ji.impact(ji.LZB(0.9), BALLS, [1.0, 0.0]),
        r"`velocity` must have shape \(3,\)",
    ),
    (
        lambda: ji.impact(ji.LZB(0.9), BALLS, [1.0, 0, np.nan]),
        r"`velocity`.*nan at index 2",
    ),
    (
        lambda: ji.impact(ji.LZB([0.9] * 3), BALLS, V),
        r"`restitution` must have shape \(2,\)",
    ),
    (
        lambda: ji.impact(ji.LZB(0.9, exponent=(1.5,) * 3), BALLS, V),
        r"`exponent`.*\(2,\)",
    ),
    (
        lambda: ji.impact(ji.Poisson([0.5] * 3), BALLS, V),
        r"`restitution` must have shape \(2,\)",
    ),
    (
        lambda: ji.impact(ji.Moreau(np.eye(3)), BALLS, V),
        r"`restitution` must have shape \(2, 2\)",
    ),
    (
        lambda: ji.impact(
            ji.LZB(
                jnp.float32(0.9),
                jnp.float32(1.0),
                initial_energy=jnp.float32(0.0),
                rtol=1e-8,
            ),
            ji.chain(jnp.ones(3, jnp.float32)),
            jnp.array(V, jnp.float32),
        ),
        r"`rtol` must be at least 1\.9e-06 in float32, but has value 1e-08",
    ),
    (
        lambda: ji.impact(ji.Compliant(ji.Hertz(1.0), rtol=1e-20), PAIR, [1.0, 0.0]),
        r"`rtol` must be at least",
    ),
    (
        lambda: ji.impact(ji.Compliant(ji.Hertz([1.0, 1.0])), PAIR, [1.0, 0.0]),
        r"`stiffness`",
    ),
    (
        lambda: ji.impact(
            ji.Compliant(ji.KelvinVoigt(1.0, [0.1, 0.2])), PAIR, [1.0, 0.0]
        ),
        r"`damping`",
    ),
    (
        lambda: ji.impact(ji.LZB(0.9, friction=0.1), MANY, np.ones(402)),
        r"`scene` must have at most 200 contacts .*, but has 201",
    ),
    (
        lambda: ji.impact(
            ji.Compliant(ji.Hertz(1.0), friction=0.1), MANY, np.ones(402)
        ),
        r"`scene` must have at most 200 contacts .*, but has 201",
    ),
    (lambda: ji.impact(ji.LZB, BALLS, V), r"`law` must be of type Law"),
    (
        lambda: ji.impact(ji.LZB(0.9), ji.Block(1.0, 2.0), V),
        r"is Block\(.* `\.scene\(q\)`",
    ),
    (
        lambda: ji.impact(ji.LZB(0.9), BALLS, [1.0, [0.0], 0.0]),
        r"`velocity`.*equally long",
    ),
    (lambda: ji.chain(np.array([1.0, 1j])), r"`masses` must be real, but is complex"),
    (
        lambda: ji.chain(np.array(["2026-01-01"] * 2, "datetime64[D]")),
        r"`masses`.*holds dates",
    ),
    (
        lambda: ji.RandomLaw(ji.LZB, restitution=ji.Uniform(0.1, 0.9)),
        r"is the class LZB",
    ),
    (
        lambda: ji.impact(ji.LZB(0.9), [1.0, 1.0, 1.0], V),
        r"`scene` must be of type Scene",
    ),
    (
        lambda: ji.impact(ji.Newton(0.5), WELDED, [1.0, 0.0, 0.5]),
        r"`velocity` must satisfy .*constraint 1 has the rate 0.5",
    ),
    (
        lambda: ji.impact(ji.Newton(0.5), BALLS, V, noise=-1.0),
        r"`noise` must lie in \[0, inf\)",
    ),
    (lambda: ji.impact(ji.Newton(0.5), BALLS, V, noise=np.nan), r"`noise`.*nan"),
    (
        lambda: ji.impact(ji.Newton(0.5), BALLS, V, noise=[0.1, 0.1]),
        r"`noise` must have shape",
    ),
    (lambda: ji.impact(ji.Newton(0.5), BALLS, V, approach=-1.0), r"`approach`.*-1"),
    (lambda: ji.impact(ji.Binary(0.5, (0, 1, 2)), BALLS, V), r"0 to 1"),
    (lambda: ji.impact(ji.Binary(0.5, (0,)), BALLS, V), r"contact 1 is missing"),
    (lambda: ji.impact(ji.Binary(0.5, (0, 0, 1)), BALLS, V), r"twice in a row"),
    (
        lambda: ji.impact(ji.RestitutionMatrix(jnp.eye(4)), BALLS, V),
        r"shape \(2, 2\) or \(3, 3\) for 2 contacts",
    ),
    (
        lambda: ji.impact(ji.RestitutionMatrix(jnp.eye(3)), BALLS, V),
        r"shape \(2, 2\) for 2 contacts without tangents",
    ),
    (lambda: ji.RandomLaw(ji.Binary(0.9)), "`parameters` must name one that is random"),
    (lambda: ji.impact(ji.LZB, BALLS, V), r"That is the class; LZB\(\.\.\.\) makes"),
    (
        lambda: ji.impact("LZB", BALLS, V),
        r"`law` must be of type Law.*as ji\.LZB\(0\.9\)",
    ),
    (
        lambda: ji.impact(BALLS, ji.LZB(0.9), V),
        "a Scene. The law comes before the scene",
    ),
    (
        lambda: ji.impact(ji.LZB(0.9), BALLS, [V, V]),
        r"shape \(3,\).*jax\.vmap takes one row",
    ),
    (
        lambda: ji.RandomLaw(ji.Newton(0.9), e=ji.Uniform(0.8, 0.9)),
        "`e`. Did you mean restitution",
    ),
    (
        lambda: ji.summary(BALLS, BALLS, V),
        "`out` must be of type Impact, but is a Scene",
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)


@jax.jit
@jax.vmap
def traced(velocity, noise, approach):
    """Of an impact against two welded bodies."""
    return ji.impact(ji.Newton(0.5), WELDED, velocity, noise, approach).status


def test_what_the_host_refuses_has_a_status_inside_jit():
    velocity = np.array([[1.0, 0, 0]] * 8)
    velocity[0] = 1.0, 0.0, 0.5
    velocity[1] = 1.0, 0.3, 0.3 + 1e-12  # within rounding
    noise, approach = np.zeros(8), np.zeros(8)
    noise[2:5] = approach[5:8] = -1e-9, np.nan, np.inf
    wanted = ["out_of_range", "ok", *["out_of_range", "not_finite", "out_of_range"] * 2]
    found = traced(velocity, noise, approach)
    assert [ji.STATUS[code].name for code in found] == wanted


def test_python_numpy_and_jax_inputs_agree():
    outs = [
        ji.impact(ji.Moreau(kind([0.9, 0.8])), ji.chain(kind([1.0, 2.0, 3.0])), kind(V))
        for kind in (list, np.array, jnp.array)
    ]
    ints = ji.impact(ji.Moreau([0.9, 0.8]), ji.chain([1, 2, 3]), [1, 0, 0])
    for out in (*outs, ints):
        np.testing.assert_allclose(out.velocity, outs[0].velocity, atol=1e-14)
