"""Tosses of the measured cube, from poses to shots: `python tests/validation/cube_tosses.py FILE 60`.

FILE is an npz of the poses of ContactNets' tosses (jimpact/data/cube_NOTICE.txt names the source):
arrays toss, time [s], position [m] of the middle of the cube, quaternion (w, x, y, z) of each frame.
The shots of the first tosses, 60 or as many as are named, are compared with `ji.data.cube_impacts`.
"""

import sys
import time

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import jimpact as ji

CENTRE = np.array([0.0, 0.0, 0.0057])  # of mass, from the middle [m]
CUBE = ji.Box(
    [0.102] * 3,
    0.37,
    [9.57e-4, 9.57e-4, 9.09e-4],
    centre=CENTRE.tolist(),
    rounding=0.0036,
)
# Of places [m] and turns [rad]. The noise from frame to frame is a third of it; the rest is what
# makes flights not quite free: frames that are not quite evenly spaced.
ERRORS = [1e-4] * 3 + [1e-3] * 3
GRAVITY = 9.604  # [m/s^2] in the lengths of the file, which are 2 % short
CONTACT = 2e-3  # [s] a contact lasts 1.7 ms
NEAR = 3e-3  # [m] the corners are round by 3.6 mm, the board is flat to 1.4 mm
RATE = 148  # frames a second
APART = 1.5  # frames by which a published impact may be earlier or later


def poses(stored: dict[str, np.ndarray], toss: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses (T, 7) of the centre of mass, quaternions scalar first."""
    own = stored["toss"] == toss
    turns = Rotation.from_quat(np.roll(stored["quaternion"][own], -1, axis=1))
    places = stored["position"][own].astype(float) + turns.apply(CENTRE)
    return stored["time"][own].astype(float), np.hstack(
        [places, np.roll(turns.as_quat(), 1, axis=1)]
    )


def track_of(t: np.ndarray, q: np.ndarray) -> ji.tracks.Track:
    """The impacts of a toss; turns next to one are left out, as the source smoothed them."""
    options = {"acceleration": [0, 0, -GRAVITY], "contact": CONTACT, "shortest": 4}
    clean = q.copy()
    flights = ji.tracks.find_impacts(t, q[:, :3], ERRORS[:3], **options).flights
    for k, frames in enumerate(flights):
        if len(frames) > 4:
            clean[frames[: int(k > 0)], 3:] = np.nan
            clean[frames[len(frames) - int(k < len(flights) - 1) :], 3:] = np.nan
    return ji.tracks.find_impacts(
        t, clean, ERRORS, quaternion="wxyz", inertia=CUBE.inertia, **options
    )


def compared(
    stored: dict[str, np.ndarray], tosses: np.ndarray
) -> tuple[list[int], np.ndarray]:
    """Counts, and differences from published velocities (K, 12) in their errors beside those.

    Counts are impacts, shots, published impacts, those found as impacts and as shots.
    """
    published, counts, apart = ji.data.cube_impacts(nearly_clean=True), [0] * 5, []
    known: dict[int, list[tuple[int, int]]] = {}
    for k, label in enumerate(published.shots):
        toss, frame = map(int, label.split(":"))
        known.setdefault(toss, []).append((frame, k))
    for toss in tosses:
        track = track_of(*poses(stored, toss))
        try:
            shots = set(track.experiments(CUBE, NEAR).shots)
        except ValueError as error:  # of one impact, or none, that is no shot
            print(f"toss {toss}: {error}")
            shots = set()
        counts[0] += len(track.impacts)
        counts[1] += len(shots)
        frames = np.array([each.time for each in track.impacts]) * RATE - 0.5
        for frame, k in known.get(int(toss), []):
            counts[2] += 1
            if not frames.size or abs(frames - frame).min() > APART:
                continue
            i = int(np.argmin(np.abs(frames - frame)))
            counts[3] += 1
            if str(i + 1) in shots:
                counts[4] += 1
                ours = np.concatenate([track.impacts[i].pre, track.impacts[i].post])
                theirs = np.concatenate([published.pre[k], published.post[k]])
                errors = np.concatenate([published.sigma_pre[k], published.sigma[k]])
                apart.append([ours - theirs, (ours - theirs) / errors])
    return counts, np.array(apart)


def main(path: str, count: int) -> None:
    """Print how many published impacts are found, and how far they are apart."""
    jax.config.update("jax_enable_x64", True)
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}
    tosses, begun = np.unique(stored["toss"])[:count], time.perf_counter()
    (impacts, shots, asked, found, kept), apart = compared(stored, tosses)
    took = time.perf_counter() - begun
    print(
        f"{len(tosses)} tosses, {took:.0f} s: {impacts} impacts, {shots} of them shots"
    )
    print(f"of {asked} published impacts {found} are found, {kept} as shots")
    sizes = np.median(np.abs(apart), axis=0)
    print("medians of differences before and after [m/s, rad/s]:", sizes[0].round(4))
    print("in published errors:", sizes[1].round(2))
    print(f"{100 * np.mean(np.abs(apart[:, 1]) < 2):.0f} % lie within two")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 60)
