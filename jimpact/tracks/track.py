"""A track with its impacts, and the shots that it holds."""

from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from jimpact.bodies.base import Body
from jimpact.core.scene import Scene, dense_mass
from jimpact.fits.covariances import covariance_of
from jimpact.fits.data import ROUNDING, Experiments
from jimpact.tools.checks import check_kind, check_values
from jimpact.tools.records import counted
from jimpact.tracks.arcs import Arcs

# A jump of velocities lies in the cone of a scene's impulses up to so many standard errors. Ten
# times more would pass impacts with something else than the contacts.
OUT_OF_CONE = 5.0
# ... or up to this share of the jump, by kinetic energy: bodies and calibrations differ from their
# model. Ten times more is all of it; ten times less drops most measured impacts of a square.
SHARE_OUT = 0.2


@dataclass(frozen=True)
class TrackImpact:
    """One impact of a track.

    Fields: time and its standard error time_error [s]; coordinates q (n,) at that instant;
    velocities pre and post (n,); covariance (2n, 2n) of (pre, post), with the error of the instant.
    """

    time: float
    time_error: float
    q: np.ndarray
    pre: np.ndarray
    post: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Track:
    """A track: its impacts, flights (frames of each), sigma (n,), covariance, warnings, units.

    `covariance` (2nK, 2nK) is that of (v-, v+) of all impacts in turn: successive ones share a
    flight. `t` (T,) and `q` (T, n) are the frames, `residual` (T, n) in units of sigma, NaN where a
    frame was not used; `units` are those of the velocities; `acceleration` (n,) that of all
    flights.
    """

    impacts: tuple[TrackImpact, ...]
    flights: tuple[np.ndarray, ...]
    sigma: np.ndarray
    covariance: np.ndarray
    warnings: tuple[str, ...]
    units: tuple[str, ...]
    t: np.ndarray
    q: np.ndarray
    arcs: Arcs = field(repr=False)

    @property
    def residual(self) -> np.ndarray:
        """(T, n) in units of sigma; NaN where a frame was not used."""
        return self.arcs.residual

    @property
    def acceleration(self) -> np.ndarray:
        """(n,) of all flights: as given, or as found."""
        return self.arcs.acceleration

    def __str__(self) -> str:
        """The impacts, a line each, and the warnings."""
        count, frames = len(self.impacts), len(self.t)
        noise = ", ".join(f"{s:.3g}" for s in self.sigma)
        lines = [
            f"{counted(count, 'impact')} in {frames} frames, {len(self.flights)} flights",
            f"sigma {noise}",
        ]
        for k, each in enumerate(self.impacts, 1):
            errors = np.sqrt(np.diag(each.covariance))
            values = [
                f"{v:.5g} ± {s:.2g}" for v, s in zip([*each.pre, *each.post], errors, strict=True)
            ]
            n = len(each.pre)
            lines.append(
                f"impact {k} at {each.time:.6g} ± {each.time_error:.2g} s: "
                f"{', '.join(values[:n])} -> {', '.join(values[n:])}"
            )
        if self.warnings:
            lines += ["Warnings", *(f"  - {line}" for line in self.warnings)]
        return "\n".join(lines)

    def plot(self, title: str = "") -> Any:
        """A picture of the track, see `ji.plot.track`."""
        pictures = import_module("jimpact.plot")  # late: matplotlib takes long to import
        return pictures.track(self, title)

    def experiments(self, scene: Scene | Body | None = None, near: float = 2e-3) -> Experiments:
        """The impacts as shots with their covariance, in the scene of each pose.

        With a scene or a body only those stay that its contacts can have made: one approaches, the
        lowest gap of the body is closed at the pose of the impact, and the change of momentum is
        one of contacts that push (with any friction), within 5 standard errors or a fifth of it. A
        chain counts coordinates and velocities towards its right end: of bodies that move the other
        way round, mirror the track (-q, and the bodies in reverse).

        Args:
            scene: of all impacts; a body, which each pose places; None: `fit` is given one, and no
                impact is left out.
            near: a contact is closed up to so far above the lowest one, and the lowest one up to so
                far from 0 [m].

        Raises:
            ValueError: no impact, or none that the contacts can have made; a body in space, whose
                angular velocity is no rate of coordinates; as `Body.scenes`.
        """
        if not self.impacts:
            raise ValueError("No impact was found in the track: there are no shots.")
        kept, scenes = np.arange(len(self.impacts)), None
        if scene is not None:
            check_kind("scene", scene, Scene | Body)  # type: ignore[arg-type]
            check_values("near", np.asarray(near, float), low=0.0)
            if isinstance(scene, Body) and scene.coordinates is not None:
                raise ValueError(
                    "Argument `scene` must not be a body in space: its angular velocity is no rate "
                    "of coordinates. Fit its places alone (`find_impacts` of x, y, z), take the "
                    "turning from orientations yourself, and give `ji.Experiments` the scenes of "
                    "`body.scenes(poses)`."
                )
            at = _scenes(scene, np.array([each.q for each in self.impacts]), near)
            possible = [s is not None and _can_be_of(s, i) for s, i in zip(at, self.impacts)]
            kept = np.flatnonzero(possible)
            if not kept.size:
                raise ValueError(
                    "Argument `scene` must be that of an impact of the track, but of none of "
                    f"{len(self.impacts)} a contact is closed within near = {near:g} m, approaches "
                    "and can have made the jump."
                )
            scenes = [at[k] for k in kept]
        n = self.q.shape[1]
        return Experiments(
            [self.impacts[k].pre for k in kept],
            [self.impacts[k].post for k in kept],
            covariance=covariance_of(self.covariance, kept, n),
            scenes=scenes,  # type: ignore[arg-type]
            shots=[str(k + 1) for k in kept],
            units=self.units,
        )


