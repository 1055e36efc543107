"""Coulomb friction: which contacts stick, which slide and where to. Planar is a disc of
one row.

With A = D^T M^-1 D of the normals and tangents D = [N, H] and x = (p, p_t) the question
is

    normal      r = a + A_n x:  r = 0 (prescribed), or
                0 <= r _|_ p >= 0 (complementary)
    tangential  s = b + A_t x,  p_t in -mu max(p, 0) Sgn(s)

for impulses and velocities, or for forces and accelerations. Each contact is free (p =
0, or it pulls; p_t = 0), sticks (s = 0) or slides (p_t = -mu p d, d = s / |s|). These
modes are found with derivatives switched off; linear solves on them then give values
and derivatives. Where A is singular on the modes (both corners of a block lying flat),
sticking contacts share what they hold in proportion to mu p, and normal impulses are
the least, wherever that is allowed.
"""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.numerics.dense import (
    block_inverse,
    block_solve,
    load_shares,
    singular_values,
    times,
)
from jimpact.numerics.discs import (
    in_disc,
    length_of,
    normals_of,
    over,
    tangents_of,
)
from jimpact.numerics.interior_points import (
    ATTEMPTS,
    Best,
    better,
    cones_of,
    within_cones,
)
from jimpact.numerics.lcp import gathered_rounding
from jimpact.numerics.many_contacts import solve_many
from jimpact.tools.compiling import full_precision
from jimpact.tools.loops import fori_loop, while_loop
from jimpact.tools.masks import choose
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE

# contacts up to which all modes are tried: 4^3 in the plane, 6^3 in space
ENUMERATED = 3
# directions of slip, evenly spread, that each sliding contact in space starts from
_DIRECTIONS = 4
_ITERATIONS = 8  # of Newton's method for the directions of slip; 4 to 6 are usual
# Part of the largest mu p: the weight in the sharing of a contact without load. Ten
# times more: it takes a visible share.
_LEAST_SHARE = 1e-6
# Projections at most, where interior points find nothing, and at most for each contact,
# if that is more. Ten times more: jammed scenes end later.
_PROJECTIONS = 5000
_PROJECTIONS_EACH = 20
# steps of Newton's method; 1 to 3 are usual, ten times more change nothing
_POLISHES = 8
# Added to the diagonal of the equations of Newton's method, which are singular where
# impulses are free. Ten times more: another step of it.
_RIDGE = 1e-8
# Rows of the equations up to which free impulses are shared out, by their singular
# values. Ten times more: a minute for an impact.
_SHARED = 256
# `distribute`: sweeps at most; part of the largest limit below which a sweep changes
# nothing; part of the limit below which a force is inside its disc, or a rate is 0. Ten
# times more of the last two: contacts on the rim of their cone stick.
_RELAXATIONS = 200
_SETTLED = 1e-13
_INSIDE = 1e-9


class FrictionImpulses(NamedTuple):
    """Impulses x = (p, p_t), n = m + t of them, and how far they are unique; without
    derivatives.

    Of up to 3 contacts there are other `shares`, s = 2 m, with the same velocities:
    those with the least and the most p of each contact.
    """

    normal: Float[Array, " m"]  # p
    tangential: Float[Array, " t"]  # p_t, t = m or 2 m
    status: Int[Array, ""]  # a code of `tools/status.py`
    # columns in which they are free, p first; 0: they are unique
    free: Float[Array, "n n"]
    shares: Float[Array, "s n"] | None


class _FrictionProblem(NamedTuple):
    """The problem above, contact-major, b = 1 + rows, scaled to a diagonal of order
    1.
    """

    matrix: Float[Array, "m b m b"]  # A
    rate: Float[Array, "m b"]  # (a, b)
    friction: Float[Array, " m"]  # mu
    load: Float[Array, " m"] | None
    complementary: bool

    @property
    def tolerance(self) -> float:
        """Misfit that counts as none, as a part of the size of the impulses."""
        m = len(self.friction)
        return gathered_rounding(m, self.matrix.dtype)


class _Modes(NamedTuple):
    """N combinations of modes of m contacts."""

    taking: Bool[Array, "m N"]  # r = 0, not p = 0
    sticks: Bool[Array, "m N"]
    direction: Float[Array, "m rows N"]  # of slip; 0 for a free contact
    turning: Float[Array, "m N"]  # beta of `_equations`


