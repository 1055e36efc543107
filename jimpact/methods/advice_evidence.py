"""The evidence of `advise`: blocks, gaps, unknown stiffnesses; laws on the scene, with errors."""

import itertools
import time
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.contact import components, kinetic_angles
from jimpact.fits.parameters import with_entries
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.laws.binary import Binary
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Bistiffness
from jimpact.laws.kinematic import Moreau, Newton
from jimpact.laws.lzb import LZB
from jimpact.laws.poisson import Poisson
from jimpact.progress import sample_bar
from jimpact.scene import Scene, gap_velocity, velocity_change, with_gaps
from jimpact.status import CODE, STATUS

# cos(kinetic angle) below so many roundings is 0: the rounding of normals and of M^-1
DECOUPLED_IN_EPS = 64
CORNERS = 64  # rows with every ratio at an end of its range; of more, random ones
ALONE = (0.0, 1 / 3, 2 / 3, 1.0)  # parts of a ratio's range (in its logarithm) tried alone
NUDGE = 0.02  # change of ln k for the sensitivity; its square is far below what is told

CHUNK = 64  # rows computed together
CHEAP = 8  # contacts up to which a chunk is always full
LANES = 2048  # impacts of a batch, over m^2, of the laws that take no time
ROUNDS, ROUNDS_SECONDS = 7, 1.0  # of the timing, and after how long there is no further one


class Block(NamedTuple):
    """Contacts that feel each other, 0-based; the kinetic angles [deg] between coupled ones."""

    contacts: tuple[int, ...]
    approaches: bool
    angles: tuple[float, float] | None
    law: str | None = None  # the simplest one that is within tolerance in this block

    @property
    def name(self) -> str:
        """Contacts counted from 1."""
        return ", ".join(str(j + 1) for j in self.contacts)


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


class Unknown(NamedTuple):
    """A stiffness known within a range only: of `contact`, over that of `base` (None: SI)."""

    contact: int
    base: int | None
    nominal: float
    low: float
    high: float

    @property
    def name(self) -> str:
        """`k2/k1`, contacts counted from 1."""
        return f"k{self.contact + 1}" + ("" if self.base is None else f"/k{self.base + 1}")


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


@dataclass(frozen=True)
class Candidate:
    """A law, the scene to use it on (contacts taken as closed or not), and how it fares.

    `velocity` (n,) at the nominal stiffness; `low`, `high` (n,) over the unknown ratios; `median`
    and `worst` error of v+ against the reference over them, relative to max |v-|; `cost` per
    impact in a batch, in units of the cheapest law's (None: not timed).
    """

    law: Law
    scene: Scene
    velocity: np.ndarray
    low: np.ndarray
    high: np.ndarray
    median: float
    worst: float
    status: str
    cost: float | None = None

    @property
    def usable(self) -> bool:
        """Whether the status allows to use the outcome, whatever order contacts are numbered in."""
        code = CODE[self.status]
        return not STATUS[code].failure and self.status != "order_dependent"


class Outcomes(NamedTuple):
    """v+ (r, n), p (r, m), status (r,) of a batch."""

    velocity: np.ndarray
    impulse: np.ndarray
    status: np.ndarray


def candidates(at: Situation, parameters: dict[str, Any]) -> dict[str, tuple[Law, Scene]]:
    """Laws by name with their scenes; the last one is the reference."""
    shape, dtype = at.gap_velocity.shape, at.gap_velocity.dtype
    e, k = (
        jnp.broadcast_to(jnp.asarray(parameters[key], dtype), shape)
        for key in ("restitution", "stiffness")
    )
    eta = parameters["exponent"]
    gapped = bool(at.gapped.any())
    binary = (Binary(e, "earliest"), at.scene) if gapped else (Binary(e), at.touching)
    found: dict[str, tuple[Law, Scene]] = {
        "newton": (Newton(e), at.touching),
        "moreau": (Moreau(e), at.touching),
        "poisson": (Poisson(e), at.touching),
        "binary": binary,
        "lzb": (LZB(e, k, eta), at.touching),
    }
    if gapped:
        found["compliant"] = Compliant(Bistiffness(k, eta, e)), at.scene
    return found


@eqx.filter_jit
def _batch(
    law: Law, scene: Scene, velocity: jax.Array, stiffness: jax.Array | None
) -> tuple[jax.Array, ...]:
    def one(v: jax.Array, k: jax.Array | None) -> tuple[jax.Array, ...]:
        out = impact(law if k is None else with_entries(law, ("stiffness",), k), scene, v)
        return out.velocity, out.impulse, out.status

    return jax.vmap(one)(velocity, stiffness)


def outcomes(
    law: Law, at: Situation, scene: Scene, stiffness: np.ndarray, progress: bool | None
) -> Outcomes:
    """Outcomes over rows of stiffness (r, m), a chunk at a time."""
    r, chunk = len(stiffness), _chunk(stiffness)
    parts = []
    with sample_bar(r, 0, progress) as advance:
        for first in range(0, r, chunk):
            chosen = np.minimum(np.arange(first, first + chunk), r - 1)
            parts.append([np.asarray(x) for x in _rows(law, at, scene, stiffness[chosen])])
            advance(min(chunk, r - first))
    return Outcomes(*(np.concatenate(x)[:r] for x in zip(*parts)))


