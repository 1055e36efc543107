"""How a motion is computed: the methods of `simulate`, and the options of each."""

import warnings
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jimpact.core.law import Law
from jimpact.motion.dynamics import is_pile
from jimpact.motion.pile_contacts import PileContacts, contacts_of_step
from jimpact.motion.start import Start, start_of
from jimpact.motion.system import System
from jimpact.tools.checks import (
    as_whole,
    check_choice,
    check_shape,
    check_values,
    is_traced,
    short_repr,
)
from jimpact.tools.precision import check_rtol

# Contacts of a pile above which motions by events warn: 1 100 compile for more than two
# minutes. Ten times more, and nobody is warned of that.
MANY = 200
# rtol, atol of the flights
TOLERANCES = {"float64": (1e-10, 1e-12), "float32": (1e-5, 1e-7)}
# Share of the largest gap velocity: a slower contact that is pressed back remains
# closed. Ten times more passes an accumulation a few impacts earlier, and loses a
# hundred times the energy there.
SLOW = 1e-6
MOST_STEPS = np.iinfo(np.int32).max  # of time stepping: they are counted in 32 bits
# of the flights by default; ten times more only delays the status `max_steps`
MAX_STEPS = 100_000


@dataclass(frozen=True)
class EventDriven:
    """Flights that land on each event, impacts in no time; 'events' is its default.

    Equation: between events that of `System`, with `0 <= lambda_n _|_ f'' >= 0` at
    contacts that are closed and at rest.

    Args:
        rtol: relative tolerance of the flights; None: 1e-10, in single precision 1e-5.
        atol: absolute one [m, m/s, rad, ..]; None: 1e-12, in single precision 1e-7.
        closed_below: contacts with smaller gaps [m] take part in an impact; None: 1e-9,
            or 80 roundings of the largest coordinate or gap at the start, if that is
            more.
        slow: repeated impacts with decreasing speed (accumulations) are cut short: a
            contact that leaves slower than this share of the largest gap velocity so
            far, and would be pressed back, remains closed. For contacts that share a
            body the limit is `sqrt(slow)` (docs/motions_reference.md). `Motion.events`
            estimates the skipped time.
        max_steps: total integrator steps.
        progress: seconds after which a bar on stderr shows the share of the duration
            that is done, after each run of 500 events; True: at once, False: never,
            None: after two seconds, and only on a terminal.

    Raises:
        ValueError: values out of range.

    >>> import jimpact as ji
    >>> ball, coarse = (
    ...     ji.System(ji.Column([1.0]), gravity=True),
    ...     ji.EventDriven(slow=0.1),
    ... )
    >>> motion = ji.simulate(
    ...     ball, ji.Newton(0.8), [1.0], [0.0], 5.0, method=coarse, samples=3
    ... )
    >>> int(motion.events.count)
    11
    """

    rtol: float | None = None
    atol: float | None = None
    closed_below: Any = None
    slow: Any = SLOW
    max_steps: int = MAX_STEPS
    progress: float | None = None

    def __post_init__(self) -> None:
        _check_flights(self)
        check_values("closed_below", self.closed_below, low=0.0, open_low=True)
        check_values("slow", self.slow, low=0.0, high=1.0)


@dataclass(frozen=True)
class ContactForces:
    """The forces of a `Compliant` law act throughout: contacts take time, and give way.

    Equation: `M v' = h + N F(f, f')`, the force F of the law at every gap f below zero.

    Args:
        rtol, atol, max_steps, progress: as of `EventDriven`.
        until_apart: end where all contacts are open and none closes, with status `ok`:
            an impact whose geometry turns. Its outcome is that of the last event.

    Raises:
        ValueError: values out of range.

    >>> import jimpact as ji
    >>> ball, law = ji.System(ji.Column([1.0])), ji.Compliant(ji.Hertz(1e6))
    >>> impact = ji.ContactForces(until_apart=True)
    >>> motion = ji.simulate(ball, law, [0.0], [-1.0], 1.0, method=impact, max_events=9)
    >>> round(float(motion.events.velocity_after[motion.events.count - 1, 0]), 6)
    1.0
    """

    rtol: float | None = None
    atol: float | None = None
    max_steps: int = MAX_STEPS
    until_apart: bool = False
    progress: float | None = None

    def __post_init__(self) -> None:
        _check_flights(self)


