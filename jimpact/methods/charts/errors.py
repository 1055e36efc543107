"""Errors of the answers of a method, and how far the reference itself can be trusted."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jimpact.methods.charts.programs import Answer, Case, Programs, on_host
from jimpact.methods.charts.record import QUANTITIES, Reference
from jimpact.methods.contenders import Method
from jimpact.scene import kinetic_energy

FINEST, SECOND = 1e-14, 1e-12  # rtol of the reference, and of the other one it is compared with
Moment = tuple[Answer, np.ndarray | None]  # answers of a sample, and their gradients


def moment_of(programs: Programs, setting: float | None) -> Moment:
    """What a method answers at a setting."""
    answer = on_host(programs.account(setting))
    return answer, None if programs.gradient is None else np.asarray(programs.gradient(setting))


def errors_of(case: Case, moment: Moment, truth: Moment) -> dict[str, float]:
    """Relative errors, the largest over as many impacts as `moment` has."""
    (found, slopes), (exact, exact_slopes) = moment, truth
    rows = len(found.velocity)
    fastest = float(jnp.max(jnp.abs(case.velocity))) or float(np.abs(exact.velocity).max())
    before = float(kinetic_energy(case.scene, case.velocity))
    before = before or float(np.abs(exact.energy).max())

    def largest(a: Any, b: Any) -> float:
        return float(np.abs(np.asarray(a) - np.asarray(b)[:rows]).max())

    impulse = np.abs(np.asarray(exact.impulse)).max()
    duration = np.abs(np.asarray(exact.duration)).max()
    error = {
        "velocity": largest(found.velocity, exact.velocity) / fastest,
        "impulse": largest(found.impulse, exact.impulse) / float(impulse),
        "energy": largest(found.energy, exact.energy) / before,
        "duration": largest(found.duration, exact.duration) / float(duration),
        "gradient": float("nan"),
    }
    if slopes is not None and exact_slopes is not None:
        error["gradient"] = largest(slopes, exact_slopes) / fastest
    return error


def reference_of(
    case: Case, exact: Method, second: Method, truth: Moment, other: Moment
) -> Reference:
    """The reference, and its distance from another solution."""
    answer = truth[0]
    uncertainty = errors_of(case, other, truth)
    assert list(uncertainty) == list(QUANTITIES)
    return Reference(
        how=f"{exact.name} at rtol {FINEST:g} against {second.name} at {SECOND:g}",
        uncertainty=uncertainty,
        velocity=np.asarray(answer.velocity[0]),
        impulse=np.asarray(answer.impulse[0]),
        duration=float(np.asarray(answer.duration)[0]),
    )
