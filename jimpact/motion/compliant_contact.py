"""Motions in which contact forces of a `Compliant` law act, instead of impacts at an
instant.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.bodies.assembly import Bodies
from jimpact.core.law import Law
from jimpact.events.contact_flow import Phase
from jimpact.laws.forces import Force
from jimpact.motion.compliant_flow import (
    CompliantFlow,
    ContactModes,
    compliant_flow,
    contact_modes,
    loaded,
    mode_rows,
    normal_forces,
    stable_step,
)
from jimpact.motion.dynamics import gaps, kinematics, not_rounding
from jimpact.motion.flow import (
    Flight,
    State,
    allowed_errors,
    first_flight,
    one_pass,
    status_at_start,
    toward_sample,
)
from jimpact.motion.persistent_contact import (
    Modes,
    by_contact,
    choose_with_friction,
    cone_margins,
    contacts_at,
    direction,
    forces,
    friction_acceleration,
    length,
    no_modes,
    rest_acceleration,
    with_normal_forces,
)
from jimpact.motion.record import KIND_CODE
from jimpact.motion.run import course_of, end_of, goes_on
from jimpact.motion.spring_flow import (
    margins_of_springs,
    spring_flow,
    springs_at_start,
)
from jimpact.motion.start import Start
from jimpact.motion.tables import (
    Course,
    MotionEnd,
    MotionProblem,
    MotionTable,
    empty_table,
    event_numbers,
)
from jimpact.motion.transitions import (
    REST_SPEED,
    STOPPED,
    After,
    Passed,
    no_jump,
    slip_stops,
    velocity_noise,
)
from jimpact.numerics.driver import until_over
from jimpact.tools.loops import any_lane
from jimpact.tools.masks import choose
from jimpact.tools.status import CODE

# Of the cone: contacts that have reached its rim stick only if others take over more
# than this. Ten times more: contacts that share what they hold slide one after the
# other.
WITHIN = 1e-6


class _CompliantRun(NamedTuple):
    """A motion with contact forces up to now."""

    flight: Flight
    # [m/s] largest approach (m) so far, with friction slip (m), too
    fastest: Float[Array, " s"]
    table: MotionTable
    event_count: Int[Array, ""]
    status: Int[Array, ""]
    apart: Bool[Array, ""]  # all contacts are open and none closes
    # [s] when steps last vanished at an end of slip, -inf before
    vanished: Float[Array, ""]


def force_of(law: Law) -> Force:
    """The contact force of a law, for motions.

    Raises:
        TypeError: a law without one, or whose force yields: motions do not keep what
            that depends on.
    """
    force: Force | None = law.contact_force
    if force is None or not law.uses_gaps:
        raise TypeError(
            "Argument `law` must use gaps and have a `contact_force` (Compliant) for "
            f"method='contact_forces', but is {law!r}."
        )
    if force.bound is not None:
        raise TypeError(
            "Argument `law` must have a force without bound in a motion: what yields "
            "is for "
            f"`impact`, but the force is {force!r}."
        )
    return force


def tangential_stiffness_of(law: Law, start: Start) -> Float[Array, " m"] | None:
    """kappa (m,) of the law's tangential springs in a motion by contact forces, or
    None, also where no contact has friction.

    Raises:
        ValueError: springs of bodies whose tangents turn while they touch: springs
            would turn with them.
    """
    kappa = getattr(law, "tangential_stiffness", None)
    if kappa is None or start.friction is None:  # no spring, or all below mu = 0
        return None
    body = start.system.body
    if start.in_space and isinstance(body, Bodies) and _touch_each_other(body):
        raise ValueError(
            "Argument `tangential_stiffness` must be None in space in a motion by "
            "contact forces of bodies that touch each other, whose tangents turn: it "
            f"is for contacts with planes, but {type(body).__name__} has pairs."
        )
    shape = (start.contacts,)
    of_contacts = jnp.broadcast_to(kappa, shape)
    dtype = start.q.dtype
    return of_contacts.astype(dtype)


def _touch_each_other(body: Bodies) -> bool:
    """True if a contact is between two bodies; the second one of a plane is -1."""
    bodies = body.pairs_in_contact()
    is_body = bodies >= 0
    of_two_bodies = is_body.all(axis=1)
    return bool(of_two_bodies.any())


def compliant_motion(
    problem: MotionProblem, max_events: int, until_apart: bool
) -> Course:
    """The motion from `times[0]` to `times[-1]`, or until all contacts are open and
    none closes.
    """
    run = partial(_run, max_events, until_apart)
    start = _start(problem)
    course, _ = course_of(problem, start, run)
    return course


def _start(problem: MotionProblem) -> State:
    """State at the beginning: indentations `x = -f`, 0 of closed gaps; no impulses
    yet, springs xi = 0.
    """
    begin = problem.times[0]
    gap = gaps(problem.system, problem.q0, begin)
    closed_below = problem.settings.closed_below
    closed = jnp.abs(gap) <= closed_below
    x = jnp.where(closed, 0.0, -gap)
    if problem.mu is None:
        directions = 0
    else:
        directions = problem.tangents // problem.contacts
    rows = 1 + directions
    impulses = jnp.zeros((rows, len(x)), x.dtype)
    contact = jnp.concatenate([x[None], impulses])
    start = problem.start._replace(contact=contact)
    if problem.tangential_stiffness is None:
        return start
    return start._replace(spring=impulses[1:])


def _run(max_events: int, until_apart: bool, problem: MotionProblem) -> MotionEnd:
    """Pass after pass until the last sample, a failure, or, `until_apart`, all contacts
    open.
    """

    def continues(problem: MotionProblem, run: _CompliantRun) -> Bool[Array, ""]:
        """True while the motion goes on, and contacts are not apart where that ends
        it.
        """
        on = goes_on(problem, run)
        if until_apart:
            return on & ~run.apart
        return on

    one = partial(_one_pass, max_events)
    start = _begin(problem, max_events)
    last = until_over(continues, one, problem, start)
    samples = last.flight.sample
    smooth = jnp.stack([samples, last.event_count])
    return end_of(problem, last, smooth)


def _begin(problem: MotionProblem, max_events: int) -> _CompliantRun:
    """Run at the start of the motion: phases follow from gaps and gap velocities.

    Compression where the indentation x > 0, or x = 0 and the contact does not open;
    expansion where x > 0 and it opens, of a force that has this phase; else open.
    """
    system = problem.system
    force = problem.law
    mu = problem.mu
    times = problem.times
    m = problem.contacts
    state = _start(problem)
    gamma, slip = _rates(problem, state)
    x = state.contact[0]
    indented = x > 0
    touches = x == 0
    closing = gamma <= 0
    compressed = indented | (touches & closing)
    phase = jnp.where(compressed, Phase.COMPRESSION, Phase.OPEN)
    if not force.slackens:
        expands = indented & (gamma > 0)
        phase = jnp.where(expands, Phase.EXPANSION, phase)
    phase = jnp.int32(phase)
    margins = 2 * m
    fastest = jnp.maximum(-gamma, 0.0)
    if mu is not None:
        fastest = jnp.concatenate([fastest, slip])
    if problem.tangential_stiffness is not None:
        rows, state = springs_at_start(problem, state, phase, fastest)
        margins = margins_of_springs(problem)
    elif mu is not None:
        rows = mode_rows(ContactModes(phase, no_modes(m, x.dtype)))
        margins = 3 * m
    else:
        rows = phase
    flight = first_flight(system, state, rows[:, None], margins, times)
    if problem.tangential_stiffness is not None:
        flow = spring_flow(problem, state, flight.aim.modes, fastest)
        stable = flow.longest
    else:
        contacts = contacts_at(system, state.q, state.v, state.t, friction=False)
        stable = stable_step(force, flight.aim.modes, contacts, state)
    flight = toward_sample(flight, times, jnp.minimum(flight.free, stable))
    # friction is to be decided
    decide = flight.event.at[:m].set(True)
    flight = flight._replace(event=decide)
    return _CompliantRun(
        flight=flight,
        fastest=jax.lax.stop_gradient(fastest),
        table=empty_table(problem, state, max_events),
        event_count=jnp.int32(0),
        status=status_at_start(system, state, times[-1], jnp.inf),
        apart=jnp.all((phase[:m] == Phase.OPEN) & (gamma >= 0)),
        vanished=jnp.full_like(state.t, -jnp.inf),
    )


def _rates(
    problem: MotionProblem, state: State
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Gap velocities f' and speeds of slip |u| [m/s], these 0 without friction."""
    rubs = problem.mu is not None
    normal, tangent = kinematics(problem.system, state.q, state.v, state.t, rubs)
    gamma = normal.rate
    if tangent is None:
        return gamma, jnp.zeros_like(gamma)
    slip = by_contact(tangent.rate, problem.contacts)
    return gamma, length(slip)


