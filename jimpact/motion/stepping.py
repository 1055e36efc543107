"""Moreau-Jean time stepping with any impact law: for many contacts, no event is
located.

One step of length h (after Remark 6.9 of Brogliato):

    q_m = q + h/2 v      closed contacts: here, or at the end by forces alone
    v'  = v + h M^-1 F + M^-1 (N p + H p_t)      0 <= p _|_ gamma' + w >= 0
    q'  = q_m + h/2 v'                           p_t in -mu p Sgn(u' + w_t)

with `w = e gamma` for a contact that approaches by Moreau's law, which joins the
problem this way. Any other law acts first, in the middle of the forces,
`v+ = impact(law, scene(q_m), v + h/2 M^-1 F)`, and slow approach (within what forces
give in two steps) is rest, `w = 0`. Order 1: an impact is early or late by up to h / 2.

ENERGY. A contact gives `p (gamma' + gamma) / 2`: no energy where `w >= gamma`. So a
contact that separates may come back as fast as it leaves, `w = gamma`, and is at rest
two steps later. Friction opposes the slip at the end, `w_t = 0` (`e_t u` in an impact).
That may give energy where the slip reverses within the step, up to (h g)^2 in a stop on
a slope, and more in Kane's paradox; such a step is solved again with all friction
against the mean slip, `w_t = u`, which cannot.

DERIVATIVES of such a step do not converge: with h the time of an impact is constant,
while its derivative is not. They are refused.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.bodies.closed_pairs import ActivePairs
from jimpact.core.impacts import impact
from jimpact.core.law import Law, within_domains
from jimpact.core.scene import Scene
from jimpact.motion.dynamics import (
    Mass,
    carried_along,
    definite,
    free_acceleration,
    gaps,
    is_pile,
    mass_at,
    recorded_gaps,
    user_force,
)
from jimpact.motion.flow import State, out_of_range, status_at_start
from jimpact.motion.record import KIND_CODE, Events, no_events, with_row
from jimpact.motion.start import Start
from jimpact.motion.step_contacts import (
    ActiveContacts,
    AllContacts,
    PileImpulses,
    contacts_of_step,
)
from jimpact.motion.system import System
from jimpact.motion.tables import Course
from jimpact.motion.transitions import FAILS, scene_at
from jimpact.numerics.derive import without_derivatives
from jimpact.numerics.many_contacts import Many, solve_many
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE

# Gap velocities below _ROUNDING times the largest speed of the motion, or its
# rounding, are what solving for contacts at rest leaves. Ten times less, and resting
# beads strike in every step; ten times more, and slow impacts come a step later.
_ROUNDING = 1e-12
SLOW = 2.0  # steps of the free acceleration: slower approach is rest, not an impact
# Misfit of a step's impulses over its velocities at which the solver ends: for a few
# contacts, for a pile; at least rounding, which matters in float32. Ten times more, and
# what rests
# creeps ten times faster.
FEW = 1e-9
PILE = 1e-6
# misfit above which `unsolved_step` is reported; ten times more is no solution
OFF = 1e-2
# of the solver, per step; ten times more costs time in jammed piles only
ITERATIONS = 1000
# iterations of the mean velocity in the forces; the error falls by h omega (spin) each
MEAN = 4
# Share of the speed that the velocities could give a gap, by which its rate changes
# where bodies pass each other in a step: head-on it is 2. Ten times less would report
# corners that roll over the ground, ten times more would hide oblique passages. What
# the free acceleration of SLOW steps explains is no passage.
TURN = 0.1
# Steps: a contact that is struck again within them by an impact that is HARD, of more
# than this share of the largest gap velocity so far, is reported as `coarse_step`. Each
# impact is early or late by up to h / 2; one below that share adds less than that share
# to the error in q that the fastest impact makes anyway. Ten times less reports stacks
# that come to rest, ten times more hides rebounds whose order the step does not
# resolve.
APART = 3
HARD = 0.1

WHY = (
    "Argument `method` must not be 'time_stepping' where derivatives are taken: with "
    "the step the "
    "times of impacts are fixed, so that derivatives do not converge. method='events' "
    "has them."
)


class _StepProblem(NamedTuple):
    """Quantities that are the same in all steps."""

    system: System
    law: Law
    mu: Float[Array, "..."] | None  # (m,), () of a pile
    h: Float[Array, ""]  # [s] length of a step
    closed_below: Float[Array, ""]  # [m]
    joint: bool  # see `time_stepping`


class _Progress(NamedTuple):
    """The motion up to now."""

    state: State
    # [m/s] largest gap velocity that velocities could give so far
    speed: Float[Array, ""]
    last_impulses: Float[Array, "m b"] | PileImpulses  # [N s] of the last step
    residual_velocity: Float[Array, ""]  # [m/s] gap velocity that these leave unsolved
    inverse_step_size: Float[Array, ""]  # of the solver, see `solve_many`
    steps_since_impact: Int[Array, " m"]
    # [m/s] rates of gaps that close before the next step; others 0
    closing: Float[Array, " m"]
    events: Events
    status: Int[Array, ""]
    reported: Int[Array, ""]  # a status that is not a failure


class _Setup(NamedTuple):
    """Data of a step before it is solved: contacts in its middle, and the law's
    impulses there.
    """

    middle: Float[Array, ""]  # [s] time in the middle of the step
    end: Float[Array, ""]  # [s] time at its end
    q: Float[Array, " nq"]  # q_m, in the middle
    mass: Mass
    base_velocity: Float[Array, " n"]
    contacts: AllContacts | ActiveContacts
    speed: Float[Array, ""]  # as in `_Progress`
    noise: Float[Array, ""]  # [m/s] smaller gap velocities are rounding
    # [m/s] gap velocities of SLOW steps of the free acceleration, noise
    slow: Float[Array, " m"]
    tolerance: float  # of the solver
    strikes: Bool[Array, " m"]  # the contact has an impact
    law_velocity: Float[Array, " n"]  # velocity to which the law is applied
    law_impulse: Float[Array, "m b"]  # [N s] of a law that does not join the problem
    law_status: Int[Array, ""]
    # [m/s] of gaps and slips, after those impulses, before forces
    rates: Float[Array, "m b"]
    offset: Float[Array, "m b"]  # w with friction against the slip at the end
    offset_for_mean: Float[Array, "m b"]  # w with friction against the mean slip


class _Trial(NamedTuple):
    """Iterate of the solution of a step."""

    v: Float[Array, " n"]  # v' at its end
    mean: Float[Array, " n"]  # mean velocity (v + v') / 2
    force: Float[Array, " n"]  # F of the argument `force` at it
    solution: Many
    adds_energy: Bool[Array, ""]  # the impulses do
    tries: Int[Array, ""]  # iterations so far, this one included


def time_stepping(
    start: Start,
    law: Law,
    times: Float[Array, " S"],
    substeps: Int[Array, ""],
    joint: bool,
    max_events: int,
) -> Course:
    """The motion with `substeps` equal steps between neighbours of the sampled `times`
    [s].

    `joint`: the law is a condition on v' that joins the problem of the step
    (`Law.joins_step`).
    """
    why = NotImplementedError(WHY)
    start, law, times = without_derivatives((start, law, times), why)
    between = times[1] - times[0]
    dtype = times.dtype
    h = between / substeps.astype(dtype)
    system = start.system
    problem = _StepProblem(system, law, start.friction, h, start.closed_below, joint)
    first = _begin(problem, start.q, start.v, times, substeps, max_events)

    def to_sample(progress: _Progress, t: Float[Array, ""]) -> tuple[_Progress, State]:
        """Motion from the sample at t to the next one, and the state there; NaN after a
        failure.
        """

        def one(i: Int[Array, ""], progress: _Progress) -> _Progress:
            """Step number i from t, unless the motion has failed."""

            def go() -> _Progress:
                number = i.astype(dtype)
                return _one_step(problem, progress, t + number * h)

            goes_on = progress.status == CODE["ok"]
            return jax.lax.cond(goes_on, go, lambda: progress)

        progress = jax.lax.fori_loop(0, substeps, one, progress)
        fine = progress.status == CODE["ok"]
        states = progress.state
        state = jax.tree.map(lambda x: jnp.where(fine, x, jnp.nan), states)
        return progress, state

    end, later = jax.lax.scan(to_sample, first, times[:-1])
    samples = jax.tree.map(
        lambda x, rest: jnp.concatenate([x[None], rest]), first.state, later
    )
    intervals = len(times) - 1
    steps = substeps * intervals
    ended_well = end.status == CODE["ok"]
    status = jnp.where(ended_well, end.reported, end.status)
    return Course(samples, end.events, steps, status)


class PileStep(NamedTuple):
    """One step of a pile."""

    pairs: ActivePairs
    impulse: Float[Array, "m b"]  # [N s] normal, then tangential
    velocity: Float[Array, " n"]  # v' at its end
    status: Int[Array, ""]


def step_of_pile(start: Start, law: Law) -> PileStep:
    """The one step of a pile from the time of `start` to its end."""
    times = jnp.stack([start.time, start.end])
    h = start.end - start.time
    problem = _StepProblem(
        start.system, law, start.friction, h, start.closed_below, joint=True
    )
    one_step = jnp.int32(1)
    first = _begin(problem, start.q, start.v, times, one_step, 1)
    setup = _set_up(problem, first, times[0])
    trial = _solve(problem, first, setup)
    state, _ = _end_state(problem, first, setup, trial)
    status, reported = _status(problem, first, setup, trial, state)
    contacts = setup.contacts
    assert isinstance(contacts, ActiveContacts)
    fails = status > 0
    code = jnp.where(fails, status, reported)
    impulse = trial.solution.impulse
    return PileStep(contacts.pairs, impulse, trial.v, code)


def _begin(
    problem: _StepProblem,
    q0: Float[Array, " nq"],
    v0: Float[Array, " n"],
    times: Float[Array, " S"],
    substeps: Int[Array, ""],
    max_events: int,
) -> _Progress:
    """Motion at the start: impulses of the last step are 0, its status that of the
    start.
    """
    system, law, mu, _, closed_below, _ = problem
    dtype = q0.dtype
    zero = jnp.zeros((), dtype)
    t0 = times[0]
    rubs = mu is not None
    m = len(recorded_gaps(system, q0, t0))

    def first() -> tuple[Float[Array, "m b"], Any]:
        """Rates of contacts, and impulses as steps keep them: their shapes are used
        alone.
        """
        contacts = contacts_of_step(system, q0, t0, q0, t0, closed_below, rubs)
        rates = contacts.rates(v0)
        return rates, contacts.kept(rates)

    shapes = jax.eval_shape(first)
    at_rest, impulses = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    contacts, b = at_rest.shape
    rest = jnp.zeros((2, m), dtype)
    begin = State(q0, v0, t0, zero, zero, rest, rest[:0])
    if is_pile(system):
        rows = 1
    else:
        rows = max_events
    directions = max(b - 1, 1)
    events = no_events(rows, q0, v0, m, tangents=m * directions)
    status = status_at_start(system, begin, times[-1], closed_below)
    fine = status == CODE["ok"]
    fails = fine & ~within_domains(law)
    code = jnp.where(fails, CODE["law_failed"], status)
    long_ago = substeps * len(times)
    return _Progress(
        state=begin,
        speed=zero,
        last_impulses=impulses,
        residual_velocity=zero,
        inverse_step_size=jnp.ones((), dtype),
        steps_since_impact=jnp.full(contacts, long_ago),
        closing=_closing_at_start(problem, begin, contacts),
        events=events,
        status=jnp.int32(code),
        reported=jnp.int32(CODE["ok"]),
    )


def _one_step(
    problem: _StepProblem, progress: _Progress, t: Float[Array, ""]
) -> _Progress:
    """Motion after one step of length h from t."""
    setup = _set_up(problem, progress, t)
    trial = _solve(problem, progress, setup)
    state, energy = _end_state(problem, progress, setup, trial)
    status, reported = _status(problem, progress, setup, trial, state)
    solution = trial.solution
    contacts = setup.contacts
    later = progress.steps_since_impact + 1
    return _Progress(
        state=state,
        speed=setup.speed,
        last_impulses=contacts.kept(solution.impulse),
        residual_velocity=solution.residual_velocity,
        inverse_step_size=solution.inverse_step_size,
        steps_since_impact=jnp.where(setup.strikes, 1, later),
        closing=_closing_after(problem, progress, setup, trial),
        events=_recorded_impact(problem, progress.events, setup, trial, energy),
        status=status,
        reported=reported,
    )


def _loads(
    system: System,
    q: Float[Array, " nq"],
    v: Float[Array, " n"],
    t: Float[Array, ""],
    mass: Mass,
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Force F(q, v, t) of the argument `force`, and the acceleration v' without
    contacts.
    """
    force = user_force(system, q, v, t)
    free = free_acceleration(system, q, v, force, mass)
    return force, free


