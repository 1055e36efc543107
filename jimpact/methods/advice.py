"""The simplest law that suffices for an impact within a tolerance, and the evidence."""

import itertools
import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import kinetic_angles
from jimpact.core.law import (
    Law,
    check_law,
    free_parameters_of,
    open_tolerance,
    options_of,
)
from jimpact.core.registry import ADVISED, registered_laws, simplest_first
from jimpact.core.scene import (
    Scene,
    as_velocity,
    dense_mass,
    gap_velocity,
    solve_mass,
    velocity_change,
    with_gaps,
)
from jimpact.laws.binary import Binary
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Bistiffness
from jimpact.laws.gap_scale import gap_scale
from jimpact.laws.lzb import LZB, default_rtol
from jimpact.methods.advice_report import Advice, Candidate, ContactBlock, Unknown
from jimpact.methods.points import (
    EnergyNorm,
    Outcomes,
    at_points,
    in_batches,
    in_turns,
    varied_impacts,
)
from jimpact.numerics.sparse import components
from jimpact.tools.checks import as_whole, check_per_contact, check_shape, check_values
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import precision
from jimpact.tools.progress import counting_bar
from jimpact.tools.status import STATUS

# Smallest tolerance over the reference's rtol. Ten times more would refuse 1e-6; ten
# times
# less would let the reference's error enter.
FINEST_TOLERANCE = 100
# The error of a loosened rtol, and the distance between LZB and Compliant, count as
# small below the tolerance over this. Ten times more costs time; ten times less moves
# the verdict.
SMALL_PART = 10
# Largest rtol that is advised: beyond, the steps of the integrator are no longer fewer.
COARSEST_RTOL = 1e-3

# Range of an unknown ratio of two stiffnesses: contacts of bodies of one kind.
UNKNOWN_RANGE = (0.1, 10.0)
# Stiffnesses with every ratio at an end of its range, all of them up to this number,
# else as many at random.
CORNERS = 64
# places in a ratio's range (of its logarithm) tried by itself
ALONE = (0.0, 1 / 3, 2 / 3, 1.0)
# change of ln k for the sensitivity; its square is far below what is printed
NUDGE = 0.02

# Open contacts of a body that turns (all but chains) take part where they can close
# while others are loaded: within this time [s], longer than hard bodies touch ...
LONGEST_CONTACT = 1e-2
# ... or, where the stiffness is known, within this many times delta_c / v, about a
# third of the duration of one collision. Ten times more: contacts far away require a
# stiffness.
CONTACT_TIMES = 10

CHUNK = 64  # rows computed together
# up to this number of contacts a chunk is always full, so that it compiles once
FEW_CONTACTS = 8
LANES = 2048  # impacts of a batch, over m^2, of the laws that take no time
ROUNDS = 7  # of the timing


class Situation(NamedTuple):
    """Scene and v- with derived quantities that decide between the laws.

    `scene` is as passed, but contacts too far to take part (`far`, (m,)) have an
    infinite gap; `touching` has all contacts closed that take part; `gapped` (m,) marks
    the open contacts that can close while others are loaded; `distance` is the norm of
    differences of velocities.
    """

    scene: Scene
    touching: Scene
    velocity: np.ndarray
    gap_velocity: np.ndarray
    blocks: tuple[ContactBlock, ...]
    gapped: np.ndarray
    far: np.ndarray
    distance: EnergyNorm

    @property
    def coupled(self) -> tuple[ContactBlock, ...]:
        """Blocks of two contacts and more in which one approaches."""
        approaching = (block for block in self.blocks if block.approaches)
        return tuple(block for block in approaching if len(block.contacts) > 1)


