"""Motion under contact forces with tangential springs below Coulomb's limit, in the
plane and in space.

The equations are those of `events/tangential_spring.py` with units, and bodies that
turn: a loaded contact with the normal force F = k x^eta and a spring of stiffness
`k_t = kappa dF/dx = kappa eta F / x` has one of three modes,

    HOLDS    xi' = u                          lambda = -k_t xi
    SLIDES   n' = (u - (n . u) n) / r         lambda = -mu F n,   |n| = 1
    DRAGS    n = u / |u|, turned back by      lambda = -mu F n
             mu x phi' / max(kappa eta |u| + mu x', kappa eta |u| / 2)

u is the slip velocity, phi its angle, and `r = mu x / (kappa eta)` the elongation at
Coulomb's limit, so that |lambda| <= mu F in every mode. Slip relative to the spring has
the speed `s = n . u - r'`.

    HOLDS  -> SLIDES, DRAGS   |xi| = r
    SLIDES, DRAGS -> HOLDS    s = 0, xi = r n
    SLIDES <-> DRAGS          |u| / r = swift; back at QUARTER of it

The direction n follows u at the rate |u| / r, which is stiff where slip is fast or x is
small: there the contact drags. At small slip it is a state, so that, other than the
direction u / |u| of rigid friction, nothing becomes singular where slip ends. In the
plane n is 1 or -1, and no contact drags.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.events.tangential_spring import QUARTER, Slide
from jimpact.laws.forces import Force
from jimpact.motion.compliant_flow import (
    SNAP,
    STABLE,
    CompliantFlow,
    contact_scales,
    loaded,
    normal_forces,
    stiffness_of,
    unloading,
)
from jimpact.motion.flow import State, longest_step, packed, roundings, unpacked
from jimpact.motion.persistent_contact import (
    Contacts,
    Forces,
    Modes,
    by_contact,
    contacts_at,
    direction,
    length,
)
from jimpact.motion.tables import MotionProblem
from jimpact.motion.transitions import velocity_noise
from jimpact.tools.masks import quotient

# Rate |u| / r above which a contact drags, in the frequency of the stiffest contact.
# Directions err by its inverse cubed; ten times more: slow slip takes ten times as many
# steps.
SWIFT = 100.0
# Longest step in the time r / |u| in which a spring that slides turns. Steps of twice
# that are not stable; a tenth takes ten times as many.
TURN = 3.0
# Of the tolerance: a spring gives way when it is so much longer than at Coulomb's limit
# (its force is not). After a steady slip it swings back to just that limit, again and
# again: where that counted as giving way, each time would take some hundred steps. A
# thousand times more saves a quarter of the steps, and would be seen in the outcome.
BEYOND = 1.0


class SpringModes(NamedTuple):
    """Phase of each contact, `friction` that acts and holds, and the mode of its
    spring.
    """

    phase: Int[Array, " m"]
    friction: Modes
    slide: Int[Array, " m"]  # `Slide`: 0 holds, 1 slides, 2 drags


class SpringMotionFlow(CompliantFlow):
    """Flow with contact forces and tangential springs.

    Equation: `M q'' = (loads) + N F(x) + H lambda`, lambda as in the module.

    `State.spring` has xi [m] of contacts that hold, n of those that slide, 0 of others.
    Modes (rows): phases, then `Slide` (m each). Margins: those by indentation and by
    velocity, Coulomb's limit or the end of slip, and in space that of dragging (m
    each).
    """

    tangential_stiffness: Float[Array, " m"]  # kappa
    swift: Float[Array, ""]  # [1/s] rate |u| / r above which a contact drags
    slide_of_start: Int[Array, " m"]  # `Slide` where the step begins

    @property
    def steep(self) -> Float[Array, " m"]:
        """`kappa eta`: k_t over the secant stiffness F / x."""
        return steepness(self.force, self.tangential_stiffness)

    @property
    def coulomb(self) -> Float[Array, " m"]:
        """mu of the contacts."""
        assert self.mu is not None  # see `tangential_stiffness_of`
        return self.mu

    def limit(self, x: Float[Array, " m"]) -> Float[Array, " m"]:
        """Elongation `r = mu x / (kappa eta)` [m] at Coulomb's limit."""
        return self.coulomb * x / self.steep

    def constants(self, modes: Int[Array, "k 1"]) -> SpringModes:  # type: ignore[override]
        """Modes from their rows."""
        return spring_modes(modes, self.like)

    # ---- forces

    def contact_forces(  # type: ignore[override]
        self, const: SpringModes, state: State
    ) -> tuple[Contacts, Forces]:
        """Contact space, and the forces F of the law and lambda of the springs."""
        contacts = self.contacts(state)
        push = normal_forces(self.force, const.phase, contacts, state)
        n = self.directions(const, state, contacts, push)
        by_springs = self.tangential_forces(const, state, push, n)
        side = by_springs.reshape(-1)
        all_forces = jnp.concatenate([push, side])
        acceleration = contacts.free + contacts.moved @ all_forces
        return contacts, Forces(push, side, acceleration)

    def tangential_forces(
        self,
        const: SpringModes,
        state: State,
        push: Float[Array, " m"],
        n: Float[Array, "m b"],
    ) -> Float[Array, "m b"]:
        """`-k_t xi` of contacts that hold, at most mu F long; `-mu F n` of those that
        slide, 0 of open ones.
        """
        x = state.contact[0]
        mu = self.coulomb
        deep = x > 0
        secant = quotient(push, x, where=deep)
        xi = springs(state)
        stretched = self.steep * length(xi)
        limit = mu * x
        beyond = stretched > limit  # by rounding, or BEYOND
        share = quotient(limit, stretched, where=beyond, otherwise=1.0)
        k_t = self.steep * secant * share
        held = -k_t[:, None] * xi
        largest = mu * push
        sliding = -largest[:, None] * n
        holds = const.slide == Slide.HOLDS
        side = jnp.where(holds[:, None], held, sliding)
        acts = loaded(const.phase)
        return jnp.where(acts[:, None], side, 0.0)

    def directions(
        self,
        const: SpringModes,
        state: State,
        contacts: Contacts,
        push: Float[Array, " m"],
    ) -> Float[Array, "m b"]:
        """Directions n of springs: the state of those that slide, of those that drag
        the direction of u, turned back.
        """
        assert contacts.tangent is not None
        m = len(push)
        mu = self.coulomb
        n = direction(springs(state))
        if not self.in_space:
            return n
        u = by_contact(contacts.tangent.rate, m)
        acts = loaded(const.phase)
        drags = (const.slide == Slide.DRAGS) & acts
        first = jnp.where(drags[:, None], direction(u), n)
        by_springs = self.tangential_forces(const, state, push, first)
        side = by_springs.reshape(-1)
        all_forces = jnp.concatenate([push, side])
        acceleration = contacts.approach + contacts.delassus @ all_forces
        growth = by_contact(acceleration[m:], m)  # u'
        across = jnp.stack([-first[:, 1], first[:, 0]], axis=1)
        speed = length(u)
        follows = self.steep * speed
        sinking = self._sinking(const, contacts)
        pace = follows + mu * sinking
        # x falls faster than n follows u: the limit closes before n turns
        pace = jnp.maximum(pace, 0.5 * follows)
        # mu x phi' / pace with phi' = u x u' / |u|^2
        aside = jnp.sum(across * growth, axis=1)
        turning = mu * state.contact[0] * aside
        divisor = speed * pace
        behind = drags & (divisor > 0)
        lag = quotient(turning, divisor, where=behind)
        ahead = jnp.cos(lag)[:, None] * first
        return ahead - jnp.sin(lag)[:, None] * across

    @property
    def in_space(self) -> bool:
        """True where each contact has two tangents."""
        assert not isinstance(self.like.spring, tuple)  # of motions with springs
        return len(self.like.spring) > 1

    def spring_rates(  # type: ignore[override]
        self,
        const: SpringModes,
        state: State,
        contacts: Contacts,
        force: Forces,
    ) -> Float[Array, "b m"]:
        """Rates of `State.spring`: u of contacts that hold, n' of those that slide,
        else 0.
        """
        assert contacts.tangent is not None
        u = by_contact(contacts.tangent.rate, len(const.slide))
        n = direction(springs(state))
        along = jnp.sum(n * u, axis=1, keepdims=True)
        across = u - along * n
        r = self.limit(state.contact[0])
        slides = const.slide == Slide.SLIDES
        turns = slides & (r > 0)
        divisor = jnp.where(turns, r, 1.0)
        turning = across / divisor[:, None]
        rate = jnp.where(turns[:, None], turning, 0.0)
        holds = const.slide == Slide.HOLDS
        rate = jnp.where(holds[:, None], u, rate)
        acts = loaded(const.phase)
        acting = jnp.where(acts[:, None], rate, 0.0)
        return acting.T

    def sizes_of_springs(self, state: State) -> list[Float[Array, " m"]]:
        """Sizes of the rows of springs, of which a step may err by `rtol`.

        Those of contacts that hold: r of the deepest indentation, without friction that
        indentation; of those that slide, where n errs by forces alone, 1 over the share
        of the indentation now.
        """
        holds = self.slide_of_start == Slide.HOLDS
        depth = self.scales.depth
        rubs = self.coulomb > 0
        scale = jnp.where(rubs, self.limit(depth), depth)
        relative = state.contact[0] / depth
        share = jnp.clip(relative, self.rtol, 1.0)
        size = jnp.where(holds, scale, 1 / share)
        return [size] * len(state.spring)

    # ---- events

    def margins(  # type: ignore[override]
        self, const: SpringModes, modes: Int[Array, "k 1"], y: Float[Array, "some 1"]
    ) -> Float[Array, "margins 1"]:
        """Margins while the modes hold, and that of the sample.

        | mode | Coulomb's limit or end of slip | dragging |
        |---|---|---|
        | holds | `(r - abs(xi)) / r_0 + BEYOND rtol` | 1 |
        | slides | `(n . u - r') / (u_0 + r_0')` | `(r - abs(u) / swift) / r_0` |
        | drags | as sliding | `(abs(u) / (QUARTER swift) - r) / r_0` |

        with the scales r_0 of the deepest indentation, u_0 of slip and r_0' of the
        fastest approach; 1 of open contacts, and of sliding ones without friction.
        """
        state = unpacked(self.like, y)
        contacts, force = self.contact_forces(const, state)
        assert contacts.tangent is not None
        m = len(const.slide)
        x = state.contact[0]
        scales = self.scales
        normal = self._normal_margins(const.phase, contacts.normal.rate, x)
        u = by_contact(contacts.tangent.rate, m)
        n = self.directions(const, state, contacts, force.normal)
        acts = loaded(const.phase)
        has_friction = self.coulomb > 0
        rubs = acts & has_friction
        holds = const.slide == Slide.HOLDS
        deepest = self.limit(scales.depth)
        scale = jnp.where(has_friction, deepest, 1.0)
        r = self.limit(x)
        stretched = length(springs(state))
        within = (r - stretched) / scale
        left = within + BEYOND * self.rtol
        sinking = self._sinking(const, contacts)
        limit_rate = self.limit(sinking)
        slip = jnp.sum(n * u, axis=1) - limit_rate
        fastest = scales.slip + self.limit(scales.speed)
        slip = slip / fastest
        friction = jnp.where(holds, left, slip)
        may_end = rubs | (acts & holds)
        friction = jnp.where(may_end, friction, 1.0)
        parts = [normal, friction]
        if self.in_space:
            lag = length(u) / self.swift
            drags_now = const.slide == Slide.DRAGS
            drags = jnp.where(drags_now, lag / QUARTER - r, r - lag)
            slides = rubs & ~holds
            dragging = drags / scale
            parts.append(jnp.where(slides, dragging, 1.0))
        margins = jnp.concatenate(parts)
        return self.with_margin_of_sample(margins, state)

    def _sinking(self, const: SpringModes, contacts: Contacts) -> Float[Array, " m"]:
        """Rate x' [m/s] of the indentations."""
        gamma = contacts.normal.rate
        return unloading(self.force, const.phase, -gamma)

    def switch(
        self,
        modes: Int[Array, "k 1"],
        y: Float[Array, "rows 1"],
        which: Bool[Array, "margins 1"],
    ) -> tuple[Int[Array, "k 1"], Float[Array, "rows 1"]]:
        """Modes and state after the events `which`.

        Slip that ends leaves xi = r n; a contact that closes or opens has xi = 0, and
        slides at once if `kappa eta |u| > mu |f'|` where it closes at x = 0.
        """
        state = unpacked(self.like, y)
        const = self.constants(modes)
        m = len(const.slide)
        _, _, fired, *dragging = which[:-1, 0].reshape(-1, m)  # the last: a sample
        toggled = jnp.zeros_like(fired)
        if dragging:  # in space
            toggled = dragging[0] & ~fired
        contacts, force = self.contact_forces(const, state)
        n = self.directions(const, state, contacts, force.normal)
        assert contacts.tangent is not None
        u = by_contact(contacts.tangent.rate, m)
        has_direction = length(n)[:, None] > 0  # else xi = 0 yet
        n = jnp.where(has_direction, n, direction(u))
        holds = const.slide == Slide.HOLDS
        x = state.contact[0]
        stopped = fired & ~holds
        begins = fired & holds
        at_limit = self.limit(x)[:, None] * n
        xi_or_n = springs(state)
        spring = jnp.where(stopped[:, None], at_limit, xi_or_n)
        slide = jnp.where(stopped, Slide.HOLDS, const.slide)
        other = jnp.where(begins, Slide.SLIDES, slide)
        is_swift = self._swift(contacts, x)
        drags = begins & is_swift
        other = jnp.where(drags, Slide.DRAGS, other)
        opposite = Slide.SLIDES + Slide.DRAGS - const.slide
        slide = jnp.where(toggled, opposite, other)
        turns = begins | toggled
        spring = jnp.where(turns[:, None], n, spring)
        phase, new = self.switched_phases(const.phase, state, which)
        was = loaded(const.phase)
        remains = loaded(phase) & was
        slide = jnp.where(remains, slide, Slide.HOLDS)
        spring = jnp.where(remains[:, None], spring, 0.0)
        closes = loaded(phase) & ~was
        slide, spring = self.closed(closes, contacts, x, slide, spring)
        drags_now = slide == Slide.DRAGS
        spring = jnp.where(drags_now[:, None], 0.0, spring)
        new = new._replace(spring=spring.T)
        rows = jnp.concatenate([phase, slide])
        whole = rows.astype(modes.dtype)
        return whole[:, None], packed(new)

    def _swift(self, contacts: Contacts, x: Float[Array, " m"]) -> Bool[Array, " m"]:
        """True where a contact in space that begins to slide drags."""
        assert contacts.tangent is not None
        if not self.in_space:
            return jnp.zeros(len(x), bool)
        u = by_contact(contacts.tangent.rate, len(x))
        # between the ends of both modes, so that neither ends at once
        return length(u) > 2 * QUARTER * self.swift * self.limit(x)

    def closed(
        self,
        closes: Bool[Array, " m"],
        contacts: Contacts,
        x: Float[Array, " m"],
        slide: Int[Array, " m"],
        spring: Float[Array, "m b"],
    ) -> tuple[Int[Array, " m"], Float[Array, "m b"]]:
        """Modes and springs of contacts that close: those with `|u| > r'` slide at
        once.
        """
        assert contacts.tangent is not None
        u = by_contact(contacts.tangent.rate, len(x))
        speed = jax.lax.stop_gradient(length(u))
        closing = jax.lax.stop_gradient(contacts.normal.rate)
        widens = self.limit(jnp.abs(closing))
        at_once = closes & (speed > widens)
        no_depth = jnp.zeros_like(x)
        swift = at_once & self._swift(contacts, no_depth)
        slide = jnp.where(at_once, Slide.SLIDES, slide)
        slide = jnp.where(swift, Slide.DRAGS, slide)
        slides = at_once[:, None]
        new_spring = jnp.where(slides, direction(u), spring)
        return slide, new_spring

    def projected(  # type: ignore[override]
        self, const: SpringModes, state: State
    ) -> tuple[State, Bool[Array, " none"]]:
        """The state as it is: springs need no projection."""
        return state, jnp.zeros(0, bool)


