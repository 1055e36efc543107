"""Measured shots: velocities before and after impacts, read from CSV files."""

import os
from collections.abc import Callable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import CLOSED_BELOW, Body
from jimpact.core.scene import WALLS, Scene, chain, dense_mass, stackable, with_gaps
from jimpact.shots.covariances import (
    as_covariance,
    covariance_of,
    diagonal_blocks,
    joined_covariance,
)
from jimpact.shots.shots_file import ANGULAR, LINEAR, read_shots
from jimpact.tools.checks import (
    as_float_array,
    check_concrete,
    check_kind,
    check_values,
    in_numbers,
    short_repr,
)
from jimpact.tools.records import counted

# Share of velocities, momenta and readings up to which a difference is rounding, also
# in files of ten digits. Ten times more would take measured shots for corrected ones no
# more often.
ROUNDING = 1e-9
# Share of the sum of |m v-| below which momentum is 0 but for the rounding of that sum,
# far above eps and below what readings resolve.
_NO_MOMENTUM = 1e-12
_VELOCITY = ("velocity", "velocities")
_PRINTED = 4  # shots that `print` shows
_VALUES = ("pre", "post", "sigma", "sigma_pre", "resolution")


class Experiments(eqx.Module):
    """Shots: velocities measured before and after impacts of the same bodies.

    Args:
        pre: v- (K, n), or (n,) for one shot [m/s].
        post: v+ of the same shape [m/s]; NaN marks a value that was not measured.
        sigma: standard error of each `post` value, (K, n) or a scalar, > 0 [m/s]; None:
            unknown, then `fit` estimates one common noise from the residual.
        scenes: one `Scene` for each shot, with the same coordinates, but any number of
            contacts; a law's entry j belongs to contact j of each. None: the argument
            `scene` of `fit`.
        shots: K labels for tables and pictures; None: 1, 2, ...
        lost_freedom: independent values that a correction has removed from each shot, K
            numbers or one for all.
        units: of each velocity, n times 'm/s' or 'rad/s', or one for all; None: m/s.
            Without sigma, velocities of different units weigh as much as others of the
            same kinetic energy.
        sigma_pre: standard error of each `pre` value, (K, n) or a scalar, >= 0 [m/s];
            with it goes a `sigma`, or a `resolution`. `fit` passes it on to v+, see
            `FitProblem`.
        resolution: steps in which `post` was read, (K, n) or a scalar, > 0 [m/s]:
            readings rounded to q have the standard error q / sqrt(12), which is added
            to sigma (in squares).
        covariance: of the errors of (v-, v+), instead of sigma, sigma_pre and
            resolution: one for each shot, (K, 2n, 2n), or of all shots, (2nK, 2nK),
            where they share errors, as successive impacts share a flight. The fields
            `sigma` and `sigma_pre` are then the roots of its diagonal.

    Raises:
        ValueError: no shots, different shapes, NaN in `pre`, infinite values, sigma <=
            0, no value measured, scenes that do not belong to these velocities; a
            covariance beside sigma, of another shape, not finite, not symmetric or not
            positive definite for each shot.

    >>> import jimpact as ji
    >>> data = ji.Experiments(pre=[1.0, 0.0], post=[0.26, 0.73], sigma=0.01)
    >>> data.pre.shape
    (1, 2)
    """

    pre: jax.Array
    post: jax.Array
    sigma: jax.Array | None
    scenes: tuple[Scene, ...] | None
    shots: tuple[str, ...] = eqx.field(static=True)
    lost: tuple[int, ...] = eqx.field(static=True)  # of each shot, by a correction
    units: tuple[str, ...] = eqx.field(static=True)
    sigma_pre: jax.Array | None
    resolution: jax.Array | None
    covariance: np.ndarray | None

    def __init__(
        self,
        pre: Any,
        post: Any,
        sigma: Any = None,
        scenes: Sequence[Scene] | None = None,
        shots: Sequence[str] | None = None,
        lost_freedom: int | Sequence[int] = 0,
        units: Sequence[str] | None = None,
        sigma_pre: Any = None,
        resolution: Any = None,
        covariance: Any = None,
    ):
        """Check and convert the arguments; resolution and covariance determine
        sigma.
        """
        self.pre = _as_rows("pre", pre)
        self.post = _as_rows("post", post)
        if self.pre.shape != self.post.shape:
            raise ValueError(
                "Arguments `pre` and `post` must have the same shape, "
                f"but have shapes {self.pre.shape} and {self.post.shape}."
            )
        check_values("pre", self.pre)
        check_values("post", self.post, nan_allowed=True)
        measured = ~np.isnan(np.asarray(self.post))
        if not measured.any():
            raise ValueError(
                "Argument `post` must hold a measured value, but all are missing."
            )
        self.covariance = None
        if covariance is not None:
            others = {"sigma": sigma, "sigma_pre": sigma_pre, "resolution": resolution}
            _check_alone("covariance", others)
            self.covariance = as_covariance(covariance, measured.shape)
            blocks = diagonal_blocks(self.covariance, 2 * measured.shape[1])
            variances = blocks.diagonal(axis1=1, axis2=2)
            deviations = np.sqrt(variances)
            sigma_pre, sigma = np.split(deviations, 2, axis=1)
        self.sigma = _as_sigma("sigma", sigma, measured)
        self.resolution = _as_sigma("resolution", resolution, measured)
        self.sigma_pre = _as_sigma("sigma_pre", sigma_pre, measured | True, zero=True)
        if self.resolution is not None:
            rounding = self.resolution / np.sqrt(12)
            if self.sigma is None:
                self.sigma = rounding
            else:
                self.sigma = jnp.hypot(self.sigma, rounding)
        if self.sigma_pre is not None and self.sigma is None:
            raise ValueError(
                "Argument `sigma` must be given where `sigma_pre` is, but is None: the "
                "errors before and after the impact weigh against each other."
            )
        if scenes is None:
            self.scenes = None
        else:
            self.scenes = _as_scenes(scenes, self.pre.shape)
        self.shots = _as_labels(shots, len(measured))
        of_shots = np.broadcast_to(lost_freedom, len(measured))
        self.lost = tuple(of_shots.tolist())
        self.units = _as_units(units, measured.shape[1])

    def __str__(self) -> str:
        """Number of shots, units, missing values, the range of sigma, and the first
        shots.
        """
        count, n = self.pre.shape
        missing = int((~self.measured).sum())
        sigma = self.sigma
        units = ", ".join(dict.fromkeys(self.units))
        lines = [f"{counted(count, 'shot')} of {counted(n, *_VELOCITY)} [{units}]"]
        if missing:
            if missing == 1:
                was = "was"
            else:
                was = "were"
            lines.append(
                f"{missing} of {self.post.size} velocities after {was} not measured"
            )
        if sigma is None:
            known = "not known"
        else:
            known = f"{np.nanmin(sigma):.3g} to {np.nanmax(sigma):.3g}"
        lines.append(f"sigma    {known}")
        for label, before, after in zip(self.shots[:_PRINTED], self.pre, self.post):
            lines.append(f"shot {label}: {in_numbers(before)} -> {in_numbers(after)}")
        if count > _PRINTED:
            lines.append(f"... and {count - _PRINTED} more")
        return "\n".join(lines)

    @staticmethod
    def _instead_of(value: Any) -> str:
        """Advice for a value that is no data, ending the message of `check_kind`."""
        if isinstance(value, str | Path):
            return " `ji.read_experiments(path)` reads a file."
        return " `ji.Experiments(pre, post)` makes them of velocities."

    @property
    def lost_freedom(self) -> int:
        """Independent values that a correction has removed, of all shots."""
        return sum(self.lost)

    @property
    def measured(self) -> np.ndarray:
        """Boolean (K, n): which `post` values were measured."""
        return ~np.isnan(np.asarray(self.post))

    def scene_of(self, scene: Scene | None, shot: int) -> Scene:
        """The scene of one shot (counted from 0): its own, or else the given common
        one.
        """
        return self.each(scene, lambda each: each)[shot]

    def largest_scene(self, scene: Scene | None) -> Scene:
        """The first of the scenes (or the given common scene) with the most
        contacts.
        """
        scenes = self.each(scene, lambda each: each)
        return max(scenes, key=lambda each: each.contacts)

    def momentum_excess(self, scene: Scene | None = None) -> np.ndarray:
        """Momentum that the contacts cannot have changed, but the data did: (K, c) [N
        s].

        Equation: `C^T M (v+ - v-)`, columns of C spanning the complement of range(N),
        each scaled to a largest entry of 1. A chain without walls has c = 1, C = (1,
        ..., 1): its total momentum. NaN for shots with missing values. `scene`: where
        shots carry none.

        >>> import jimpact as ji
        >>> data = ji.Experiments(pre=[1.0, 0.0], post=[0.2, 0.9])
        >>> round(float(data.momentum_excess(ji.chain([1.0, 1.0]))[0, 0]), 6)
        0.1
        """
        balances = self.balances(scene)
        return _filled([m @ (post - pre) for m, pre, post in balances])

    def momentum_ratio(self, scene: Scene | None = None) -> np.ndarray:
        """`C^T M v+ / C^T M v-` (K, c) in a scene, see `momentum_excess`; inf or NaN
        where C^T M v- is 0 but for rounding.
        """
        rows = []
        with np.errstate(divide="ignore", invalid="ignore"):
            for m, pre, post in self.balances(scene):
                before = m @ pre
                rounding = _NO_MOMENTUM * np.abs(m) @ np.abs(pre)
                some = np.abs(before) > rounding
                rows.append((m @ post) / np.where(some, before, 0.0))
        return _filled(rows)

    def energy_ratio(self, scene: Scene | None = None) -> np.ndarray:
        """`T+ / T-` of every shot (K,) in a scene; NaN for shots with missing
        values.
        """
        masses = np.array(self.each(scene, dense_mass))
        both = (self.pre, self.post)
        velocities = map(np.asarray, both)
        before, after = (np.einsum("ki,kij,kj->k", v, masses, v) for v in velocities)
        return after / np.where(before > 0, before, np.nan)

    def momentum_corrected(self, scene: Scene | None = None) -> "Experiments":
        """The same shots, moved as little as possible so that they conserve momentum.

        Equation: minimize `sum ((v+' - v+) / sigma)^2` subject to
        `C^T M (v+' - v-) = 0` (sigma = 1 where unknown; with a `covariance` by that of
        v+). For equal masses in a chain: the mean excess is taken from each component.
        Shots with missing values stay as they are. v- stay as they were measured; where
        they have a `sigma_pre`, `fit` passes it on through the correction. `scene`:
        where shots carry none.

        >>> import jimpact as ji
        >>> data = ji.Experiments(pre=[1.0, 0.0], post=[0.2, 0.9])
        >>> corrected = data.momentum_corrected(ji.chain([1.0, 1.0]))
        >>> [round(float(v), 6) for v in corrected.post[0]]
        [0.15, 0.85]
        """
        corrected = np.array(self.post, dtype=float)
        lost = list(self.lost)
        after = _after(self)
        balances = self.balances(scene)
        for k, (m, pre, post) in enumerate(balances):
            if len(m) == 0 or np.isnan(post).any():
                continue
            excess = m @ (post - pre)
            corrected[k] -= _smallest_change(after[k], m) @ excess
            lost[k] += len(m)
        return self._with(post=corrected, lost_freedom=lost)

    def _with(self, **changed: Any) -> "Experiments":
        """A copy with some arguments changed, by name; all are checked anew."""
        fields = self._of_each_shot() | {"units": self.units} | changed
        if fields["covariance"] is not None:  # the errors follow from it
            fields |= {"sigma": None, "sigma_pre": None}
        resolution = fields.pop("resolution")
        copy = Experiments(**fields)
        if resolution is None:
            return copy
        # set afterwards: sigma has the error of rounding already
        steps = np.asarray(resolution)
        return eqx.tree_at(
            lambda x: x.resolution, copy, steps, is_leaf=lambda x: x is None
        )

    def _of_each_shot(self) -> dict[str, Any]:
        """Arguments with one entry for each shot, by name; None where the shots have
        none.
        """
        values = {name: getattr(self, name) for name in _VALUES}
        fields: dict[str, Any] = {
            name: None if x is None else np.asarray(x) for name, x in values.items()
        }
        shots = {"scenes": self.scenes, "shots": self.shots, "lost_freedom": self.lost}
        return fields | shots | {"covariance": self.covariance}

    def with_contacts(self, contacts: int | Sequence[int]) -> "Experiments":
        """The shots whose scenes have one of these numbers of contacts."""
        chosen = np.isin(self.contacts, contacts)
        if not chosen.any():
            known = sorted(set(self.contacts))
            numbers = ", ".join(map(str, known))
            raise ValueError(
                f"`contacts` in [data] must be one of {numbers}, but is {contacts}."
            )
        return self.only(chosen)

    def only(self, which: Any) -> "Experiments":
        """The shots at `which`: indices (from 0), or a boolean for each shot.

        >>> import jimpact as ji
        >>> data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.3, 0.7], [0.6, 1.4]])
        >>> data.only([1]).shots
        ('2',)
        """
        rows = np.arange(len(self.shots))[which]
        fields = self._of_each_shot()
        covariance = fields.pop("covariance")
        chosen: dict[str, Any] = {
            k: None if x is None else [x[i] for i in rows] for k, x in fields.items()
        }
        if covariance is not None:
            chosen["covariance"] = covariance_of(covariance, rows, self.pre.shape[1])
        return self._with(**chosen)

    def __add__(self, other: "Experiments") -> "Experiments":
        """These shots and others, see `join`."""
        return Experiments.join([self, other])

    @staticmethod
    def join(many: Sequence["Experiments"]) -> "Experiments":
        """All shots of several data sets in one; `a + b` joins two.

        Args:
            many: sets of the same bodies. All or none of them have a `sigma`, and
                scenes of their own. v- without a `sigma_pre` count as exact where
                others have one. Labels that several sets have get the number of their
                set: 2/1 is shot 1 of the second.

        Raises:
            ValueError: no sets; other numbers of bodies, units, sigma or scenes in
                some.

        >>> import jimpact as ji
        >>> first, second = (
        ...     ji.Experiments([v, 0.0], [0.1 * v, 0.9 * v]) for v in (1.0, 2.0)
        ... )
        >>> (first + second).shots, (first + second).pre.tolist()
        (('1/1', '2/1'), [[1.0, 0.0], [2.0, 0.0]])
        """
        many = list(many)
        if not many:
            raise ValueError(
                "Argument `many` must hold at least one data set, but is empty."
            )
        units = [data.units for data in many]
        without_errors = [data.sigma is None for data in many]
        without_scenes = [data.scenes is None for data in many]
        for name, same in (
            ("as many bodies and the same units", units),
            ("a `sigma` (or `resolution`) in all or in none", without_errors),
            ("scenes of their own in all or in none", without_scenes),
        ):
            if len(set(same)) > 1:
                raise ValueError(f"Argument `many` must have {name}.")
        columns = [data._of_each_shot() for data in many]
        covariances = [each.pop("covariance") for each in columns]
        if any(each["sigma_pre"] is not None for each in columns):
            for each in columns:
                if each["sigma_pre"] is None:
                    each["sigma_pre"] = np.zeros_like(each["pre"])
        joined: dict[str, Any] = {}
        if any(covariance is not None for covariance in covariances):
            joined["covariance"] = joined_covariance([data.joint for data in many])
        for name in columns[0]:
            parts = [each[name] for each in columns]
            all_have_it = all(part is not None for part in parts)
            if all_have_it:
                joined[name] = [row for part in parts for row in part]
            else:
                joined[name] = None
        if len(set(joined["shots"])) < len(joined["shots"]):
            sets = enumerate(many, 1)
            joined["shots"] = [
                f"{i}/{label}" for i, data in sets for label in data.shots
            ]
        return many[0]._with(**joined)

    @property
    def joint(self) -> np.ndarray | None:
        """Covariance of (v-, v+): (K, 2n, 2n), or (2nK, 2nK) of all shots; None: not
        known.

        By `covariance`, or else by `sigma` and `sigma_pre` (0 where it is None) as
        independent errors. Of a value that was not measured the variance of `sigma` is
        1.
        """
        if self.covariance is not None or self.sigma is None:
            return self.covariance
        sigma = np.asarray(self.sigma, float)
        after = np.where(self.measured, sigma, 1.0)
        if self.sigma_pre is None:
            before = np.zeros_like(after)
        else:
            before = np.asarray(self.sigma_pre)
        errors = np.hstack([before, after])
        variances = errors[:, :, None] ** 2
        return variances * np.eye(errors.shape[1])

    @property
    def contacts(self) -> np.ndarray:
        """Number of contacts of every shot (K,) whose scenes are its own."""
        return np.array(self.each(None, lambda scene: scene.contacts))

    def approach_speed(self, scene: Scene | None = None) -> np.ndarray:
        """Largest approach speed `max(0, -N^T v-)` (K,) of closed contacts of the scene
        [m/s].

        >>> import jimpact as ji
        >>> data = ji.Experiments(pre=[1.0, 0.25], post=[0.2, 0.9])
        >>> float(data.approach_speed(ji.chain([1.0, 1.0]))[0])
        0.75
        """
        normals = self.each(scene, closed_normals)
        velocities = np.asarray(self.pre, float)
        rates = [n.T @ v for n, v in zip(normals, velocities)]
        approaches = (-gamma.min(initial=0.0) for gamma in rates)
        return np.array([max(approach, 0.0) for approach in approaches])

    def natural_errors(self, scene: Scene | None = None) -> np.ndarray:
        """Errors (n,) of equal weight in a scene: 1 m/s, and the rad/s of as much
        energy; 1 for all where units are alike.

        Equation: `sqrt(mean M_ii of the velocities in m/s / mean M_ii of those in
        rad/s)`, means over shots and coordinates; `scene` None: the scenes of the
        shots.
        """
        turns = np.array(self.units) == ANGULAR
        if turns.all() or not turns.any():
            return np.ones(len(turns))
        diagonals = [np.diag(mass) for mass in self.each(scene, dense_mass)]
        masses = np.mean(diagonals, axis=0)
        # [rad/s] of as much energy as 1 m/s
        turning = np.sqrt(masses[~turns].mean() / masses[turns].mean())
        return np.where(turns, turning, 1.0)

    def balances(
        self, scene: Scene | None
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """`C^T M` (c, n) of `momentum_excess`, v- (n,) and v+ (n,) of each shot in its
        scene.
        """
        pre = np.asarray(self.pre, float)
        post = np.asarray(self.post, float)
        rows = self.each(scene, conserved_momenta)
        return list(zip(rows, pre, post))

    def each(self, scene: Scene | None, function: Callable[[Scene], Any]) -> list[Any]:
        """K values `function(scene)` of the scenes of the shots; once for a scene they
        share.
        """
        if self.scenes is not None:
            different = {id(each): each for each in self.scenes}
            values = {key: function(each) for key, each in different.items()}
            return [values[id(each)] for each in self.scenes]
        if scene is None:
            raise ValueError(
                "Argument `scene` must be a Scene where the experiments carry none, "
                "but is None."
            )
        if scene.size != self.pre.shape[1]:
            raise ValueError(
                f"Argument `experiments` must have one velocity per body of the scene: "
                f"it has {self.pre.shape[1]} a shot, but the scene has {scene.size}."
            )
        return [function(scene)] * len(self.shots)


def _after(data: Experiments) -> np.ndarray:
    """Covariance (K, n, n) of v+ of each shot; the identity where no error is known."""
    count, n = data.pre.shape
    joint = data.joint
    if joint is None:
        return np.tile(np.eye(n), (count, 1, 1))
    return diagonal_blocks(joint, 2 * n)[:, n:, n:]


def _smallest_change(after: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """`S m^T (m S m^T)^-1` (n, c), S = `after` (n, n), m = `rows` = C^T M (c, n).

    Its columns are the changes of v+, least in the norm of S^-1, by one unit of each
    momentum.
    """
    weighted = after @ rows.T
    return np.asarray(weighted @ np.linalg.inv(rows @ weighted))


def kept_by_corrections(data: Experiments, scene: Scene | None) -> np.ndarray:
    """Projectors (K, n, n) of the momentum corrections of shots; identities where there
    was none.

    Equation: `I - S m^T (m S m^T)^-1 m` with m = C^T M and S the covariance of v+.
    """
    identity = np.eye(data.pre.shape[1])
    kept = np.tile(identity, (len(data.shots), 1, 1))
    after = _after(data)
    balances = data.balances(scene)
    for k, (m, pre, post) in enumerate(balances):
        speeds = np.abs(pre) + np.abs(post)
        rounding = ROUNDING * np.abs(m) @ speeds
        conserved = (np.abs(m @ (post - pre)) <= rounding).all()
        if 0 < len(m) <= data.lost[k] and conserved:
            kept[k] -= _smallest_change(after[k], m) @ m
    return kept


def _filled(rows: list[np.ndarray]) -> np.ndarray:
    """Rows of different lengths as an array (K, c), with NaN behind shorter ones."""
    columns = list(zip_longest(*rows, fillvalue=np.nan))
    filled = np.array(columns, float)
    return filled.reshape(-1, len(rows)).T


def conserved_momenta(scene: Scene) -> np.ndarray:
    """`C^T M` (c, n): C spans the orthogonal complement of all normals, tangents,
    constraints.

    Each column of C is scaled to a largest entry of 1.
    """
    all_others = (scene.tangents, scene.constraints)
    others = [x for x in all_others if x is not None]
    directions = (scene.normals, *others)
    forces = np.hstack([np.asarray(x, float) for x in directions])
    u, singular, _ = np.linalg.svd(forces)
    rounding = singular[0] * max(forces.shape) * np.finfo(float).eps
    rank = int((singular > rounding).sum())
    complement = u[:, rank:]
    size = np.abs(complement).round(12)
    largest = np.argmax(size, axis=0)  # the first of equal ones
    column = np.arange(complement.shape[1])
    scaled = complement / complement[largest, column]
    return scaled.T @ dense_mass(scene)


def closed_normals(scene: Scene) -> np.ndarray:
    """Normals (n, c) of the closed contacts."""
    normals = np.asarray(scene.normals, float)
    return normals[:, np.asarray(scene.closed)]


def possible_normals(scene: Scene) -> np.ndarray:
    """Normals (n, c) of the contacts that are closed, or have a gap that may close."""
    possible = scene.closed if scene.gaps is None else np.isfinite(scene.gaps)
    normals = np.asarray(scene.normals, float)
    return normals[:, np.asarray(possible)]


def _check_alone(given: str, others: dict[str, Any]) -> None:
    """Raise a ValueError for other arguments beside one that holds all errors."""
    for name, beside in others.items():
        if beside is not None:
            raise ValueError(
                f"Argument `{name}` must be left out where `{given}` is given, which "
                f"holds all errors, but both are given."
            )


def _as_rows(name: str, value: Any) -> jax.Array:
    """Velocities as an array (K, n), of one shot (1, n)."""
    array = as_float_array(name, value)
    check_concrete(name, array)
    if array.ndim == 1:
        array = array[None, :]
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"Argument `{name}` must have shape (K, n), K >= 1 shots of n velocities, "
            f"but has shape {tuple(array.shape)}."
        )
    return array


def _as_labels(shots: Sequence[str] | None, count: int) -> tuple[str, ...]:
    """Labels of so many shots: those given, as text; None: 1, 2, ...

    ValueError: another number of them.
    """
    if shots is None:
        return tuple(map(str, range(1, count + 1)))
    labels = tuple(map(str, shots))
    if len(labels) != count:
        raise ValueError(
            f"Argument `shots` must have {count} labels, one per shot, "
            f"but has {len(labels)}."
        )
    return labels


def _as_units(units: Sequence[str] | None, n: int) -> tuple[str, ...]:
    """Units of n velocities, m/s or rad/s: those given, or one for all; None: m/s.

    ValueError: other units, or another number of them.
    """
    if units is None:
        units = LINEAR
    if isinstance(units, str):
        each: tuple[str, ...] = (units,) * n
    else:
        each = tuple(units)
    if len(each) != n or not set(each) <= {LINEAR, ANGULAR}:
        raise ValueError(
            f"Argument `units` must have {n} entries, each '{LINEAR}' or "
            f"'{ANGULAR}', but has value {units!r}: convert velocities to these (1 "
            f"cm/s = 0.01 m/s)."
        )
    return each


def _as_sigma(
    name: str, value: Any, measured: np.ndarray, zero: bool = False
) -> jax.Array | None:
    """Standard errors as (K, n), NaN where no value was measured; `zero`: 0 is
    allowed.
    """
    if value is None:
        return None
    sigma = as_float_array(name, value)
    check_concrete(name, sigma)
    if sigma.shape == measured.shape[1:] and len(measured) == 1:
        sigma = sigma[None, :]
    if sigma.shape not in ((), measured.shape):
        advice = ""
        if sigma.shape == measured.shape[1:]:
            repeated = f"numpy.tile({name}, ({len(measured)}, 1))"
            advice = f" One for each coordinate: {repeated}."
        raise ValueError(
            f"Argument `{name}` must be a scalar or have shape {measured.shape} like "
            f"`post`, but has shape {tuple(sigma.shape)}.{advice}"
        )
    # the error of a value that was not measured does not matter
    known = np.where(measured, np.asarray(sigma), 1.0)
    check_values(name, known, low=0.0, open_low=not zero)
    return jnp.where(measured, sigma, jnp.nan)


def _as_scenes(scenes: Sequence[Scene], shape: tuple[int, ...]) -> tuple[Scene, ...]:
    """The scenes, one for each shot, checked."""
    check_kind("scenes", scenes, Sequence)
    scenes = tuple(scenes)
    if len(scenes) != shape[0]:
        raise ValueError(
            f"Argument `scenes` must have one scene per shot, {shape[0]}, but has "
            f"{len(scenes)}."
        )
    for k, scene in enumerate(scenes):
        if scene.size != shape[1]:
            raise ValueError(
                f"Argument `scenes` must have {shape[1]} bodies as the velocities "
                f"have, but the scene of shot {k + 1} has {scene.size}."
            )
    stackable(scenes)  # raises where they cannot be fitted together
    return scenes


def read_experiments(
    path: str | Path, scene: Scene | Body | None = None, near: float = CLOSED_BELOW
) -> Experiments:
    """Read shots from a CSV file whose headers state the units.

    Columns: `pre_1[m/s]`, `post_1[m/s]` and so on for every body, optional
    `sigma_1[m/s]`, ... (standard errors of `post`), `sigma_pre_1[m/s]` (of `pre`),
    `resolution_1[m/s]` (steps of the readings, see `Experiments`) and `shot` (a label);
    `comment` and `comment_...` are not read.
    Units: m/s, cm/s, mm/s, km/h, in/s, ft/s, converted to m/s; rad/s, deg/s, converted
    to rad/s. An empty `post` cell is a value that was not measured; so is NaN, with a
    warning. Scenes that differ from shot to shot: `mass_1[kg]` (kg, g) of every body
    and `gap_1[m]` (m, cm, mm, um) of every contact of a chain; `q_1[m]`, `q_2[rad]`,
    ... (lengths, rad, deg, 1) are the configuration of a body.

    Args:
        path: of the file.
        scene: what such columns complete: a chain, whose masses or gaps they take the
            place of, or a `Body`, which they place. The shots then have scenes of their
            own.
        near: of a body's contacts, those up to so far above the lowest one are closed,
            the others are left out (see `Body.scenes`) [m].

    Returns:
        `Experiments` of K shots, all in m/s and rad/s.

    Raises:
        FileNotFoundError: no such file.
        ValueError: unknown or missing unit, missing, unknown or repeated column, text
            in a number, a line of the wrong length, no shots, sigma <= 0; with file,
            line and column.

    >>> import jimpact as ji
    >>> from importlib.resources import files
    >>> balls = ji.read_experiments(files("jimpact") / "data" / "three_balls.csv")
    >>> [round(float(v), 4) for v in balls.post[0]]
    [-0.0605, 0.1049, 0.9978]
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(
            f"Argument `path` must be the path of a CSV file, but is "
            f"{short_repr(path)}. Of arrays "
            "or a table in memory make `Experiments(pre=table[[...]], "
            "post=table[[...]])`."
        )
    values, units, shots = read_shots(path)
    named: dict[str, Any] = {name: values.get(name) for name in _VALUES}
    scenes = _scenes_of(path, values, scene, near)
    return Experiments(**named, scenes=scenes, shots=shots, units=units)


def _scenes_of(
    path: str | Path,
    values: dict[str, np.ndarray],
    place: Scene | Body | None,
    near: float,
) -> list[Scene] | None:
    """Scenes of the shots by the columns q, mass, gap of a file; None without such
    columns.

    `place` is the `Body` that q places, or the chain whose masses or gaps are replaced.
    """
    columns = [kind for kind in ("q", "mass", "gap") if kind in values]
    if not columns:
        return None
    if "q" in values:
        if columns != ["q"] or not isinstance(place, Body):
            if columns != ["q"]:
                given = "with masses or gaps"
            else:
                given = f"for {type(place).__name__}"
            raise ValueError(
                f"{path}: columns `q` must belong to a body, but are given {given}."
            )
        return place.scenes(values["q"], near)
    if not isinstance(place, Scene) or ("mass" in values and place.walls is None):
        raise ValueError(
            f"{path}: columns `{columns[0]}` must belong to a chain that is given as "
            f"`scene`, but that is {type(place).__name__}."
        )
    count = len(values["pre"])
    gaps = values.get("gap", [place.gaps] * count)
    if "mass" not in values:
        return [with_gaps(place, as_float_array("gaps", gap)) for gap in gaps]
    with_walls = (name for name, sides in WALLS.items() if sides == place.walls)
    wall: Any = next(with_walls)
    masses_and_gaps = zip(values["mass"], gaps)
    return [chain(mass, wall, gap) for mass, gap in masses_and_gaps]