@full_precision
def solve(
    matrix: Float[Array, "n n"],
    normal: Float[Array, " m"],
    slip: Float[Array, " t"],
    friction: Float[Array, " m"],
    *,
    complementary: bool,
    load: Float[Array, " m"] | None = None,
    sliding: Float[Array, " t"] | None = None,
) -> FrictionImpulses:
    """Impulses `x = (p, p_t)` of contacts with Coulomb friction.

    Equation: `r = normal + A_n x` is 0, or (`complementary`) `0 <= r _|_ p >= 0`;
    `s = slip + A_t x`, `p_t in -mu max(p, 0) Sgn(s)`.

    Args:
        matrix: A, n = m + t rows, normals first, then the t = m (planar) or 2 m
            tangents, contact-major. A contact that takes no part has rows and columns
            of a unit matrix.
        normal: what gamma+ - gamma- must make up for; the same for accelerations.
        slip: `(1 + e_t) u-`.
        friction: mu.
        complementary: contacts may part; otherwise they may pull (without friction).
        load: >= 0, normal impulses in addition to p, which friction includes: it is
            bounded by `mu (p + load)`, and acts on contacts with p = 0 too. None: 0.
            One below rounding counts as one that begins: where p = 0 = r, derivatives
            are those of a contact that opens.
        sliding: unit vectors of slip where it is known (forces of contacts that slide
            already: s, an acceleration, does not decide), 0 where it is unknown. Not
            together with `load`.

    Returns:
        p, p_t and a status. `several_outcomes`: with up to 3 contacts all modes are
        tried, and consistent ones whose velocities differ were found; the one with most
        sticking contacts is returned. In space Newton's method looks for the directions
        of slip from 4 starts a contact, all combined: solutions that none of them
        reaches are missed. Above 3 contacts other modes are not looked for. It is
        reported also where redundant contacts slide, so that how they share p changes
        their slip (a spinning cube flat on four corners).
        `impulse_not_unique`: only the impulses differ; of more than 256 rows no shares
        are computed, nor whether slip depends on them. `infeasible`: no modes are
        consistent;
        `max_steps`: none were found (in space, above 3 contacts).

    Derivatives (up to the third, in any mode) hold the modes, which is one-sided where
    they are about to change, and take a singular matrix to keep its rank; those of
    impulses that are not unique hold the directions in which they are free.

    Source: Anitescu and Potra, Nonlinear Dynamics 14 (1997) 231-247 (planar existence).

    >>> import jax
    >>> import jax.numpy as jnp
    >>> from jimpact.numerics.friction import solve
    >>> matrix, mu = jnp.diag(jnp.array([1.0, 2.0])), jnp.array([0.5])
    >>> problem = (matrix, jnp.array([-1.0]), jnp.array([3.0]), mu)
    >>> x = jax.jit(lambda *a: solve(*a, complementary=True))(*problem)
    >>> [round(float(p), 6) for p in (x.normal[0], x.tangential[0])]
    [1.0, -0.5]
    """
    m = len(normal)
    rows = len(slip) // m
    scaled = _by_contact(matrix, normal, slip, friction)
    scale = scaled.scale
    dtype = matrix.dtype
    drag = jnp.zeros((m, rows), dtype)  # p_t / p of contacts whose slip is known
    if sliding is not None:
        directions = sliding.reshape(m, rows)
        drag = -scaled.friction[:, None] * directions
        scaled = _with_known_slip(scaled, directions, drag)
    largest = jax.lax.stop_gradient(jnp.abs(scaled.rate).max())
    moves = largest > 0
    size = jnp.where(moves, largest, 1.0)
    if load is not None:
        load = load * scaled.norm / size
    rate = scaled.rate / size
    numbers = (scaled.matrix, rate, scaled.friction, load)
    problem = _FrictionProblem(*numbers, complementary)
    fixed = _FrictionProblem(*jax.lax.stop_gradient(numbers), complementary)
    decision = _decided(fixed)
    decided = decision.impulse
    modes, inverted = _most_at_rest(fixed, decision.modes, decided)
    free, code = _freedom(fixed, inverted)
    status = jnp.maximum(decision.status, code)
    x = _on_modes(problem, modes, inverted, decided)
    constant = jax.lax.stop_gradient(x)
    missed = _misfit_of_one(fixed, constant, decided)
    wrong = ~(missed <= fixed.tolerance)
    unsolved = wrong & (status < CODE["infeasible"])
    status = jnp.where(unsolved, CODE["max_steps"], status)
    with_drag = tangents_of(x) + drag * normals_of(x)
    both = jnp.concatenate([normals_of(x), with_drag], axis=1)
    x = both * scale * size
    p = x[:, 0]
    if complementary:
        pulls = p < 0
        p = jnp.where(pulls, 0.0, p)  # rounding
    units_of_rows = jax.lax.stop_gradient(scale)[..., None]
    by_contact = free.reshape(*scale.shape, -1)
    free = units_of_rows * by_contact
    free = _normals_first(free)
    shares = None
    if decision.others is not None:
        units = jax.lax.stop_gradient(scale * size)[..., None]
        others = units * decision.others
        shares = _normals_first(others).T
    p_t = tangents_of(x).reshape(-1)
    return FrictionImpulses(p, p_t, status, free, shares)


class _Decision(NamedTuple):
    """The modes that were decided on, and how far they are the only ones."""

    modes: _Modes  # N = 1
    impulse: Float[Array, "m b"]  # x on them
    status: Int[Array, ""]
    # with the least and the most p of each contact, s = 2 m
    others: Float[Array, "m b s"] | None


class _ByContact(NamedTuple):
    """The problem by contacts, in unknowns `x / scale`: A has a diagonal of 1."""

    matrix: Float[Array, "m b m b"]
    rate: Float[Array, "m b"]
    friction: Float[Array, " m"]
    norm: Float[Array, " m"]  # 1 / scale of the normal impulses
    scale: Float[Array, "m b"]


def _by_contact(
    matrix: Float[Array, "n n"],
    normal: Float[Array, " m"],
    slip: Float[Array, " t"],
    friction: Float[Array, " m"],
) -> _ByContact:
    """The problem of `solve` with the rows of each contact together: its normal, then
    its tangents, which are scaled alike.
    """
    m = len(normal)
    rows = len(slip) // m
    numbers = np.arange(m)
    tangents = m + np.arange(m * rows).reshape(m, rows)
    order = np.concatenate([numbers[:, None], tangents], 1)
    of_contacts = matrix[order[:, :, None, None], order[None, None]]
    diagonal = jnp.diagonal(jax.lax.stop_gradient(matrix))
    squares = diagonal[order]
    of_tangents = jnp.mean(tangents_of(squares), axis=1)
    of_normals = squares[:, 0]
    squares = jnp.stack([of_normals, of_tangents], axis=1)
    positive = squares > 0
    norm = jnp.sqrt(jnp.where(positive, squares, 1.0))
    repeats = np.array([1, rows])
    entries = 1 + rows
    scale = 1 / jnp.repeat(norm, repeats, axis=1, total_repeat_length=entries)
    slip_rows = slip.reshape(m, rows)
    rates = jnp.concatenate([normal[:, None], slip_rows], axis=1)
    rate = rates * scale
    of_normal = norm[:, 0]
    scaled_friction = friction * norm[:, -1] / of_normal
    scaled_rows = of_contacts * scale[:, :, None, None]
    scaled_matrix = scaled_rows * scale[None, None]
    return _ByContact(scaled_matrix, rate, scaled_friction, of_normal, scale)