def _set_up(problem: _StepProblem, progress: _Progress, t: Float[Array, ""]) -> _Setup:
    """Data of the step that begins at t: contacts in its middle, impacts, offsets w.

    A closed contact strikes where `gamma < -slow`. The law acts there unless it is
    `joint`.
    """
    system, law, mu, h, closed_below, joint = problem
    q, v, *_ = progress.state
    dtype = q.dtype
    body = system.body
    middle = t + 0.5 * h
    end = t + h
    q = body.moved(q, 0.5 * h * v)
    base_velocity = carried_along(system, v, middle)
    mass = mass_at(system, q)
    _, free = _loads(system, q, v, middle, mass)
    v_end = v + h * free
    q_predicted = body.moved(q, 0.5 * h * v_end)
    rubs = mu is not None
    contacts = contacts_of_step(system, q, middle, q_predicted, end, closed_below, rubs)
    rates = contacts.rates(v - base_velocity)
    speed = jnp.maximum(progress.speed, contacts.fastest(v))
    rounding = precision(dtype).accumulated
    tolerance = max(PILE if is_pile(system) else FEW, rounding)
    share = max(_ROUNDING, rounding)
    noise = share * speed + progress.residual_velocity
    noise += tolerance * contacts.fastest(h * free)
    by_loads = contacts.rates(free)[:, 0]
    slow = noise + SLOW * h * jnp.abs(by_loads)
    approaches = rates[:, 0] < -slow
    strikes = contacts.closed & approaches
    # half of the forces before an impact, half after it: over the whole step they take
    # as much energy from the velocities as the potential gains
    half = 0.5 * h
    if joint:
        law_velocity = v
        impulse = jnp.zeros_like(rates)
        law_status = jnp.int32(CODE["ok"])
    else:
        law_velocity = v + half * free
        scene = scene_at(system, q, middle, contacts.closed)
        relative = law_velocity - base_velocity
        struck = jnp.any(strikes)
        impulse, law_status = _impulses_if(struck, law, scene, relative, noise, rates)
    rates = rates + contacts.product(impulse)
    added = jnp.where(strikes, half * by_loads, 0.0)
    e, e_t = _coefficients(problem, strikes, dtype)
    offset, offset_for_mean = _offsets(e, e_t, rates, added)
    return _Setup(
        middle=middle,
        end=end,
        q=q,
        mass=mass,
        base_velocity=base_velocity,
        contacts=contacts,
        speed=speed,
        noise=noise,
        slow=slow,
        tolerance=tolerance,
        strikes=strikes,
        law_velocity=law_velocity,
        law_impulse=impulse,
        law_status=law_status,
        rates=rates,
        offset=offset,
        offset_for_mean=offset_for_mean,
    )


