"""Motions as films in real time: GIF, MP4, or a page that plays them."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import rc_context
from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter
from matplotlib.figure import Figure

from jimpact.bodies.base import Body, projected
from jimpact.motion.dynamics import seen_from_base
from jimpact.motion.pictures import (
    POINT,
    base_path,
    colours_of,
    course_of,
    one_motion,
    plane_of,
    set_limits,
)
from jimpact.motion.record import Motion
from jimpact.motion.system import System
from jimpact.plot.style import GREY
from jimpact.tools.checks import check_values
from jimpact.tools.progress import counting_bar

ENDINGS = (".gif", ".mp4", ".html")
# [s] films of shorter motions are slow; ten times more slows most motions down
_SHORTEST = 2.0
# [1/s] of a film. Ten times more: files ten times as large, which most screens cannot
# show.
_FRAMES_PER_SECOND = 25.0
# a GIF counts in 1/100 s; viewers do not show less than two
_GIF_CLOCK = 100.0
_GIF_LEAST = 2.0
# [s] Frames last a little longer, because whole milliseconds are cut off the rounded
# numbers of a GIF; a thousand times more would slow films down.
_CUT_OFF = 1e-6
_PLACE = (0.15, 0.11, 0.81, 0.77)  # of the axes in a film, for all frames
# [MB] Largest page with its frames. matplotlib's own limit, 20, leaves out the end of a
# long film.
_LARGEST_PAGE = 1000


def animation(
    system: System,
    motion: Motion,
    path: str | Path,
    title: str = "",
    progress: float | None = None,
    *,
    speed: float | None = None,
    frames_per_second: float = _FRAMES_PER_SECOND,
) -> Path:
    """The motion as a film: an animated GIF, an MP4, or a page (.html) that plays it.

    Frames are equally spaced in time, whatever the samples are: between the states of
    the record, those at events included, positions follow cubics with the velocities of
    the record. Bodies in space are shown in parallel projection, their shadows in grey.
    What moves with the base moves in the picture. The page holds all frames and has a
    slider; only the icons of its buttons come from the network.

    Args:
        system: that moved.
        motion: one motion.
        path: the file, ending in .gif, .mp4 (needs ffmpeg) or .html.
        title: of the picture; the time stands below it.
        progress: a bar on stderr; None: on a terminal, where it takes long.
        speed: of the film, not in [m/s]: seconds of the motion that a second of it
            shows; 1: real time, 0.1: slow motion. None: 1, and less for motions of less
            than two seconds.
        frames_per_second: of the film; a GIF has the nearest rate of 100 / k.

    Returns:
        The path of the file that was written.

    Raises:
        ValueError: another ending, a batch, no sample, a speed or rate that is not
            positive;
        TypeError: a body without outlines; RuntimeError: an MP4 without ffmpeg.

    >>> import tempfile, pathlib, jimpact as ji
    >>> ball = ji.System(ji.Column([1.0]), gravity=True)
    >>> motion = ji.simulate(ball, ji.Newton(0.5), [1.0], [0.0], 1.0, samples=21)
    >>> place = pathlib.Path(tempfile.mkdtemp())
    >>> ji.plot.animation(
    ...     ball, motion, place / "ball.gif", speed=0.5, frames_per_second=10
    ... ).name
    'ball.gif'
    """
    one_motion(motion)
    path = Path(path)
    if path.suffix not in ENDINGS:
        raise ValueError(
            f"Argument `path` must end in {' or '.join(ENDINGS)}, but is '{path}'."
        )
    check_values("speed", speed, low=0.0, open_low=True)
    check_values("frames_per_second", frames_per_second, low=0.0, open_low=True)
    if path.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise RuntimeError(
            "Argument `path` ends in .mp4, for which the program ffmpeg must be "
            "installed: install "
            "it, or give a path that ends in .gif or .html."
        )
    if path.suffix == ".gif":
        frames_per_second = _GIF_CLOCK / max(
            round(_GIF_CLOCK / frames_per_second), _GIF_LEAST
        )
    count, frames = _frames(system, motion, title, speed, frames_per_second)
    path.parent.mkdir(parents=True, exist_ok=True)
    with counting_bar(count, "frames", progress) as advance:
        if path.suffix == ".html":
            with rc_context({"animation.embed_limit": _LARGEST_PAGE}):
                page = frames.to_jshtml(fps=round(frames_per_second))
            path.write_text(page, encoding="utf-8")
            advance(count)
        else:  # both writers take fractions
            kind: Any = PillowWriter if path.suffix == ".gif" else FFMpegWriter
            writer = kind(fps=1 / (1 / frames_per_second + _CUT_OFF))
            # a film that is stopped leaves no file, and keeps an earlier one
            with TemporaryDirectory(dir=path.parent) as folder:
                whole = Path(folder) / path.name
                frames.save(
                    whole, writer=writer, progress_callback=lambda i, n: advance(1)
                )
                whole.replace(path)
    return path


def readable_speed(duration: float) -> float:
    """Speed of a film: 1, or the largest of .5, .2, .1, .. at which it lasts 2 s
    (`_SHORTEST`).

    `duration` [s] is that of the motion, `duration / speed` that of the film.

    >>> from jimpact.motion.films import readable_speed
    >>> [readable_speed(x) for x in (8.0, 1.0, 0.03, 0.0)]
    [1.0, 0.5, 0.01, 1.0]
    """
    wanted = duration / _SHORTEST
    if not 0 < wanted < 1:
        return 1.0
    power = float(10.0 ** np.floor(np.log10(wanted) + 1e-9))
    below = wanted * (1 + 1e-9)
    digit = max(x for x in (1.0, 2.0, 5.0) if x * power <= below)
    return float(digit) * power


def _frames(
    system: System, motion: Motion, title: str, speed: float | None, rate: float
) -> tuple[int, FuncAnimation]:
    """Number of frames, and the film of a motion at `speed`, with `rate` frames a
    second; speed None: `readable_speed`.
    """
    course = course_of(motion)
    body = system.body
    finite_q = np.isfinite(course.q).all(axis=1)
    known = finite_q & np.isfinite(course.v).all(axis=1)
    at = course.time[known]
    q = course.q[known]
    v = course.v[known]
    if not len(at):
        raise ValueError(
            "Argument `motion` must have a sample that was reached, but has none."
        )
    if speed is None:
        speed = readable_speed(at[-1] - at[0])
    else:
        speed = float(speed)
    duration = (at[-1] - at[0]) / speed
    count = int(duration * rate + 1e-9) + 1  # rounding loses no last frame
    time = at[0] + np.arange(count) * speed / rate
    rates = jax.vmap(body.rates)
    slopes = np.asarray(rates(jnp.asarray(q), jnp.asarray(v)))  # dq/dt
    q = positions(at, q, slopes, time)
    ground = _base_in_picture(system, time)
    point = POINT * (np.ptp(q) or 1.0)
    if system.base is not None:
        seen = jax.vmap(partial(seen_from_base, system))
        q = np.asarray(seen(jnp.asarray(q), jnp.asarray(time)))
    curves = [
        [curve + moved for curve in (*body.shadows(x), *body.outlines(x, point))]
        for x, moved in zip(q, ground)
    ]
    captions = _captions(title, time, speed, rate)
    shadows = [GREY] * len(body.shadows(q[0]))
    colours = [*shadows, *colours_of(body, q[0], point)]
    return count, _film(body, curves, colours, ground, captions)


def _base_in_picture(system: System, time: np.ndarray) -> np.ndarray:
    """Path (F, 2) [m] of the base in the picture: of a base in space projected, of one
    on a line upwards; 0 without a base.
    """
    if system.base is None:
        return np.zeros((len(time), 2))
    path = base_path(system, time)
    if path.shape[1] == 3:
        return projected(path)
    if path.shape[1] == 1:
        return np.insert(path, 0, 0.0, axis=1)
    return path


def _captions(title: str, time: np.ndarray, speed: float, rate: float) -> list[str]:
    """Title and time of each frame, with the digits in which frames differ; the speed
    where it is not 1.
    """
    digits_that_differ = int(np.ceil(-np.log10(speed / rate)))
    digits = max(2, digits_that_differ)
    slow = ""
    if speed != 1:
        slow = f" (speed {speed:g})"
    return [f"{title}\n{t:.{digits}f} s{slow}".lstrip() for t in time]


def _film(
    body: Body,
    curves: Sequence[Sequence[np.ndarray]],
    colours: list[str],
    ground: np.ndarray,
    captions: list[str],
) -> FuncAnimation:
    """Film of curves in their `colours`, the planes that a body stands on, and
    captions.

    For each frame: outlines `curves[k]` (points, 2) of the body [m], displacement
    `ground[k]` (2,) of the planes, caption.
    """
    figure = Figure(figsize=(4.8, 4.8), dpi=80)
    axes = figure.add_axes(_PLACE)
    axes.set_xlabel("[m]")
    axes.set_ylabel("[m]")
    floors = [plane_of(*floor) for floor in body.floors]
    set_limits(axes, curves, ground, floors)
    lines = [axes.plot([], [], color=colour)[0] for colour in colours]
    planes = [axes.plot([], [], color=GREY, lw=2)[0] for _ in floors]
    view = np.array([axes.get_xlim(), axes.get_ylim()])  # limits of x, of y

    def draw(k: int) -> list[Any]:
        """Set lines, planes and title to frame k; returns what has changed."""
        for line, points in zip(lines, curves[k], strict=True):
            line.set_data(*points.T)
        for line, floor in zip(planes, floors, strict=True):
            line.set_data(*stretch_of(*floor, view, ground[k]))
        axes.set_title(captions[k], loc="left")
        return [*lines, *planes]

    return FuncAnimation(figure, draw, frames=len(captions))


def stretch_of(
    n: np.ndarray, offset: float, view: np.ndarray, ground: np.ndarray
) -> np.ndarray:
    """Ends (2, 2), a column each, of the part of a plane `n^T (x - ground) = offset` in
    view.

    `view` (2, 2) are the limits of x and of y, `ground` (2,) is the displacement of the
    plane. The middle is the foot of the perpendicular from the centre of the view.
    """
    middle = view.mean(axis=1)
    reach = np.ptp(view[0])
    foot = middle - (n @ (middle - ground) - offset) * n
    direction = np.array([n[1], -n[0]])[:, None]
    return foot[:, None] + reach * np.array([-1, 1]) * direction


def positions(
    at: np.ndarray, q: np.ndarray, slopes: np.ndarray, time: np.ndarray
) -> np.ndarray:
    """q (K, n) at `time` (K,), by cubics between states q (S, n), dq/dt (S, n) at `at`
    (S,).

    Equation: Hermite's `q = (1 + 2 s)(1 - s)^2 q_k + s^2 (3 - 2 s) q_(k+1) + s (1 -
    s)^2 h q'_k - s^2 (1 - s) h q'_(k+1)`, `s = (t - t_k) / h`. Times may
    repeat: states before and after an event.

    >>> import numpy as np
    >>> from jimpact.motion.films import positions
    >>> at, q, slopes = (
    ...     np.array([0.0, 1.0]),
    ...     np.array([[0.0], [1.0]]),
    ...     np.array([[0.0], [2.0]]),
    ... )
    >>> positions(at, q, slopes, np.array([0.5]))  # t^2
    array([[0.25]])
    """
    if len(at) == 1:
        return np.repeat(q, len(time), axis=0)
    before = np.searchsorted(at, time, side="right") - 1
    k = np.clip(before, 0, len(at) - 2)
    h = (at[k + 1] - at[k])[:, None]
    after = (time - at[k])[:, None]
    s = after / np.where(h > 0, h, 1.0)
    begin = (1 + 2 * s) * (1 - s) ** 2
    end = s**2 * (3 - 2 * s)
    of_begin = s * (1 - s) ** 2 * h * slopes[k]
    of_end = s**2 * (1 - s) * h * slopes[k + 1]
    turns = of_begin - of_end
    return begin * q[k] + end * q[k + 1] + turns
