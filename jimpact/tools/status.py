"""Status codes of impacts and motions: set on the device, worded and raised on the
host.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jimpact.tools.checks import is_traced


class Status(NamedTuple):
    """One row of the table; `failure` marks results that must not be used as they
    are.
    """

    name: str
    message: str
    failure: bool


# One table for impacts and motions. The code is the row number; where several apply the
# highest wins, so rows go from mild to grave. `failure` marks impacts without a usable
# outcome and motions that end before t_end.
STATUS = (
    Status("ok", "resolved within tolerance", failure=False),
    Status(
        "impulse_not_unique",
        "v+ is determined, the impulses are one of many",
        failure=False,
    ),
    Status(
        "order_dependent",
        "the outcome depends on the order of adjacent collisions",
        failure=False,
    ),
    Status(
        "several_outcomes",
        "the law allows several outcomes, this is one of them",
        failure=False,
    ),
    Status(
        "plastic_limit",
        "contacts re-close without end; finished in the plastic limit",
        failure=False,
    ),
    Status(
        "ill_conditioned",
        "the outcome depends on the tolerance by more than 10 rtol",
        failure=False,
    ),
    Status(
        "coarse_step",
        "steps are too long: within 3 a contact is struck again, at more than a tenth "
        "of the largest gap velocity, or in one bodies pass each other, or a disc of a "
        "pile moves by more than the least radius",
        failure=False,
    ),
    Status(
        "unsolved_step",
        "impulses of a step are off by > 1 % of its velocities",
        failure=False,
    ),
    Status(
        "energy_gain",
        "the outcome holds more energy than was there before",
        failure=True,
    ),
    Status(
        "inadmissible_velocity",
        "a contact still approaches after the impact",
        failure=True,
    ),
    Status("negative_impulse", "a contact would have to pull (p < 0)", failure=True),
    Status("infeasible", "the law has no solution for this scene", failure=True),
    Status(
        "law_failed",
        "the law fails at an impact of the motion (see `events.status`)",
        failure=True,
    ),
    Status(
        "no_contact_force",
        "contact forces with friction have no solution, and the law has no impact "
        "without collision for it: LZB with `friction` has one",
        failure=True,
    ),
    Status(
        "room", "more contacts are closed than the body has `room` for", failure=True
    ),
    Status("max_events", "more events than `max_events`", failure=True),
    Status(
        "max_steps",
        "the step limit, or steps that vanish, ended the impact or the motion before "
        "it was over; for an impact by LZB or Compliant try method='implicit'",
        failure=True,
    ),
    Status("penetration", "a gap is negative at the start", failure=True),
    Status("backward", "t_end is not after t_start", failure=True),
    Status(
        "singular_mass",
        "the mass matrix is not positive definite on the way",
        failure=True,
    ),
    Status(
        "out_of_range",
        (
            "an argument, the energy of the impact or a gap function on the way is "
            "outside its range"
        ),
        failure=True,
    ),
    Status("not_finite", "the result or its input is NaN or infinite", failure=True),
)

CODE = {row.name: code for code, row in enumerate(STATUS)}

# A sign is violated only beyond these multiples of the impact's own scale: rounding and
# the solver's tolerance stay below (float64: 1e-7; float32: about 2e-3).
SIGN_TOLERANCE = {"float64": 1e-7, "float32": 2e-3}


def raise_for(
    codes: Any,
    table: Sequence[Status],
    what: str,
    more: Callable[[Status, np.ndarray], str],
) -> None:
    """Raise a RuntimeError that lists the failures among status codes, or return.

    Args:
        codes: numbers of rows of the table, of any shape.
        table: rows, as `STATUS`.
        what: plural of what has a code, for the message.
        more: text to add for a row of the table, and the places (k,) of its code in
            flat `codes`.
    """
    if is_traced(codes):
        raise TypeError(
            "Argument `out` must hold numbers, but is traced (jit, vmap, grad), where "
            "nothing can be raised: read `out.status` (0: ok), or call this outside."
        )
    codes = np.atleast_1d(np.asarray(codes))
    lines = []
    for code in np.unique(codes):
        row = table[code]
        at = np.argwhere(codes == code)
        if row.failure:
            first = ", ".join(
                str(tuple(map(int, i)) if len(i) > 1 else int(i[0])) for i in at[:5]
            )
            if codes.size > 1:
                where = f" at {first}{', ...' if len(at) > 5 else ''}"
            else:
                where = ""
            added = more(row, np.flatnonzero(codes == code))
            lines.append(f"{row.name}: {row.message} ({len(at)}{where}){added}")
    if lines:
        raise RuntimeError(
            f"Failed {what} among {codes.size}:\n  " + "\n  ".join(lines)
        )


def sign_tolerance(dtype: Any) -> float:
    """Part of the impact's size beyond which a sign counts as violated, in this
    precision.
    """
    return SIGN_TOLERANCE.get(str(dtype), SIGN_TOLERANCE["float32"])
