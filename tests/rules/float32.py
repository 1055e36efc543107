"""Single precision, as JAX has it by default: every law, a fit, a motion, samples. `.ci/legs` runs it."""

import jax
import numpy as np

import jimpact as ji

ABOUT = 2e-3  # of the fastest velocity: what single precision leaves of the closed forms below

balls, v = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
ALL_BUT_ONE, PAIRS = [-1 / 3, 2 / 3, 2 / 3], [0.0, 0.0, 1.0]
LAWS = {  # elastic, with v+ in closed form
    "newton": (ji.Newton(1.0), ALL_BUT_ONE),
    "moreau": (ji.Moreau(1.0), ALL_BUT_ONE),
    "poisson": (ji.Poisson(1.0), ALL_BUT_ONE),
    "binary": (ji.Binary(1.0), PAIRS),
    "matrix": (ji.RestitutionMatrix(np.eye(2)), ALL_BUT_ONE),
    "lzb": (ji.LZB(1.0, [1.0, ji.theory.newby_ratio(3)], 1.0), ALL_BUT_ONE),
    "compliant": (
        ji.Compliant(ji.LinearSpring([1.0, ji.theory.newby_ratio(3)])),
        ALL_BUT_ONE,
    ),
}

assert not jax.config.jax_enable_x64
for name, (law, after) in LAWS.items():
    out = ji.raise_on_failure(ji.impact(law, balls, v))
    assert out.velocity.dtype == np.float32, name
    np.testing.assert_allclose(out.velocity, after, atol=ABOUT, err_msg=name)
    slope = jax.grad(lambda u, law=law: ji.impact(law, balls, u).velocity[2])(
        np.float32(v)
    )
    assert np.isfinite(slope).all(), name
    print(f"{name:10s}", out.velocity, slope)

data = ji.Experiments(pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]])
found = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
np.testing.assert_allclose(found.value, [0.4], atol=ABOUT)
motion = ji.simulate(
    ji.System(ji.Column([1.0]), gravity=True),
    ji.Newton(0.8),
    [1.0],
    [0.0],
    5.0,
    samples=21,
)
ji.raise_on_failure(motion)
assert len(motion.event_times("accumulation")) == 1
assert motion.q[-1] == motion.velocity[-1] == 0
np.testing.assert_allclose(motion.events.time[0], np.sqrt(2 / 9.80665), atol=ABOUT)
sampled = ji.monte_carlo(
    ji.Newton(0.5), balls, ji.Uniform(v, [2.0, 0.0, 0.0]), samples=1000
)
assert sampled.count == 1000
print("fit", found.value, "motion", motion.events.time[0], "samples", sampled.mean)
