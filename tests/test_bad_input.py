"""Each bad input is one clear error that names the argument, its value and what is allowed."""

import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]

BAD = [
    (lambda: ji.LZB(1.3), r"`restitution` must lie in \[0, 1\], but has value 1\.3"),
    (lambda: ji.LZB([0.5, -0.1]), r"`restitution`.*-0\.1 at index 1"),
    (lambda: ji.LZB(np.nan), r"`restitution`.*nan"),
    (lambda: ji.LZB(0.9, stiffness=0.0), r"`stiffness` must lie in \(0, inf\), but has value 0"),
    (lambda: ji.LZB(0.9, stiffness=[1.0, np.inf]), r"`stiffness`.*inf at index 1"),
    (lambda: ji.LZB(0.9, exponent=0.5), r"`exponent` must lie in \[1, inf\)"),
    (lambda: ji.LZB(0.9, exponent=(1.5, 0.9)), r"`exponent`.*0\.9 at index 1"),
    (lambda: ji.LZB(0.9, initial_energy=-1.0), r"`initial_energy`.*-1"),
    (lambda: ji.LZB(0.9, rtol=0.0), r"`rtol`"),
    (lambda: ji.LZB(0.9, method="euler"), r"`method` must be one of .*'euler'"),
    (lambda: ji.LZB(0.9, method="propagator"), r"`exponent` must be the float 1\.0"),
    (lambda: ji.LZB("high"), r"`restitution` must be numeric"),
    (lambda: ji.Newton(-0.1), r"`restitution`"),
    (lambda: ji.chain([1.0, -1.0]), r"`masses` must lie in \(0, inf\).*-1 at index 1"),
    (lambda: ji.chain([1.0, 0.0]), r"`masses`"),
    (lambda: ji.chain([1.0, np.nan]), r"`masses`"),
    (lambda: ji.chain([[1.0, 1.0]]), r"`masses` must have shape \(n,\)"),
    (lambda: ji.chain([1.0]), r"at least one contact"),
    (lambda: ji.chain([1.0, 1.0], wall="up"), r"`wall` must be one of .*'up'"),
    (lambda: ji.chain([1.0, 1.0], gaps=[-1e-6]), r"`gaps`.*-1e-06"),
    (lambda: ji.chain([1.0, 1.0], gaps=[0.0, 0.0]), r"`gaps` must have shape \(1,\)"),
    (lambda: ji.Scene([[1.0, 0.5], [0.0, 1.0]], [[1.0], [0.0]]), r"`mass` must be symmetric"),
    (lambda: ji.Scene([[1.0, 1.0], [1.0, 1.0]], [[1.0], [0.0]]), r"positive definite"),
    (lambda: ji.Scene([1.0, -1.0], [[1.0], [0.0]]), r"`mass`.*-1"),
    (lambda: ji.Scene([1.0, 1.0], [1.0, 0.0]), r"`normals` must have shape \(n, m\)"),
    (lambda: ji.Scene([1.0, 1.0], [[0.0], [0.0]]), r"zero column"),
    (lambda: ji.Scene([1.0, 1.0], [[np.nan], [0.0]]), r"`normals`"),
    (lambda: ji.Scene([1.0], [[1.0]], tangents=[[1.0, 0.0, 0.0]]), r"`tangents`"),
    (lambda: ji.Scene([1.0], [[1.0]], constraints=[1.0]), r"`constraints`"),
    (lambda: ji.impact(ji.LZB(0.9), BALLS, [1.0, 0.0]), r"`velocity` must have shape \(3,\)"),
    (lambda: ji.impact(ji.LZB(0.9), BALLS, [1.0, 0.0, np.nan]), r"`velocity`.*nan at index 2"),
    (lambda: ji.impact(ji.LZB([0.9] * 3), BALLS, V), r"`restitution` must have shape \(2,\)"),
    (lambda: ji.impact(ji.LZB(0.9, exponent=(1.5,) * 3), BALLS, V), r"`exponent`.*\(2,\)"),
    (
        lambda: ji.impact(
            ji.LZB(jnp.float32(0.9), jnp.float32(1.0), initial_energy=jnp.float32(0.0), rtol=1e-8),
            ji.chain(jnp.ones(3, jnp.float32)),
            jnp.array(V, jnp.float32),
        ),
        r"`rtol` must be at least 1\.9e-06 in float32, but has value 1e-08",
    ),
    (lambda: ji.history(ji.Newton(0.9), BALLS, V), r"`law` must be an LZB"),
    (lambda: ji.impact(ji.LZB, BALLS, V), r"`law` must be of type Law"),
    (lambda: ji.impact(ji.LZB(0.9), [1.0, 1.0, 1.0], V), r"`scene` must be of type Scene"),
    (lambda: ji.fit(ji.LZB(0.9), BALLS, [V, V]), r"`experiments` must be of type Experiments"),
    (
        lambda: ji.simulate(ji.Newton(0.5), ji.ball_system(), [1.0], [0.0], 1.0),
        r"`system` must be of type System",
    ),
    (lambda: ji.gap_velocity(BALLS, [1.0, 0.0]), r"`velocity` must have shape \(3,\)"),
    (lambda: ji.velocity_change(BALLS, [1.0]), r"`impulse` must have shape \(2,\)"),
    (lambda: ji.history(ji.LZB(0.9), BALLS, V, samples=1), r"`samples`"),
    (lambda: ji.distributing_rule([-1.0, 1.0], 1.0, 1.5), r"`energy`"),
]


@pytest.mark.parametrize(("call", "message"), BAD)
def test_bad_input(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()


def test_python_numpy_and_jax_inputs_agree():
    outs = [
        ji.impact(ji.LZB(kind([0.9, 0.8])), ji.chain(kind([1.0, 2.0, 3.0])), kind([1.0, 0.0, 0.0]))
        for kind in (list, np.array, jnp.array)
    ]
    ints = ji.impact(ji.LZB([0.9, 0.8]), ji.chain([1, 2, 3]), [1, 0, 0])
    for out in (*outs, ints):
        np.testing.assert_array_equal(out.velocity, outs[0].velocity)
