"""A user's script: mypy and pyright must see every name, signature and field of it (it never runs).

An ignored error is one that they have to find: an ignore without an error is an error, too.
"""

from typing import assert_type

import jax
import numpy as np
from matplotlib.figure import Figure

import jimpact as ji
from jimpact.montecarlo.result import MonteCarlo
from jimpact.motion.record import Motion

cradle = ji.chain([1.0, 1.0, 1.0])
law = ji.LZB(0.9, [1.0, 2.0], exponent=1.5, rtol=1e-9)
out = ji.impact(law, cradle, [1.0, 0.0, 0.0])
assert_type(cradle, ji.Scene)
assert_type(law, ji.LZB)
assert_type(out, ji.Impact)
assert_type(out.velocity, jax.Array)
assert_type(ji.Newton(0.5, friction=[0.1, 0.2]).restitution, jax.Array)
assert_type(ji.Moreau([0.5, 0.6], friction=0.3).friction, jax.Array | None)
assert_type(ji.RestitutionMatrix([[0.1, 0.0], [0.8, 0.5]]).matrix, jax.Array)
assert_type(ji.Poisson(0.5).restitution, jax.Array)
assert_type(
    ji.Binary(np.array([0.5, 0.9]), order="earliest").order, str | tuple[int, ...]
)
assert_type(ji.Compliant(ji.KelvinVoigt(1e9, 10.0)).force, ji.Force)
assert_type(out.status, jax.Array)
assert_type(ji.raise_on_failure(out), ji.Impact)
assert_type(ji.summary(out, cradle, [1.0, 0.0, 0.0]), str)
assert_type(ji.history(law, cradle, [1.0, 0.0, 0.0], samples=50).force, jax.Array)
assert_type(bool(ji.audit(out, cradle, [1.0, 0.0, 0.0]).energetic), bool)

# what goes into a fit as LZB comes out as LZB
shots = ji.Experiments(pre=[[1.0, 0.0, 0.0]], post=[[-0.06, 0.1, 1.0]])
fit = ji.fit(law, cradle, shots, free=("restitution",))
assert_type(fit.law, ji.LZB)
assert_type(fit.law.restitution, jax.Array)
assert_type(fit.standard_error, np.ndarray)
assert_type(fit.warnings, tuple[str, ...])

found = ji.monte_carlo(
    law, cradle, [1.0, 0.0, 0.0], gaps=ji.Uniform(0.0, 1e-5), samples=100
)
assert_type(found, MonteCarlo)
assert_type(ji.compare(cradle, [1.0, 0.0, 0.0]).velocity, np.ndarray)
assert_type(
    ji.simulate(ji.System(ji.Column([1.0]), gravity=True), law, [1.0], [0.0], 1.0),
    Motion,
)

# name spaces
assert_type(ji.plot.fit(fit), Figure)
assert_type(ji.plot.monte_carlo(found), Figure)
assert_type(ji.theory.newby_ratio(3), float)
assert_type(ji.theory.admissible_set(cradle, [1.0, 0.0, 0.0]), ji.theory.AdmissibleSet)

print(ji.LZB(0.9, stifness=1.0))  # type: ignore[call-arg]
print(ji.impact(cradle, law, [1.0, 0.0, 0.0]))  # type: ignore[arg-type]
print(ji.no_such_law)  # type: ignore[attr-defined]
print(ji.plot_fit)  # type: ignore[attr-defined]
print(ji.plot.no_such_picture)  # type: ignore[attr-defined]
print(out.velocty)  # type: ignore[attr-defined]