@dataclass(frozen=True)
class TimeStepping:
    """Moreau-Jean steps of equal length, for many contacts.

    Equation: `M (v+ - v-) = h dt + N p`, p that of the law at the contacts that are
    closed in the middle of the step.

    Args:
        step: [s]; those between two samples are equal, none is longer.
        closed_below: as of `EventDriven`.
        progress: seconds after which stderr says that the motion runs, see
            `EventDriven`.

    Raises:
        ValueError: values out of range.

    Source: Brogliato, Nonsmooth Mechanics (2016), Remark 6.9.

    >>> import jimpact as ji
    >>> ball, steps = ji.System(ji.Column([1.0]), gravity=True), ji.TimeStepping(1e-3)
    >>> motion = ji.simulate(
    ...     ball, ji.Moreau(0.0), [0.1], [0.0], 1.0, method=steps, samples=2
    ... )
    >>> abs(float(motion.velocity[-1, 0])) < 1e-12
    True
    """

    step: float
    closed_below: Any = None
    progress: float | None = None

    def __post_init__(self) -> None:
        if self.step is None or is_traced(self.step):
            raise ValueError(
                "Argument `step` must be a number, for method 'time_stepping'."
            )
        check_shape("step", self.step, (), "one number")
        check_values("step", self.step, low=0.0, open_low=True)
        check_values("closed_below", self.closed_below, low=0.0, open_low=True)

    def contacts(
        self, system: System, law: Law, q: Any, v: Any, t: Any = 0.0
    ) -> PileContacts:
        """The contacts of a pile, and their impulses, in the step that begins at q, v.

        Equation: `0 <= p _|_ gamma' + w >= 0`, `|p_t| <= mu p`, as in a motion. In a
        heap at rest `impulse / step` are the contact forces; without forces of the
        system, and with a step in which nothing moves far, it is an impact by Moreau's
        law, with friction, on a packing of any size.

        Args:
            system: of a body with many contacts (`Bodies`).
            law: `Moreau`.
            q: (n,), for example a sample of a motion.
            v: (n,) [m/s, rad/s].
            t: time at the start of the step [s].

        Returns:
            `PileContacts`: bodies, normals, impulses, velocity after the step. Not
            differentiable, not inside jit.

        Raises:
            ValueError: as of `simulate`; a system without many contacts, no contact in
                this step.

        >>> import jimpact as ji
        >>> discs = ji.Bodies([ji.Disc(0.1, 1.0), ji.Disc(0.1, 2.0)], room=8)
        >>> system, q = (
        ...     ji.System(discs, gravity=10.0),
        ...     discs.at([[0.0, 0.3], [0.0, 0.1]]),
        ... )
        >>> found = ji.TimeStepping(1e-3).contacts(system, ji.Moreau(0.0), q, [0.0] * 6)
        >>> found.bodies.tolist(), [round(float(p) / 1e-3, 3) for p in found.impulse]
        ([[0, 1], [1, -1]], [10.0, 30.0])
        """
        h = self.step
        substeps_of(self, t, t + h, 2)  # raises for a step that cannot be one
        return contacts_of_step(system, law, q, v, t, h, self.closed_below)


Method = EventDriven | ContactForces | TimeStepping
METHODS: dict[str, type[Any]] = {
    "events": EventDriven,
    "time_stepping": TimeStepping,
    "contact_forces": ContactForces,
}


