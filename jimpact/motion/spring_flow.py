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
        self, const: SpringModes, at: State
    ) -> tuple[Contacts, Forces]:
        """Contact space, and the forces F of the law and lambda of the springs."""
        contacts = self.contacts(at)
        push = normal_forces(self.force, const.phase, contacts, at)
        n = self.directions(const, at, contacts, push)
        side = self.tangential_forces(const, at, push, n).reshape(-1)
        both = jnp.concatenate([push, side])
        return contacts, Forces(push, side, contacts.free + contacts.moved @ both)

    def tangential_forces(
        self,
        const: SpringModes,
        at: State,
        push: Float[Array, " m"],
        n: Float[Array, "m b"],
    ) -> Float[Array, "m b"]:
        """`-k_t xi` of contacts that hold, `-mu F n` of those that slide, 0 of open
        ones.
        """
        x = at.contact[0]
        deep = x > 0
        secant = quotient(push, x, where=deep)
        xi = springs(at)
        stretched = self.steep * length(xi)
        beyond = stretched > self.coulomb * x  # by rounding, or BEYOND
        share = quotient(self.coulomb * x, stretched, where=beyond, otherwise=1.0)
        held = -(self.steep * secant * share)[:, None] * xi
        sliding = -(self.coulomb * push)[:, None] * n
        holds = (const.slide == Slide.HOLDS)[:, None]
        side = jnp.where(holds, held, sliding)
        acts = loaded(const.phase)[:, None]
        return jnp.where(acts, side, 0.0)

    def directions(
        self,
        const: SpringModes,
        at: State,
        contacts: Contacts,
        push: Float[Array, " m"],
    ) -> Float[Array, "m b"]:
        """Directions n of springs: the state of those that slide, of those that drag
        the direction of u, turned back.
        """
        assert contacts.tangent is not None
        m = len(push)
        n = direction(springs(at))
        if n.shape[1] == 1:
            return n
        u = by_contact(contacts.tangent.rate, m)
        drags = (const.slide == Slide.DRAGS) & loaded(const.phase)
        first = jnp.where(drags[:, None], direction(u), n)
        side = self.tangential_forces(const, at, push, first).reshape(-1)
        both = jnp.concatenate([push, side])
        acceleration = contacts.approach + contacts.delassus @ both
        growth = by_contact(acceleration[m:], m)  # u'
        across = jnp.stack([-first[:, 1], first[:, 0]], axis=1)
        follows = self.steep * length(u)
        pace = follows + self.coulomb * self._sinking(const, contacts)
        # x falls faster than n follows u: the limit closes before n turns
        pace = jnp.maximum(pace, 0.5 * follows)
        # mu x phi' / pace with phi' = u x u' / |u|^2
        aside = jnp.sum(across * growth, axis=1)
        turning = self.coulomb * at.contact[0] * aside
        divisor = length(u) * pace
        behind = drags & (divisor > 0)
        lag = quotient(turning, divisor, where=behind)
        ahead = jnp.cos(lag)[:, None] * first
        return ahead - jnp.sin(lag)[:, None] * across

    def spring_rates(  # type: ignore[override]
        self,
        const: SpringModes,
        at: State,
        contacts: Contacts,
        force: Forces,
    ) -> Float[Array, "b m"]:
        """Rates of `State.spring`: u of contacts that hold, n' of those that slide,
        else 0.
        """
        assert contacts.tangent is not None
        u = by_contact(contacts.tangent.rate, len(const.slide))
        n = direction(springs(at))
        along = jnp.sum(n * u, axis=1, keepdims=True)
        across = u - along * n
        r = self.limit(at.contact[0])
        turns = (const.slide == Slide.SLIDES) & (r > 0)
        turning = across / jnp.where(turns, r, 1.0)[:, None]
        rate = jnp.where(turns[:, None], turning, 0.0)
        holds = (const.slide == Slide.HOLDS)[:, None]
        rate = jnp.where(holds, u, rate)
        acts = loaded(const.phase)[:, None]
        return jnp.where(acts, rate, 0.0).T

    def sizes_of_springs(self, at: State) -> list[Float[Array, " m"]]:
        """Sizes of the rows of springs, of which a step may err by `rtol`.

        Those of contacts that hold: r of the deepest indentation, without friction that
        indentation; of those that slide, where n errs by forces alone, 1 over the share
        of the indentation now.
        """
        modes = self.slide_of_start
        depth = self.scales.depth
        scale = jnp.where(self.coulomb > 0, self.limit(depth), depth)
        relative = at.contact[0] / self.scales.depth
        share = jnp.clip(relative, self.rtol, 1.0)
        size = jnp.where(modes == Slide.HOLDS, scale, 1 / share)
        return [size] * len(at.spring)

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
        at = unpacked(self.like, y)
        contacts, force = self.contact_forces(const, at)
        assert contacts.tangent is not None
        m = len(const.slide)
        x = at.contact[0]
        normal = self._normal_margins(const.phase, contacts.normal.rate, x)
        u = by_contact(contacts.tangent.rate, m)
        n = self.directions(const, at, contacts, force.normal)
        acts = loaded(const.phase)
        rubs = acts & (self.coulomb > 0)
        holds = const.slide == Slide.HOLDS
        deepest = self.limit(self.scales.depth)
        scale = jnp.where(self.coulomb > 0, deepest, 1.0)
        r = self.limit(x)
        within = (r - length(springs(at))) / scale
        left = within + BEYOND * self.rtol
        limit_rate = self.limit(self._sinking(const, contacts))
        slip = jnp.sum(n * u, axis=1) - limit_rate
        fastest = self.scales.slip + self.limit(self.scales.speed)
        slip = slip / fastest
        friction = jnp.where(holds, left, slip)
        friction = jnp.where(rubs | (acts & holds), friction, 1.0)
        parts = [normal, friction]
        if u.shape[1] == 2:
            lag = length(u) / self.swift
            drags_now = const.slide == Slide.DRAGS
            drags = jnp.where(drags_now, lag / QUARTER - r, r - lag)
            parts.append(jnp.where(rubs & ~holds, drags / scale, 1.0))
        return self.from_margins(jnp.concatenate(parts), at)

    def _sinking(self, const: SpringModes, contacts: Contacts) -> Float[Array, " m"]:
        """Rate x' [m/s] of the indentations."""
        return unloading(self.force, const.phase, -contacts.normal.rate)

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
        at = unpacked(self.like, y)
        const = self.constants(modes)
        m = len(const.slide)
        _, _, fired, *dragging = which[:-1, 0].reshape(-1, m)  # the last: a sample
        toggled = jnp.zeros_like(fired)
        if dragging:  # in space
            toggled = dragging[0] & ~fired
        contacts, force = self.contact_forces(const, at)
        n = self.directions(const, at, contacts, force.normal)
        assert contacts.tangent is not None
        u = by_contact(contacts.tangent.rate, m)
        has_direction = length(n)[:, None] > 0  # else xi = 0 yet
        n = jnp.where(has_direction, n, direction(u))
        holds = const.slide == Slide.HOLDS
        x = at.contact[0]
        stopped = fired & ~holds
        begins = fired & holds
        at_limit = self.limit(x)[:, None] * n
        spring = jnp.where(stopped[:, None], at_limit, springs(at))
        slide = jnp.where(stopped, Slide.HOLDS, const.slide)
        other = jnp.where(begins, Slide.SLIDES, slide)
        drags = begins & self._swift(contacts, x)
        other = jnp.where(drags, Slide.DRAGS, other)
        opposite = Slide.SLIDES + Slide.DRAGS - const.slide
        slide = jnp.where(toggled, opposite, other)
        turns = (begins | toggled)[:, None]
        spring = jnp.where(turns, n, spring)
        phase, at = self.switched_phases(const.phase, at, which)
        was = loaded(const.phase)
        remains = loaded(phase) & was
        slide = jnp.where(remains, slide, Slide.HOLDS)
        spring = jnp.where(remains[:, None], spring, 0.0)
        closes = loaded(phase) & ~was
        slide, spring = self.closed(closes, contacts, x, slide, spring)
        drags_now = (slide == Slide.DRAGS)[:, None]
        spring = jnp.where(drags_now, 0.0, spring)
        at = at._replace(spring=spring.T)
        rows = jnp.concatenate([phase, slide])
        return rows[:, None].astype(modes.dtype), packed(at)

    def _swift(self, contacts: Contacts, x: Float[Array, " m"]) -> Bool[Array, " m"]:
        """True where a contact in space that begins to slide drags."""
        assert contacts.tangent is not None
        u = by_contact(contacts.tangent.rate, len(x))
        if u.shape[1] == 1:
            return jnp.zeros(len(x), bool)
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
        swift = at_once & self._swift(contacts, jnp.zeros_like(x))
        slide = jnp.where(at_once, Slide.SLIDES, slide)
        slide = jnp.where(swift, Slide.DRAGS, slide)
        new_spring = jnp.where(at_once[:, None], direction(u), spring)
        return slide, new_spring

    def projected(  # type: ignore[override]
        self, const: SpringModes, at: State
    ) -> tuple[State, Bool[Array, " none"]]:
        """The state as it is: springs need no projection."""
        return at, jnp.zeros(0, bool)


