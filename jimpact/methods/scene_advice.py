"""The simplest scene that suffices for an impact: contacts and friction that may be
left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import delassus_matrix
from jimpact.core.law import Law, check_law
from jimpact.core.scene import Scene, as_velocity, gap_velocity, with_gaps
from jimpact.methods.advice import blocks_of
from jimpact.methods.advice_report import ContactBlock, share
from jimpact.methods.points import EnergyNorm, Outcomes, in_batches, varied_impacts
from jimpact.numerics.tridiagonal import diagonal
from jimpact.tools.checks import as_whole, check_kind, check_shape, check_values
from jimpact.tools.records import Column, Table, Tabular, fields_as_data, listed

# Impacts computed together, and the entries of their Delassus matrices. Ten times more
# take ten times the memory, a gigabyte, and are not faster.
LANES = 64
ENTRIES = 2**24
PRINTED = 12  # contacts in the printed table; ten times more fill three pages


@dataclass(frozen=True)
class SceneAdvice(Tabular):
    """The result of `simplest_scene`, for `ji.impact(result.law, result.scene, v)`.

    Errors are changes of v+ in the energy norm over that of v-. NaN: the law fails
    without this contact, or `runs` did not suffice.

    Attributes:
        law: the law, without friction where that suffices.
        scene: the scene in which contacts are left out (they have an infinite gap),
            with one tangent for each contact, or none, where that suffices.
        kept: contacts (from 0) that are not left out.
        error: of v+ with this law and scene.
        tolerance: as passed.
        friction: the error of each way to treat friction: 'none', 'one direction'.
        names: of the contacts (m,).
        impulses: p (m,) [N s] with all contacts.
        errors: of leaving out each contact by itself (m,).
        changes: the largest change of a velocity by that (m,) [m/s, rad/s].
        blocks: groups of coupled contacts with their kinetic angles.
    """

    law: Law
    scene: Scene
    kept: tuple[int, ...]
    error: float
    tolerance: float
    friction: dict[str, float]
    names: tuple[str, ...]
    impulses: np.ndarray
    errors: np.ndarray
    changes: np.ndarray
    blocks: tuple[ContactBlock, ...]

    def reason(self, contact: int) -> str:
        """Phrase: the reason why this contact (from 0) is kept or left out: its effect
        is small or none, it is open, nothing approaches in its block, or it has no
        impulse.
        """
        if contact in self.kept:
            return "kept"
        if self.errors[contact] > 0:
            return "left out: small"
        around = (b for b in self.blocks if contact in b.contacts)
        block = next(around, None)
        if block is None:
            return "left out: open"
        if not block.approaches:
            return "left out: nothing approaches"
        if self.impulses[contact]:
            return "left out: no effect"
        return "left out: no impulse"

    def to_dict(self) -> dict[str, Any]:
        """Numbers of all contacts, as a JSON file can hold them; contacts counted from
        1.
        """
        kept = {"kept": [j + 1 for j in self.kept]}
        return fields_as_data(self, "law", "scene", "blocks", "kept") | kept

    @property
    def table(self) -> Table:
        """Table: kept contacts and friction, then a row for each contact, largest error
        first.
        """
        m = len(self.names)
        head = [
            f"{len(self.kept)} of {m} contacts suffice within {share(self.tolerance)}; "
            f"the error of v+ is {share(self.error)}"
        ]
        head += [
            f"friction, {name}: "
            + (f"error {share(x)}" if np.isfinite(x) else "the law fails")
            for name, x in self.friction.items()
        ]
        for block in self.blocks[:PRINTED]:
            ends = block.angles
            if ends:
                angles = f"; kinetic angles {ends[0]:.0f} to {ends[1]:.0f} degrees"
            else:
                angles = ""
            some = listed([str(j + 1) for j in block.contacts])
            if block.approaches:
                state = "impact"
            else:
                state = "nothing approaches"
            head.append(f"group of contacts {some}: {state}{angles}")
        known_first = -np.nan_to_num(self.errors, nan=np.inf)
        order = np.argsort(known_first, kind="stable")
        columns = (
            Column("contact"),
            Column("impulse", ".3g", unit="N s"),
            Column(
                "error",
                lambda x: share(x) if np.isfinite(x) else "not known",
                "error without",
            ),
            Column("change", ".2g", "change of v+"),
            Column("advice"),
        )
        values = self.impulses, self.errors, self.changes
        rows = [
            [
                f"{j + 1} {self.names[j]}".strip(),
                *(x[j] for x in values),
                self.reason(int(j)),
            ]
            for j in order
        ]
        return Table(columns, rows, [*head, ""])

    def __str__(self) -> str:
        """The first `PRINTED` rows of the table: half a page."""
        table = self.table
        more = len(self.names) - PRINTED
        if more > 0:
            notes = [f"and {more} more"]
        else:
            notes = []
        printed = replace(table, rows=table.rows[:PRINTED], notes=notes)
        return str(printed)


def simplest_scene(
    law: Law,
    scene: Scene,
    velocity: Any,
    tolerance: float = 1e-2,
    *,
    names: Any = None,
    watched: Any = None,
    runs: int = 256,
) -> SceneAdvice:
    """Find the contacts, and the friction, that v+ needs within `tolerance`.

    Equation: error `sqrt(dv^T M dv) / sqrt(v-^T M v-)`, dv the change of v+ by what is
    left out. A contact without impulse can be left out exactly: nothing approaches in
    its group of coupled contacts, or no load reaches it. Each of the others is left out
    by itself, then together with those of smaller errors, where `tolerance` allows it.
    Before that, friction is left out, or given one direction at each contact, that of
    its impulse (planar), where that suffices.

    Args:
        law: as for `impact`.
        scene: n coordinates, m contacts, for example of `from_mujoco`.
        velocity: v- (n,) [m/s, rad/s].
        tolerance: of the error, in (0, 1).
        names: of the contacts (m,), for the table, as `from_mujoco` gives them.
        watched: indices of the coordinates whose velocities count; None: all. A contact
            that a wave reaches too late to change them has the error 0.
        runs: largest number of contacts left out one by one, those of the largest
            `p_j sqrt(W_jj)`, and of impacts with several left out.

    Returns:
        `SceneAdvice`: law, scene, errors; `print` gives a table.

    Raises:
        ValueError: shapes or ranges.
        RuntimeError: the law fails on the whole scene.

    >>> import jimpact as ji
    >>> advice = ji.simplest_scene(
    ...     ji.Moreau(1.0), ji.chain([1.0, 1.0, 1e-6]), [1.0, 0.0, 0.0]
    ... )
    >>> advice.kept, round(float(advice.errors[1]), 4)
    ((0,), 0.001)
    """
    check_kind("law", law, Law)
    check_kind("scene", scene, Scene)
    v = as_velocity(scene, velocity, finite=True)
    check_law(law, scene, v.dtype)
    check_shape("tolerance", tolerance, (), "one number")
    check_values("tolerance", tolerance, low=0.0, high=1.0, open_low=True)
    as_whole("runs", runs, 1)
    if names is None:
        labels = ("",) * scene.contacts
    else:
        labels = tuple(map(str, names))
    one_each = np.empty(len(labels))
    check_shape("names", one_each, (scene.contacts,), "one per contact")
    norm = EnergyNorm.of(scene, np.asarray(v), watched)
    trial = _ReducedImpact(law, scene, v, norm)
    reference = trial.run([()])
    reference.check_first("The law fails on the whole scene")
    friction, trial = _simplest_friction(trial, reference, tolerance)
    working, errors, changes = _effect_of_each_contact(trial, runs)
    kept, error = _sufficient_contacts(
        trial, reference, working, errors, tolerance, runs
    )
    taking_part = scene.closed
    if law.uses_gaps and scene.gaps is not None:
        taking_part = jnp.isfinite(scene.gaps)
    has_friction = getattr(trial.law, "friction", None) is not None
    gamma = np.asarray(gap_velocity(scene, v))
    return SceneAdvice(
        law=trial.law,
        scene=trial.without(np.setdiff1d(np.arange(scene.contacts), kept)),
        kept=tuple(kept.tolist()),
        error=error,
        tolerance=float(tolerance),
        friction=friction,
        names=labels,
        impulses=reference.impulse[0],
        errors=errors,
        changes=changes,
        blocks=blocks_of(
            trial.scene, gamma, np.flatnonzero(np.asarray(taking_part)), has_friction
        ),
    )


class _ReducedImpact(NamedTuple):
    """A law on a scene of which contacts are left out, at v- (n,), with the norm of
    errors.
    """

    law: Law
    scene: Scene
    velocity: jax.Array
    norm: EnergyNorm

    def without(self, left_out: Any) -> Scene:
        """The scene with an infinite gap at the contacts of these indices."""
        gaps = self.gaps([left_out])[0]
        if len(left_out):
            return with_gaps(self.scene, jnp.asarray(gaps))
        return self.scene

    def gaps(self, left_out: Sequence[Any]) -> np.ndarray:
        """Gaps (r, m) [m], infinite in row i at the contacts `left_out[i]`
        (indices).
        """
        scene = self.scene
        if scene.gaps is None:
            own = np.zeros(scene.contacts)
        else:
            own = np.asarray(scene.gaps)
        in_precision = own.astype(scene.mass.dtype)
        gaps = np.tile(in_precision, (len(left_out), 1))
        for row, index in zip(gaps, left_out):
            row[list(index)] = np.inf
        return gaps

    def run(self, left_out: Sequence[Any]) -> Outcomes:
        """Outcomes (r,) of the impact without each set of contacts in `left_out`, in
        batches.
        """
        m = self.scene.contacts
        by_memory = ENTRIES // m**2
        lanes = max(1, min(LANES, m + 1, by_memory))
        run = partial(varied_impacts, self.law, self.scene, self.velocity)
        return in_batches(run, {"gaps": self.gaps(left_out)}, lanes)

    def changes(self, left_out: Sequence[Any], reference: Outcomes) -> np.ndarray:
        """Changes (r, n) of v+ from that of the whole scene; NaN where the law
        fails.
        """
        return self.run(left_out).where_usable().velocity - reference.velocity[0]


def _simplest_friction(
    trial: _ReducedImpact, reference: Outcomes, tolerance: float
) -> tuple[dict[str, float], _ReducedImpact]:
    """Errors of v+ by way to treat friction, and the simplest way that is within
    tolerance.

    Ways are 'none', and 'one direction' of the tangents at each contact in space.
    """
    law = trial.law
    scene = trial.scene
    if getattr(law, "friction", None) is None or scene.tangents is None:
        return {}, trial
    fields = [
        name for name in ("friction", "tangential_stiffness") if hasattr(law, name)
    ]
    simpler: Any = replace(law, **dict.fromkeys(fields))
    frictionless = _with_tangents(scene, None)
    ways = {"none": trial._replace(law=simpler, scene=frictionless)}
    if scene.tangents.shape[1] == 2 * scene.contacts:
        along = _with_tangents(scene, _tangents_along_impulses(scene, reference))
        ways["one direction"] = trial._replace(scene=along)
    errors = {}
    chosen = None
    for name, way in ways.items():
        change = way.changes([()], reference)
        errors[name] = float(trial.norm(change)[0])
        if chosen is None and errors[name] <= tolerance:
            chosen = way
    return errors, chosen or trial


def _with_tangents(scene: Scene, tangents: jax.Array | None) -> Scene:
    """The scene with tangents (n, t) in place of its own."""
    return eqx.tree_at(lambda tree: tree.tangents, scene, tangents)


def _tangents_along_impulses(scene: Scene, reference: Outcomes) -> jax.Array:
    """One tangent (n, m) for each contact in space, along its tangential impulse.

    Equation: `T_j d_j`, T_j (n, 2) the tangents of contact j, `d_j = p_t,j / |p_t,j|`
    (2,), the first tangent where p_t,j = 0.
    """
    m = scene.contacts
    impulse = reference.tangential[0].reshape(m, 2)
    size = np.linalg.norm(impulse, axis=1, keepdims=True)
    moves = size > 0
    unit = impulse / np.where(moves, size, 1.0)
    direction = np.where(moves, unit, [[1.0, 0.0]])
    tangents = np.asarray(scene.tangents).reshape(-1, m, 2)
    along = np.sum(tangents * direction[None], axis=2)
    return jnp.asarray(along.astype(tangents.dtype))


def _effect_of_each_contact(
    trial: _ReducedImpact, runs: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Effect of leaving out each contact by itself.

    Returns the indices of contacts with an impulse, and for all m contacts the error of
    v+ in the energy norm over that of v- and the largest change of a velocity [m/s,
    rad/s]. Both are 0 for a contact without impulse, and NaN beyond the first `runs`
    contacts with the largest `p_j sqrt(W_jj)`.
    """
    reference = trial.run([()])
    norm = trial.norm
    p = np.abs(reference.impulse[0])
    working = np.flatnonzero(p)
    w = np.asarray(diagonal(delassus_matrix(trial.scene)))
    weight = p * np.sqrt(w)
    order = np.argsort(-weight[working], kind="stable")
    largest = working[order][:runs]
    errors = np.zeros(len(p))
    changes = np.zeros(len(p))
    errors[working] = np.nan
    changes[working] = np.nan
    if len(largest):
        change = trial.changes([(j,) for j in largest], reference)
        errors[largest] = norm(change)
        watched = np.abs(change[:, norm.watched])
        changes[largest] = watched.max(axis=1)
    return working, errors, changes