class Trial(NamedTuple):
    """A law to try, and the scene to try it on: contacts taken as closed or not.

    `rtol` is the law's tolerance, None: it takes none. As a number that varies it
    shares one compiled program with others.
    """

    law: Law
    scene: Scene
    rtol: float | None

    def varied(
        self, velocity: np.ndarray, stiffness: np.ndarray
    ) -> tuple[dict[str, Any], int]:
        """Arguments to vary, by name with a row for each impact, and the rows of a
        batch.

        Stiffness (r, m) [N/m^eta] of a law that has one, else v- (1, n) [m/s]: one
        impact; the tolerance (r,) of a law that takes one.
        """
        rows, contacts = stiffness.shape
        if "stiffness" in free_parameters_of(self.law):
            varied = {"stiffness": stiffness}
            batch = CHUNK if contacts <= FEW_CONTACTS else min(rows, CHUNK)
        else:
            varied = {"velocity": velocity[None, :]}
            batch = max(1, LANES // contacts**2)
        if self.rtol is not None:
            count = len(next(iter(varied.values())))
            varied["rtol"] = np.full(count, self.rtol, velocity.dtype)
        return varied, batch

    def run(self, velocity: np.ndarray, varied: dict[str, Any]) -> Outcomes:
        """Outcomes of impacts at v- (n,), one for each row of the arguments
        `varied`.
        """
        scene = self.scene
        # scenes with and without gaps share one compiled program
        if scene.gaps is None:
            touching = jnp.zeros(scene.contacts, scene.mass.dtype)
            scene = with_gaps(scene, touching)
        return varied_impacts(self.law, scene, jnp.asarray(velocity), varied)


def advise(
    scene: Scene,
    velocity: Any,
    tolerance: float = 1e-2,
    *,
    restitution: Any = 1.0,
    stiffness: Any = None,
    exponent: Any = 1.5,
    friction: Any = None,
    tangential_stiffness: Any = None,
    stiffness_range: tuple[float, float] | None = None,
    samples: int = 128,
    seed: int = 0,
    timing: bool = True,
    progress: float | None = None,
) -> Advice:
    """Find the simplest law whose v+ agrees with the bistiffness reference.

    Equation: the error of a law is `sqrt(dv^T M dv) / sqrt(v-^T M v-)`, dv the
    difference between its v+ and the reference's: a ratio of energy norms, which does
    not mix m/s and rad/s.

    The reference is `LZB`, or `Compliant` where the two differ: in LZB an opened
    contact re-closes as soon as its bodies approach, in `Compliant` only after the gap
    that opened has closed (as with a wall). Only `Compliant` follows open contacts that
    can close while others are loaded; this requires the absolute stiffness. Each law is
    compared with it over the unknown stiffness ratios: varied one at a time, at the
    corners of their ranges, and at log-uniform samples. Open contacts of bodies that
    turn (of all scenes but chains) take no part if they cannot close during the impact.

    Args:
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s].
        tolerance: of the error; at least 100 times the reference's rtol (1e-8 in
            float64).
        restitution: e in [0, 1], scalar or (m,).
        stiffness: k > 0, scalar or (m,) [N / m^eta]; None: only their ratio's range is
            known.
        exponent: eta >= 1, as in `LZB`.
        friction: Coulomb's mu >= 0, scalar or (m,), of every law (e_t = 0); None: no
            friction.
        tangential_stiffness: kappa > 0, scalar or (m,), of `LZB` and `Compliant`, with
            `friction`; None: contacts stick rigidly.
        stiffness_range: low and high factor on each unknown ratio k_j / k_first within
            a group of coupled contacts, or on each k_j if absolute stiffness matters;
            default: (0.1, 10) if `stiffness` is None, else (1, 1).
        samples: number of log-uniform samples.
        seed: of the samples.
        timing: measure the cost of every law (some seconds of compilation).
        progress: bar on stderr; None: on a terminal, for long runs.

    Returns:
        `Advice`; `print` gives half a page.

    Raises:
        ValueError: shapes or ranges; friction on a scene without tangents; gaps that
            matter, or unequal exponents, without stiffness.
        RuntimeError: the reference fails on this scene.

    Source: comparisons as in Brogliato, Nonsmooth Mechanics (2016), section 6.3.3.

    >>> import jimpact as ji
    >>> advice = ji.advise(
    ...     ji.chain([1.0, 1.0]), [1.0, 0.0], restitution=0.9, timing=False
    ... )
    >>> advice.name, advice.reason
    ('newton', 'single contact')
    """
    v = as_velocity(scene, velocity, finite=True)
    if stiffness is None:
        k = np.ones(())
    else:
        k = stiffness
    parameters = {"restitution": restitution, "stiffness": k, "exponent": exponent}
    if friction is not None:
        parameters["friction"] = friction
    if tangential_stiffness is not None:
        parameters["tangential_stiffness"] = tangential_stiffness
    for name, value in parameters.items():
        check_per_contact(name, value, scene.contacts)
    factors = _checked_range(stiffness_range, stiffness is not None)
    finest = FINEST_TOLERANCE * default_rtol("time", v.dtype)
    check_shape("tolerance", tolerance, (), "one number")
    check_values("tolerance", tolerance, low=finest, high=1.0)
    as_whole("samples", samples, 1)
    as_whole("seed", seed, 0)
    springs = tangential_stiffness
    law = LZB(restitution, k, exponent, friction=friction, tangential_stiffness=springs)
    check_law(law, scene, v.dtype)
    situation = situation_of(scene, np.asarray(v), law, stiffness is not None)
    mixed = len(np.unique(np.asarray(exponent, float))) > 1
    # gaps, and contacts with unequal exponents, have no outcome in ratios of stiffness
    # alone
    some_gap = bool(situation.gapped.any())
    absolute = some_gap or (mixed and bool(situation.coupled))
    if absolute and stiffness is None:
        raise ValueError(_missing_stiffness(situation))
    given = np.asarray(k, v.dtype)
    nominal = np.broadcast_to(given, (scene.contacts,))
    unknown = _unknown_stiffnesses(situation, nominal, factors, absolute)
    tried = _stiffnesses_to_try(nominal, unknown, samples, seed)
    laws = trials(situation, law)
    options = (float(tolerance), timing, progress)
    random = slice(-samples, None)
    return _simplest_law(situation, laws, unknown, tried, random, *options)


def _simplest_law(
    situation: Situation,
    laws: dict[str, Trial],
    unknown: tuple[Unknown, ...],
    k: np.ndarray,
    random: slice,
    tolerance: float,
    timing: bool,
    progress: float | None,
) -> Advice:
    """Compare all laws with the reference, and advise the simplest one within
    `tolerance`.

    Each runs over stiffnesses k (r, m), row 0 the nominal ones, in which the `unknown`
    ones vary; `random` are the rows drawn at random. The reference is Compliant where
    gaps count or contacts re-close, else LZB.
    """
    v = situation.velocity
    programs = {
        name: partial(_outcomes, law, v, progress=progress)
        for name, law in laws.items()
    }
    outcomes, left_out = at_points(programs, k)
    for name in ("lzb", "compliant"):
        if name in left_out:
            raise RuntimeError(f"The reference law {name} {left_out[name]}")
    laws = {name: laws[name] for name in outcomes}
    apart = _reclosing_distance(situation, outcomes)  # of LZB and Compliant
    if situation.gapped.any() or apart > tolerance / SMALL_PART:
        name = "compliant"
    else:
        name = "lzb"
    outcomes[name].check_first(f"The reference law {name} fails on this scene")
    reference = outcomes[name].where_usable()
    costs: dict[str, Any] = {}
    if timing:
        costs = _costs(laws, v, k)
    candidates = {
        key: _candidate(
            law, situation, outcomes[key], reference, random, costs.get(key)
        )
        for key, law in laws.items()
    }
    chosen, suffices = _simplest(candidates, tolerance, name)
    law = laws[chosen]
    if "rtol" in options_of(type(law.law)) and law.rtol is not None:
        candidates[chosen] = _with_coarsest_rtol(
            candidates[chosen], law, situation, k, reference, tolerance
        )
    blocks = _with_simplest_laws(situation, candidates, outcomes, reference, tolerance)
    return Advice(
        name=chosen,
        tolerance=tolerance,
        within=suffices,
        reference=name,
        velocity=v,
        gap_velocity=situation.gap_velocity,
        candidates=candidates,
        blocks=blocks,
        stiffness=k[0],
        unknown=_with_effects(situation, unknown, reference, tolerance),
        rows=len(k),
        gap_ratio=_gap_ratio(situation, laws["compliant"].law),
        far=tuple(np.flatnonzero(situation.far).tolist()),
        reclosing=apart,
        left_out=left_out,
    )


def _gap_ratio(situation: Situation, compliant: Law) -> np.ndarray | None:
    """Gaps over the scale of this law, of contacts with a gap; None where none has."""
    gapped = situation.gapped
    if not gapped.any():
        return None
    scale = gap_scale(situation.scene, compliant, situation.velocity)
    return np.asarray(scale.ratio)[gapped]


def _simplest(
    candidates: dict[str, Candidate], tolerance: float, reference: str
) -> tuple[str, bool]:
    """The first of the candidates that is usable and within the tolerance, and that
    there is one; else the reference.
    """
    for name, candidate in candidates.items():
        if candidate.usable and candidate.worst <= tolerance:
            return name, True
    return reference, False


def _checked_range(
    factors: tuple[float, float] | None, known: bool
) -> tuple[float, float]:
    """Low and high factor on each unknown stiffness, checked; `known`: its value was
    given.
    """
    if factors is None:
        if known:
            return (1.0, 1.0)
        return UNKNOWN_RANGE
    ends = np.asarray(factors)
    check_shape("stiffness_range", ends, (2,), "low and high factor")
    check_values("stiffness_range", ends, low=0.0, open_low=True)
    low = float(ends[0])
    high = float(ends[1])
    if low > high:
        raise ValueError(
            f"Argument `stiffness_range` must have low <= high, but has value "
            f"({low:g}, {high:g})."
        )
    return low, high


def _missing_stiffness(situation: Situation) -> str:
    """Error message: the absolute stiffness must be given, and why."""
    if situation.gapped.any():
        numbers = np.flatnonzero(situation.gapped)
        named = ", ".join(str(j + 1) for j in numbers)
        return (
            f"Argument `stiffness` must be given [N/m^eta] where open contacts can "
            f"close while others are loaded (contact {named}): gaps count in units of "
            f"the indentation. Set their gaps to inf if they take no part."
        )
    return (
        "Argument `stiffness` must be given where exponents differ: ratios do not "
        "suffice then."
    )


# ------------------------------------------------------- the scene, and what is tried
# on it


def situation_of(
    scene: Scene, velocity: np.ndarray, law: LZB, known: bool
) -> Situation:
    """Blocks of coupled contacts, and the gaps that count, of a scene at v- (n,) [m/s].

    `known`: the stiffness of `law` is that of the contacts, not a placeholder.
    """
    gamma = np.asarray(gap_velocity(scene, velocity))
    opened = ~np.asarray(scene.closed)
    far = opened & ~_can_close(scene, velocity, law, known)
    if far.any():
        assert scene.gaps is not None
        removed = jnp.asarray(far)
        scene = with_gaps(scene, jnp.where(removed, jnp.inf, scene.gaps))
    near = np.flatnonzero(~far)
    rubs = law.friction is not None
    blocks = blocks_of(scene, gamma, near, rubs)
    # in a block that approaches; and open
    acting, gapped = np.zeros((2, len(gamma)), bool)
    for block in blocks:
        contacts = list(block.contacts)
        acting[contacts] = block.approaches
        counts = block.approaches & (len(contacts) > 1)
        gapped[contacts] = opened[contacts] & counts
    touching = scene
    if scene.gaps is not None:
        without = jnp.where(jnp.asarray(acting), 0.0, scene.gaps)
        gaps = without.astype(scene.gaps.dtype)
        touching = with_gaps(scene, gaps)
    v = np.asarray(velocity)
    norm = EnergyNorm.of(scene, v)
    return Situation(scene, touching, v, gamma, blocks, gapped, far, norm)


def _can_close(scene: Scene, velocity: np.ndarray, law: LZB, known: bool) -> np.ndarray:
    """Mask (m,) of contacts that can close while others are loaded; in a chain all.

    Equation: `gap_j <= sqrt(W_jj 2 T-) t`: without a gain of energy no gap velocity
    exceeds the root. The loads last t = `LONGEST_CONTACT`, or
    `CONTACT_TIMES delta_c / max(-gamma-)` if the stiffness is `known`.
    """
    if scene.walls is not None or scene.gaps is None:
        return np.ones(scene.contacts, bool)
    mass = dense_mass(scene)
    normals = np.asarray(scene.normals)
    # W_jj
    moved = np.asarray(solve_mass(scene, scene.normals))
    diagonal = np.sum(normals * moved, axis=0)
    fastest = np.sqrt(diagonal * (velocity @ mass @ velocity))
    duration = LONGEST_CONTACT
    approach = float(-np.min(normals.T @ velocity))
    if known and approach > 0:
        scale = gap_scale(scene, law, velocity)
        delta = np.asarray(scale.delta)[np.asarray(scene.closed)]
        duration = CONTACT_TIMES * float(delta.max(initial=0.0)) / approach
    return np.asarray(scene.gaps) <= fastest * duration


def blocks_of(
    scene: Scene, gamma: np.ndarray, contacts: np.ndarray, friction: bool
) -> tuple[ContactBlock, ...]:
    """Blocks of the given `contacts` (indices), with their kinetic angles [deg].

    Two contacts share a block if they are coupled (W_ij is not 0; with `friction` also
    between normals and tangents), directly or through others. `gamma` (m,) [m/s] are
    gap velocities.
    """
    cosine = _largest_cosines(scene, friction)[np.ix_(contacts, contacts)]
    angle = np.degrees(np.asarray(kinetic_angles(scene)))
    # rounding of normals and of M^-1
    coupled = cosine > precision(cosine.dtype).accumulated
    label = components(coupled | np.eye(len(contacts), dtype=bool))
    blocks = []
    for each in np.unique(label):
        members = np.flatnonzero(label == each)
        inside = np.ix_(contacts[members], contacts[members])
        pairs = np.triu(coupled[np.ix_(members, members)], 1)
        angles = angle[inside][pairs]
        if angles.size:
            ends = (float(angles.min()), float(angles.max()))
        else:
            ends = None
        joined = contacts[members]
        approaches = bool((gamma[joined] < 0).any())
        blocks.append(ContactBlock(tuple(joined.tolist()), approaches, ends))
    return tuple(blocks)


@full_precision
def _largest_cosines(scene: Scene, friction: bool) -> np.ndarray:
    """Largest `|W_ij| / sqrt(W_ii W_jj)` (m, m) between the directions of two contacts.

    Directions of a contact are its normal and, with friction, its tangents.
    """
    if not friction:
        return np.abs(np.cos(np.asarray(kinetic_angles(scene))))
    assert scene.tangents is not None
    columns = jnp.concatenate([scene.normals, scene.tangents], axis=1)
    w = np.asarray(columns.T @ solve_mass(scene, columns))
    size = np.sqrt(np.diag(w))
    m = scene.contacts
    # the contact of each column
    tangents = (len(w) - m) // m
    contact = np.concatenate([np.arange(m), np.repeat(np.arange(m), tangents)])
    largest = np.zeros((m, m))
    pairs = (contact[:, None], contact[None, :])
    cosines = np.abs(w / np.outer(size, size))
    np.maximum.at(largest, pairs, cosines)
    return largest


def _unknown_stiffnesses(
    situation: Situation,
    stiffness: np.ndarray,
    factors: tuple[float, float],
    absolute: bool,
) -> tuple[Unknown, ...]:
    """Stiffnesses of coupled contacts known only to a factor; none if both factors are
    equal.

    Ratios to the first contact of the block, unless the `absolute` stiffness [N/m^eta]
    counts.
    """
    if factors[0] == factors[1]:
        return ()
    unknown = []
    for block in situation.coupled:
        first = block.contacts[0]
        for j in block.contacts if absolute else block.contacts[1:]:
            name = f"k{j + 1}"
            nominal = float(stiffness[j])
            if not absolute:
                name = f"{name}/k{first + 1}"
                nominal = nominal / float(stiffness[first])
            low, high = (nominal * factor for factor in factors)
            unknown.append(Unknown(name, j, nominal, low, high))
    return tuple(unknown)


def _stiffnesses_to_try(
    stiffness: np.ndarray, unknown: tuple[Unknown, ...], samples: int, seed: int
) -> np.ndarray:
    """Stiffnesses (r, m) to try: rows of changes of ln k of the unknown ones from the
    nominal.

    In order: no change; each unknown by itself, at the places `ALONE` of its range and
    by +- NUDGE; corners of the ranges of all; `samples` log-uniform draws.
    """
    count = len(unknown)
    random = np.random.default_rng(seed)
    if count == 0:
        return stiffness[None, :]
    low = np.log([u.low / u.nominal for u in unknown])
    high = np.log([u.high / u.nominal for u in unknown])
    alone = low + np.outer(ALONE, high - low)
    nudged = [[NUDGE] * count, [-NUDGE] * count]
    places = np.concatenate([alone, nudged])
    # axes: the unknown that changes, its place, change of ln k of every unknown
    of_unknown = np.eye(count)[:, None, :]
    single = places.T[:, :, None] * of_unknown
    if 2**count <= CORNERS:
        corners = itertools.product((0.0, 1.0), repeat=count)
        ends = np.array(list(corners))
    else:
        ends = random.integers(0, 2, (CORNERS, count)).astype(float)
    drawn = random.uniform(0.0, 1.0, (samples, count))
    spread = low + np.concatenate([ends, drawn]) * (high - low)
    nominal = np.zeros((1, count))
    change = np.concatenate([nominal, single.reshape(-1, count), spread])
    tried = np.tile(stiffness, (len(change), 1))
    for i, u in enumerate(unknown):
        tried[:, u.contact] *= np.exp(change[:, i])
    return tried


def trials(situation: Situation, law: LZB) -> dict[str, Trial]:
    """Laws by name with e, k, eta and mu of `law`, the simplest first, and the scenes
    to try.

    A law that uses gaps gets the scene with gaps that count; others take its contacts
    as closed.
    """
    v = situation.velocity
    m = situation.scene.contacts
    e = jnp.broadcast_to(law.restitution, (m,)).astype(v.dtype)
    k = jnp.broadcast_to(law.stiffness, (m,)).astype(v.dtype)
    mu = law.friction
    touching = situation.touching
    kappa = law.tangential_stiffness
    gapped = bool(situation.gapped.any())
    values = (e, k, law.exponent, mu, kappa)
    known = dict(zip(ADVISED, values, strict=True))
    laws, _ = registered_laws(known, simplest_first())
    laws["binary"] = Binary(e, "earliest" if gapped else "fastest", friction=mu)
    bistiffness = Bistiffness(k, law.exponent, e)
    laws["compliant"] = Compliant(bistiffness, friction=mu, tangential_stiffness=kappa)
    ordered = {name: laws[name] for name in simplest_first()}
    tried = {}
    for name, each in ordered.items():
        scene = situation.scene if gapped and each.uses_gaps else touching
        tried[name] = Trial(each, scene, open_tolerance(each, scene, jnp.asarray(v)))
    return tried


# -------------------------------------------------------------------------- running the
# laws


def _outcomes(
    trial: Trial, velocity: np.ndarray, stiffness: np.ndarray, progress: float | None
) -> Outcomes:
    """Outcomes of a law at v- (n,) over stiffnesses (r, m); one outcome of a law
    without them.
    """
    varied, batch = trial.varied(velocity, stiffness)
    count = len(next(iter(varied.values())))
    with counting_bar(count, "impacts", progress) as advance:
        return in_batches(partial(trial.run, velocity), varied, batch, advance)


def _costs(
    laws: dict[str, Trial], velocity: np.ndarray, stiffness: np.ndarray
) -> dict[str, float]:
    """Median time of one impact in a full batch by each law, over that of the cheapest
    law.
    """
    runs = []
    counts = []
    for trial in laws.values():
        varied, batch = trial.varied(velocity, stiffness)
        # rows repeated until the batch is full
        full = {name: np.resize(x, (batch, *x.shape[1:])) for name, x in varied.items()}
        runs.append(partial(trial.run, velocity, jax.device_put(full)))
        counts.append(batch)
    timed = zip(in_turns(runs, ROUNDS), counts)
    medians = [np.median(times) / count for times, count in timed]
    cheapest = min(medians)
    return {name: float(x / cheapest) for name, x in zip(laws, medians)}


# -------------------------------------------------------------------------- the
# evidence


def _reclosing_distance(situation: Situation, outcomes: dict[str, Outcomes]) -> float:
    """Largest `|v+_LZB - v+_Compliant|_M / |v-|_M` of contacts without gaps; with gaps
    0.

    The two differ where contacts open and close again.
    """
    lzb = outcomes["lzb"]
    compliant = outcomes["compliant"]
    usable = ~(lzb.failed | compliant.failed)
    if situation.gapped.any() or not usable.any():
        return 0.0
    change = (lzb.velocity - compliant.velocity)[usable]
    return float(situation.distance(change).max())


def _candidate(
    trial: Trial,
    situation: Situation,
    outcomes: Outcomes,
    reference: Outcomes,
    random: slice,
    cost: float | None,
) -> Candidate:
    """Summary of a law: v+ and its range, errors against the reference, status, cost.

    The law is used at the nominal stiffness, row 0 of `outcomes`; `reference` has a row
    for each stiffness tried, `random` are those drawn at random.
    """
    error = situation.distance(outcomes.velocity[:1] - reference.velocity)
    return Candidate(
        law=trial.law,
        scene=trial.scene,
        velocity=outcomes.velocity[0],
        low=np.nanmin(outcomes.velocity, axis=0),
        high=np.nanmax(outcomes.velocity, axis=0),
        median=float(np.nanmedian(error[random])),
        worst=float(np.nanmax(error)),
        status=STATUS[int(outcomes.status[0])].name,
        cost=cost,
    )


def _with_coarsest_rtol(
    candidate: Candidate,
    trial: Trial,
    situation: Situation,
    stiffness: np.ndarray,
    reference: Outcomes,
    tolerance: float,
) -> Candidate:
    """The candidate with the coarsest rtol, a power of ten, that suffices for this
    tolerance.

    It changes v+ by at most `tolerance / SMALL_PART` in the energy norm over that of
    v-, at the nominal one of the stiffnesses (r, m); the default rtol, if no coarser
    one does.
    """
    assert trial.rtol is not None
    power = math.floor(math.log10(tolerance / SMALL_PART))
    coarsest = min(10.0**power, COARSEST_RTOL)
    decades = max(0, math.ceil(math.log10(coarsest / trial.rtol)))
    rtol = np.maximum(coarsest / 10.0 ** np.arange(decades + 1), trial.rtol)
    varied, batch = trial.varied(situation.velocity, stiffness)
    nominal = {name: np.repeat(x[:1], len(rtol), axis=0) for name, x in varied.items()}
    nominal["rtol"] = rtol.astype(situation.velocity.dtype)
    out = in_batches(partial(trial.run, situation.velocity), nominal, batch)
    change = situation.distance(out.velocity - candidate.velocity)
    suffices = change <= tolerance / SMALL_PART
    suffices[-1] = True
    i = int(np.argmax(suffices))
    law: Any = replace(candidate.law, rtol=float(rtol[i]))  # type: ignore[call-arg]
    error = float(situation.distance(out.velocity[i] - reference.velocity[0]))
    return replace(candidate, law=law, worst=max(candidate.worst, error))


def _with_simplest_laws(
    situation: Situation,
    candidates: dict[str, Candidate],
    outcomes: dict[str, Outcomes],
    reference: Outcomes,
    tolerance: float,
) -> tuple[ContactBlock, ...]:
    """The blocks, each with the simplest law that suffices there; None if none does.

    Equation: the law's impulses in the block, those of the reference elsewhere, change
    v+ by `M^-1 (N dp + H_t dp_t)`, at most `tolerance` in the energy norm over that of
    v-.
    """
    m = situation.scene.contacts
    blocks = []
    changes = jax.vmap(partial(velocity_change, situation.scene))
    for block in situation.blocks:
        names = candidates if block.approaches else ()
        inside = np.isin(np.arange(m), block.contacts)
        for name in names:
            out = outcomes[name]
            dp_t = None
            if t := reference.tangential.shape[1]:
                of_block = np.repeat(inside, t // m)  # mask (t,) of tangents
                dp_t = (out.tangential[:1] - reference.tangential) * of_block
            dp = (out.impulse[:1] - reference.impulse) * inside
            dv = changes(dp, dp_t)
            within = np.nanmax(situation.distance(np.asarray(dv))) <= tolerance
            if within and candidates[name].status != "order_dependent":
                block = block._replace(law=name)
                break
        blocks.append(block)
    return tuple(blocks)


def _with_effects(
    situation: Situation,
    unknown: tuple[Unknown, ...],
    reference: Outcomes,
    tolerance: float,
) -> tuple[Unknown, ...]:
    """The unknown stiffnesses k with the changes of v+ that each causes by itself.

    Equation: `alone = max |v+(k) - v+(nominal)|` over its range, in the energy norm
    over that of v-; `needed = tolerance / |d v+ / d ln k|`, the derivative by central
    differences. Rows of the reference are in the order of `_stiffnesses_to_try`.
    """
    each = []
    places = len(ALONE) + 2
    for i, u in enumerate(unknown):
        v = reference.velocity[1 + i * places :][:places]
        *_, up, down = v  # ln k changed by +- NUDGE
        change = v[: len(ALONE)] - reference.velocity[0]
        alone = float(np.nanmax(situation.distance(change)))
        slope = float(situation.distance(up - down)) / (2 * NUDGE)
        if slope > 0:
            needed = tolerance / slope
        else:
            needed = math.inf
        each.append(u._replace(alone=alone, needed=needed))
    return tuple(each)
