"""Outlines of the ready systems, for animations."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jimpact.motion.ready_systems import ColumnGaps, CradleGaps, Tips
from jimpact.motion.system import System

# q (n,) -> curves (k, 2) of points (x, y) in metres
Outlines = Callable[[np.ndarray], Sequence[np.ndarray]]

_AROUND = np.linspace(0, 2 * np.pi, 49)
_CIRCLE = np.stack([np.cos(_AROUND), np.sin(_AROUND)], axis=1)
_POINT = 0.02  # radius in which a point mass is drawn, of the heights that it reaches


def outlines_of(system: System, q: np.ndarray) -> Outlines:
    """Curves that show a ready system; `q` (S, n) is the motion, for the scale of points.

    Raises:
        TypeError: a system that is not one of the ready ones: give `outlines` yourself.
    """
    gaps: Any = system.gap_function
    if isinstance(gaps, ColumnGaps):
        point = _POINT * (np.nanmax(q) - np.nanmin(q) or 1.0)
        radii = np.maximum(np.asarray(gaps.radii), 0)
        shown = np.where(radii > 0, radii, point)
        lift = np.where(radii > 0, 0.0, point)
        return lambda q: [r * _CIRCLE + (0, y + d) for r, y, d in zip(shown, q, lift, strict=True)]
    if isinstance(gaps, CradleGaps):
        return lambda q: _cradle(gaps, q)
    if isinstance(gaps, Tips):
        return lambda q: _body(gaps, q)
    raise TypeError(
        "Argument `outlines` must be given for a system that is none of the ready ones."
    )


def _cradle(gaps: CradleGaps, q: np.ndarray) -> list[np.ndarray]:
    length, spacing, diameter = (float(x) for x in (gaps.length, gaps.spacing, gaps.diameter))
    curves = []
    for j, angle in enumerate(q):
        pivot = np.array([j * spacing, 0.0])
        centre = pivot + length * np.array([np.sin(angle), -np.cos(angle)])
        curves += [np.stack([pivot, centre]), centre + diameter / 2 * _CIRCLE]
    return curves


def _body(gaps: Tips, q: np.ndarray) -> list[np.ndarray]:
    c, s = np.cos(q[2]), np.sin(q[2])
    turn = np.array([[c, -s], [s, c]])
    along, across = np.asarray(gaps.along), np.asarray(gaps.across)
    tips = np.stack([along, across], axis=1)
    radius = float(gaps.radius)
    if radius > 0:
        ends = q[:2] + tips @ turn.T
        return [ends, *(end + radius * _CIRCLE for end in ends)]
    corners = np.concatenate([tips, -tips, tips[:1]])
    return [q[:2] + corners @ turn.T]
