"""A track with its impacts, and the shots that it holds."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from jimpact.bodies.base import Body
from jimpact.bodies.rigid import place_of, quaternion_of
from jimpact.core.scene import Scene, dense_mass
from jimpact.shots.covariances import covariance_of
from jimpact.shots.data import Experiments
from jimpact.tools.checks import check_kind, check_values
from jimpact.tools.records import counted
from jimpact.tracks.arcs import Arcs
from jimpact.tracks.frames import Frames, neighbours
from jimpact.tracks.held import held_flights
from jimpact.tracks.pushes import Pushes, slopes_in_pose
from jimpact.tracks.quaternions import (
    in_the_other_order,
    turns_since_first,
)

# Share of the trace by which moments of inertia may differ from those of the body of a
# scene. Ten times more is a tenth: flights would turn otherwise by degrees.
INERTIA_WITHIN = 0.01


@dataclass(frozen=True)
class TrackImpact:
    """One impact of a track.

    Fields: time and its standard error time_error [s]; coordinates q (n,) at that
    instant; velocities pre and post (n,); covariance (2n, 2n) of (pre, post), with the
    error of the instant;
    doubtful: a flight of another acceleration explains its frames about as well.
    """

    time: float
    time_error: float
    q: np.ndarray
    pre: np.ndarray
    post: np.ndarray
    covariance: np.ndarray
    doubtful: bool = False

    def can_be_of(self, scene: Scene) -> bool:
        """True if the contacts of a scene can have made it, see `Pushes.can_make`."""
        return Pushes.of(scene).can_make(self.pre, self.post, self.covariance)

    def not_in(self, order: str) -> "TrackImpact":
        """Impact as if the quaternions of the file stood in the other order than
        `order`.

        omega becomes A omega, with A of `in_the_other_order`; its covariance follows.
        """
        other, A = in_the_other_order(quaternion_of(self.q), order)
        one = np.eye(3)  # of places, before and after
        gain = block_diag(one, A, one, A)
        pre, post = np.split(gain @ np.concatenate([self.pre, self.post]), 2)
        q = np.append(place_of(self.q), other)
        covariance = gain @ self.covariance @ gain.T
        return replace(self, q=q, pre=pre, post=post, covariance=covariance)


@dataclass(frozen=True)
class Track:
    """A track: its impacts, flights (frames of each), sigma (n,), covariance, warnings,
    units.

    `covariance` (2nK, 2nK) is that of (v-, v+) of all impacts in turn: successive ones
    share a flight. `t` (T,) and `q` (T, n) are the frames, `residual` (T, n) in units
    of sigma, NaN where a frame was not used; `units` are those of the velocities;
    `acceleration` (n,) that of all flights. Of poses q is (T, 7), the quaternion's
    scalar first, whatever the `order` of the file; residuals and sigma are those of
    places and of turns about the axes of the body, and `inertia` is as given, None as
    of a sphere. `candidates` say how many impacts there is no evidence for, and why;
    `name` is the label of its shots. `covariance_with_poses` (3nK, 3nK) is that of (v-,
    v+, pose) of all impacts, turns of a pose about the axes of the body.
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
    order: str | None = None
    inertia: np.ndarray | None = None
    candidates: tuple[str, ...] = ()
    name: str = ""
    covariance_with_poses: np.ndarray = field(
        default_factory=lambda: np.zeros((0, 0)), repr=False
    )

    @property
    def residual(self) -> np.ndarray:
        """Residuals (T, n) in units of sigma; NaN where a frame was not used."""
        return self.arcs.residual

    @property
    def coordinates(self) -> np.ndarray:
        """Coordinates q (T, n); of poses places, and turns about axes of the body since
        frame 1.
        """
        if self.order is None:
            return self.q
        turns = turns_since_first(quaternion_of(self.q))
        return np.hstack([place_of(self.q), turns])

    @property
    def acceleration(self) -> np.ndarray:
        """Acceleration (n,) of all flights: as given, or as found."""
        return self.arcs.acceleration

    @property
    def drag(self) -> float:
        """Drag k of all flights [1/m]: as given, or as found."""
        return self.arcs.drag

    def __str__(self) -> str:
        """The impacts, a line each, and the warnings."""
        count = len(self.impacts)
        frames = len(self.t)
        noise = ", ".join(f"{s:.3g}" for s in self.sigma)
        lines = [
            (
                f"{counted(count, 'impact')} in {frames} frames, {len(self.flights)} "
                f"flights"
            ),
            f"sigma {noise}",
        ]
        if self.arcs.flight.drag_unknown:
            lines.append(f"drag {self.drag:.4g} ± {self.arcs.drag_error:.2g} 1/m")
        for k, each in enumerate(self.impacts, 1):
            errors = np.sqrt(np.diag(each.covariance))
            values = [
                f"{v:.5g} ± {s:.2g}"
                for v, s in zip([*each.pre, *each.post], errors, strict=True)
            ]
            n = len(each.pre)
            if each.doubtful:
                doubt = " (doubtful)"
            else:
                doubt = ""
            lines.append(
                f"impact {k} at {each.time:.6g} ± {each.time_error:.2g} s{doubt}: "
                f"{', '.join(values[:n])} -> {', '.join(values[n:])}"
            )
        lines += self.candidates
        if self.warnings:
            lines += ["Warnings", *(f"  - {line}" for line in self.warnings)]
        return "\n".join(lines)

    def plot(self, title: str = "") -> Any:
        """A picture of the track, see `ji.plot.track`."""
        # late: matplotlib takes long to import
        pictures = import_module("jimpact.plot")
        return pictures.track(self, title)

    def experiments(
        self,
        scene: Scene | Body | None = None,
        near: float = 2e-3,
        label: str | None = None,
        doubtful: bool = False,
    ) -> Experiments:
        """The impacts as shots with their covariance, in the scene of each pose.

        Impacts that are doubtful are left out, unless `doubtful`.

        With a scene or a body only those stay that its contacts can have made: one
        approaches, the lowest gap of the body is closed at the pose of the impact, and
        the change of momentum is one of contacts that push (with any friction), within
        5 standard errors or a fifth of it; and in both flights the body is free, not
        nearer to no acceleration than to a known one. A chain counts coordinates and
        velocities towards its right end: of bodies that move the other way round,
        mirror the track (-q, and the bodies in reverse).

        Errors of a body's pose turn the lever arms of its contacts. The covariance of
        v+ has what they do to velocities after an impact with impulses in the measured
        ratios and with the measured restitution, at the same v-.

        Args:
            scene: of all impacts; a body, which each pose places; None: `fit` is given
                one, and no impact is left out.
            near: a contact is closed up to so far above the lowest one, and the lowest
                one up to so far from 0 [m].
            label: of the track, before the number of each impact, 'run 3:1'; None: the
                name of the track, which `read` and studies give it.
            doubtful: take those impacts, too, that a flight of another acceleration
                explains.

        Raises:
            ValueError: no impact, or only doubtful ones, or none that the contacts can
            have made; a body in space without
                poses (`quaternion`), or of another inertia than `find_impacts` was
                given, or whose contacts can have made more of the impacts in the other
                order of quaternions; as `Body.scenes`.
        """
        if not self.impacts:
            raise ValueError("No impact was found in the track: there are no shots.")
        certain = np.array([doubtful or not each.doubtful for each in self.impacts])
        kept = np.flatnonzero(certain)
        scenes = None
        covariance = self.covariance
        if not kept.size:
            raise ValueError(
                f"All of {counted(len(self.impacts), 'impact')} of the track are "
                f"doubtful, see `warnings`: there are no shots, but with doubtful=True."
            )
        if scene is not None:
            check_kind("scene", scene, Scene | Body)  # type: ignore[arg-type]
            check_values("near", np.asarray(near, float), low=0.0)
            if isinstance(scene, Body) and scene.coordinates is not None:
                body = scene
            else:
                body = None
            if body is not None:  # in space
                self._check_inertia(body, near)
            at = _scenes_of(scene, self.impacts, near)
            if body is not None:
                self._check_order(body, near, at)
            free = self._between_free_flights()
            possible = np.array([s is not None for s in at])
            kept = np.flatnonzero(certain & possible & free)
            if not kept.size:
                raise ValueError(
                    f"Argument `scene` must be that of an impact of the track, but of "
                    f"none of {len(self.impacts)} a contact is closed within near = "
                    f"{near:g} m, approaches and can have made the jump, between "
                    f"flights in which the body is free."
                )
            scenes = [at[k] for k in kept]
            if isinstance(scene, Body):
                covariance = self._with_errors_of_poses(scene, near, kept)
        n = len(self.units)
        if label is None:
            name = self.name
        else:
            name = label
        if name:
            before = f"{name}:"
        else:
            before = ""
        return Experiments(
            [self.impacts[k].pre for k in kept],
            [self.impacts[k].post for k in kept],
            covariance=covariance_of(covariance, kept, n),
            scenes=scenes,  # type: ignore[arg-type]
            shots=[f"{before}{k + 1}" for k in kept],
            units=self.units,
        )

    def _with_errors_of_poses(
        self, body: Body, near: float, kept: np.ndarray
    ) -> np.ndarray:
        """Covariance (2nK, 2nK) of (v-, v+ - F q) of K impacts in n coordinates, q the
        error of the pose.

        F is that of `slopes_in_pose` of impacts that are `kept` (their indices), 0 of
        others; contacts with gaps up to `near` [m] take part.
        """
        n = len(self.units)
        count = len(self.impacts)
        # of (v-, v+, q) of each impact
        gain = np.zeros((count, 2 * n, count, 3 * n))
        for k in range(count):
            gain[k, :, k, : 2 * n] = np.eye(2 * n)
        for k in kept:
            impact = self.impacts[k]
            slopes = slopes_in_pose(body, impact.q, near, impact.pre, impact.post)
            gain[k, n:, k, 2 * n :] = -slopes
        flat = gain.reshape(2 * n * count, 3 * n * count)
        return flat @ self.covariance_with_poses @ flat.T

    def _between_free_flights(self) -> np.ndarray:
        """True (K,) for impacts before and after which the body is free, not held."""
        n = len(self.acceleration)
        frames = Frames(self.t - self.t.mean(), self.q[:, :n], self.sigma[:n])
        known = self.arcs.flight.known_acceleration
        held = held_flights(frames, known, self.flights)
        before, after = neighbours(held)
        return ~(before | after)

    def _check_inertia(self, body: Body, near: float) -> None:
        """Raise unless the track has poses, and turns with the inertia of this body."""
        if self.order is None:
            raise ValueError(
                "Argument `scene` must not be a body in space, whose angular velocity "
                "is no rate of coordinates: give `find_impacts` poses, places and "
                "quaternions (`quaternion`)."
            )
        first = body.scenes([self.impacts[0].q], near)[0]
        turns = slice(3, None)  # rows of angular velocities
        own = dense_mass(first)[turns, turns]
        if self.inertia is None:
            given = np.eye(3)
            words = "None, as of a sphere"
        else:
            given = self.inertia
            words = str(given.tolist())
        apart = own / np.trace(own) - given / np.trace(given)
        if np.abs(apart).max() > INERTIA_WITHIN:
            raise ValueError(
                "Argument `scene` must have the `inertia` of `find_impacts`, but has "
                f"the moments of inertia {own.tolist()}, and `inertia` was {words}: "
                "give it inertia=body.inertia."
            )

    def _check_order(
        self, body: Body, near: float, scenes: Sequence[Scene | None]
    ) -> None:
        """Raise where the other order of quaternions explains more impacts than these
        scenes do.
        """
        if all(scenes) or self.order is None:
            return
        turned = [each.not_in(self.order) for each in self.impacts]
        here, other = (
            sum(map(bool, x)) for x in (scenes, _scenes_of(body, turned, near))
        )
        # a few close a gap by chance, as a cube looks the same from many sides
        if other > 2 * here + 1 or other > here == 0:
            raise ValueError(
                f"Argument `quaternion` of `find_impacts` must name the order of the "
                f"file, but in the order {self.order!r} {here} of "
                f"{counted(len(turned), 'impact')} can be of this body, in the other "
                f"one {other}."
            )


def _scenes_of(
    place: Scene | Body, impacts: Sequence[TrackImpact], near: float
) -> list[Scene | None]:
    """Scene of each impact; None where no gap is within `near` [m], or by `can_be_of`.

    `place`: a scene of all impacts, or a body, which each pose places.
    """
    if isinstance(place, Scene):
        scenes: list[Scene | None] = [place] * len(impacts)
    else:
        poses = np.array([each.q for each in impacts])
        scenes = list(place.scenes(poses, near))
        for k, pose in enumerate(poses):
            if abs(float(np.min(np.asarray(place.gap_function(pose))))) > near:
                scenes[k] = None
    for k, (at, impact) in enumerate(zip(scenes, impacts)):
        if at is not None and not impact.can_be_of(at):
            scenes[k] = None
    return scenes
