"""No more model than a scene needs: the simplest law within a tolerance, and why."""

import itertools
import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_whole, check_per_contact, check_shape, check_values
from jimpact.contact import components, kinetic_angles
from jimpact.fits.parameters import with_entries
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.laws import SIMPLEST_FIRST
from jimpact.laws.binary import Binary
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Bistiffness
from jimpact.laws.kinematic import Moreau, Newton
from jimpact.laws.lzb import LZB, default_rtol
from jimpact.laws.poisson import Poisson
from jimpact.methods.advice_report import Advice, Block, Candidate, Unknown
from jimpact.methods.timing import in_turns
from jimpact.montecarlo.gaps import gap_scale
from jimpact.progress import counting_bar
from jimpact.scene import Scene, as_velocity, gap_velocity, velocity_change, with_gaps
from jimpact.status import STATUS

FINEST_TOLERANCE = 100  # times the reference's own tolerance
RTOL_PART = 10  # the advised rtol is this part of the tolerance, or a little less
COARSEST_RTOL = 1e-3

UNKNOWN_RANGE = (0.1, 10.0)  # plausible ratio of two stiffnesses where nothing is said
# cos(kinetic angle) below so many roundings is 0: the rounding of normals and of M^-1
DECOUPLED_IN_EPS = 64
CORNERS = 64  # rows with every ratio at an end of its range; of more, random ones
ALONE = (0.0, 1 / 3, 2 / 3, 1.0)  # parts of a ratio's range (in its logarithm) tried alone
NUDGE = 0.02  # change of ln k for the sensitivity; its square is far below what is told

CHUNK = 64  # rows computed together
CHEAP = 8  # contacts up to which a chunk is always full
LANES = 2048  # impacts of a batch, over m^2, of the laws that take no time
ROUNDS = 7  # of the timing


class Situation(NamedTuple):
    """Scene and v- with what decides about the laws.

    `touching` is the scene with all contacts closed that take part; `gapped` (m,) marks the open
    contacts that can close and meet others at work.
    """

    scene: Scene
    touching: Scene
    velocity: np.ndarray
    gap_velocity: np.ndarray
    blocks: tuple[Block, ...]
    gapped: np.ndarray

    @property
    def scale(self) -> float:
        """max |v-|, 1 at rest."""
        return float(np.abs(self.velocity).max()) or 1.0

    @property
    def at_work(self) -> tuple[Block, ...]:
        """Blocks in which a contact approaches."""
        return tuple(block for block in self.blocks if block.approaches)

    @property
    def coupled(self) -> tuple[Block, ...]:
        """Blocks at work of two contacts and more."""
        return tuple(block for block in self.at_work if len(block.contacts) > 1)


class Rows(NamedTuple):
    """Stiffnesses (r, m) to try; row 0 is the nominal one, `random` are the last rows.

    `alone[i]` are the rows in which only unknown i leaves its nominal value, `nudged[i]` the two
    in which it does so by a little.
    """

    stiffness: np.ndarray
    unknown: tuple[Unknown, ...]
    alone: np.ndarray
    nudged: np.ndarray
    random: slice


class Outcomes(NamedTuple):
    """v+ (r, n), p (r, m), status (r,) of a batch; JAX, then numpy."""

    velocity: Any
    impulse: Any
    status: Any


