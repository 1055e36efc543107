"""What `advise` is given: checks, defaults, and what is known of the stiffnesses."""

from typing import Any

import numpy as np

from jimpact._checks import check_per_contact, check_shape, check_values
from jimpact.laws.lzb import LZB
from jimpact.methods.advice.structure import Situation
from jimpact.scene import Scene

UNKNOWN_RANGE = (0.1, 10.0)  # plausible ratio of two stiffnesses where nothing is said


def parameters_of(
    scene: Scene, law: LZB | None, restitution: Any, stiffness: Any, exponent: Any
) -> tuple[dict[str, Any], bool]:
    """Restitution, stiffness and exponent, and whether the stiffness is known."""
    given = {"restitution": restitution, "stiffness": stiffness, "exponent": exponent}
    if law is not None:
        if not isinstance(law, LZB):
            raise TypeError(f"Argument `law` must be an LZB, but is {law!r}.")
        double = [name for name, value in given.items() if value is not None]
        if double:
            raise ValueError(
                f"Argument `{double[0]}` must be None where `law` is given, "
                f"but has value {given[double[0]]!r}."
            )
        if np.asarray(law.initial_energy).any():
            raise ValueError(
                "Argument `law` must have no initial_energy (no simpler law knows of "
                f"precompression), but has {law.initial_energy}."
            )
        given = {name: getattr(law, name) for name in given}
    known = given["stiffness"] is not None
    defaults = {"restitution": 1.0, "stiffness": 1.0, "exponent": 1.5}
    values = {key: defaults[key] if value is None else value for key, value in given.items()}
    for key, value in values.items():
        check_per_contact(key, value, scene.contacts)
    return values, known


def span_of(given: tuple[float, float] | None, known: bool) -> tuple[float, float]:
    """The range of a stiffness ratio, as factors."""
    if given is None:
        return (1.0, 1.0) if known else UNKNOWN_RANGE
    ends = np.asarray(given)
    check_shape("stiffness_range", ends, (2,), "low and high factor")
    check_values("stiffness_range", ends, low=0.0, open_low=True)
    low, high = float(ends[0]), float(ends[1])
    if low > high:
        raise ValueError(
            f"Argument `stiffness_range` must have low <= high, but has value ({low:g}, {high:g})."
        )
    return low, high


def check_tolerance(tolerance: Any, finest: float) -> None:
    """A number between what the reference can resolve and 1."""
    check_shape("tolerance", tolerance, (), "one number")
    check_values("tolerance", tolerance, low=finest, high=1.0)


def missing_stiffness(at: Situation) -> str:
    """The message where ratios of stiffnesses are not enough."""
    if at.gapped.any():
        named = ", ".join(str(j + 1) for j in np.flatnonzero(at.gapped))
        return (
            "Argument `stiffness` must be given [N/m^eta] where open contacts can meet others at "
            f"work (contact {named}): gaps count in units of the indentation."
        )
    return "Argument `stiffness` must be given where exponents differ: ratios then say nothing."