def _with_known_slip(
    given: _ByContact, directions: Float[Array, "m t"], drag: Float[Array, "m t"]
) -> _ByContact:
    """The problem without the p_t of contacts whose direction of slip is not 0.

    Their `p_t = drag p` moves into the column of p; their p_t get unit rows, rates 0
    and friction 0.
    """
    is_known = directions != 0
    slides = jnp.any(is_known, axis=1)
    terms = _of_tangents(given.matrix) * drag[None, None]
    dragged = jnp.sum(terms, axis=3)
    matrix = given.matrix.at[..., 0].add(dragged)
    _, tangents = directions.shape
    of_rows = jnp.repeat(slides[:, None], tangents, axis=1)
    decoupled = jnp.pad(of_rows, ((0, 0), (1, 0)))
    apart = decoupled[:, :, None, None] | decoupled[None, None]
    identity = jnp.eye(given.rate.size, dtype=matrix.dtype)
    unit = identity.reshape(matrix.shape)
    return given._replace(
        matrix=jnp.where(apart, unit, matrix),
        rate=jnp.where(decoupled, 0.0, given.rate),
        friction=jnp.where(slides, 0.0, given.friction),
    )


def _normals_first(x: Float[Array, "m b N"]) -> Float[Array, "n N"]:
    """Rows of contacts reordered: the normal of each, then the tangents,
    contact-major.
    """
    *_, columns = x.shape
    tangents = tangents_of(x).reshape(-1, columns)
    return jnp.concatenate([x[:, 0], tangents])


def _of_tangents(matrix: Float[Array, "m b m b"]) -> Float[Array, "m b m rows"]:
    """The columns of a matrix that multiply tangential impulses."""
    return matrix[..., 1:]


# ------------------------------------------------------------------- the equations of
# modes


def _rates(
    problem: _FrictionProblem, x: Float[Array, "m b N"]
) -> Float[Array, "m b N"]:
    """Rates `(r, s) = (a, b) + A x` of N impulses x."""
    constant = problem.rate[..., None]
    if len(x) <= ENUMERATED:
        product = _times(problem.matrix[..., None], x)
        return constant + product
    # never computed twice
    product = jnp.tensordot(problem.matrix, x, 2)
    return constant + product


def _times(
    matrix: Float[Array, "m b m b #N"], x: Float[Array, "m b N"]
) -> Float[Array, "m b N"]:
    """Products `A x` of one or N matrices with N impulses x."""
    terms = matrix * x[None, None]
    return jnp.sum(terms, axis=(2, 3))


def _bound(problem: _FrictionProblem, x: Float[Array, "m b N"]) -> Float[Array, "m N"]:
    """Radii `mu (max(p, 0) + load)` of the discs of friction."""
    p = jnp.maximum(x[:, 0], 0.0)
    if problem.load is not None:
        p = p + problem.load[:, None]
    mu = problem.friction[:, None]
    return mu * p


def _rubs(problem: _FrictionProblem) -> Bool[Array, "m 1"]:
    """Mask of contacts with friction: without it none sticks, also where it does not
    slip.
    """
    mu = problem.friction[:, None]
    return mu > 0


def _size(x: Float[Array, "m b *N"]) -> Float[Array, "*N"]:
    """Sizes `1 + max |x|` of one or N impulses; the rates without impulses have size
    1.
    """
    largest = jnp.abs(x).max(axis=(0, 1))
    return 1 + largest


def _misfit(
    problem: _FrictionProblem,
    x: Float[Array, "m b N"],
    size: Float[Array, " N"] | None = None,
) -> Float[Array, " N"]:
    """Largest violation of the law by x, as a part of the size of x.

    Normal: |min(p, r)|, or |r| where r = 0 is prescribed; tangential: the distance of
    p_t from the projection of p_t - s on the disc. Another `size` is given where
    impulses follow from x: they must not hide their errors by growing.
    """
    rate = _rates(problem, x)
    p = x[:, 0]
    r = rate[:, 0]
    side = tangents_of(x)
    if problem.complementary:
        normal = jnp.minimum(p, r)
    else:
        normal = r
    bound = _bound(problem, x)
    tried = side - tangents_of(rate)
    wrong = side - in_disc(tried, bound)
    of_normals = jnp.abs(normal).max(axis=0)
    of_tangents = jnp.abs(wrong).max(axis=(0, 1))
    most = jnp.maximum(of_normals, of_tangents)
    if size is None:
        size = _size(x)
    return most / size


def _misfit_of_one(
    problem: _FrictionProblem, x: Float[Array, "m b"], decided: Float[Array, "m b"]
) -> Float[Array, ""]:
    """`_misfit` of the impulses x alone, by the size of those that were `decided`."""
    size = _size(decided[..., None])
    (missed,) = _misfit(problem, x[..., None], size)
    return missed


