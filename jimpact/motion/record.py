"""The record of a motion: samples, events, energy ledger, status."""

import dataclasses
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.tools.checks import suggesting_names
from jimpact.tools.records import as_data, fields_as_data
from jimpact.tools.status import STATUS, Status

EVENT_KINDS = (
    "none",
    "impact",
    "accumulation",
    "contact",
    "detachment",
    "friction",
    "paroxysm",
)
_ROUNDING = 1e-12  # of the largest work: what is smaller is not printed
# of the energy: what friction gives at most by rounding. Ten times more: less is shown
# as given; ten times less: sums of rounding hide the shares
_ROUNDED = 1e-9
FORMAT = 1  # version of the files of motions

KIND_CODE = {name: code for code, name in enumerate(EVENT_KINDS)}

# Codes are saved as their names, so that files outlive the order of these rows.
_NAMES = {
    "status": tuple(row.name for row in STATUS),
    "events.kind": EVENT_KINDS,
    "events.status": tuple(row.name for row in STATUS),
}


# on the host `Motion.then` and `joined` take rows by NumPy
AnyArray = Array | np.ndarray


class Events(eqx.Module):
    """Rows of events, in time; rows beyond `count` are NaN or 0. E: number of rows.

    `kind` is an index of `jimpact.motion.record.EVENT_KINDS`: an `accumulation` is the
    impact at which the rest of an infinite sequence is passed; by estimates from its
    energy, the force that presses and what the impact absorbed, `accumulation_end` [s]
    is when that sequence would end, and `accumulation_gap` [m] how far its contacts
    might still have opened. A `paroxysm` is an impact without collision. `energy`
    (2, m) is what each contact supplied (< 0: absorbed), normally and tangentially.
    """

    count: Int[AnyArray, "..."]
    time: Float[AnyArray, "... E"]
    kind: Int[AnyArray, "... E"]
    contacts: Bool[AnyArray, "... E m"]  # that take part
    q: Float[AnyArray, "... E nq"]
    velocity_before: Float[AnyArray, "... E n"]
    velocity_after: Float[AnyArray, "... E n"]
    impulse: Float[AnyArray, "... E m"]
    tangential_impulse: Float[AnyArray, "... E t"]  # t = m, in space 2 m
    energy: Float[AnyArray, "... E 2 m"]
    status: Int[AnyArray, "... E"]  # of the law, see `jimpact.STATUS`
    accumulation_end: Float[AnyArray, "... E"]
    accumulation_gap: Float[AnyArray, "... E"]


def no_events(
    size: int, q: jax.Array, v: jax.Array, m: int, tangents: int | None = None
) -> Events:
    """Table of `size` empty rows for events of m contacts; `tangents`: their number,
    None: m.
    """
    dtype = q.dtype
    n = v.shape[0]

    def blank(*shape: int) -> Float[Array, "size ..."]:
        """NaN for each row, of this shape."""
        return jnp.full((size, *shape), jnp.nan, dtype)

    return Events(
        count=jnp.int32(0),
        time=blank(),
        kind=jnp.zeros(size, jnp.int32),
        contacts=jnp.zeros((size, m), bool),
        q=blank(q.shape[0]),
        velocity_before=blank(n),
        velocity_after=blank(n),
        impulse=blank(m),
        tangential_impulse=blank(m if tangents is None else tangents),
        energy=blank(2, m),
        status=jnp.zeros(size, jnp.int32),
        accumulation_end=blank(),
        accumulation_gap=blank(),
    )


def joined(parts: list[Events], most: int) -> Events:
    """Events of runs that follow each other as one table, on the host; `most` rows at
    most.
    """
    if len(parts) == 1 and len(parts[0].time) <= most:
        return parts[0]
    columns = [name for name in Events.__dataclass_fields__ if name != "count"]
    rows = {
        name: np.concatenate([getattr(x, name) for x in parts])[:most]
        for name in columns
    }
    count = np.sum([x.count for x in parts], dtype=np.int32)
    columns_of_jax = {name: jnp.asarray(x) for name, x in rows.items()}
    return Events(jnp.asarray(count), **columns_of_jax)