def springs(at: State) -> Float[Array, "m b"]:
    """`State.spring` by contact: xi [m] or n."""
    assert not isinstance(at.spring, tuple)  # of motions with springs
    return at.spring.T


def steepness(force: Force, kappa: Float[Array, " m"]) -> Float[Array, " m"]:
    """`kappa eta`: the tangential stiffness over the secant one F / x."""
    assert force.bistiffness is not None  # see `Compliant`
    return kappa * jnp.asarray(force.bistiffness.exponent, kappa.dtype)


def spring_modes(modes: Int[Array, "k 1"], like: State) -> SpringModes:
    """Phases and modes of springs from their rows (m each)."""
    phase, slide = modes[:, 0].reshape(2, -1)
    acts = loaded(phase)
    one = jnp.ones_like(like.contact[0])
    friction = Modes(acts, slide == Slide.HOLDS, one)
    return SpringModes(phase, friction, slide)


def margins_of_springs(problem: MotionProblem) -> int:
    """Number of margins whose zeros are events: 3 m in the plane, 4 m in space."""
    if problem.settings.spatial:
        return 4 * problem.contacts
    return 3 * problem.contacts


def springs_at_start(
    problem: MotionProblem,
    at: State,
    phase: Int[Array, " m"],
    fastest: Float[Array, " s"],
) -> tuple[Int[Array, " rows"], State]:
    """Rows of the modes and the state where the motion begins.

    Springs hold with xi = 0; those of contacts that close just then, at x = 0, as
    `SpringMotionFlow.closed` says.
    """
    holds = jnp.full_like(phase, Slide.HOLDS)
    rows = jnp.concatenate([phase, holds])
    flow = spring_flow(problem, at, rows[:, None], fastest)
    contacts = flow.contacts(at)
    x = at.contact[0]
    closes = loaded(phase) & (x <= 0)
    slide, spring = flow.closed(closes, contacts, x, holds, springs(at))
    drags = (slide == Slide.DRAGS)[:, None]
    spring = jnp.where(drags, 0.0, spring)
    both = jnp.concatenate([phase, slide])
    return both, at._replace(spring=spring.T)