def _with_friction(problem: MotionProblem, run: _CompliantRun) -> _CompliantRun:
    """Run with new modes of friction after an event: contacts whose force acts stick or
    slide.

    Without an event modes remain, and with tangential springs, which decide by
    themselves.
    """
    has_springs = problem.tangential_stiffness is not None
    if has_springs or problem.mu is None:
        return run
    flight = run.flight
    old = flight.aim.modes, jnp.asarray(True)
    happened = jnp.any(flight.event)
    new = jax.lax.cond(
        any_lane(happened), lambda: _new_modes(problem, run), lambda: old
    )
    modes, consistent = choose(happened, new, old)
    code = jnp.where(consistent, run.status, CODE["no_contact_force"])
    status = jnp.int32(code)
    aim = flight.aim._replace(modes=modes)
    flight = flight._replace(aim=aim)
    return run._replace(flight=flight, status=status)


def _new_modes(
    problem: MotionProblem, run: _CompliantRun
) -> tuple[Int[Array, "k 1"], Bool[Array, ""]]:
    """Rows of the new modes of friction, and true if they are consistent.

    Contacts with slip slide. All others stick if forces with normal forces F of the law
    hold them: `|a_t| <= within` at `|lambda_t| <= mu F`; else modes solve
    `choose_with_friction` for given normal forces.
    """
    system, force, mu, settings, *_ = problem
    assert mu is not None
    flight = run.flight
    state = flight.state
    m = problem.contacts
    phase, old = contact_modes(flight.aim.modes, state)
    contacts = contacts_at(system, state.q, state.v, state.t, friction=True)
    push = normal_forces(force, phase, contacts, state)
    pushed = with_normal_forces(contacts, push)
    scale = jnp.max(run.fastest)
    _, slip = _rates(problem, state)
    fired = flight.event[2 * m :]
    stopped = slip_stops(settings, old, fired, slip, scale)
    at_limit = fired & old.stick  # friction has reached mu F
    let_go = at_limit | stopped
    no_normal = jnp.zeros_like(let_go)
    released = jnp.concatenate([no_normal, let_go])
    # largest acceleration: a share is rounding
    fastest = jnp.max(jnp.abs(pushed.approach))
    dtype = slip.dtype
    share = not_rounding(REST_SPEED, dtype)
    noise = velocity_noise(settings, fastest)
    rest = share * scale + noise
    moving = slip > rest
    slides = moving & ~stopped
    slack = rest_acceleration(dtype) * fastest
    acts = loaded(phase)
    choice = choose_with_friction(pushed, mu, old, acts, released, slides, slack)
    # corners that sink in differently are nearly redundant: they stick where the
    # forces of the flow, which share what they hold, can hold them
    assert pushed.tangent is not None
    of_slip = direction(by_contact(pushed.tangent.rate, m))
    sign = jnp.where(slides, of_slip[:, 0], 1.0)
    sticking = Modes(acts, acts & ~slides, sign)
    if settings.spatial:
        sticking = _without_sign(sticking)
    along = jnp.where(slides[:, None], of_slip, 0.0)
    held = forces(pushed, mu, sticking, along)
    left = cone_margins(pushed, mu, held)  # [m/s^2] to the rim
    within = WITHIN * friction_acceleration(pushed, mu, held.normal)
    # what passes the flat position turns: no forces hold both of its corners
    assert held.tangential is not None
    all_forces = jnp.concatenate([held.normal, held.tangential])
    # slip acceleration of contacts that stick: not 0 where forces cannot hold them
    acceleration = pushed.approach + pushed.delassus @ all_forces
    growth = length(by_contact(acceleration[m:], m))
    reserve = jnp.where(let_go, within, 0.0)
    at_rest = growth <= within
    in_cone = left >= reserve
    holds = at_rest & in_cone
    holds_or_slides = ~sticking.stick | holds
    sticks = jnp.all(holds_or_slides)
    chosen = choose(sticks, sticking, choice.modes)
    # a force that changes as fast as in a contact has slip begin at once
    if settings.spatial:
        chosen = _without_sign(chosen)
    new = ContactModes(phase, chosen)
    rows = mode_rows(new)
    consistent = choice.consistent | sticks
    return rows[:, None], consistent