def with_row(
    events: Events, happened: Bool[Array, ""], values: dict[str, jax.Array]
) -> Events:
    """Events with the `values` of fields in the next row if one `happened` and a row is
    left.
    """
    size = events.time.shape[0]
    row = jnp.where(happened, events.count, size)
    new = {
        name: getattr(events, name).at[row].set(value, mode="drop")
        for name, value in values.items()
    }
    fits = (happened & (events.count < size)).astype(jnp.int32)
    return dataclasses.replace(events, count=events.count + fits, **new)


@suggesting_names(t="time", v="velocity", f="gaps")
class Motion(eqx.Module):
    """A motion, or a batch B of them: samples at equal times, events, energies, status.

    Samples that were not reached are NaN. The ledger
    `T + V - (T + V)(t_0) = force_work + base_work + sum contact_work` holds at every
    sample.

    Attributes:
        time: (S,) [s].
        q: (S, n), see the body.
        velocity: (S, n).
        kinetic_energy: T (S,) [J].
        potential_energy: V (S,) [J].
        force_work: of `force` since the start (S,) [J].
        base_work: of the moving base (S,) [J].
        contact_work: of each contact, normal and tangential (S, 2, m) [J]; <= 0
            dissipates.
        gaps: (S, m) [m].
        events: a table of all impacts, liftoffs, .., as `print(motion)` lists them.
        steps: () of the integrator.
        status: () code, 0 = ok; see `raise_on_failure`.
    """

    time: Float[Array, "... S"]
    q: Float[Array, "... S nq"]
    velocity: Float[Array, "... S n"]
    kinetic_energy: Float[Array, "... S"]
    potential_energy: Float[Array, "... S"]
    force_work: Float[Array, "... S"]
    base_work: Float[Array, "... S"]
    # normal, tangential; of a pile M = 1, else m
    contact_work: Float[Array, "... S 2 M"]
    gaps: Float[Array, "... S M"]
    events: Events
    steps: Int[Array, "..."]
    status: Int[Array, "..."]

    @property
    def energy(self) -> Float[Array, "... S"]:
        """T + V [J]."""
        return self.kinetic_energy + self.potential_energy

    @property
    def ledger_residual(self) -> Float[Array, "... S"]:
        """Error of the ledger [J]: `T + V - (T + V)(t_0)` without all works."""
        by_contacts = jnp.sum(self.contact_work, axis=(-2, -1))
        work = self.force_work + self.base_work + by_contacts
        return self.energy - self.energy[..., :1] - work

    def event_times(self, kind: str = "impact") -> np.ndarray:
        """Times of the events of a kind, on the host, of one motion."""
        if kind not in EVENT_KINDS:
            raise ValueError(
                f"Argument `kind` must be one of {EVENT_KINDS}, but is {kind!r}."
            )
        chosen = np.asarray(self.events.kind) == KIND_CODE[kind]
        return np.asarray(self.events.time)[chosen]

    def restart(self, t_end: float) -> dict[str, Any]:
        """Arguments `q0`, `v0`, `t_end` of `simulate` with which one motion goes on, on
        the host.

        `simulate(system, law, **motion.restart(2.0))` begins at the last sample that
        was reached.
        """
        last = self._reached() - 1
        times = (float(self.time[last]), t_end)
        return {"q0": self.q[last], "v0": self.velocity[last], "t_end": times}

    def _reached(self) -> int:
        """Number of samples that were reached, of one motion."""
        if np.ndim(self.status):
            raise ValueError(
                "A batch of motions has no common end: pick one motion of it."
            )
        finite = np.isfinite(np.asarray(self.q)).all(axis=-1)
        return int(finite.sum())

    def then(self, later: "Motion") -> "Motion":
        """This motion and a `later` one, which goes on from its end (`restart`), as one
        record.

        Works add up, so that the ledger holds from the start of this motion on.
        """
        count = self._reached()
        last = float(self.time[count - 1])
        begin = float(later.time[0])
        if begin != last:
            raise ValueError(
                f"Argument `later` must begin at {last:g} s, where this motion ends, "
                f"but begins at "
                f"{begin:g} s."
            )
        samples = {}
        for name in _SAMPLED:
            first = getattr(self, name)[:count]
            second = getattr(later, name)[1:]
            if name.endswith("_work"):
                added = first[-1]
            else:
                added = 0.0
            samples[name] = jnp.concatenate([first, second + added])
        # events after the last sample occur in `later` again
        happened = np.asarray(self.events.kind > 0)
        known = happened & (np.asarray(self.events.time) <= last)
        events = jax.tree.map(
            lambda x: np.asarray(x)[known] if np.ndim(x) else x, self.events
        )
        known_count = jnp.int32(known.sum())
        events = dataclasses.replace(events, count=known_count)
        rows = int(known.sum()) + later.events.time.shape[0]
        table = joined([events, later.events], rows)
        steps = self.steps + later.steps
        return dataclasses.replace(later, **samples, events=table, steps=steps)

    def explain_failure(self, row: Status, lanes: np.ndarray) -> str:
        """End of a message: names of the law's status codes in the failed motions
        `lanes`.

        Empty unless their status, of which `row` is the table's row, is `law_failed`.
        """
        if row.name != "law_failed":
            return ""
        every_code = np.asarray(self.events.status).reshape(self.status.size, -1)
        codes = every_code[lanes]
        gravest = np.unique(codes.max(axis=1))
        names = [STATUS[code].name for code in gravest if code]
        if names:
            return f": {', '.join(names)}"
        return ""

    def save(self, path: str | Path) -> Path:
        """Write everything to `path`, which ends in .npz; `ji.load` reads it."""
        path = Path(path)
        if path.suffix != ".npz":
            raise ValueError(f"Argument `path` must end in .npz, but is '{path}'.")
        arrays = {name: np.asarray(x) for name, x in _arrays(self).items()}
        arrays |= {
            "format": np.asarray(FORMAT),
            "jimpact": np.asarray(version("jimpact")),
        }
        for name, words in _NAMES.items():
            arrays[name] = np.asarray(words)[arrays[name]]
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        return path

    def to_dict(self) -> dict[str, Any]:
        """Samples, events by the names of their kinds, and status, ready for JSON (NaN:
        None).
        """
        n = int(self.events.count)
        columns = {
            k: np.asarray(v) for k, v in vars(self.events).items() if k != "count"
        }
        rows = {name: column[:n] for name, column in columns.items()}
        kinds = [EVENT_KINDS[k] for k in rows["kind"]]
        events = rows | {"kind": kinds}
        status = STATUS[int(self.status)].name
        return fields_as_data(self, "events") | as_data(
            {"status": status, "events": events}
        )

    def __str__(self) -> str:
        """Status, events and energies in five lines; of a batch how many have which
        status.
        """
        if np.ndim(self.status):
            return _batch_report(self)
        kinds = np.asarray(self.events.kind)
        numbers = np.bincount(kinds, minlength=len(EVENT_KINDS))
        counts = [
            f"{n} {name}"
            for n, name in zip(numbers, EVENT_KINDS)
            if n and name != "none"
        ]
        row = STATUS[int(self.status)]
        known = np.isfinite(np.asarray(self.energy))
        reached = np.asarray(self.time)[known]
        last = int(known.sum()) - 1
        shares = contact_shares(self).items()
        works = {name: work[max(last, 0)] for name, work in shares}
        works |= {
            "the base": self.base_work[last],
            "forces": self.force_work[last],
        }
        lines = [
            (
                f"Motion from {float(self.time[0]):g} s to {float(self.time[-1]):g} s: "
                f"{row.name}"
            )
            + (f" ({row.message})" if row.name != "ok" else ""),
            f"  events: {', '.join(counts) or 'none'}",
            f"  energy T + V: {float(self.energy[0]):.6g} J to "
            f"{float(self.energy[last]):.6g} J"
            f" at {reached[-1] if len(reached) else np.nan:g} s",
            f"  {_work_report(works)}",
            (
                f"  ledger closes to "
                f"{np.nanmax(np.abs(np.asarray(self.ledger_residual))):.1e} J"
            ),
        ]
        return "\n".join(lines)