def _equations(
    problem: _FrictionProblem, modes: _Modes
) -> tuple[Float[Array, "m b m b N"], Float[Array, "m b N"]]:
    """Matrices and right sides of the linear equations of modes: r = 0 or p = 0, and

        Q s + (1 - Q) p_t + mu (p + load) d = 0

    with Q = 1 where a contact sticks and Q = 0 where it is free or slides along a fixed
    direction. With Q = beta e e^T, e orthogonal to d, beta = mu p / (mu p + |s|), this
    is Newton's method for the direction of slip.
    """
    m, rows, _ = modes.direction.shape
    dtype = problem.matrix.dtype
    one = jnp.eye(rows, dtype=dtype)[None, ..., None]
    sticks = modes.sticks[:, None, None]
    q = sticks.astype(dtype) * one
    if rows == 2:
        first, second = jnp.moveaxis(modes.direction, 1, 0)
        e = jnp.stack([-second, first], axis=1)
        beta = modes.turning[:, None, None]
        q = q + beta * e[:, :, None] * e[:, None]
    q = jnp.pad(q, ((0, 0), (1, 0), (1, 0), (0, 0)))
    takes = modes.taking.astype(dtype)
    q = q.at[:, 0, 0].set(takes)
    identity = jnp.eye(m * (1 + rows), dtype=dtype)
    unit = identity.reshape(problem.matrix.shape)
    identity = jnp.eye(m, dtype=dtype)
    own = identity[:, None, :, None, None]
    first_row = jnp.eye(1 + rows, dtype=dtype)[0]
    of_normal = first_row[None, None, None, :, None]
    mu = problem.friction[:, None, None]
    friction_direction = modes.direction * mu
    one_row = (1, 0)
    friction_direction = jnp.pad(friction_direction, ((0, 0), one_row, (0, 0)))
    pressed = friction_direction[:, :, None, None] * own * of_normal
    # term by term: in single precision XLA may crash on sums within batches of so many
    # axes
    apart = (problem.matrix - unit)[..., None]
    # Q A + (1 - Q) = 1 + Q (A - 1)
    entries = range(1 + rows)
    moved = sum(q[:, :, k, None, None] * apart[:, None, k] for k in entries)
    terms = q * problem.rate[:, None, :, None]
    right = -jnp.sum(terms, axis=2)
    if problem.load is not None:
        load = problem.load[:, None, None]
        right = right - friction_direction * load
    matrix = moved + pressed + unit[..., None]
    return matrix, right


def _turned(
    problem: _FrictionProblem, modes: _Modes, x: Float[Array, "m b N"]
) -> _Modes:
    """Modes with the directions `d = (s - p_t) / |s - p_t|` of slip that x has, in
    space.

    `turning` is the beta of `_equations`.
    """
    _, tangents, _ = modes.direction.shape
    if tangents == 1:
        return modes
    slip = tangents_of(_rates(problem, x))
    # along d where a contact slides, and where it only reaches its cone
    pull = slip - tangents_of(x)
    length = length_of(pull)
    bound = _bound(problem, x)
    had_direction = length_of(modes.direction) > 0
    slides = had_direction & (length > 0)
    new = over(pull, length)
    direction = jnp.where(slides[:, None], new, modes.direction)
    both = bound + length_of(slip)
    some = both > 0
    share = bound / jnp.where(some, both, 1.0)
    turning = jnp.where(slides & some, share, 0.0)
    return modes._replace(direction=direction, turning=turning)


def _solved(problem: _FrictionProblem, modes: _Modes) -> Float[Array, "m b N"]:
    """Impulses x on modes, contact by contact; wrong where their equations are
    singular.

    Refinements undo what `block_inverse` perturbs.
    """
    matrix, right = _equations(problem, modes)
    inverse = block_inverse(matrix)

    def refine(_: Any, x: Float[Array, "m b N"]) -> Float[Array, "m b N"]:
        """One refinement `x + E^-1 (right - E x)` by the approximate inverse."""
        missed = right - _times(matrix, x)
        return x + _times(inverse, missed)

    none = jnp.zeros_like(right)
    return fori_loop(0, 3, refine, none)


# ------------------------------------------------------------------- the decision


def _table(contacts: int, rows: int, loaded: bool) -> tuple[np.ndarray, np.ndarray]:
    """All combinations of modes (m, N), most sticking first: 0 sticks, 1 is free, 2, 3,
    .. slide.

    And the mask (m, N) of contacts with r = 0: all that are not free; with a load those
    may have p = 0 instead, and none is free.
    """
    if rows == 1:
        slides = 2
    else:
        slides = _DIRECTIONS
    if not loaded:
        unloaded = itertools.product(range(2 + slides), repeat=contacts)
        most_first = sorted(unloaded, key=lambda k: (np.count_nonzero(k), k.count(1)))
        table = np.array(most_first).T
        return table, table != 1
    of_contact = itertools.product((0, *range(2, 2 + slides)), (True, False))
    of_all = itertools.product(list(of_contact), repeat=contacts)
    ordered = sorted(of_all, key=lambda k: sum((kind > 0) for kind, _ in k))
    kinds, taking = np.array(ordered).T
    return kinds, taking == 1


def _decided(problem: _FrictionProblem) -> _Decision:
    """By all modes of up to ENUMERATED contacts, of more by `_search`."""
    if len(problem.friction) <= ENUMERATED:
        return _enumerate(problem)
    return _search(problem)