def _coefficients(
    problem: _StepProblem, strikes: Bool[Array, " m"], dtype: jnp.dtype
) -> tuple[Float[Array, "..."], Float[Array, " m"]]:
    """Restitution e () or (m,), and e_t where contacts strike; 0 unless the law
    `joins_step`.
    """
    e = jnp.zeros((), dtype)
    e_t = jnp.zeros((), dtype)
    if problem.joint:
        law: Any = problem.law
        e = law.restitution
        if law.tangential_restitution is not None:
            e_t = law.tangential_restitution
    of_impacts = jnp.where(strikes, e_t, 0.0)
    return e, of_impacts


def _solve(problem: _StepProblem, progress: _Progress, setup: _Setup) -> _Trial:
    """Impulses p and velocity v' of the step, of the problem at the head of this file.

    Equation: `gamma' = D^T v + h D^T a + W p`, with the acceleration a at the mean
    velocity: it is iterated. If the impulses add energy, `offset_for_mean` is taken
    from then on.
    """
    system = problem.system
    h = problem.h
    contacts = setup.contacts
    v0 = progress.state.v
    tries = _tries(system)
    if problem.mu is None:
        mu = jnp.zeros((), v0.dtype)
    else:
        mu = problem.mu
    closed = contacts.closed[:, None]

    def iteration(last: _Trial) -> _Trial:
        """Solution of the step with the loads at the mean velocity of the `last`
        trial.
        """
        force, free = _loads(system, setup.q, last.mean, setup.middle, setup.mass)
        with_loads = setup.rates + h * contacts.rates(free)  # D^T v + h D^T a
        for_mean = last.tries < tries
        offset = jnp.where(for_mean, setup.offset, setup.offset_for_mean)
        right_side = with_loads + offset
        solution = solve_many(
            contacts.product,
            contacts.diagonal,
            jnp.where(closed, right_side, 0.0),
            mu,
            last.solution.impulse,
            last.solution.inverse_step_size,
            setup.tolerance,
            ITERATIONS,
        )
        x = solution.impulse
        every_impulse = setup.law_impulse + x
        v = v0 + h * free + contacts.velocity_change(every_impulse)
        after = with_loads + contacts.product(x)  # gamma' and slips
        twice_mean = setup.rates + after
        energy = 0.5 * jnp.vdot(x, twice_mean)
        rounding = setup.noise + solution.residual_velocity
        allowed = rounding * jnp.sum(jnp.abs(x))
        adds_energy = energy > allowed
        mean = 0.5 * (v0 + v)
        number = last.tries + 1
        return _Trial(v, mean, force, solution, adds_energy, number)

    def goes_on(trial: _Trial) -> Bool[Array, ""]:
        """True before `tries` trials, then while energy is added, up to twice as
        many.
        """
        due = trial.tries < tries
        may_retry = trial.tries < 2 * tries
        return due | (trial.adds_energy & may_retry)

    start = _first_trial(progress, setup)
    return jax.lax.while_loop(goes_on, iteration, start)