_WHOLE = ("events", "steps", "status")  # fields that do not belong to samples
_SAMPLED = tuple(name for name in Motion.__dataclass_fields__ if name not in _WHOLE)


def _arrays(motion: Motion) -> dict[str, jax.Array]:
    """All fields by name, those of events as `events.name`."""
    rows = {f"events.{name}": x for name, x in vars(motion.events).items()}
    samples = {name: x for name, x in vars(motion).items() if name != "events"}
    return samples | rows


def read_motion(path: Path) -> Motion:
    """Read a motion, or batch, that `Motion.save` wrote; a ValueError says what else a
    file is.
    """
    wrong = f"Argument `path` must be a file of `Motion.save`, but '{path}' "
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except (ValueError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"{wrong}cannot be read.") from error
    found = arrays.pop("format", None)
    if found is None or not {"time", "status", "events.kind"} <= set(arrays):
        raise ValueError(f"{wrong}holds something else.")
    written = arrays.pop("jimpact")
    if int(found) != FORMAT:
        raise ValueError(
            f"{wrong}has format {int(found)}, of jimpact {written}; this version reads "
            f"{FORMAT}."
        )
    for name, words in _NAMES.items():
        index_of = np.vectorize(words.index, otypes=[np.int32])
        arrays[name] = index_of(arrays[name])
    if jnp.asarray(arrays["q"]).dtype != arrays["q"].dtype:
        raise ValueError(f"{wrong}is in {arrays['q'].dtype}: enable jax_enable_x64.")
    values = {name: jnp.asarray(x) for name, x in arrays.items()}
    rows = {name: values.pop(f"events.{name}") for name in Events.__dataclass_fields__}
    return Motion(events=Events(**rows), **values)