class Trial(NamedTuple):
    """A law to try, and the scene to try it on: contacts taken as closed or not."""

    law: Law
    scene: Scene

    @property
    def knows_stiffness(self) -> bool:
        """Whether stiffnesses are parameters of the law."""
        return isinstance(self.law, LZB | Compliant)

    def lanes(self, rows: int) -> int:
        """Impacts computed together for so many rows of stiffness: enough to hide a call's cost."""
        return rows if self.knows_stiffness else max(1, LANES // self.scene.contacts**2)

    def run(self, at: Situation, stiffness: np.ndarray) -> Outcomes:
        """v+, p and status over rows of stiffness, or of the same impact many times."""
        v = jnp.tile(jnp.asarray(at.velocity), (self.lanes(len(stiffness)), 1))
        scene = self.scene
        if scene.gaps is None:  # scenes with and without gaps share one compiled program
            scene = with_gaps(scene, jnp.zeros(scene.contacts, scene.mass.dtype))
        rows = jnp.asarray(stiffness, v.dtype) if self.knows_stiffness else None
        return _batch(self.law, scene, v, rows)


def advise(
    scene: Scene,
    velocity: Any,
    tolerance: float = 1e-2,
    *,
    restitution: Any = 1.0,
    stiffness: Any = None,
    exponent: Any = 1.5,
    stiffness_range: tuple[float, float] | None = None,
    samples: int = 128,
    seed: int = 0,
    timing: bool = True,
    progress: float | None = None,
) -> Advice:
    """The simplest law whose v+ is within a tolerance of LZB on this scene, with the evidence.

    Every law is compared with LZB over the stiffness ratios that are not known: one at a time, at
    the corners of their ranges, and log-uniformly. Where open contacts can meet others at work
    the reference is `Compliant` with these gaps, and the absolute stiffness must be given.

    Args:
        scene: n coordinates, m contacts. Friction is left out.
        velocity: v- (n,) [m/s].
        tolerance: of v+, relative to max |v-|; at least 100 times the reference's own 1e-8.
        restitution: e in [0, 1], scalar or (m,).
        stiffness: k > 0, scalar or (m,) [N / m^eta]; None: only their ratio's range is known.
        exponent: eta >= 1, as in `LZB`.
        stiffness_range: low and high factor on every stiffness ratio (k_j over that of the first
            contact of its block; on every k_j where not only ratios count); default: (0.1, 10)
            where no stiffness is given, else (1, 1).
        samples: number of log-uniform samples.
        seed: of the samples.
        timing: measure the cost of every law (some seconds of compilation).
        progress: bar on stderr; None: on a terminal, for long runs.

    Returns:
        `Advice`; `print` gives half a page.

    Raises:
        ValueError: shapes or ranges; gaps that matter, or unequal exponents, without stiffness.
        RuntimeError: the reference fails on this scene.

    Source: the kind of Brogliato, Nonsmooth Mechanics (2016), section 6.3.3.

    >>> import jimpact as ji
    >>> found = ji.advise(ji.chain([1.0, 1.0]), [1.0, 0.0], restitution=0.9, timing=False)
    >>> found.name, found.reason
    ('newton', "single contact: every law is Newton's")
    """
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    known = stiffness is not None
    k = stiffness if known else 1.0
    for name, value in (("restitution", restitution), ("stiffness", k), ("exponent", exponent)):
        check_per_contact(name, value, scene.contacts)
    span = span_of(stiffness_range, known)
    finest = FINEST_TOLERANCE * default_rtol("time", v.dtype)
    check_shape("tolerance", tolerance, (), "one number")
    check_values("tolerance", tolerance, low=finest, high=1.0)
    as_whole("samples", samples, 1)
    as_whole("seed", seed, 0)
    at = situation(scene, np.asarray(v))
    mixed = len(np.unique(np.asarray(exponent, float))) > 1
    absolute = bool(at.gapped.any()) or (mixed and bool(at.coupled))
    if absolute and not known:
        raise ValueError(missing_stiffness(at))
    k = np.broadcast_to(np.asarray(k, v.dtype), (scene.contacts,))
    laws = trials(at, restitution, k, exponent)
    tried = rows(k, unknowns(at, k, span, absolute), samples, seed)
    return _found(at, laws, tried, float(tolerance), timing, progress)


def _found(
    at: Situation,
    laws: dict[str, Trial],
    tried: Rows,
    tolerance: float,
    timing: bool,
    progress: float | None,
) -> Advice:
    name = list(laws)[-1]
    own = {key: outcomes(law, at, tried.stiffness, progress) for key, law in laws.items()}
    reference = _usable_rows(own[name], name)
    evidence = {
        key: candidate(law, at, own[key], reference, tried.random) for key, law in laws.items()
    }
    if timing:
        for key, cost in costs(laws, at, tried.stiffness).items():
            evidence[key] = replace(evidence[key], cost=cost)
    fit = [key for key, c in evidence.items() if c.usable and c.worst <= tolerance]
    chosen = fit[0] if fit else name
    if laws[chosen].knows_stiffness:
        evidence[chosen] = _loosened(evidence[chosen], at, reference, tolerance)
    gap_ratio = None
    if at.gapped.any():
        scale = gap_scale(at.scene, laws["compliant"].law, at.velocity)
        gap_ratio = np.asarray(scale.ratio)[at.gapped]
    return Advice(
        name=chosen,
        tolerance=tolerance,
        within=bool(fit),
        reference=name,
        velocity=at.velocity,
        gap_velocity=at.gap_velocity,
        candidates=evidence,
        blocks=_blocks(at, evidence, own, reference, tolerance),
        stiffness=tried.stiffness[0],
        unknown=_effects(at, tried, reference, tolerance),
        rows=len(tried.stiffness),
        gap_ratio=gap_ratio,
    )


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


def missing_stiffness(at: Situation) -> str:
    """The message where ratios of stiffnesses are not enough."""
    if at.gapped.any():
        named = ", ".join(str(j + 1) for j in np.flatnonzero(at.gapped))
        return (
            "Argument `stiffness` must be given [N/m^eta] where open contacts can meet others at "
            f"work (contact {named}): gaps count in units of the indentation."
        )
    return "Argument `stiffness` must be given where exponents differ: ratios then say nothing."


# ------------------------------------------------------- the scene, and what is tried on it


def situation(scene: Scene, velocity: np.ndarray) -> Situation:
    """Blocks and gaps of a scene at the velocity v- (n,)."""
    gamma = np.asarray(gap_velocity(scene, velocity))
    angle = np.degrees(np.asarray(kinetic_angles(scene)))
    rounding = DECOUPLED_IN_EPS * np.finfo(angle.dtype).eps
    touch = np.abs(np.cos(np.radians(angle))) > rounding
    label = components(touch | np.eye(len(gamma), dtype=bool))
    together = [tuple(np.flatnonzero(label == first).tolist()) for first in np.unique(label)]
    blocks = tuple(_block(members, gamma, angle, touch) for members in together)
    opened = ~np.asarray(scene.closed)
    acting = np.zeros(len(gamma), bool)
    gapped = np.zeros(len(gamma), bool)
    for block in blocks:
        acting[list(block.contacts)] = block.approaches
        if block.approaches and len(block.contacts) > 1:
            gapped[list(block.contacts)] = opened[list(block.contacts)]
    touching = scene
    if scene.gaps is not None:
        gaps = jnp.where(jnp.asarray(acting), 0.0, scene.gaps).astype(scene.gaps.dtype)
        touching = with_gaps(scene, gaps)
    return Situation(scene, touching, np.asarray(velocity), gamma, blocks, gapped)


def _block(
    members: tuple[int, ...], gamma: np.ndarray, angle: np.ndarray, touch: np.ndarray
) -> Block:
    pairs = [angle[i, j] for i, j in itertools.combinations(members, 2) if touch[i, j]]
    angles = (float(min(pairs)), float(max(pairs))) if pairs else None
    return Block(members, bool((gamma[list(members)] < 0).any()), angles)


def unknowns(
    at: Situation, stiffness: np.ndarray, span: tuple[float, float], absolute: bool
) -> tuple[Unknown, ...]:
    """What is not known of the stiffnesses; `absolute`: not only ratios count."""
    if span[0] == span[1]:
        return ()
    found = []
    for block in at.coupled:
        base = None if absolute else block.contacts[0]
        for j in block.contacts if absolute else block.contacts[1:]:
            nominal = float(stiffness[j] / (1.0 if base is None else stiffness[base]))
            found.append(Unknown(j, base, nominal, nominal * span[0], nominal * span[1]))
    return tuple(found)


def rows(stiffness: np.ndarray, unknown: tuple[Unknown, ...], samples: int, seed: int) -> Rows:
    """Nominal, one at a time, corners of the ranges, and a log-uniform sample of them."""
    count, random = len(unknown), np.random.default_rng(seed)
    if count == 0:
        return Rows(stiffness[None, :], (), np.zeros((0, 0), int), np.zeros((0, 2), int), slice(1))
    low = np.log([u.low / u.nominal for u in unknown])
    high = np.log([u.high / u.nominal for u in unknown])
    part = np.eye(count)[:, None, :]
    alone = (part * (low + np.array(ALONE)[:, None] * (high - low))[None]).reshape(-1, count)
    nudged = (part * np.array([[NUDGE], [-NUDGE]])[None]).reshape(-1, count)
    if 2**count <= CORNERS:
        ends = np.array(list(itertools.product((0.0, 1.0), repeat=count)))
    else:
        ends = random.integers(0, 2, (CORNERS, count)).astype(float)
    drawn = random.uniform(0.0, 1.0, (samples, count))
    spread = low + np.concatenate([ends, drawn]) * (high - low)
    change = np.concatenate([np.zeros((1, count)), alone, nudged, spread])
    tried = np.tile(stiffness, (len(change), 1))
    for i, u in enumerate(unknown):
        tried[:, u.contact] *= np.exp(change[:, i])
    first = 1 + np.arange(len(alone)).reshape(count, -1)
    second = 1 + len(alone) + np.arange(len(nudged)).reshape(count, 2)
    return Rows(tried, unknown, first, second, slice(len(change) - samples, None))


@eqx.filter_jit
def _batch(law: Law, scene: Scene, velocity: jax.Array, stiffness: jax.Array | None) -> Outcomes:
    def one(v: jax.Array, k: jax.Array | None) -> Outcomes:
        out = impact(law if k is None else with_entries(law, ("stiffness",), k), scene, v)
        return Outcomes(out.velocity, out.impulse, out.status)

    return jax.vmap(one)(velocity, stiffness)


def trials(at: Situation, restitution: Any, stiffness: np.ndarray, eta: Any) -> dict[str, Trial]:
    """Laws by name with their scenes; the last one is the reference."""
    e, k = (
        jnp.broadcast_to(jnp.asarray(x, at.gap_velocity.dtype), at.gap_velocity.shape)
        for x in (restitution, stiffness)
    )
    gapped = bool(at.gapped.any())
    found = {
        "newton": Trial(Newton(e), at.touching),
        "moreau": Trial(Moreau(e), at.touching),
        "poisson": Trial(Poisson(e), at.touching),
        "binary": Trial(Binary(e, "earliest" if gapped else "fastest"), at.touching),
        "lzb": Trial(LZB(e, k, eta), at.touching),
    }
    if gapped:
        found["binary"] = found["binary"]._replace(scene=at.scene)
        found["compliant"] = Trial(Compliant(Bistiffness(k, eta, e)), at.scene)
    return {name: found[name] for name in SIMPLEST_FIRST if name in found}


def outcomes(
    trial: Trial, at: Situation, stiffness: np.ndarray, progress: float | None
) -> Outcomes:
    """Outcomes over rows of stiffness (r, m), a chunk at a time; one of a law that knows none."""
    r, chunk = len(stiffness) if trial.knows_stiffness else 1, _chunk(stiffness)
    parts = []
    with counting_bar(r, "impacts", progress) as advance:
        for first in range(0, r, chunk):
            chosen = np.minimum(np.arange(first, first + chunk), r - 1)
            parts.append(jax.device_get(trial.run(at, stiffness[chosen])))
            advance(min(chunk, r - first))
    return jax.tree.map(lambda *x: np.concatenate(x)[:r], *parts)


def _chunk(stiffness: np.ndarray) -> int:
    """Rows computed together: one size where impacts are cheap, so that it compiles once."""
    r, m = stiffness.shape
    return CHUNK if m <= CHEAP else min(r, CHUNK)


def candidate(
    trial: Trial, at: Situation, own: Outcomes, reference: Outcomes, random: slice
) -> Candidate:
    """The record of a law with the outcomes `own` (one row for all, or one each)."""
    error = np.abs(own.velocity[:1] - reference.velocity).max(axis=1) / at.scale
    return Candidate(
        law=trial.law,
        scene=trial.scene,
        velocity=own.velocity[0],
        low=np.nanmin(own.velocity, axis=0),
        high=np.nanmax(own.velocity, axis=0),
        median=float(np.nanmedian(error[random])),
        worst=float(np.nanmax(error)),
        status=STATUS[int(own.status[0])].name,
    )


def costs(laws: dict[str, Trial], at: Situation, stiffness: np.ndarray) -> dict[str, float]:
    """Time of one impact in a batch over the cheapest law's: medians, side by side."""
    few = stiffness[np.arange(_chunk(stiffness)) % len(stiffness)]
    taken = in_turns([partial(trial.run, at, few) for trial in laws.values()], ROUNDS)
    each = [np.median(t) / trial.lanes(len(few)) for t, trial in zip(taken, laws.values())]
    return {name: float(x / min(each)) for name, x in zip(laws, each)}


# -------------------------------------------------------------------------- the evidence


def _loosened(found: Candidate, at: Situation, reference: Outcomes, tolerance: float) -> Candidate:
    """The law with an rtol for this tolerance, tightened until its own error is small beside it."""
    rtol = min(10.0 ** math.floor(math.log10(tolerance / RTOL_PART)), COARSEST_RTOL)
    exact, best = reference.velocity[0], default_rtol("time", at.velocity.dtype)
    while True:
        rtol = max(rtol, best)
        law: Any = replace(found.law, rtol=rtol)  # type: ignore[call-arg]
        own = np.asarray(impact(law, found.scene, at.velocity).velocity)
        error = float(np.abs(own - exact).max()) / at.scale
        if rtol == best or error <= tolerance / RTOL_PART:
            return replace(found, law=law, worst=max(found.worst, error))
        rtol /= 10


def _usable_rows(reference: Outcomes, name: str) -> Outcomes:
    """The reference with NaN where it failed; at the nominal stiffness it must not."""
    failed = np.array([STATUS[int(code)].failure for code in reference.status])
    if failed[0]:
        raise RuntimeError(
            f"The reference law {name} fails on this scene: "
            f"{STATUS[int(reference.status[0])].message}."
        )
    lost = failed[:, None]
    v, p = (np.where(lost, np.nan, x) for x in (reference.velocity, reference.impulse))
    return reference._replace(velocity=v, impulse=p)


def _blocks(
    at: Situation,
    evidence: dict[str, Candidate],
    own: dict[str, Outcomes],
    reference: Outcomes,
    tolerance: float,
) -> tuple[Block, ...]:
    """The blocks, each with the simplest law whose impulses there move v+ within tolerance."""
    of_impulse = jax.vmap(partial(velocity_change, at.scene))
    change = np.asarray(of_impulse(jnp.eye(len(at.gap_velocity), dtype=at.velocity.dtype)))

    def error(name: str, block: Block) -> float:
        here = list(block.contacts)
        wrong = own[name].impulse[:1, here] - reference.impulse[:, here]
        return float(np.nanmax(np.abs(wrong @ change[here]))) / at.scale

    def simplest(block: Block) -> str | None:
        known = (name for name, c in evidence.items() if c.status != "order_dependent")
        return next((name for name in known if error(name, block) <= tolerance), None)

    return tuple(b._replace(law=simplest(b)) if b.approaches else b for b in at.blocks)


def _effects(
    at: Situation, tried: Rows, reference: Outcomes, tolerance: float
) -> tuple[Unknown, ...]:
    """The unknown stiffnesses with what each does by itself."""
    v, found = reference.velocity, []
    for i, unknown in enumerate(tried.unknown):
        alone = float(np.nanmax(np.abs(v[tried.alone[i]] - v[0]))) / at.scale
        up, down = v[tried.nudged[i]]
        slope = float(np.abs(up - down).max()) / (2 * NUDGE) / at.scale
        needed = tolerance / slope if slope > 0 else math.inf
        found.append(unknown._replace(alone=alone, slope=slope, needed=needed))
    return tuple(found)