def _enumerate(problem: _FrictionProblem) -> _Decision:
    """The consistent modes that stick most, of all modes, and what other consistent
    ones give.
    """
    m = len(problem.friction)
    rows = problem.rate.shape[1] - 1
    dtype = problem.matrix.dtype
    kinds, taking = _table(m, rows, problem.load is not None)
    directions = 2 if rows == 1 else _DIRECTIONS
    angle = 2 * np.pi * (kinds - 2) / directions
    cosine = np.cos(angle)
    sine = np.sin(angle)
    turned = np.array([[cosine, -sine], [sine, cosine]])
    # rotations (rows, rows, m, N) of the first direction, 0 where a contact does not
    # slide
    of_sliding = np.where(kinds > 1, turned, 0.0)
    turn = jnp.asarray(of_sliding[:rows, :rows], dtype)
    begin = jnp.ones((m, 1, 1), dtype)
    if rows == 2:  # the slip without impulses, if there is some
        begin = tangents_of(problem.rate)[..., None] + 0.0
        moves = length_of(begin)[:, None] > 0
        begin = jnp.where(moves, begin, 1.0)
        begin = over(begin, length_of(begin))
    modes = _Modes(
        jnp.asarray(taking | (not problem.complementary)),
        jnp.asarray(kinds == 0),
        jnp.sum(turn * begin.swapaxes(0, 1)[None], axis=1).swapaxes(0, 1),
        jnp.zeros(kinds.shape, dtype),
    )
    modes, x = _newton(problem, modes)
    misfit = _misfit(problem, x)
    root = precision(dtype).root
    # larger impulses are the rounding of a singular matrix
    within = misfit <= problem.tolerance
    small = _size(x) < 1 / root
    good = within & small
    some_good = jnp.any(good)
    first_good = jnp.argmax(good)
    best = jnp.where(some_good, first_good, jnp.nanargmin(misfit))

    def differ(values: Float[Array, "m b N"]) -> Bool[Array, ""]:
        """True if these values of consistent modes differ from those of the chosen
        ones.
        """
        of_best = values[..., best][..., None]
        apart = jnp.abs(values - of_best).max(axis=(0, 1))
        different = root * _size(x[..., best])
        differs = apart > different
        return jnp.any(good & differs)

    several_impulses = differ(x)
    status = jnp.where(several_impulses, CODE["impulse_not_unique"], CODE["ok"])
    several_rates = differ(_rates(problem, x))
    status = jnp.where(several_rates, CODE["several_outcomes"], status)
    none = CODE["infeasible" if rows == 1 else "max_steps"]
    chosen = jax.tree.map(lambda leaf: leaf[..., best][..., None], modes)
    p = x[:, 0]
    signed = jnp.concatenate([p, -p])  # p and -p (2 m, N)
    of_good = jnp.where(good, signed, jnp.inf)
    extreme = jnp.argmin(of_good, axis=1)
    chosen_others = jnp.where(some_good, extreme, best)
    others = x[..., chosen_others]
    code = jnp.where(some_good, status, none)
    return _Decision(chosen, x[..., best], code, others)


def _newton(
    problem: _FrictionProblem, modes: _Modes
) -> tuple[_Modes, Float[Array, "m b N"]]:
    """Impulses x of modes, in space with the directions of slip that they lead to."""
    _, tangents, count = modes.direction.shape
    none = jnp.zeros((*problem.rate.shape, count), problem.matrix.dtype)
    if tangents == 1:
        return modes, _solved(problem, modes)

    def step(
        _: Any, state: tuple[_Modes, Float[Array, "m b N"]]
    ) -> tuple[_Modes, Float[Array, "m b N"]]:
        """Modes with the directions of slip of their impulses x, and x."""
        last, _ = state
        x = _solved(problem, last)
        return _turned(problem, last, x), x

    return fori_loop(0, _ITERATIONS, step, (modes, none))


def _at_rest(
    problem: _FrictionProblem, x: Float[Array, "m b"], margin: Float[Array, ""]
) -> _Modes:
    """The modes (N = 1) that x has, where contacts stick that slip by less than
    `margin` times the size of x.

    Contacts take part where r is at most the margin, all where they may not part; one
    whose load only begins, and that does not press, leaves. Of those that take part and
    push, or have a load, the fast ones slide and the others stick, if they rub.
    """
    column = x[..., None]
    rate = _rates(problem, column)  # (r, s)
    r = rate[:, 0]
    p = normals_of(x)
    margin = (margin * _size(column))[None]
    if problem.complementary:
        taking = r <= margin
    else:
        taking = jnp.ones(r.shape, bool)
    if problem.load is not None:
        small = problem.load < precision(x.dtype).eps
        begins = (problem.load > 0) & small
        leaves = begins[:, None] & (p <= margin)
        taking = taking & ~leaves
    pushes = taking & (p >= -margin)
    if problem.load is not None:
        loaded = problem.load[:, None] > 0
        pushes = pushes | loaded
    slip = tangents_of(rate)
    speed = length_of(slip)
    slides = pushes & (speed > margin)
    sticks = pushes & ~slides & _rubs(problem)
    along = over(slip, speed)
    direction = jnp.where(slides[:, None], along, 0.0)
    no_turning = jnp.zeros(speed.shape, x.dtype)
    modes = _Modes(taking, sticks, direction, no_turning)
    return _turned(problem, modes, column)


