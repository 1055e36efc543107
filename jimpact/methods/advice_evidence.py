"""The evidence of `advise`: blocks, gaps, unknown stiffnesses; laws on the scene, with errors."""

import itertools
import math
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
from jimpact.progress import counting_bar
from jimpact.scene import Scene, gap_velocity, velocity_change, with_gaps
from jimpact.status import CODE, STATUS
from jimpact.timing import in_turns

# cos(kinetic angle) below so many roundings is 0: the rounding of normals and of M^-1
DECOUPLED_IN_EPS = 64
CORNERS = 64  # rows with every ratio at an end of its range; of more, random ones
ALONE = (0.0, 1 / 3, 2 / 3, 1.0)  # parts of a ratio's range (in its logarithm) tried alone
NUDGE = 0.02  # change of ln k for the sensitivity; its square is far below what is told

CHUNK = 64  # rows computed together
CHEAP = 8  # contacts up to which a chunk is always full
LANES = 2048  # impacts of a batch, over m^2, of the laws that take no time
ROUNDS = 7  # of the timing


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
    """A stiffness known within a range only: of `contact`, over that of `base` (None: SI).

    What it does to v+ by itself, relative to max |v-|: `alone`: largest change over its range;
    `slope`: |d v+ / d ln k|; `needed`: relative accuracy of k at which it moves v+ by the
    tolerance (inf: it does not).
    """

    contact: int
    base: int | None
    nominal: float
    low: float
    high: float
    alone: float = math.nan
    slope: float = math.nan
    needed: float = math.nan

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

    def run(self, at: Situation, stiffness: np.ndarray) -> tuple[jax.Array, ...]:
        """v+, p and status over rows of stiffness, or of the same impact many times."""
        v = jnp.tile(jnp.asarray(at.velocity), (self.lanes(len(stiffness)), 1))
        scene = self.scene
        if scene.gaps is None:  # scenes with and without gaps share one compiled program
            scene = with_gaps(scene, jnp.zeros(scene.contacts, scene.mass.dtype))
        return _batch(
            self.law, scene, v, jnp.asarray(stiffness, v.dtype) if self.knows_stiffness else None
        )


@eqx.filter_jit
def _batch(
    law: Law, scene: Scene, velocity: jax.Array, stiffness: jax.Array | None
) -> tuple[jax.Array, ...]:
    def one(v: jax.Array, k: jax.Array | None) -> tuple[jax.Array, ...]:
        out = impact(law if k is None else with_entries(law, ("stiffness",), k), scene, v)
        return out.velocity, out.impulse, out.status

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
    return found


def outcomes(trial: Trial, at: Situation, stiffness: np.ndarray, progress: bool | None) -> Outcomes:
    """Outcomes over rows of stiffness (r, m), a chunk at a time; one of a law that knows none."""
    r, chunk = len(stiffness) if trial.knows_stiffness else 1, _chunk(stiffness)
    parts = []
    with counting_bar(r, "impacts", progress) as advance:
        for first in range(0, r, chunk):
            chosen = np.minimum(np.arange(first, first + chunk), r - 1)
            parts.append([np.asarray(x) for x in trial.run(at, stiffness[chosen])])
            advance(min(chunk, r - first))
    return Outcomes(*(np.concatenate(x)[:r] for x in zip(*parts)))


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


def block_errors(at: Situation, own: Outcomes, reference: Outcomes) -> list[float]:
    """Worst error of v+ that the impulses of each block cause, relative to max |v-|."""
    m = own.impulse.shape[1]
    change = jax.vmap(partial(velocity_change, at.scene))(jnp.eye(m, dtype=at.velocity.dtype))
    wrong = own.impulse[:1] - reference.impulse

    def error(block: Block) -> float:
        chosen = list(block.contacts)
        return float(np.nanmax(np.abs(wrong[:, chosen] @ np.asarray(change)[chosen]))) / at.scale

    return [error(block) for block in at.blocks]


def costs(laws: dict[str, Trial], at: Situation, stiffness: np.ndarray) -> dict[str, float]:
    """Time of one impact in a batch over the cheapest law's: medians, side by side."""
    few = stiffness[np.arange(_chunk(stiffness)) % len(stiffness)]
    taken = in_turns([partial(trial.run, at, few) for trial in laws.values()], ROUNDS)
    each = [np.median(t) / trial.lanes(len(few)) for t, trial in zip(taken, laws.values())]
    return {name: float(x / min(each)) for name, x in zip(laws, each)}
