"""What the contacts of a scene can do to velocities, and what errors of its pose do.

Impulses p of the contacts change velocities by `M^-1 W p`, W = [N, H, C] of normals,
tangents and constraints.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from jimpact.bodies.base import Body
from jimpact.bodies.rigid import place_of, quaternion_of, turning_of
from jimpact.core.scene import Scene, dense_mass
from jimpact.shots.data import ROUNDING

# A jump of velocities lies in the cone of a scene's impulses up to so many standard
# errors. Ten times more would pass impacts with something else than the contacts.
OUT_OF_CONE = 5.0
# ... or up to this share of the jump, by kinetic energy: bodies and calibrations differ
# from their model. Ten times more is all of it; ten times less drops most measured
# impacts of a square.
SHARE_OUT = 0.2
# Turn [rad] and place [m] by which poses are moved for difference quotients. Ten times
# more would change which contacts are closed; ten times less is lost in single
# precision.
MOVED = 1e-4


@dataclass(frozen=True)
class Pushes:
    """Columns W (n, m) of impulses of closed contacts, their lowest values `low` (m,),
    how many are normals, and the mass matrix (n, n).
    """

    columns: np.ndarray
    low: np.ndarray
    normals: int
    mass: np.ndarray

    @classmethod
    def of(cls, scene: Scene) -> "Pushes":
        """Those of a scene: normals of closed contacts push only, tangents and
        constraints push and pull.
        """
        normals = np.asarray(scene.normals, float)[:, np.asarray(scene.closed)]
        columns = [normals]
        low = [np.zeros(normals.shape[1])]
        for both_ways in (scene.tangents, scene.constraints):
            if both_ways is not None:
                columns.append(np.asarray(both_ways, float))
                low.append(np.full(both_ways.shape[1], -np.inf))
        mass = np.asarray(dense_mass(scene), float)
        return cls(np.hstack(columns), np.concatenate(low), normals.shape[1], mass)

    @property
    def moves(self) -> np.ndarray:
        """Velocities (n, m) that unit impulses add, `M^-1 W`."""
        return np.linalg.solve(self.mass, self.columns)

    @property
    def energy(self) -> np.ndarray:
        """Metric A (n, n) of kinetic energy, `A^T A = M`."""
        return np.linalg.cholesky(self.mass).T

    def approached(self, before: np.ndarray) -> bool:
        """True if velocities (n,) close a contact."""
        normals = self.columns[:, : self.normals]
        speeds = np.abs(normals).T @ np.abs(before)
        return bool((normals.T @ before < -ROUNDING * speeds).any())

    def nearest(self, metric: np.ndarray, jump: np.ndarray) -> tuple[np.ndarray, float]:
        """Impulses (m,) of least `|A (M^-1 W p - jump)|`, A the metric, and this."""
        bounds = (self.low, np.full(len(self.low), np.inf))
        found = lsq_linear(metric @ self.moves, metric @ jump, bounds, "bvls")
        return found.x, float(np.sqrt(2 * found.cost))

    def can_make(
        self, before: np.ndarray, after: np.ndarray, covariance: np.ndarray
    ) -> bool:
        """True if a contact approaches, and contacts that push can have made the jump.

        Within OUT_OF_CONE in units of the errors of the jump, by the covariance (2n,
        2n) of (before, after), or within SHARE_OUT of the jump by energy.
        """
        if not self.approached(before):
            return False
        jump = after - before
        n = len(jump)
        signs = np.hstack([-np.eye(n), np.eye(n)])
        errors = np.linalg.inv(np.linalg.cholesky(signs @ covariance @ signs.T))
        limit = SHARE_OUT * np.linalg.norm(self.energy @ jump)
        _, missed = self.nearest(errors, jump)
        if missed <= OUT_OF_CONE:
            return True
        _, missed = self.nearest(self.energy, jump)
        return bool(missed <= limit)

    def after(
        self, before: np.ndarray, impulses: np.ndarray, restitution: float
    ) -> np.ndarray:
        """Velocities (n,) after impulses in the same ratios, with this restitution.

        Equation: with d = W p and its normal part d_n, `v+ = v- - (1 + e) M^-1 d
        (d_n . v-) / (d_n . M^-1 d)`.
        """
        push = self.columns @ impulses
        normal = self.columns[:, : self.normals] @ impulses[: self.normals]
        moved = np.linalg.solve(self.mass, push)
        size = -(1 + restitution) * (normal @ before) / (normal @ moved)
        return before + size * moved

    def restitution(
        self, before: np.ndarray, after: np.ndarray, impulses: np.ndarray
    ) -> float:
        """`- (d_n . v+) / (d_n . v-)` of impulses, d_n their normal part."""
        normal = self.columns[:, : self.normals] @ impulses[: self.normals]
        return -float(normal @ after) / float(normal @ before)


def slopes_in_pose(
    body: Body, pose: np.ndarray, near: float, before: np.ndarray, after: np.ndarray
) -> np.ndarray:
    """Derivatives F (n, n) of v+ in the coordinates of a pose, at the same v-.

    Of an impact whose impulses keep their ratios and their restitution, those of the
    measured velocities: by difference quotients of `Pushes.after`. A quaternion turns
    about the axes of the body. 0 of a move that changes which contacts are closed.
    """
    n = len(before)
    poses = [
        pose,
        *(moved(pose, step) for step in MOVED * np.vstack([np.eye(n), -np.eye(n)])),
    ]
    here, *others = (Pushes.of(scene) for scene in body.scenes(np.array(poses), near))
    impulses, _ = here.nearest(here.energy, after - before)
    slopes = np.zeros((n, n))
    normal = here.columns[:, : here.normals] @ impulses[: here.normals]
    if not normal @ before < 0:
        return slopes
    e = here.restitution(before, after, impulses)
    for k, (up, down) in enumerate(zip(others[:n], others[n:])):
        if up.columns.shape == down.columns.shape == here.columns.shape:
            rise = up.after(before, impulses, e) - down.after(before, impulses, e)
            slopes[:, k] = rise / (2 * MOVED)
    return slopes


def moved(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A pose after a step (n,): of coordinates, or of places and a turn of the body."""
    if len(pose) == len(step):
        return pose + step
    before = Rotation.from_quat(quaternion_of(pose), scalar_first=True)
    after = before * Rotation.from_rotvec(turning_of(step))
    place = place_of(pose) + place_of(step)
    return np.append(place, after.as_quat(scalar_first=True))