class _Inverted(NamedTuple):
    """Inverse of the equations E of modes, with the weights D of the sharing and no
    derivatives.

    B = E D = U S V^T with n = m b rows: `inverse` is that of B + U_0 V_0^T, U_0 and V_0
    the null vectors. `held`: free impulses remain as they are, as the least ones are
    not allowed. Of more than `_SHARED` rows the inverse is that of B with a ridge, and
    the pairs are 0.
    """

    inverse: Float[Array, "n n"]
    pairs: Float[Array, "n n"]  # U_0 V_0^T
    weight: Float[Array, "m b"]  # D
    held: Bool[Array, ""]


def _inverted(
    problem: _FrictionProblem, modes: _Modes, x: Float[Array, "m b"]
) -> _Inverted:
    """The equations of modes at x, inverted; see the class."""
    n = x.size
    turned = _turned(problem, modes, x[..., None])
    matrix, _ = _equations(problem, turned)
    weight = 1 / jnp.sqrt(_weights(problem, x))
    weighted = matrix[..., 0] * weight[None, None]
    scaled = weighted.reshape(n, n)
    held = jnp.asarray(True)
    if n > _SHARED:
        eye = jnp.eye(n, dtype=x.dtype)
        regular = jnp.linalg.inv(scaled + _RIDGE * eye)
        return _Inverted(regular, 0 * eye, weight, held)
    left, values, right, null = singular_values(scaled)
    divisor = jnp.where(null, 1.0, values)
    inverse = (right.T / divisor[None]) @ left.T
    free = jnp.where(null[None], left, 0.0)
    return _Inverted(inverse, free @ right, weight, held)


def _weights(problem: _FrictionProblem, x: Float[Array, "m b"]) -> Float[Array, "m b"]:
    """Weights w of the `sum w x^2` that shared impulses make least: 1 of p, 1 / share
    of p_t.
    """
    bound = _bound(problem, x[..., None])
    share = load_shares(bound, _LEAST_SHARE)
    _, b = x.shape
    of_tangents = jnp.repeat(1 / share, b - 1, 1)
    of_normal = jnp.ones_like(share)
    return jnp.concatenate([of_normal, of_tangents], 1)


def _most_at_rest(
    problem: _FrictionProblem, modes: _Modes, x: Float[Array, "m b"]
) -> tuple[_Modes, _Inverted]:
    """Modes with the velocities of x where all sticks that can, if its shared impulses
    are allowed.

    Otherwise, and of more than `_SHARED` rows, the modes as they are.
    """
    if x.size > _SHARED:
        return modes, _inverted(problem, modes, x)
    margin = jnp.asarray(problem.tolerance, x.dtype)
    rest = _at_rest(problem, x, margin)
    # loads that begin open contacts
    taking = modes.taking & rest.taking
    modes = modes._replace(taking=taking)
    both = jax.tree.map(lambda *leaf: jnp.stack(leaf), rest, modes)
    inverted = jax.lax.map(lambda modes: _inverted(problem, modes, x), both)
    held = jnp.array([False, True])
    inverted = inverted._replace(held=held)
    first = jax.tree.map(lambda leaf: leaf[0], inverted)
    shared = _on_modes(problem, rest, first, x)
    missed = _misfit_of_one(problem, shared, x)
    allowed = missed <= problem.tolerance
    choices = (both, inverted)
    return jax.tree.map(lambda leaf: jnp.where(allowed, *leaf), choices)


def _freedom(
    problem: _FrictionProblem, inverted: _Inverted
) -> tuple[Float[Array, "n n"], Int[Array, ""]]:
    """Columns `D V_0 U_0^T` in which impulses are free, and a status that says what
    they change.
    """
    weight = inverted.weight.reshape(-1, 1)
    free = weight * inverted.pairs.T
    if len(free) > _SHARED:  # there the inverse is large where impulses are free
        largest = jnp.max(jnp.abs(inverted.inverse))
        not_unique = largest > _RIDGE**-0.5
        return free, jnp.where(not_unique, CODE["impulse_not_unique"], CODE["ok"])
    # contacts that slide may share p so that slip changes
    matrix = problem.matrix.reshape(free.shape)
    moves = jnp.abs(matrix @ free)
    root = precision(free.dtype).root
    some_free = jnp.any(free != 0)
    code = jnp.where(some_free, CODE["impulse_not_unique"], CODE["ok"])
    some_move = jnp.any(moves > root)
    return free, jnp.where(some_move, CODE["several_outcomes"], code)


def _on_modes(
    problem: _FrictionProblem,
    modes: _Modes,
    inverted: _Inverted,
    x: Float[Array, "m b"],
) -> Float[Array, "m b"]:
    """Impulses x on their modes, with derivatives up to the third, by as many chord
    steps.

    With y = x / D it solves `B y = f` and `V_0^T (D W D) y = 0`, W the `_weights`, or
    holds `V_0^T y`.
    """
    shape = x.shape
    n = x.size
    weight = inverted.weight.reshape(n)
    start = x.reshape(n) / weight

    def step(_: Any, y: Float[Array, " n"]) -> Float[Array, " n"]:
        """One chord step `y - inverse (E x - f + U_0 V_0^T D W D y)`, x = D y."""
        x = (weight * y).reshape(shape)
        turned = _turned(problem, modes, x[..., None])
        matrix, right = _equations(problem, turned)
        of_shares = _weights(problem, x).reshape(n)
        shared = weight**2 * of_shares * y
        change = jnp.where(inverted.held, y - start, shared)
        free = inverted.pairs @ change
        product = matrix.reshape(n, n) @ x.reshape(n)
        missed = product - right.reshape(n) + free
        return y - inverted.inverse @ missed

    last = fori_loop(0, 3, step, start)
    return (weight * last).reshape(shape)


# ------------------------------------------------------------------- many contacts