def _sufficient_contacts(
    trial: _ReducedImpact,
    reference: Outcomes,
    working: np.ndarray,
    errors: np.ndarray,
    tolerance: float,
    runs: int,
) -> tuple[np.ndarray, float]:
    """Indices of contacts that suffice for v+ within `tolerance`, and the error of v+.

    Greedy: the contacts `working` with an impulse are sorted by their `errors`, unknown
    ones (with less impulse) first. As many of the first as possible are left out
    together, the next is kept, and so on with those after it, for at most `runs`
    impacts.
    """
    known = np.nan_to_num(errors[working], nan=-1.0)
    order = working[np.argsort(known, kind="stable")]
    works = np.isin(np.arange(len(errors)), working)
    left_out = np.flatnonzero(~works).tolist()
    kept: list[int] = []
    waiting = order.tolist()
    while True:
        last = max(len(waiting) - (not kept), 0)  # one is always kept
        # numbers of waiting contacts to leave out, all from 0 to `last` if `runs`
        # allows it
        tries = min(runs, last) + 1
        counts = np.unique(np.linspace(0, last, tries, dtype=int))
        sets = [left_out + waiting[:count] for count in counts]
        error = trial.norm(trial.changes(sets, reference))
        suffice = np.flatnonzero(error <= tolerance)
        if len(suffice):
            best = int(suffice[-1])
        else:
            best = 0
        left_out = sets[best]
        left = waiting[counts[best] :]
        if best + 1 < len(counts):
            needed = counts[best + 1] - counts[best]
        else:
            needed = 1
        kept = kept + left[:needed]
        waiting = left[needed:]
        runs = runs - last
        if runs <= 0 or not waiting:
            sufficient = np.array(kept + waiting, dtype=int)
            return np.sort(sufficient), float(error[best])
