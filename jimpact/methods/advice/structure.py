"""What `advise` looks at first: blocks of coupled contacts, gaps that matter, unknown stiffness."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jimpact.contact import components, kinetic_angles
from jimpact.scene import Scene, gap_velocity, with_gaps

# cos(kinetic angle) below so many roundings is 0: the rounding of normals and of M^-1
DECOUPLED_IN_EPS = 64
CORNERS = 64  # rows with every ratio at an end of its range; of more, random ones
ALONE = (0.0, 1 / 3, 2 / 3, 1.0)  # parts of a ratio's range (in its logarithm) tried alone
NUDGE = 0.02  # change of ln k for the sensitivity; its square is far below what is told


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
    """A stiffness that is only known within a range: of `contact`, over that of `of` (None: SI)."""

    contact: int
    of: int | None
    nominal: float
    low: float
    high: float

    @property
    def name(self) -> str:
        """`k2/k1`, contacts counted from 1."""
        return f"k{self.contact + 1}" + ("" if self.of is None else f"/k{self.of + 1}")


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
        of = None if absolute else block.contacts[0]
        for j in block.contacts if absolute else block.contacts[1:]:
            nominal = float(stiffness[j] / (1.0 if of is None else stiffness[of]))
            found.append(Unknown(j, of, nominal, nominal * span[0], nominal * span[1]))
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
