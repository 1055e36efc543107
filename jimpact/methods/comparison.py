"""Every law on one scene, side by side."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import numpy as np

from jimpact.core.audits import Audit, audit, nothing_approaches
from jimpact.core.impacts import Impact, impact
from jimpact.core.law import Law
from jimpact.core.registry import registered_laws
from jimpact.core.scene import Scene, as_velocity, dense_mass
from jimpact.methods.points import at_points, in_turns, left_out_notes, seconds
from jimpact.theory.dispersion import dispersion_index, energy_ratio
from jimpact.tools.checks import check_kind
from jimpact.tools.compiling import quick_jit
from jimpact.tools.records import (
    Column,
    Table,
    Tabular,
    as_data,
    fields_as_data,
    microseconds,
)
from jimpact.tools.status import STATUS

_REPEATS = 20  # of the timing, whose median is reported
# distances from the measured velocities up to this ratio count as equal
AS_CLOSE = 1.01


@dataclass(frozen=True)
class Entry:
    """One law's row of a comparison; `time` [s] of one impact, compiled, `compile_time`
    [s].
    """

    law: Law
    outcome: Impact
    audit: Audit
    energy_ratio: float
    dispersion_index: float
    time: float
    compile_time: float

    @property
    def status(self) -> str:
        """Name of the status."""
        return STATUS[int(self.outcome.status)].name

    @property
    def verdict(self) -> str:
        """'ok', or the conditions that the audit finds violated, and a status that is
        not ok.
        """
        broken = [f"{name} violated" for name in self.audit.broken]
        if self.status != "ok":
            broken.append(self.status)
        return ", ".join(broken) or "ok"

    def to_dict(self) -> dict[str, Any]:
        """The row, as a JSON file can hold it."""
        out = self.outcome
        checked = {"status": self.status, "consistent": self.audit.consistent}
        rest = fields_as_data(self, "law", "outcome", "audit")
        moved = {"velocity": out.velocity, "impulse": out.impulse}
        return as_data(moved | checked) | rest


@dataclass(frozen=True)
class Comparison(Tabular):
    """The result of `compare`; `print` gives a table.

    Attributes:
        scene: as passed.
        velocity: v- (n,) [m/s].
        entries: outcome, audit, energy ratio, dispersion and time by law.
        left_out: why a law is missing.
        measured: v+ (n,) [m/s] to compare with, or None.
    """

    scene: Scene
    velocity: np.ndarray
    entries: dict[str, Entry]
    left_out: dict[str, str] = field(default_factory=dict)
    measured: np.ndarray | None = None

    picture = "comparison"

    @property
    def distances(self) -> dict[str, float]:
        """Root mean square difference [m/s] of each law's v+ from the measured one, if
        any.

        Equation: `sqrt(mean_i (M_ii / max M_ii) (v_i+ - measured_i)^2)`, weights of 1
        in a chain: rotations in rad/s count as m/s with as much energy. Coordinates
        that were not measured (NaN) are left out.
        """
        if self.measured is None:
            return {}
        root_weight = np.ones(self.scene.size)
        if self.scene.walls is None:
            inertia = np.diag(dense_mass(self.scene))
            root_weight = np.sqrt(inertia / inertia.max())
        after = {name: entry.outcome.velocity for name, entry in self.entries.items()}
        off = {
            name: root_weight * (np.asarray(v) - self.measured)
            for name, v in after.items()
        }
        return {name: float(np.sqrt(np.nanmean(x**2))) for name, x in off.items()}

    @property
    def closest(self) -> tuple[str, ...]:
        """The law closest to the measured velocities, and those that are as close to 1
        %.
        """
        least = min(self.distances.values(), default=math.nan)
        return tuple(
            name for name, x in self.distances.items() if x <= AS_CLOSE * least
        )

    def to_dict(self) -> dict[str, Any]:
        """The laws' rows, as a JSON file can hold them."""
        return as_data(self.entries)

    @property
    def table(self) -> Table:
        """Table: a row for each law, and one for the measured velocities."""
        # others may be rad/s
        if self.scene.walls is not None:
            unit = "m/s"
        else:
            unit = ""
        columns = (
            Column("law"),
            *(
                Column(f"v_{i + 1}_plus", ".5f", f"v{i + 1}+", unit)
                for i in range(self.scene.size)
            ),
            Column("energy_ratio", ".4f", "T+/T-"),
            Column("dispersion", ".3f"),
            Column("time_s", microseconds, "time", "µs"),
            Column("audit"),
        )
        rows = [
            [
                *(name, *np.asarray(x.outcome.velocity).tolist()),
                *(x.energy_ratio, x.dispersion_index, x.time, x.verdict),
            ]
            for name, x in self.entries.items()
        ]
        if self.measured is not None:
            ratio, spread = _energies(self.scene, self.velocity, self.measured)
            numbers = (*self.measured.tolist(), float(ratio), float(spread))
            rows.append(["measured", *numbers, None, ""])
        notes = []
        if self.closest:
            rms = self.distances[self.closest[0]]
            named = ", ".join(self.closest)
            notes.append(
                f"closest to the measured velocities: {named} (rms {rms:.3g} m/s)"
            )
        notes += left_out_notes(self.left_out)
        why_no_impact = nothing_approaches(self.scene, self.velocity)
        if why_no_impact is not None:
            notes.append(f"no impact: {why_no_impact}")
        return Table(columns, rows, notes=notes)