def _scenes(place: Scene | Body, poses: np.ndarray, near: float) -> list[Scene | None]:
    """The scene of each pose (K, n); None where no gap is closed."""
    if isinstance(place, Scene):
        return [place] * len(poses)
    scenes: list[Scene | None] = list(place.scenes(poses, near))
    for k, pose in enumerate(poses):
        if abs(float(np.min(np.asarray(place.gap_function(pose))))) > near:
            scenes[k] = None
    return scenes


def _can_be_of(scene: Scene, impact: TrackImpact) -> bool:
    """Whether a contact approaches, and impulses of pushing contacts make the jump."""
    normals = np.asarray(scene.normals, float)[:, np.asarray(scene.closed)]
    speeds = np.abs(normals).T @ np.abs(impact.pre)
    if not (normals.T @ impact.pre < -ROUNDING * speeds).any():
        return False
    columns, low = [normals], [np.zeros(normals.shape[1])]
    for other in (scene.tangents, scene.constraints):
        if other is not None:
            columns.append(np.asarray(other, float))
            low.append(np.full(columns[-1].shape[1], -np.inf))
    mass = np.asarray(dense_mass(scene), float)
    moves, n = np.linalg.solve(mass, np.hstack(columns)), len(impact.pre)
    signs = np.hstack([-np.eye(n), np.eye(n)])
    errors = np.linalg.inv(np.linalg.cholesky(signs @ impact.covariance @ signs.T))
    energy, limits = np.linalg.cholesky(mass).T, np.concatenate(low)
    limit = SHARE_OUT * np.linalg.norm(energy @ (impact.post - impact.pre))
    for metric, allowed in ((errors, OUT_OF_CONE), (energy, limit)):
        jump = metric @ (impact.post - impact.pre)
        rest = lsq_linear(metric @ moves, jump, (limits, np.full(len(limits), np.inf)), "bvls")
        if 2 * rest.cost <= allowed**2:
            return True
    return False