def _chunk(stiffness: np.ndarray) -> int:
    """Rows computed together: one size where impacts are cheap, so that it compiles once."""
    r, m = stiffness.shape
    return CHUNK if m <= CHEAP else min(r, CHUNK)


def _rows(law: Law, at: Situation, scene: Scene, stiffness: np.ndarray) -> tuple[jax.Array, ...]:
    v = jnp.tile(jnp.asarray(at.velocity), (len(stiffness), 1))
    return _batch(law, _with_gaps(scene), v, jnp.asarray(stiffness, v.dtype))


def _with_gaps(scene: Scene) -> Scene:
    """The scene with gaps of 0 where it names none: both kinds share one compiled program."""
    if scene.gaps is not None:
        return scene
    none = jnp.zeros(scene.contacts, scene.mass.dtype)
    return with_gaps(scene, none)


def one_outcome(law: Law, at: Situation, scene: Scene) -> Outcomes:
    """The outcome of a law that knows no stiffness."""
    return Outcomes(*(np.asarray(x)[:1] for x in _lanes(law, at, scene)))


def _lanes(law: Law, at: Situation, scene: Scene) -> tuple[jax.Array, ...]:
    """The same impact as many times as hide the cost of a call."""
    v = jnp.tile(jnp.asarray(at.velocity), (max(1, LANES // scene.contacts**2), 1))
    return _batch(law, _with_gaps(scene), v, None)


def candidate(
    law: Law, at: Situation, scene: Scene, own: Outcomes, reference: Outcomes, random: slice
) -> Candidate:
    """The record of a law with the outcomes `own` (one row for all, or one each)."""
    error = np.abs(own.velocity[:1] - reference.velocity).max(axis=1) / at.scale
    return Candidate(
        law=law,
        scene=scene,
        velocity=own.velocity[0],
        low=np.nanmin(own.velocity, axis=0),
        high=np.nanmax(own.velocity, axis=0),
        median=float(np.nanmedian(error[random])),
        worst=float(np.nanmax(error)),
        status=STATUS[int(own.status[0])].name,
    )


def block_errors(at: Situation, own: Outcomes, reference: Outcomes) -> list[float]:
    """Worst error of v+ that the impulses of each block cause, relative to max |v-|."""
    m = own.impulse.shape[1]
    change = jax.vmap(partial(velocity_change, at.scene))(jnp.eye(m, dtype=at.velocity.dtype))
    wrong = own.impulse[:1] - reference.impulse

    def error(block: Block) -> float:
        chosen = list(block.contacts)
        return float(np.nanmax(np.abs(wrong[:, chosen] @ np.asarray(change)[chosen]))) / at.scale

    return [error(block) for block in at.blocks]


def costs(laws: dict[str, tuple[Law, Scene]], at: Situation, tried: Rows) -> dict[str, float]:
    """Time of one impact in a batch over the cheapest law's: median of rounds, side by side."""
    few = tried.stiffness[np.arange(_chunk(tried.stiffness)) % len(tried.stiffness)]

    def run(law: Law, scene: Scene) -> int:
        knows = isinstance(law, LZB | Compliant)
        out = _rows(law, at, scene, few) if knows else _lanes(law, at, scene)
        return len(jax.block_until_ready(out)[0])

    def seconds(name: str) -> float:
        begin = time.perf_counter()
        count = run(*laws[name])
        return (time.perf_counter() - begin) / count

    begin = time.perf_counter()
    rounds: list[list[float]] = []
    while not rounds or (len(rounds) < ROUNDS and time.perf_counter() - begin < ROUNDS_SECONDS):
        times = {name: seconds(name) for name in laws}
        cheapest = min(times.values())
        rounds.append([times[name] / cheapest for name in laws])
    return dict(zip(laws, np.median(rounds, axis=0).tolist()))


@dataclass(frozen=True)
class Effect:
    """What one unknown stiffness does to v+ by itself, relative to max |v-|.

    `alone`: largest change over its range; `slope`: |d v+ / d ln k|; `needed`: relative accuracy
    of k at which it moves v+ by the tolerance (inf: it does not).
    """

    name: str
    alone: float
    slope: float
    needed: float


@dataclass(frozen=True)
class Findings:
    """The simplest law, and how all of them fare.

    `within`: the law keeps the tolerance; `candidates[name]` the evidence, from the simplest law
    to the `reference`; `unknown` and `effects` of the stiffnesses not known.
    """

    name: str
    law: Law
    scene: Scene
    velocity: np.ndarray
    gap_velocity: np.ndarray
    tolerance: float
    within: bool
    reference: str
    candidates: dict[str, Candidate]
    blocks: tuple[Block, ...]
    stiffness: np.ndarray
    unknown: tuple[Unknown, ...]
    effects: tuple[Effect, ...]
    rows: int
    gap_ratio: np.ndarray | None

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        return len(self.gap_velocity)