def _without_sign(modes: Modes) -> Modes:
    """Modes of contacts in space, whose slip has a direction but no sign: 1."""
    one = jnp.ones_like(modes.sign)
    return modes._replace(sign=one)


def _one_pass(
    max_events: int, problem: MotionProblem, run: _CompliantRun
) -> _CompliantRun:
    """Run after one pass of the stepper, with its state as next sample, and its event
    if any.

    Events: contacts that close or open, and friction that turns from sticking to slip
    or stops.
    """
    run = _with_friction(problem, run)
    times = problem.times
    flight = run.flight
    m = problem.contacts
    springs = problem.tangential_stiffness is not None
    modes = flight.aim.modes
    given = problem, flight.state, modes, run.fastest
    flow: CompliantFlow
    if springs:
        flow = spring_flow(*given)
    else:
        flow = compliant_flow(*given)
    settings = problem.settings
    allowed = _allowed_errors(problem, flow, flight.state)
    flown, _ = one_pass(flow, settings, allowed, times, flight)
    old_phase = modes[:m, 0]
    new_phase = flown.aim.modes[:m, 0]
    was_open = old_phase == Phase.OPEN
    is_open = new_phase == Phase.OPEN
    closed = was_open & ~is_open
    opened = ~was_open & is_open
    gamma, slip = _rates(problem, flown.state)
    fastest = jnp.maximum(-gamma, 0.0)
    turned = jnp.zeros(m, bool)
    vanished = run.vanished
    if problem.mu is not None:
        fastest = jnp.concatenate([fastest, slip])
    if springs:
        turned = flown.event[2 * m : 3 * m]
    elif problem.mu is not None:
        flown, turned, vanished = _turned_friction(problem, run, flow, flown, slip)
    state = flown.state
    changes = closed | opened | turned
    happened = jnp.any(changes)
    count = run.event_count
    full = happened & (count >= max_events)  # no row is left
    written = happened & ~full
    status = jnp.where(full, CODE["max_events"], run.status)
    marks = _marks(closed, opened, turned)
    row = jnp.where(written, count, max_events)
    table = run.table.with_sample(state, flight.sample)
    leaves = is_open & (gamma >= 0)
    return _CompliantRun(
        flight=flown,
        fastest=jax.lax.stop_gradient(jnp.maximum(run.fastest, fastest)),
        table=table.with_event(_event(problem, state, opened), marks, row),
        event_count=count + jnp.int32(written),
        status=jnp.int32(status),
        apart=jnp.all(leaves),
        vanished=vanished,
    )