def _modes_at(problem: _FrictionProblem, x: Float[Array, "m b"]) -> _Modes:
    """The modes (N = 1) to which x is closest, by which Newton's method goes on.

    r = 0 where p > r; a contact sticks where |s - p_t| is within its disc.
    """
    x = x[..., None]
    rate = _rates(problem, x)
    p = x[:, 0]
    if problem.complementary:
        taking = p > rate[:, 0]
    else:
        taking = jnp.ones(p.shape, bool)
    pull = tangents_of(rate) - tangents_of(x)
    bound = _bound(problem, x)
    length = length_of(pull)
    within = length <= bound
    sticks = within & _rubs(problem)
    slides = ~sticks & (bound > 0)
    along = over(pull, length)
    direction = jnp.where(slides[:, None], along, 0.0)
    no_turning = jnp.zeros_like(p)
    modes = _Modes(taking, sticks, direction, no_turning)
    return _turned(problem, modes, x)


class _Polish(NamedTuple):
    """Impulses of Newton's method, the best so far, and the number of steps done."""

    impulse: Float[Array, "m b"]
    best: Best
    steps: Int[Array, ""]


def _search(problem: _FrictionProblem) -> _Decision:
    """Modes of many contacts; other shares are not looked for.

    By attempts of interior points, the last one by projections where contacts may part,
    each with Newton's method on the modes that it leads to.
    """

    def misfit(x: Float[Array, "m b"]) -> Float[Array, ""]:
        """Largest violation of the law by x, as a part of its size."""
        return _misfit(problem, x[..., None])[0]

    def newton(now: _Polish) -> _Polish:
        """The next x of Newton's method, which may be worse, and the best x."""
        x = _polished(problem, now.impulse)
        best_so_far = better(misfit, now.best, x)
        return _Polish(x, best_so_far, now.steps + 1)

    def wrong(best: Best) -> Bool[Array, ""]:
        """True if the law is not satisfied; also where the misfit is NaN."""
        return ~(best.misfit <= problem.tolerance)

    def goes_on(now: _Polish) -> Bool[Array, ""]:
        """True while the best x is wrong and steps are left."""
        some_left = now.steps < _POLISHES
        return wrong(now.best) & some_left

    def attempt(state: tuple[Best, Int[Array, ""]]) -> tuple[Best, Int[Array, ""]]:
        """The best so far, or what attempt `number` leads to, and the number of the
        next one.
        """
        best, number = state
        tried = within_cones(cones, misfit, number, problem.tolerance)
        if problem.complementary:
            last = number == ATTEMPTS
            swept = _projected(problem, best.impulse, last)
            last_try = jnp.where(last, swept, tried.impulse)
            tried = better(misfit, tried, last_try)
        begin = _Polish(tried.impulse, tried, jnp.asarray(0))
        last_polish = while_loop(goes_on, newton, begin)
        tried = last_polish.best
        less = tried.misfit < best.misfit
        best = choose(less, tried, best)
        return best, number + 1

    def attempts_left(state: tuple[Best, Int[Array, ""]]) -> Bool[Array, ""]:
        """True while the best impulses are wrong and attempts are left."""
        best, number = state
        some_left = number < most
        return wrong(best) & some_left

    cones = cones_of(*problem)
    none = jnp.zeros_like(problem.rate)
    unknown = jnp.inf + 0 * jnp.sum(problem.rate)
    start = Best(none, unknown), jnp.asarray(0)
    if problem.complementary:
        most = ATTEMPTS + 1
    else:
        most = ATTEMPTS
    best, _ = while_loop(attempts_left, attempt, start)
    unsolved = wrong(best)
    status = jnp.where(unsolved, CODE["max_steps"], CODE["ok"])
    modes = _modes_at(problem, best.impulse)
    return _Decision(modes, best.impulse, status, None)


def _polished(problem: _FrictionProblem, x: Float[Array, "m b"]) -> Float[Array, "m b"]:
    """x after a step of Newton's method on its modes; what is free in them stays as it
    is.
    """
    modes = _modes_at(problem, x)
    equations = _equations(problem, modes)
    matrix, right = (y[..., 0] for y in equations)
    product = jnp.sum(matrix * x[None, None], axis=(2, 3))
    missed = right - product
    identity = jnp.eye(x.size, dtype=x.dtype)
    unit = identity.reshape(matrix.shape)
    regular = matrix + _RIDGE * unit
    change = block_solve(regular, missed[..., None])
    return x + change[..., 0]


def _projected(
    problem: _FrictionProblem, x: Float[Array, "m b"], needed: Bool[Array, ""]
) -> Float[Array, "m b"]:
    """Impulses after accelerated projections from x (`many_contacts.py`), if they are
    `needed`.
    """
    return solve_many(
        lambda x: jnp.sum(problem.matrix * x[None, None], axis=(2, 3)),
        jnp.ones_like(problem.rate),
        problem.rate,
        problem.friction,
        x,
        jnp.ones((), x.dtype),
        problem.tolerance,
        jnp.where(needed, max(_PROJECTIONS, _PROJECTIONS_EACH * len(x)), 0),
        problem.load,
    ).impulse


# ------------------------------------------------------------------- known normal
# forces