def contact_shares(motion: Motion) -> dict[str, np.ndarray]:
    """Works (S,) [J] of `the contacts` and of `friction`, or of both together.

    The share of an impact is `p (gamma- + gamma+) / 2` or `p_t . (u- + u+) / 2`. Their
    sum is the work; each alone is where velocities are linear in its impulse. Where
    slip reverses, and `friction` would give energy by that, only the sum is stated.
    """
    works = np.asarray(motion.contact_work).sum(axis=-1)
    normal, tangential = works.T
    added = np.diff(tangential[np.isfinite(tangential)])
    energy = np.abs(np.asarray(motion.energy))
    largest = np.nanmax(energy, initial=0.0)
    if np.max(added, initial=0.0) > _ROUNDED * largest:
        return {"contacts and friction": normal + tangential}
    return {"the contacts": normal, "friction": tangential}


def _work_report(works: dict[str, Any]) -> str:
    """Sentence of the works [J] by source, supplied > 0 and absorbed < 0; roundings are
    left out.
    """
    sizes = (abs(float(work)) for work in works.values())
    least = _ROUNDING * max(sizes)
    parts = [
        f"{source} {'absorbed' if work < 0 else 'supplied'} {abs(float(work)):.4g} J"
        for source, work in works.items()
        if abs(float(work)) > least
    ]
    return ", ".join(parts) or "nothing did work"


def _batch_report(motion: Motion) -> str:
    """Line with the number of motions of a batch, and how many have each status."""
    status = np.asarray(motion.status)
    codes, counts = np.unique(status, return_counts=True)
    parts = ", ".join(
        f"{n} {STATUS[c].name}" for c, n in zip(codes, counts, strict=True)
    )
    return f"{np.size(motion.status)} motions: {parts}"