def spring_flow(
    problem: MotionProblem,
    at: State,
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
    m = problem.contacts
    assert kappa is not None
    contacts = contacts_at(system, at.q, at.v, at.t, friction=True)
    scales = contact_scales(force, contacts, _with_stored(force, contacts, at, fastest))
    snap = jnp.full(m, SNAP * settings.rtol, at.q.dtype)
    noise = velocity_noise(settings, jnp.max(jnp.abs(contacts.approach)))
    by_speed = jnp.maximum(snap, noise / scales.speed)
    slide = spring_modes(modes, at).slide
    # where slip ends as much is left as counts as none: a margin that then falls by
    # rounding, and rises, has no event
    at_limit = jnp.full(m, 2 * BEYOND * settings.rtol, at.q.dtype)
    of_slip = jnp.maximum(snap, noise / scales.slip)
    by_slip = jnp.where(slide == Slide.HOLDS, at_limit, of_slip)
    rows = [snap, by_speed, by_slip]
    if settings.spatial:
        rows.append(snap)
    state_rows = len(packed(at))
    blank = jnp.zeros((state_rows, 1), at.q.dtype)
    longest = longest_step(system, problem.times)
    flow = SpringMotionFlow(
        system=system,
        rounding=roundings(jnp.concatenate(rows), problem.times),
        sample=problem.times[0],
        rtol=settings.rtol,
        sizes=blank,
        like=at,
        longest=longest,
        mu=problem.mu,
        axes=None,
        force=force,
        scales=scales,
        tangential_stiffness=kappa,
        swift=SWIFT * _frequency(force, kappa, contacts, scales.depth),
        slide_of_start=slide,
    )
    longest = jnp.minimum(longest, stable(flow, modes, contacts, at))
    return dataclasses.replace(flow, longest=longest)


def _with_stored(
    force: Force, contacts: Contacts, at: State, fastest: Float[Array, " s"]
) -> Float[Array, " s"]:
    """Largest approach, then slip, of each contact [m/s], the approach at least what
    its indentation could give.

    Equation: `sqrt(W_jj F x)`, of contacts that carry a load without having struck.
    """
    m = contacts.normal.value.shape[0]
    x = jnp.maximum(at.contact[0], 0.0)
    w = jnp.diagonal(contacts.delassus)[:m]
    push = force.force(x, jnp.zeros_like(x))
    stored = jnp.sqrt(w * push * x)
    return fastest.at[:m].max(jax.lax.stop_gradient(stored))


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
    normal = stiffness_of(force, x, jnp.zeros_like(x))
    return _fastest(contacts, normal, kappa * normal)


def _fastest(
    contacts: Contacts, normal: Float[Array, " m"], tangential: Float[Array, " m"]
) -> Float[Array, ""]:
    """`sqrt(max_i sum_j |W_ij| k_j)` [1/s] of the stiffnesses k [N/m] of all rows."""
    m = len(normal)
    count = (len(contacts.delassus) - m) // m
    rows = jnp.concatenate([normal, jnp.repeat(tangential, count)])
    square = jnp.max(jnp.abs(contacts.delassus) @ rows)
    return jax.lax.stop_gradient(jnp.sqrt(square))


def stable(
    flow: SpringMotionFlow, modes: Int[Array, "k 1"], contacts: Contacts, at: State
) -> Float[Array, ""]:
    """Longest stable step [s]: `min(STABLE / omega, TURN r / |u|)`.

    omega bounds the frequency with the stiffness of loaded contacts and the springs
    that hold; r / |u| is the time in which springs turn that slide.
    """
    assert contacts.tangent is not None
    const = flow.constants(modes)
    m = len(const.slide)
    x = jnp.maximum(at.contact[0], 0.0)
    stiffness = stiffness_of(flow.force, x, jnp.zeros_like(x))
    acts = loaded(const.phase)
    holds = acts & (const.slide == Slide.HOLDS)
    steep = unloading(flow.force, const.phase, stiffness)
    normal = jnp.where(acts, steep, 0.0)
    side = jnp.where(holds, flow.tangential_stiffness * stiffness, 0.0)
    fastest = _fastest(contacts, normal, side)
    some = fastest > 0
    by_springs = quotient(STABLE, fastest, where=some, otherwise=jnp.inf)
    slip = length(by_contact(contacts.tangent.rate, m))
    turns = acts & (const.slide == Slide.SLIDES) & (slip > 0)
    if len(at.spring) == 1:
        turns = jnp.zeros_like(turns)
    r = flow.limit(x)
    by_turning = quotient(TURN * r, slip, where=turns, otherwise=jnp.inf)
    longest = jnp.minimum(by_springs, jnp.min(by_turning))
    return jax.lax.stop_gradient(longest)