def springs(state: State) -> Float[Array, "m b"]:
    """`State.spring` by contact: xi [m] or n."""
    spring = state.spring
    assert not isinstance(spring, tuple)  # of motions with springs
    return spring.T


def steepness(force: Force, kappa: Float[Array, " m"]) -> Float[Array, " m"]:
    """`kappa eta`: the tangential stiffness over the secant one F / x."""
    assert force.bistiffness is not None  # see `Compliant`
    exponent = force.bistiffness.exponent
    return kappa * jnp.asarray(exponent, kappa.dtype)


def spring_modes(modes: Int[Array, "k 1"], like: State) -> SpringModes:
    """Phases and modes of springs from their rows (m each)."""
    phase, slide = modes[:, 0].reshape(2, -1)
    acts = loaded(phase)
    one = jnp.ones_like(like.contact[0])
    holds = slide == Slide.HOLDS
    friction = Modes(acts, holds, one)
    return SpringModes(phase, friction, slide)


def margins_of_springs(problem: MotionProblem) -> int:
    """Number of margins whose zeros are events: 3 m in the plane, 4 m in space."""
    if problem.settings.spatial:
        return 4 * problem.contacts
    return 3 * problem.contacts


def springs_at_start(
    problem: MotionProblem,
    state: State,
    phase: Int[Array, " m"],
    fastest: Float[Array, " s"],
) -> tuple[Int[Array, " rows"], State]:
    """Rows of the modes and the state where the motion begins.

    Springs hold with xi = 0; those of contacts that close just then, at x = 0, as
    `SpringMotionFlow.closed` says.
    """
    holds = jnp.full_like(phase, Slide.HOLDS)
    rows = jnp.concatenate([phase, holds])
    flow = spring_flow(problem, state, rows[:, None], fastest)
    contacts = flow.contacts(state)
    x = state.contact[0]
    closes = loaded(phase) & (x <= 0)
    xi = springs(state)
    slide, spring = flow.closed(closes, contacts, x, holds, xi)
    drags = slide == Slide.DRAGS
    spring = jnp.where(drags[:, None], 0.0, spring)
    rows = jnp.concatenate([phase, slide])
    start = state._replace(spring=spring.T)
    return rows, start


