"""What `advise` found, as data."""

from dataclasses import dataclass

import numpy as np

from jimpact.law import Law
from jimpact.methods.advice.evidence import Candidate
from jimpact.methods.advice.structure import Block, Unknown
from jimpact.scene import Scene


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