def as_method(
    method: str | Method, step: float | None = None, **options: Any
) -> Method:
    """Method object for the argument `method` of `simulate`: itself, or that of a word.

    `options` are those of the word's class; `step` belongs to 'time_stepping' alone.
    """
    if isinstance(method, Method):
        if step is not None:
            raise ValueError(
                "Argument `step` must be left out where `method` is an object: a "
                "`TimeStepping` "
                f"has its own, and others take none, but `method` has value "
                f"{short_repr(method)}."
            )
        return method
    if not isinstance(method, str):
        raise TypeError(
            f"Argument `method` must be one of {', '.join(METHODS)} or an object of "
            f"`EventDriven`, "
            f"`TimeStepping` or `ContactForces`, but has value {short_repr(method)}."
        )
    check_choice("method", method, tuple(METHODS))
    if method == "time_stepping":
        options["step"] = step
    elif step is not None:
        raise ValueError(
            "Argument `step` must be left out but for method='time_stepping', which it "
            "belongs to; "
            f"`method` has value {method!r}."
        )
    make = METHODS[method]
    made: Method = make(**options)
    return made


def name_of(method: Method) -> str:
    """The word for a method."""
    named = METHODS.items()
    return next(name for name, kind in named if isinstance(method, kind))


def substeps_of(
    method: TimeStepping, start: Any, end: Any, samples: int
) -> Int[Array, ""]:
    """Number of equal steps between two samples, so that none is longer than `step`."""
    if is_traced((start, end)):
        raise ValueError("Argument `t_end` must not be traced in time stepping.")
    duration = float(end) - float(start)
    intervals = samples - 1
    between = duration / intervals
    steps = between / float(method.step)
    # a step that fits but for rounding is not cut in two
    whole = np.ceil(steps * (1 - 1e-9))
    count = max(1.0, whole)
    if count * intervals > MOST_STEPS:
        raise ValueError(
            f"Argument `step` must give at most {MOST_STEPS} steps, but has value "
            f"{method.step:g}."
        )
    return jnp.asarray(int(count), jnp.int32)  # an array: one program for all steps


def start_by(
    method: Method,
    system: System,
    law: Law,
    q: Float[Array, "..."],
    v: Float[Array, "..."],
    t_end: Any,
) -> Start:
    """Checked start of a motion by this method; with contact forces it may be in
    penetration.

    Warns of piles whose events take long. Raises a ValueError as `start_of`, and for
    friction of a pile, which only time stepping has.
    """
    if isinstance(method, ContactForces):
        start = start_of(system, law, q, v, t_end, may_penetrate=True)
    else:
        start = start_of(system, law, q, v, t_end, method.closed_below)
    if isinstance(method, TimeStepping) or not is_pile(system):
        return start
    name = name_of(method)
    body = type(system.body).__name__
    if start.friction is not None:
        raise ValueError(
            f"Argument `friction` must be 0 for the contacts of {body} by "
            f"method={name!r}: use "
            "method='time_stepping', or name the `pairs` of few `Bodies`."
        )
    if start.contacts > MANY:
        warnings.warn(
            f"Argument `method` {name!r} computes all {start.contacts} contacts of "
            f"{body} at each "
            "event, and compiles for minutes: use method='time_stepping' for many "
            "bodies.",
            stacklevel=4,  # the line that calls `simulate`, through `full_precision`
        )
    return start


def tolerances(
    method: EventDriven | ContactForces, dtype: jnp.dtype
) -> tuple[float, float]:
    """Relative and absolute tolerance of the flights: the method's, each by default
    that of the precision. ValueError: an `rtol` of 'events' below rounding.
    """
    rtol, atol = TOLERANCES.get(str(dtype), TOLERANCES["float32"])
    if method.rtol is not None:
        rtol = method.rtol
    if method.atol is not None:
        atol = method.atol
    if isinstance(method, EventDriven):
        check_rtol(rtol, dtype)
    return rtol, atol


def _check_flights(method: EventDriven | ContactForces) -> None:
    """Raise a ValueError for options that flights do not have."""
    check_values("rtol", method.rtol, low=0.0, open_low=True)
    check_values("atol", method.atol, low=0.0, open_low=True)
    as_whole("max_steps", method.max_steps, 1)