def spring_flow(
    problem: MotionProblem,
    state: State,
    modes: Int[Array, "k 1"],
    fastest: Float[Array, " s"],
) -> SpringMotionFlow:
    """Flow from this state on; `fastest`: largest approach, then slip, of each contact
    [m/s].

    Roundings of margins: SNAP of the tolerance, or velocities that arise within the
    rounding of time.
    """
    system = problem.system
    force = problem.law
    settings = problem.settings
    kappa = problem.tangential_stiffness
    times = problem.times
    m = problem.contacts
    assert kappa is not None
    dtype = state.q.dtype
    contacts = contacts_at(system, state.q, state.v, state.t, friction=True)
    with_stored = _with_stored(force, contacts, state, fastest)
    scales = contact_scales(force, contacts, with_stored)
    rtol = settings.rtol
    snap = jnp.full(m, SNAP * rtol, dtype)
    largest = jnp.max(jnp.abs(contacts.approach))
    noise = velocity_noise(settings, largest)
    of_rate = noise / scales.speed
    by_speed = jnp.maximum(snap, of_rate)
    slide = spring_modes(modes, state).slide
    # where slip ends as much is left as counts as none: a margin that then falls by
    # rounding, and rises, has no event
    twice = 2 * BEYOND * rtol
    at_limit = jnp.full(m, twice, dtype)
    noise_of_slip = noise / scales.slip
    of_slip = jnp.maximum(snap, noise_of_slip)
    holds = slide == Slide.HOLDS
    by_slip = jnp.where(holds, at_limit, of_slip)
    rows = [snap, by_speed, by_slip]
    if settings.spatial:
        rows.append(snap)
    state_rows = len(packed(state))
    blank = jnp.zeros((state_rows, 1), dtype)
    longest = longest_step(system, times)
    omega = _frequency(force, kappa, contacts, scales.depth)
    flow = SpringMotionFlow(
        system=system,
        rounding=roundings(jnp.concatenate(rows), times),
        sample=times[0],
        rtol=rtol,
        sizes=blank,
        like=state,
        longest=longest,
        mu=problem.mu,
        axes=None,
        force=force,
        scales=scales,
        tangential_stiffness=kappa,
        swift=SWIFT * omega,
        slide_of_start=slide,
    )
    h = stable(flow, modes, contacts, state)
    longest = jnp.minimum(longest, h)
    return dataclasses.replace(flow, longest=longest)