def _allowed_errors(
    problem: MotionProblem, flow: CompliantFlow, state: State
) -> Float[Array, " rows"]:
    """Errors that a step may make in the rows of the state but q and v: in time and
    works, then in indentations, impulses and springs by the scales of the contacts.
    """
    settings = problem.settings
    no_rows = state.contact[:0]
    without = state._replace(contact=no_rows, spring=())
    ledger = allowed_errors(problem.system, settings, without, 1.0)
    scales = flow.scales
    rows = len(state.contact)
    sizes = [scales.depth]
    sizes += [scales.impulse] * (rows - 1)
    springs = flow.sizes_of_springs(state)
    sizes.extend(springs)
    of_contacts = jnp.concatenate(sizes)
    errors = settings.rtol * of_contacts
    return jnp.concatenate([ledger, errors])


def _marks(
    closed: Bool[Array, " m"], opened: Bool[Array, " m"], turned: Bool[Array, " m"]
) -> Int[Array, " marks"]:
    """Marks of an event: its kind, no status of a law, and the contacts that take part.

    Kind: `contact` where one closed, else `detachment` where one opened, else
    `friction`.
    """
    any_opened = jnp.any(opened)
    any_closed = jnp.any(closed)
    kind = jnp.where(any_opened, KIND_CODE["detachment"], KIND_CODE["friction"])
    kind = jnp.where(any_closed, KIND_CODE["contact"], kind)
    no_law = 0 * kind
    takes_part = closed | opened | turned
    of_contacts = takes_part.astype(kind.dtype)
    return jnp.concatenate([jnp.stack([kind, no_law]), of_contacts])