def _first_trial(progress: _Progress, setup: _Setup) -> _Trial:
    """No change of velocity, with the impulses of the last step to start from."""
    v = progress.state.v
    zero = 0 * setup.speed
    begin = Many(
        impulse=setup.contacts.warm_start(progress.last_impulses),
        misfit=zero,
        residual_velocity=zero,
        iterations=jnp.int32(0),
        inverse_step_size=progress.inverse_step_size,
    )
    no_force = jnp.zeros_like(v)
    no = jnp.asarray(False)
    return _Trial(v, v, no_force, begin, no, jnp.int32(0))


def _tries(system: System) -> int:
    """Iterations of the mean velocity: 1 where no load depends on it, else MEAN."""
    constant_mass = not callable(system.mass)
    constant = constant_mass and system.force is None
    if constant and system.body.coordinates is None:
        return 1
    return MEAN


def _end_state(
    problem: _StepProblem, progress: _Progress, setup: _Setup, trial: _Trial
) -> tuple[State, Float[Array, "2 m"]]:
    """State at the end of the step, and the energy [J] that each contact gave.

    Equation: `q' = q_m + h v' / 2`; works at the mean velocity u, `h F . u` of the
    force, `p . D^T (u - B y_b')` of contacts (normal, tangential), `D p . B y_b'` of
    the base.
    """
    h = problem.h
    state = progress.state
    contacts = setup.contacts
    x = setup.law_impulse + trial.solution.impulse
    relative = trial.mean - setup.base_velocity
    work = x * contacts.rates(relative)
    by_normal = work[:, 0]
    by_friction = jnp.sum(work[:, 1:], axis=1)
    energy = jnp.stack([by_normal, by_friction])
    half = 0.5 * h
    by_contacts = contacts.generalized_impulse(x)
    by_force = h * trial.force @ trial.mean
    new = state._replace(
        q=problem.system.body.moved(setup.q, half * trial.v),
        v=trial.v,
        t=setup.end,
        work=state.work + by_force,
        base_work=state.base_work + by_contacts @ setup.base_velocity,
        contact_work=state.contact_work + contacts.recorded(energy),
    )
    return new, energy