def _with_stored(
    force: Force, contacts: Contacts, state: State, fastest: Float[Array, " s"]
) -> Float[Array, " s"]:
    """Largest approach, then slip, of each contact [m/s], the approach at least what
    its indentation could give.

    Equation: `sqrt(W_jj F x)`, of contacts that carry a load without having struck.
    """
    m = len(contacts.normal.value)
    x = jnp.maximum(state.contact[0], 0.0)
    w = jnp.diagonal(contacts.delassus)[:m]
    no_rate = jnp.zeros_like(x)
    push = force.force(x, no_rate)
    energy = w * push * x
    stored = jax.lax.stop_gradient(jnp.sqrt(energy))
    return fastest.at[:m].max(stored)


def _frequency(
    force: Force,
    kappa: Float[Array, " m"],
    contacts: Contacts,
    x: Float[Array, " m"],
) -> Float[Array, ""]:
    """Bound [1/s] of the frequency of contacts at the indentations x, all of them
    loaded and held.

    Equation: `omega^2 = max_i sum_j |W_ij| k_j`, k_j = dF/dx in normal rows and
    kappa dF/dx in tangential ones.
    """
    no_rate = jnp.zeros_like(x)
    normal = stiffness_of(force, x, no_rate)
    tangential = kappa * normal
    return _fastest(contacts, normal, tangential)


