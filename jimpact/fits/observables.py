"""What is observed of a law: velocities after impacts, or a user's own function of
it.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import contact_of
from jimpact.core.impacts import impact
from jimpact.core.law import AnyLaw, Law
from jimpact.core.scene import Scene
from jimpact.fits.parameters import placed
from jimpact.shots.data import Experiments
from jimpact.tools.status import CODE, sign_tolerance

# Outcomes whose velocities are meaningless.
UNUSABLE = ("infeasible", "max_steps", "not_finite")

# Shots are filled up to 4, 8, 16, ... of them: a program serves all numbers in between,
# and the copies that fill up cost far less than compiling another one.
FEWEST = 4
# Error of computed gap velocities, as a part of their noise. Ten times more: as large
# as the noise itself, and the same in all shots.
PART_OF_NOISE = 0.1
# Tolerance for such data: one, since each compiles a program. Standard errors move by
# .1 %; at one ten times more derivatives lose another digit.
COARSE_RTOL = 1e-4
# remembers the shapes that it has seen; only these are asked for
_CONTACT = jax.jit(contact_of)


class Prediction(NamedTuple):
    """Predictions of a law: values, `bad` where they are meaningless, and status codes
    (S,).
    """

    value: jax.Array
    bad: jax.Array
    status: jax.Array


class Shots(eqx.Module):
    """The observable of impacts: v+ (K, n)."""

    scenes: Scene  # stacked, one for each shot
    pre: jax.Array  # (K, n), further columns where scenes were made alike
    bodies: int = eqx.field(static=True)

    def __call__(self, law: Law) -> Prediction:
        """v+ (K, n) after the impact of each shot, and its status code; bad if it is
        `UNUSABLE`.
        """
        law, scenes = placed(law, self.scenes)
        impact_of_shot = jax.vmap(impact, in_axes=(None, 0, 0))
        out = impact_of_shot(law, scenes, self.pre)
        codes = [CODE[name] for name in UNUSABLE]
        unusable = jnp.asarray(codes, out.status.dtype)
        is_unusable = out.status[:, None] == unusable[None, :]
        bad = jnp.any(is_unusable, axis=1)
        velocity = out.velocity[:, : self.bodies]
        return Prediction(velocity, bad[:, None], out.status)


class Observed(eqx.Module):
    """The observable of a user's own function of a law.

    `absolute`: it may see absolute stiffnesses (a force, a time), not only their
    ratios.
    """

    function: Callable[[Law], Any] = eqx.field(static=True)
    absolute: bool = eqx.field(static=True, default=False)

    def __call__(self, law: Law) -> Prediction:
        """The value of the function; NaN counts as meaningless."""
        value = jnp.asarray(self.function(law))
        no_status = jnp.zeros(1, jnp.int32)
        return Prediction(value, ~jnp.isfinite(value), no_status)


def filled_count(count: int) -> int:
    """Number of shots of the program for `count` shots: the next of 4, 8, 16, ..."""
    if count <= FEWEST:
        return FEWEST
    return 2 ** math.ceil(math.log2(count))


def tolerated(
    law: AnyLaw, scene: Scene | None, data: Experiments
) -> tuple[AnyLaw, tuple[str, ...]]:
    """The law with `rtol = COARSE_RTOL` where the noise of the data allows it, and a
    note.

    It does where `sigma` is known, and in each shot the smallest noise of a gap
    velocity, `sqrt(sum (N_ij sigma_i)^2)`, times `PART_OF_NOISE` is at least
    `COARSE_RTOL` of the fastest one. Laws with an `rtol`, more accurate ones and less
    accurate ones stay as they are.
    """
    if data.sigma is None or getattr(law, "rtol", COARSE_RTOL) is not None:
        return law, ()
    pre = np.asarray(data.pre)
    sigma = np.asarray(data.sigma)
    shapes = _CONTACT.eval_shape(data.largest_scene(scene), pre[0])
    if not sign_tolerance(pre.dtype) < law.accuracy(shapes) < COARSE_RTOL:
        return law, ()
    normals = data.each(scene, lambda each: np.asarray(each.normals))
    rates = [n.T @ v for n, v in zip(normals, pre)]
    fastest = [np.abs(rate).max() for rate in rates]
    noise = [np.sqrt(np.square(n.T) @ s**2).min() for n, s in zip(normals, sigma)]
    # a noise of NaN, where a value was not measured, allows nothing
    both = zip(noise, fastest)
    if not all(PART_OF_NOISE * s >= COARSE_RTOL * v for s, v in both):
        return law, ()
    line = (
        f"Velocities finer than {COARSE_RTOL:g} of the fastest approach: the law is "
        f"computed with `rtol` = {COARSE_RTOL:g}, a tenth of the noise or less; give "
        f"it an `rtol` to change that."
    )
    return dataclasses.replace(law, **{"rtol": COARSE_RTOL}), (line,)