def _status(
    problem: _StepProblem,
    progress: _Progress,
    setup: _Setup,
    trial: _Trial,
    state: State,
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Status code after the step, and the code that is reported without ending the
    motion.

    The latter is `coarse_step` where a hard impact follows within APART steps of
    another one, or bodies have passed each other, or in a pile a body moves farther
    than the reach of its list of neighbours; `unsolved_step` where the solver leaves a
    misfit above OFF.
    """
    system = problem.system
    contacts = setup.contacts
    fails = jnp.asarray(FAILS)[setup.law_status]
    status = jnp.where(fails, CODE["law_failed"], progress.status)
    outside = out_of_range(system, state)
    status = jnp.where(outside, CODE["out_of_range"], status)
    if isinstance(contacts, ActiveContacts):
        status = jnp.where(contacts.pairs.overflows, CODE["room"], status)
    # a base that is NaN shows in its work, a coefficient in that of the contacts
    finite_v = jnp.all(jnp.isfinite(trial.v))
    finite = finite_v & jnp.isfinite(state.base_work)
    finite &= jnp.all(jnp.isfinite(state.contact_work))
    status = jnp.where(finite, status, CODE["not_finite"])
    if callable(system.mass):
        finite_mass = jnp.all(jnp.isfinite(setup.mass))
        positive = definite(setup.mass)
        fine = positive | ~finite_mass
        status = jnp.where(fine, status, CODE["singular_mass"])
    if isinstance(contacts, ActiveContacts):
        _, size = contacts.inverse.shape  # 3 in a plane, 6 in space
        velocities = trial.v.reshape(-1, size)
        places = (size + 1) // 2  # 2 of 3 in a plane, 3 of 6 in space
        of_places = velocities[:, :places]
        squares = jnp.sum(of_places**2, axis=1)
        fastest = jnp.sqrt(jnp.max(squares))
        coarse = problem.h * fastest > contacts.pairs.reach
    else:
        relative = progress.state.v - setup.base_velocity
        rate = contacts.normals.T @ relative
        recent = progress.steps_since_impact < APART
        hard = rate < -HARD * setup.speed
        struck_again = setup.strikes & recent & hard
        # a gap that was to close grows: bodies passed each other between two
        # evaluations of it
        normals = jnp.abs(contacts.normals)
        speeds = normals.T @ jnp.abs(relative)
        change = rate - progress.closing
        turned = change > TURN * speeds + setup.slow
        was_closing = progress.closing < 0
        grows = rate > 0
        opens = was_closing & grows & turned
        coarse = jnp.any(struck_again | opens)
    coarse = jnp.where(coarse, CODE["coarse_step"], 0)
    off = trial.solution.misfit > OFF
    unsolved = jnp.where(off, CODE["unsolved_step"], 0)
    worse = jnp.maximum(coarse, unsolved)
    reported = jnp.maximum(progress.reported, worse)
    return jnp.int32(status), jnp.int32(reported)


def _closing_at_start(
    problem: _StepProblem, begin: State, contacts: int
) -> Float[Array, " m"]:
    """Rates [m/s] of gaps that close before the middle of the first step, 0
    elsewhere.
    """
    system = problem.system
    q = begin.q
    v = begin.v
    t = begin.t
    if is_pile(system):
        return jnp.zeros(contacts, q.dtype)

    def later(s: Float[Array, ""]) -> Float[Array, " m"]:
        """Gaps [m] after the time s at the velocity v."""
        moved = system.body.moved(q, s * v)
        return gaps(system, moved, t + s)

    no_time = 0 * t
    one = jnp.ones_like(t)
    gap, rate = jax.jvp(later, (no_time,), (one,))
    half = 0.5 * problem.h
    return _closing(gap, rate, half, problem.closed_below)


def _closing_after(
    problem: _StepProblem, progress: _Progress, setup: _Setup, trial: _Trial
) -> Float[Array, " m"]:
    """Rates [m/s] of gaps that close before the middle of the next step, 0
    elsewhere.
    """
    contacts = setup.contacts
    if isinstance(contacts, ActiveContacts):
        return progress.closing
    relative = trial.v - setup.base_velocity
    rate = contacts.normals.T @ relative
    return _closing(contacts.gap, rate, problem.h, problem.closed_below)


def _closing(
    gap: Float[Array, " m"],
    rate: Float[Array, " m"],
    h: Float[Array, ""],
    closed_below: Float[Array, ""],
) -> Float[Array, " m"]:
    """Rates [m/s] of open gaps with `gap + h rate < 0`, 0 elsewhere."""
    is_open = gap > closed_below
    penetrates = gap + h * rate < 0
    closes = is_open & penetrates
    return jnp.where(closes, rate, 0.0)


def _recorded_impact(
    problem: _StepProblem,
    events: Events,
    setup: _Setup,
    trial: _Trial,
    energy: Float[Array, "2 m"],
) -> Events:
    """Events with one row more where a contact strikes in this step; a pile records
    none.

    Velocities and impulses are those of the law alone; of a joint step those at its
    end, with the impulses of contacts that rest.
    """
    contacts = setup.contacts
    x = setup.law_impulse
    after = trial.v
    if isinstance(contacts, ActiveContacts):
        return events
    if problem.joint:
        x = x + trial.solution.impulse
    else:
        by_law = contacts.velocity_change(x)
        after = setup.law_velocity + by_law
    row = {
        "time": setup.middle,
        "kind": jnp.int32(KIND_CODE["impact"]),
        "contacts": setup.strikes,
        "q": setup.q,
        "velocity_before": setup.law_velocity,
        "velocity_after": after,
        "impulse": x[:, 0],
        "energy": energy,
        "status": setup.law_status,
    }
    tangential = x[:, 1:]
    if tangential.size:
        row["tangential_impulse"] = tangential.reshape(-1)
    happened = jnp.any(setup.strikes)
    return with_row(events, happened, row)


def _offsets(
    e: Float[Array, "..."],
    e_t: Float[Array, " m"],
    rates: Float[Array, "m b"],
    added: Float[Array, " m"],
) -> tuple[Float[Array, "m b"], Float[Array, "m b"]]:
    """Offsets w of `0 <= p _|_ gamma' + w >= 0`, for friction at the end and at the
    mean slip; gamma' is the gap velocity at the end of the step.

    Equation: `w_n = e (gamma + added) - added` where gamma < 0, else gamma: a contact
    strikes at `gamma + added`, leaves at -e times that, and the forces, which act on
    after the impact, add `added` once more. `w_t = e_t u` for friction against the slip
    at the end, `w_t = u` for the mean slip.

    Args:
        e: coefficient () or (m,) of normal restitution.
        e_t: that of tangential restitution, 0 where no contact strikes.
        rates: gap velocities gamma and slips u [m/s] without the forces of the step.
        added: gap velocity [m/s] that the forces add before the impact, 0 where there
            is none.

    Where `w >= rates`, as always in normal direction, impulses add no energy.
    """
    gamma = rates[:, 0]
    struck = e * (gamma + added) - added
    approaches = gamma < 0
    w_n = jnp.where(approaches, struck, gamma)
    normal = w_n[:, None]
    slip = rates[:, 1:]
    w_t = e_t[:, None] * slip
    at_end = jnp.concatenate([normal, w_t], axis=1)
    for_mean = jnp.concatenate([normal, slip], axis=1)
    return at_end, for_mean


def _impulses_if(
    struck: Bool[Array, ""],
    law: Law,
    scene: Scene,
    v: Float[Array, " n"],
    noise: Float[Array, ""],
    rates: Float[Array, "m b"],
) -> tuple[Float[Array, "m b"], Int[Array, ""]]:
    """`_law_impulses` where a contact is `struck`; else none, of the shape of the
    `rates`, and the status `ok`.
    """
    none = jnp.zeros_like(rates)
    ok = jnp.int32(CODE["ok"])
    return jax.lax.cond(
        struck,
        lambda: _law_impulses(law, scene, v, noise, rates.shape),
        lambda: (none, ok),
    )


def _law_impulses(
    law: Law,
    scene: Scene,
    v: Float[Array, " n"],
    noise: Float[Array, ""],
    shape: tuple[int, ...],
) -> tuple[Float[Array, "m b"], Int[Array, ""]]:
    """Impulses [N s] of the law at each contact, normal then tangential, and its
    status.
    """
    out: Any = impact(law, scene, v, noise)
    x = out.impulse[:, None]
    m, b = shape
    if b > 1:
        side = out.tangential_impulse.reshape(m, -1)
        x = jnp.concatenate([x, side], axis=1)
    return x, out.status
