"""The tolerance of impacts that the noise of measured velocities allows."""

import dataclasses

import jax
import numpy as np

from jimpact.contact import contact_of
from jimpact.fits.experiments import Experiments
from jimpact.law import AnyLaw
from jimpact.scene import Scene
from jimpact.status import sign_tolerance

# Error of computed gap velocities, as a part of their noise. Ten times more: as large as the noise
# itself, and the same in all shots.
PART_OF_NOISE = 0.1
# Tolerance for such data: one, since each compiles a program. Standard errors move by .1 %; at one
# ten times more derivatives lose another digit.
COARSE = 1e-4
_CONTACT = jax.jit(contact_of)  # remembers the shapes that it has seen; only these are asked for


def tolerated(
    law: AnyLaw, scene: Scene | None, data: Experiments
) -> tuple[AnyLaw, tuple[str, ...]]:
    """The law at a tolerance that the noise of the data allows, and a sentence that says so.

    Of a law without `rtol` that errs by more than signs do (`Law.accuracy`), where `sigma` is
    known.
    """
    if data.sigma is None or getattr(law, "rtol", COARSE) is not None:
        return law, ()
    pre, sigma = np.asarray(data.pre), np.asarray(data.sigma)
    shapes = _CONTACT.eval_shape(data.largest_scene(scene), pre[0])
    if not sign_tolerance(pre.dtype) < law.accuracy(shapes) < COARSE:
        return law, ()
    normals = data.each(scene, lambda each: np.asarray(each.normals))
    fastest = [np.abs(n.T @ v).max() for n, v in zip(normals, pre)]
    noise = [np.sqrt(np.square(n.T) @ s**2).min() for n, s in zip(normals, sigma)]
    # a noise of NaN, where a value was not measured, allows nothing
    if not all(PART_OF_NOISE * s >= COARSE * v for s, v in zip(noise, fastest)):
        return law, ()
    line = (
        f"Velocities finer than {COARSE:g} of the fastest approach: the law is computed with `rtol`"
        f" = {COARSE:g}, a tenth of the noise or less; give it an `rtol` to change that."
    )
    return dataclasses.replace(law, **{"rtol": COARSE}), (line,)
