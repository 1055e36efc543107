"""The evidence of `advise`: every law on the scene, against the reference over unknown ratios."""

import time
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.fits.parameters import with_entries
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.laws.binary import Binary
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Bistiffness
from jimpact.laws.kinematic import Moreau, Newton
from jimpact.laws.lzb import LZB
from jimpact.laws.poisson import Poisson
from jimpact.methods.advice.structure import Block, Rows, Situation
from jimpact.montecarlo.bars import sample_bar
from jimpact.scene import Scene, velocity_change, with_gaps
from jimpact.status import CODE, STATUS

CHUNK = 64  # rows computed together
CHEAP = 8  # contacts up to which a chunk is always full
LANES = 2048  # impacts of a batch, over m^2, of the laws that take no time
ROUNDS, ROUNDS_SECONDS = 7, 1.0  # of the timing, and after how long there is no further one


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