def _turned_friction(
    problem: MotionProblem,
    run: _CompliantRun,
    flow: CompliantFlow,
    flown: Flight,
    slip: Float[Array, " m"],
) -> tuple[Flight, Bool[Array, " m"], Float[Array, ""]]:
    """Flight after its friction events, contacts whose friction turned, and the time
    of `_ended_slip`.

    Friction turns where a contact that stuck has reached mu F, or slip has stopped,
    which is then set to 0. `slip`: its speeds [m/s] at the end of the step.
    """
    m = problem.contacts
    modes = run.flight.aim.modes
    friction = contact_modes(modes, flown.state).friction
    flown, vanished = _ended_slip(problem, run, flown, friction, slip)
    fired = flown.event[2 * m :]
    scale = flow.scales.slip
    stopped = slip_stops(problem.settings, friction, fired, slip, scale)
    at_limit = fired & friction.stick
    state = flow.stopped(stopped, flown.state)
    flown = flown._replace(state=state)
    return flown, at_limit | stopped, vanished


def _ended_slip(
    problem: MotionProblem,
    run: _CompliantRun,
    flown: Flight,
    friction: Modes,
    slip: Float[Array, " m"],
) -> tuple[Flight, Float[Array, ""]]:
    """Flight in which slip of at most STOPPED of the scale ends where steps vanish, and
    that time.

    `friction`: modes of the step; `slip`: its speeds [m/s] at the end. The time [s] is
    `run.vanished` unless this happens now; not twice at one instant.

    A body that turns on one corner drags another through its end of slip. There
    friction turns round at once, and with it the force that holds the first corner: no
    step lands on its cone.
    """
    m = problem.contacts
    max_steps = problem.settings.max_steps
    fastest = jnp.max(run.fastest)
    scale = jnp.maximum(fastest, jnp.max(slip))
    slides = friction.active & ~friction.stick
    slow = slip <= STOPPED * scale
    ends = slides & slow
    some_left = flown.steps < max_steps
    t = flown.state.t
    later = t > run.vanished
    vanished = flown.stuck & some_left & later
    here = vanished & jnp.any(ends)
    event = flown.event.at[2 * m :].set(ends)
    goes_on = flown._replace(event=event, stuck=jnp.asarray(False))
    again = toward_sample(goes_on, problem.times, flown.free)
    last = jnp.where(here, t, run.vanished)
    return choose(here, again, flown), last


def _event(
    problem: MotionProblem, state: State, opened: Bool[Array, " m"]
) -> Float[Array, " w"]:
    """Row of an event: impulses of contacts that have `opened`; velocities do not
    jump.
    """
    none = no_jump(state, problem.contacts, problem.tangents)
    zero = jnp.zeros_like(state.t)
    push, *tangential = jnp.where(opened, state.contact[1:], 0.0)
    jump = none._replace(impulse=push)
    if tangential:
        by_tangent = jnp.stack(tangential, axis=1)
        jump = jump._replace(tangential=by_tangent.reshape(-1))
    passed = Passed(zero, zero)
    after = After(state, jump, passed)
    return event_numbers(state, after)