def _fastest(
    contacts: Contacts, normal: Float[Array, " m"], tangential: Float[Array, " m"]
) -> Float[Array, ""]:
    """`sqrt(max_i sum_j |W_ij| k_j)` [1/s] of the stiffnesses k [N/m] of all rows."""
    m = len(normal)
    w = jnp.abs(contacts.delassus)
    tangents = (len(w) - m) // m
    of_tangents = jnp.repeat(tangential, tangents)
    k = jnp.concatenate([normal, of_tangents])
    square = jnp.max(w @ k)
    return jax.lax.stop_gradient(jnp.sqrt(square))


def stable(
    flow: SpringMotionFlow, modes: Int[Array, "k 1"], contacts: Contacts, state: State
) -> Float[Array, ""]:
    """Longest stable step [s]: `min(STABLE / omega, TURN r / |u|)`.

    omega bounds the frequency with the stiffness of loaded contacts and the springs
    that hold; r / |u| is the time in which springs turn that slide.
    """
    assert contacts.tangent is not None
    const = flow.constants(modes)
    m = len(const.slide)
    x = jnp.maximum(state.contact[0], 0.0)
    no_rate = jnp.zeros_like(x)
    stiffness = stiffness_of(flow.force, x, no_rate)
    acts = loaded(const.phase)
    held = const.slide == Slide.HOLDS
    holds = acts & held
    steep = unloading(flow.force, const.phase, stiffness)
    normal = jnp.where(acts, steep, 0.0)
    k_t = flow.tangential_stiffness * stiffness
    side = jnp.where(holds, k_t, 0.0)
    fastest = _fastest(contacts, normal, side)
    some = fastest > 0
    by_springs = quotient(STABLE, fastest, where=some, otherwise=jnp.inf)
    slip = length(by_contact(contacts.tangent.rate, m))
    slides = const.slide == Slide.SLIDES
    moves = slip > 0
    turns = acts & slides & moves
    if not flow.in_space:
        turns = jnp.zeros_like(turns)
    r = flow.limit(x)
    turn = TURN * r
    by_turning = quotient(turn, slip, where=turns, otherwise=jnp.inf)
    shortest = jnp.min(by_turning)
    longest = jnp.minimum(by_springs, shortest)
    return jax.lax.stop_gradient(longest)
