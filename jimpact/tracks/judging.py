"""Whether a track is one of ballistic flights: what its residuals and its frames show."""

import numpy as np
from scipy.stats import chi2, norm

from jimpact.tracks.arcs import Arcs

# Chance that a good track has a warning: half by curvatures, half by sizes of residuals. Ten times
# more would warn of one good track in ten.
FALSE_ALARMS = 0.01
# Share of the frames, lost ones aside, that fit no flight, from which on it is said. Good frames
# are left out once in 1000.
UNUSED = 0.03
# Frames in a row that fit no flight at an end of the track, from which on it is said.
AT_AN_END = 2
# Share of the moving frames that repeat the one before to the last digit; noise does it hardly
# ever, but for positions in whole pixels.
DOUBLED = 0.05


def findings_of_input(t: np.ndarray, q: np.ndarray, units: tuple[str, ...]) -> list[str]:
    """What is suspect in the frames, before anything is fitted."""
    found, seen = [], np.isfinite(q).all(axis=1)
    places = q[seen]
    if len(places) > 2:
        same = (np.diff(places, axis=0) == 0).all(axis=1)
        if DOUBLED <= same.mean() < 1:
            found.append(
                f"{int(same.sum())} of {len(places)} frames repeat the one before to the last "
                "digit: a film converted to another rate has frames twice, and its times are wrong."
            )
    for c in np.flatnonzero(np.array(units) == "rad"):
        steps = np.abs(np.diff(places[:, c])) if len(places) > 1 else np.zeros(1)
        # turns of 2 pi are unwrapped; what is left tells how far a frame turns
        turned = np.abs((steps + np.pi) % (2 * np.pi) - np.pi)
        if (steps > 3 * np.pi).any() or np.quantile(turned, 0.9) > np.pi / 2:
            found.append(
                f"Coordinate {c + 1} turns by more than a quarter of a turn from frame to frame: "
                "is it in degrees, or do the frames miss turns?"
            )
    return found


def findings(t: np.ndarray, q: np.ndarray, sigma: np.ndarray, arcs: Arcs) -> list[str]:
    """What is wrong with a fitted track, a sentence each."""
    found = [*_of_curvatures(t, sigma, arcs), *_of_sizes(arcs), *_unused(t, q, arcs)]
    if len(arcs.instants) == 2:
        found.insert(0, "No impact was found: one flight explains all frames within sigma.")
    return found


def _of_curvatures(t: np.ndarray, sigma: np.ndarray, arcs: Arcs) -> list[str]:
    """Flights whose acceleration is not that of the fit."""
    excess, error = np.zeros((2, len(arcs.members), len(sigma)))
    for i, frames in enumerate(arcs.members):
        for c, scale in enumerate(sigma):
            ok = frames[np.isfinite(arcs.residual[frames, c])]
            x = t[ok] - t[ok].mean()
            line = np.linalg.qr(np.vander(x, 2))[0]
            curve = x**2 / 2 - line @ (line.T @ (x**2 / 2))
            size = float(np.linalg.norm(curve))
            error[i, c] = scale / size if size > 0 else np.inf
            excess[i, c] = scale * float(curve @ arcs.residual[ok, c]) / size**2 if size else 0.0
    limit = norm.isf(FALSE_ALARMS / 4 / excess.size)
    far = np.abs(excess) > limit * error
    found = []
    for i, c in zip(*np.nonzero(far)):
        same = far[:, c].sum() > 1 and len(set(np.sign(excess[far[:, c], c]))) == 1
        why = (
            "the acceleration, the scale of lengths or of times, or a rolling shutter"
            if same
            else "drag, a rolling shutter, a moving camera, or an impact that was not found"
        )
        found.append(
            f"Flight {i + 1} is not ballistic: coordinate {c + 1} has an acceleration of "
            f"{excess[i, c]:.3g} ± {error[i, c]:.2g} beyond that of the fit. Perhaps {why}."
        )
    return found


def _of_sizes(arcs: Arcs) -> list[str]:
    """Flights whose residuals are larger than sigma allows."""
    n, flights, found = arcs.places.shape[1], len(arcs.members), []
    # parameters of a flight: places and instants are shared with its neighbours
    taken = (n * (flights + 1) + flights - 1) / flights
    for i, frames in enumerate(arcs.members):
        rest = arcs.residual[frames]
        freedom = max(np.isfinite(rest).sum() - taken, 1.0)
        p_value = chi2.sf(np.nansum(rest**2), freedom)
        if p_value < FALSE_ALARMS / 2 / flights:
            found.append(
                f"Flight {i + 1} is not ballistic within sigma: its residuals are "
                f"{np.sqrt(np.nansum(rest**2) / freedom):.2g} times as large (p-value "
                f"{p_value:.1g}). Perhaps times jitter, frames are there twice, or a false point "
                "was tracked."
            )
    return found


def _unused(t: np.ndarray, q: np.ndarray, arcs: Arcs) -> list[str]:
    """Frames that belong to no flight: at the ends, and in all."""
    seen, used = np.isfinite(q).any(axis=1), np.zeros(len(q), bool)
    used[np.concatenate(arcs.members)] = True
    found, order = [], np.flatnonzero(used)
    for where, frames in (("first", seen[: order[0]]), ("last", seen[order[-1] + 1 :])):
        if frames.sum() >= AT_AN_END:
            found.append(
                f"The {where} {len(frames)} frames are too few for a flight, and fit no other: an "
                "impact there is not found."
            )
    inner = slice(order[0], order[-1] + 1)
    lost = int((seen[inner] & ~used[inner]).sum())
    if lost > UNUSED * seen[inner].sum() + 1:
        found.append(
            f"{lost} of {int(seen[inner].sum())} frames are left out: they fit no flight, or lie "
            "in a contact."
        )
    return found
