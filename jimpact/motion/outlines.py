"""Outlines of the ready systems, for animations."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jimpact.bodies.bodies import Block, Dimer
from jimpact.bodies.pendulums import PendulumCradle
from jimpact.motion.ready_systems import ColumnGaps
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
    body = mechanism(system)
    if isinstance(body, PendulumCradle):
        return lambda q: _cradle(body, q)
    if isinstance(body, Block | Dimer):
        return lambda q: _body(body, q)
    raise TypeError(
        "Argument `outlines` must be given for a system that is none of the ready ones."
    )


def mechanism(system: System) -> Any:
    """What a ready system's gaps are those of."""
    return getattr(system.gap_function, "__self__", None)


def _cradle(cradle: PendulumCradle, q: np.ndarray) -> list[np.ndarray]:
    length, radius = float(cradle.length), np.asarray(cradle.radius)
    between = radius[:-1] + radius[1:] + np.asarray(cradle.gaps)
    curves = []
    for x, r, angle in zip(np.cumsum([0.0, *between]), radius, q):
        pivot = np.array([x, 0.0])
        centre = pivot + length * np.array([np.sin(angle), -np.cos(angle)])
        curves += [np.stack([pivot, centre]), centre + r * _CIRCLE]
    return curves


def _body(body: Block | Dimer, q: np.ndarray) -> list[np.ndarray]:
    c, s = np.cos(q[2]), np.sin(q[2])
    turn = np.array([[c, -s], [s, c]])
    if isinstance(body, Dimer):
        radius, arm = float(body.radius), float(body.arm)
        ends = q[:2] + np.array([[arm, 0.0], [-arm, 0.0]]) @ turn.T
        return [ends, *(end + radius * _CIRCLE for end in ends)]
    w, h = float(body.width) / 2, float(body.height) / 2
    corners = np.array([[w, -h], [-w, -h], [-w, h], [w, h], [w, -h]])
    return [q[:2] + corners @ turn.T]