def compare(
    scene: Scene, velocity: Any, laws: Mapping[str, Law] | None = None, **values: Any
) -> Comparison:
    """Outcomes of laws on one impact: velocities, energy, dispersion, audit, time.

    Args:
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s].
        laws: by name; default: every law of the registry, with these
        values: parameters by name, `restitution=0.9, stiffness=..., exponent=...,
            matrix=...` (laws that need others are left out, see `left_out`);
            restitution is 1 unless it is among them.

    Returns:
        `Comparison`: an entry for each law, `print` gives a table, `ji.plot.comparison`
        a picture. A law that raises is left out, and the table says why.

    Raises:
        ValueError: velocities of another size or NaN; both `laws` and values.
        TypeError: `laws` without names.

    >>> import jimpact as ji
    >>> table = ji.compare(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0], restitution=1.0)
    >>> [round(float(v), 4) for v in table.entries["moreau"].outcome.velocity]
    [-0.3333, 0.6667, 0.6667]
    """
    v = as_velocity(scene, velocity, finite=True)
    left_out: dict[str, str] = {}
    if laws is None:
        laws, left_out = registered_laws({"restitution": 1.0} | values)
    elif values:
        raise ValueError(
            f"Argument `laws` must be None where parameters are given, but "
            f"{', '.join(values)} came with it."
        )
    check_kind("laws", laws, Mapping)
    # the first calls, with compiling, sort out the laws that raise; then all are timed
    # in turns
    calls = {name: partial(_first_call, law, scene) for name, law in laws.items()}
    first, raised = at_points(calls, v)
    runs = {name: partial(impact, laws[name], scene, v) for name in first}
    measured = in_turns(list(runs.values()), _REPEATS)
    each = dict(zip(runs, measured))
    times = {name: float(np.median(x)) for name, x in each.items()}
    entries = {}
    for name, run in runs.items():
        outcome = run()
        ratio, dispersion = _energies(scene, v, outcome.velocity)
        entries[name] = Entry(
            law=laws[name],
            outcome=outcome,
            audit=_audit(outcome, scene, v),
            energy_ratio=float(ratio),
            dispersion_index=float(dispersion),
            time=times[name],
            compile_time=max(first[name] - times[name], 0.0),
        )
    return Comparison(scene, np.asarray(v), entries, left_out | raised)


_audit = quick_jit(audit)


@quick_jit
def _energies(scene: Scene, before: Any, after: Any) -> tuple[jax.Array, jax.Array]:
    """T+ / T- () and dispersion index () of v- and v+ (n,)."""
    return energy_ratio(scene, before, after), dispersion_index(scene, after)


def _first_call(law: Law, scene: Scene, velocity: jax.Array) -> float:
    """Time [s] of a law's first impact, with compiling."""
    return seconds(partial(impact, law, scene, velocity))
