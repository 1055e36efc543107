"""Impacts that change the turning of a body alone: its places show none of them.

Of a body whose moments of inertia are equal, angular velocity stays between impacts.
Sums of turns from frame to frame about the axes of the body are lines then. Where it
turns fast their errors add up, frame by frame, to what looks like jumps: what is found
must save its price of rotations that are fitted to the orientations themselves.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from jimpact.tracks.arcs import Arcs, Start, fit_arcs
from jimpact.tracks.division import divided, price
from jimpact.tracks.flight import Flight
from jimpact.tracks.frames import Frames, noise
from jimpact.tracks.quaternions import turns_since_first
from jimpact.tracks.search import Settings, doubts, fitted_arcs, searched
from jimpact.tracks.turning import fit_turning


def with_impacts_of_turning(
    arcs: Arcs, frames: Frames, e: np.ndarray, sigma: np.ndarray | None, shortest: int
) -> tuple[Arcs, np.ndarray]:
    """Arcs of places with impacts of orientations e (T, 4) alone, and which these are.

    Each flight of the places is searched by its turns. Impacts that are not doubtful
    part it. The places tell nothing of their instants, which count as known within a
    flight's least duration: orientations that meet there determine them. Returns the
    arcs, and True (K,) for impacts of the turning.
    """
    parts: list[np.ndarray] = []
    instants = list(arcs.instants_of_impacts)
    errors = [np.nan] * arcs.impacts
    origin: list[int] = []
    for i, some in enumerate(arcs.members):
        found = _parts_of(frames.t[some], e[some], sigma, shortest)
        instants += found
        errors += [shortest * frames.step] * len(found)
        cuts = np.searchsorted(frames.t[some], found)
        new = [part for part in np.split(some, cuts) if len(part)]
        parts += new
        origin += [i] * len(new)
    order = np.argsort(instants)
    alone = np.isfinite(np.array(errors)[order])
    if not alone.any():
        return arcs, alone
    start = Start(
        parts,
        arcs.flight,
        arcs.errors,
        arcs.bent[origin],
        0.0,
        np.array(instants)[order],
        np.array(errors)[order],
    )
    return fit_arcs(frames, start), alone


def _parts_of(
    t: np.ndarray, e: np.ndarray, sigma: np.ndarray | None, shortest: int
) -> list[float]:
    """Instants at which the angular velocity of one flight jumps."""
    if np.isfinite(e[:, 0]).sum() < 2 * shortest:
        return []
    turns = turns_since_first(e)
    if sigma is None:
        given = noise(t, turns)
    else:
        given = sigma
    frames = Frames(t, turns, given, (True,) * 3)
    if not divided(frames, np.zeros(3), shortest).flights:
        return []  # not the turns of such a body
    settings = Settings(sigma is None, 0.0, shortest, None)
    search = searched(frames, Flight.of(np.zeros(3)), settings)
    arcs, _ = fitted_arcs(search)
    instants = list(arcs.instants_of_impacts[~doubts(search, arcs)])
    return _borne_out(t, e, given, instants)


def _borne_out(
    t: np.ndarray, e: np.ndarray, sigma: np.ndarray, instants: list[float]
) -> list[float]:
    """Those of the instants [s] at which orientations e (T, 4) show another rotation.

    Equation: an instant saves `chi^2(both) - chi^2(before) - chi^2(after)` of free
    rotations that fit the frames from the instant before it to the one after it. The
    one that saves least is left out as long as it saves less than the price of a flight
    in three coordinates.
    """
    seen = np.isfinite(e[:, 0])
    times = t[seen]
    turns = Rotation.from_quat(e[seen], scalar_first=True)
    least = price(len(times), 3)

    def chi_square(begin: float, end: float) -> float:
        """chi^2 of the rotation that fits the frames between two times [s]."""
        some = (times >= begin) & (times < end)
        if some.sum() < 2:
            return 0.0
        _, rest = fit_turning(times[some], turns[some], sigma, None)
        return float(np.sum((rest / sigma) ** 2))

    left = list(instants)
    while left:
        ends = [-np.inf, *left, np.inf]
        saved = []
        for begin, middle, end in zip(ends, ends[1:], ends[2:]):
            parted = chi_square(begin, middle) + chi_square(middle, end)
            saved.append(chi_square(begin, end) - parted)
        weakest = int(np.argmin(saved))
        if saved[weakest] >= least:
            break
        left.pop(weakest)
    return left