def distribute(
    matrix: Float[Array, "t t B"],
    rate: Float[Array, "t B"],
    limit: Float[Array, "m B"],
    candidates: Bool[Array, "m B"],
) -> tuple[Bool[Array, "m B"], Float[Array, "t B"]]:
    """Mask of the `candidates` that stick, and where the others slide to; normal forces
    are known.

    Equation: `u' = rate + K lambda`, lambda in the discs |lambda_j| <= limit_j,
    `lambda_j in -limit_j Sgn(u_j')`. This is a convex problem: u' is unique. A
    decision, without derivatives: forces follow from the modes, to rounding.

    Args:
        matrix: K, positive semidefinite, t = m (planar) or 2 m, contact-major.
        rate: u' without the forces of these contacts.
        limit: mu F.
        candidates: other contacts have no force here.

    Returns:
        A mask of the contacts that stick, and the directions of slip of the others. A
        contact in space that others hold on the rim of its disc counts as sliding, at
        speed 0, against its force. Contacts are relaxed in turn, 200 times at most: of
        strongly coupled ones near the rim (of random pairs with nearly equal tangents 3
        %) the last to settle may be wrong.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> from jimpact.numerics.friction import distribute
    >>> k, candidates = (
    ...     jnp.ones((2, 2, 1)),
    ...     jnp.ones((2, 1), bool),
    ... )  # both corners of a block
    >>> problem = (k, jnp.full((2, 1), 1.5), jnp.array([[0.4], [0.6]]), candidates)
    >>> stick, slip = jax.jit(distribute)(*problem)
    >>> stick[:, 0].tolist(), jnp.sign(slip[:, 0]).tolist()
    ([False, False], [1.0, 1.0])
    """
    matrix, rate, limit = jax.lax.stop_gradient((matrix, rate, limit))
    m, _ = limit.shape
    rows = len(matrix) // m
    limit = jnp.where(candidates, limit, 0.0)
    of_rows = jnp.repeat(candidates, rows, axis=0)
    both = of_rows[:, None] & of_rows[None]
    matrix = jnp.where(both, matrix, 0.0)
    rate = jnp.where(of_rows, rate, 0.0)
    force = _relaxed(matrix, rate, limit)
    slip = rate + times(matrix, force)
    size = _lengths(force, rows)
    inside = (1 - _INSIDE) * limit
    stick = size < inside
    if rows == 1:
        scale = jnp.max(jnp.abs(rate), axis=0, keepdims=True)
        stick = stick | (jnp.abs(slip) <= _INSIDE * scale)
    loaded = size > 0
    pushed = jnp.repeat(loaded, rows, axis=0)
    toward = jnp.where(pushed, -force, slip)
    return candidates & stick, toward


def _lengths(force: Float[Array, "t *B"], rows: int) -> Float[Array, "m *B"]:
    """|lambda_j| of each contact j, from its one or two tangential rows."""
    by_contact = force.reshape(-1, rows, *force.shape[1:])
    squares = jnp.sum(by_contact**2, axis=1)
    return jnp.sqrt(squares)


class _Sweep(NamedTuple):
    """Tangential forces after a sweep, if it changed them, and those done."""

    force: Float[Array, "t B"]
    changes: Bool[Array, ""]
    done: Int[Array, ""]


# In turn, as no other solver is as quick: in 256 lanes of 2 to 8 contacts accelerated
# projections (`many_contacts.py`) take 4 to 130 times as long, and descent with
# Anderson's extrapolation (`step_impulses.py`) leaves one lane in a hundred off by 4 %
# of the largest limit and more.
def _relaxed(
    matrix: Float[Array, "t t B"], rate: Float[Array, "t B"], limit: Float[Array, "m B"]
) -> Float[Array, "t B"]:
    """Forces lambda that satisfy the law of `distribute`, by projected Gauss-Seidel
    sweeps.
    """
    m = len(limit)
    t, *batch = rate.shape
    rows = t // m
    largest = jnp.max(limit, axis=0, keepdims=True)
    settled = _SETTLED * largest
    of_contacts = matrix.reshape(m, rows, t, *batch)
    row = np.arange(t)
    diagonal = matrix[row, row]
    by_contact = diagonal.reshape(m, rows, *batch)
    stiffness = jnp.sum(by_contact, axis=1)
    some = stiffness > 0
    stiffness = jnp.where(some, stiffness, 1.0)[:, None]  # no step is too long

    def relax(
        j: Int[Array, ""] | int, force: Float[Array, "t B"]
    ) -> Float[Array, "t B"]:
        """Forces after `lambda_j <- P(lambda_j - u_j' / stiffness_j)`, P projects on
        disc j.
        """
        first = rows * j
        at_contact = jax.lax.dynamic_slice_in_dim(force, first, rows)
        at_rest = jax.lax.dynamic_slice_in_dim(rate, first, rows)
        change = at_rest + times(of_contacts[j], force)
        tried = at_contact - change / stiffness[j]
        radius = limit[j][None]
        length = _lengths(tried, rows)
        moves = length > 0
        outside = length > radius
        ratio = radius / jnp.where(moves, length, 1.0)
        shrink = jnp.where(outside, ratio, 1.0)
        new = tried * shrink
        return jax.lax.dynamic_update_slice_in_dim(force, new, first, 0)

    def sweep(now: _Sweep) -> _Sweep:
        """The forces after each contact was relaxed once more."""
        force = fori_loop(0, m, relax, now.force)
        change = jnp.abs(force - now.force)
        changes = jnp.any(change > settled)
        return _Sweep(force, changes, now.done + 1)

    def goes_on(now: _Sweep) -> Bool[Array, ""]:
        """True while forces change and sweeps are left."""
        some_left = now.done < _RELAXATIONS
        return now.changes & some_left

    some_load = jnp.any(limit > 0)
    no_force = jnp.zeros_like(rate)
    start = _Sweep(no_force, some_load, jnp.asarray(0))
    last = while_loop(goes_on, sweep, start)
    return last.force
