"""Report of `advise`: half a page, with the numbers of the scene."""

import math
import textwrap
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from jimpact.core.law import Declared, Law, parameters_of
from jimpact.core.scene import Scene
from jimpact.methods.points import left_out_notes
from jimpact.tools.records import (
    Column,
    Table,
    Tabular,
    as_data,
    fields_as_data,
    listed,
    one_digit,
)
from jimpact.tools.status import CODE, STATUS

_WIDTH = 80  # characters of the printed lines
_NAMED = 4  # unknown stiffnesses named one by one; the others are "..."
_PERCENT_FROM = 1e-4  # smaller errors are printed as 2e-05, not as 0.002 %
ROUNDING = 1e-12  # errors up to this are printed as "rounding"
_KNOWN = (  # where nothing was varied
    "The stiffnesses are taken as known. A range on their ratios tests whether that "
    "matters: `stiffness_range=(0.5, 2)`, `jimpact advise --stiffness-range 0.5 2`."
)
# parameters of a law as it is printed
_POSITIONAL = ("restitution", "stiffness", "exponent")
# the same, by name, where they are not the default
_KEYWORDS = ("friction", "tangential_stiffness", "order", "rtol")


class ContactBlock(NamedTuple):
    """Contacts that feel each other, 0-based; the kinetic angles [deg] between coupled
    ones.
    """

    contacts: tuple[int, ...]
    approaches: bool
    angles: tuple[float, float] | None
    law: str | None = None  # the simplest one that is within tolerance in this block


class Unknown(NamedTuple):
    """A stiffness of `contact` that is known within a range only; `k2/k1`: a ratio,
    `k2`: in SI.

    What it does to v+ by itself, in the energy norm over that of v-: `alone`: largest
    change over its range; `needed`: relative accuracy of k at which it moves v+ by the
    tolerance (inf: it does not).
    """

    name: str
    contact: int
    nominal: float
    low: float
    high: float
    alone: float = math.nan
    needed: float = math.nan


@dataclass(frozen=True)
class Candidate:
    """A law, the scene to use it on (contacts taken as closed or not), and how it
    fares.

    `velocity` (n,) at the nominal stiffness; `low`, `high` (n,) over the unknown
    ratios; `median` and `worst` error of v+ against the reference over them, in the
    energy norm over that of v-; `cost` per impact in a batch, in units of the cheapest
    law's (None: not timed).
    """

    law: Law
    scene: Scene
    velocity: np.ndarray
    low: np.ndarray
    high: np.ndarray
    median: float
    worst: float
    status: str
    cost: float | None = None

    @property
    def usable(self) -> bool:
        """True if the status is no failure, and v+ does not depend on how contacts are
        numbered.
        """
        code = CODE[self.status]
        return not STATUS[code].failure and self.status != "order_dependent"


@dataclass(frozen=True)
class Advice(Tabular):
    """The result of `advise`, for `ji.impact(advice.law, advice.scene, v)`.

    Attributes:
        name: of the simplest law; `reason` says what decided.
        tolerance: as passed.
        within: whether that law is within it.
        reference: name of the law that all are compared with, 'lzb' or 'compliant'.
        velocity: v- (n,) [m/s].
        gap_velocity: gamma- (m,) [m/s].
        candidates: the evidence by law, the simplest first.
        blocks: groups of coupled contacts.
        stiffness: nominal ones (m,).
        unknown: the stiffnesses that are not known and what they do.
        rows: how many stiffnesses were tried.
        gap_ratio: gaps that can close while other contacts are loaded, in units of
            delta_c (`ji.theory.gap_scale`), or None.
        far: open contacts (from 0) that cannot close during the impact and take no
            part.
        reclosing: largest difference between LZB and Compliant on contacts without
            gaps: LZB lets opened contacts close again at once.
        left_out: why a law is missing: it raised.
    """

    name: str
    tolerance: float
    within: bool
    reference: str
    velocity: np.ndarray
    gap_velocity: np.ndarray
    candidates: dict[str, Candidate]
    blocks: tuple[ContactBlock, ...]
    stiffness: np.ndarray
    unknown: tuple[Unknown, ...]
    rows: int
    gap_ratio: np.ndarray | None
    far: tuple[int, ...] = ()
    reclosing: float = 0.0
    left_out: dict[str, str] = field(default_factory=dict)

    picture = "advice"

    @property
    def law(self) -> Law:
        """The law to use."""
        return self.candidates[self.name].law

    @property
    def scene(self) -> Scene:
        """The scene to use it on: contacts taken as closed or not."""
        return self.candidates[self.name].scene

    @property
    def reason(self) -> str:
        """Sentence: why this law is advised, and the error of the best simpler law."""
        phrases = (_cause(self), _closest_simpler(self))
        return "; ".join(filter(None, phrases))

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it; contacts counted from 1."""
        laws = {
            name: fields_as_data(c, "law", "scene")
            | {"law": as_code(c.law), "usable": c.usable}
            for name, c in self.candidates.items()
        }
        return fields_as_data(self, "name", "candidates") | {
            "advice": self.name,
            "law": as_code(self.law),
            "reason": self.reason,
            "laws": laws,
            "blocks": [
                as_data(b) | {"contacts": _from_one(b.contacts)} for b in self.blocks
            ],
            "unknown": [as_data(u) | {"contact": u.contact + 1} for u in self.unknown],
            "far": _from_one(self.far),
        }

    @property
    def table(self) -> Table:
        """The advice, its reason, and a row for each law: half a page."""
        if self.within:
            verdict = "within"
        else:
            verdict = "NOT within"
        head = [f"Advice: {as_code(self.law)}, {verdict} {share(self.tolerance)}"]
        for line in (self.reason, *_block_lines(self)):
            head += textwrap.wrap(line, _WIDTH)
        if self.unknown:
            head += ["", *str(_unknown_table(self.unknown)).splitlines()]
        columns = (
            Column("law", lambda name: ("*" if name == self.name else " ") + name),
            *(Column(name, share) for name in ("median", "worst")),
            Column("cost", one_digit, "relative cost"),
            *(
                Column(f"v_{i + 1}_plus", ".4f", f"v{i + 1}+")
                for i in range(len(self.velocity))
            ),
            Column("status"),
        )
        rows = [
            [name, c.median, c.worst, c.cost, *c.velocity.tolist(), c.status]
            for name, c in self.candidates.items()
        ]
        footnote = (
            f"Error of v+ against {self.reference}: sqrt(dv^T M dv) over sqrt(v-^T M "
            f"v-), dv the difference of v+; stiffnesses tried: {self.rows}."
        )
        notes = ["", *textwrap.wrap(footnote, _WIDTH)]
        clusters = (b for b in self.blocks if b.approaches and len(b.contacts) > 1)
        if not self.unknown and any(clusters):
            notes += textwrap.wrap(_KNOWN, _WIDTH)
        notes += left_out_notes(self.left_out)
        return Table(columns, rows, [*head, ""], notes)


def _from_one(contacts: tuple[int, ...]) -> list[int]:
    """Contacts counted from 1."""
    return [j + 1 for j in contacts]


def _unknown_table(unknown: tuple[Unknown, ...]) -> Table:
    """Table of unknown stiffnesses, the strongest first: range, change of v+, accuracy
    needed.
    """
    columns = (
        Column("unknown"),
        Column("range"),
        Column("alone", share, "moves v+ by"),
        Column(
            "needed", lambda x: f"{100 * x:.2g} %" if x < 1 else "", "know it within"
        ),
    )
    strongest = sorted(unknown, key=lambda u: -u.alone)[:_NAMED]
    rows = [
        [u.name, f"{u.low:.3g} to {u.high:.3g}", u.alone, u.needed] for u in strongest
    ]
    return Table(columns, rows)


def share(x: float) -> str:
    """A relative error, rounded up to two digits: 2 %, 3e-05.

    >>> from jimpact.methods.advice_report import share
    >>> share(0.0191), share(2.01e-5), share(0.0)
    ('2 %', '2.1e-05', 'rounding')
    """
    if math.isnan(x):
        return "nan"
    if x <= ROUNDING:
        return "rounding"
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    up = math.ceil(x / unit * (1 - ROUNDING)) * unit
    if x >= _PERCENT_FROM:
        return f"{100 * up:.3g} %"
    return f"{up:.2g}"


def as_code(law: Declared) -> str:
    """Python expression of a law: `LZB(0.9, 1, 1.5, rtol=0.001)`.

    Laws within it are written alike; options that are None, or words at their default,
    are left out.
    """
    words = []
    for each in fields(law):
        value = getattr(law, each.name)
        if isinstance(value, Declared):
            words.append(as_code(value))
        elif each.name in _POSITIONAL:
            words.append(_in_code(value))
        elif each.name in _KEYWORDS and value is not None:
            if isinstance(value, str) and value == each.default:
                continue
            words.append(f"{each.name}={_in_code(value)}")
    return f"{type(law).__name__}({', '.join(words)})"


def _in_code(value: Any) -> str:
    """Python expression of a value: a string, one number, or a list of unequal
    numbers.
    """
    if isinstance(value, str):
        return repr(value)
    array = np.asarray(value)
    if array.size and (array == array.flat[0]).all():
        return f"{array.flat[0]:.6g}"
    return f"[{', '.join(f'{x:.6g}' for x in array)}]"


def _block_lines(advice: Advice) -> list[str]:
    """Lines of the report: contacts of each block, their kinetic angles, the law that
    suffices.

    Decoupled contacts with the same law share a line.
    """
    groups: dict[tuple[str, Any], list[int]] = {}
    for block in advice.blocks:
        law = f"{block.law or 'no law'} suffices"
        what = f"decoupled: {law}"
        coupled = None
        if not block.approaches:
            what = "without an approach"
        elif block.angles is not None:
            coupled = block.contacts
            low, high = (f"{angle:.4g}" for angle in block.angles)
            if low == high:
                angles = f"angle {low}"
            else:
                angles = f"angles {low} to {high}"
            what = f"coupled (kinetic {angles} degrees): {law}"
        groups.setdefault((what, coupled), []).extend(block.contacts)
    if advice.far:
        groups["too far open to close during the impact", None] = list(advice.far)
    return [
        (
            f"contact{'s' * (len(contacts) > 1)} "
            f"{', '.join(str(j + 1) for j in contacts)} "
            f"{what}"
        )
        for (what, _), contacts in groups.items()
    ]


def _cause(advice: Advice) -> str:
    """Phrase: the cause of the advice, the first of these that holds.

    Nothing approaches; contacts act alone; no law is within the tolerance, so that a
    stiffness must be measured; gaps; contacts that close again; contacts of e = 0; else
    the stiffnesses.
    """
    at_work = [block for block in advice.blocks if block.approaches]
    if not at_work:
        slowest = float(advice.gap_velocity.min())
        return f"no approach: nothing happens (smallest gap velocity {slowest:.3g} m/s)"
    if all(len(block.contacts) == 1 for block in at_work):
        alone = "single contact"
        several = "contacts decoupled: kinetic angle 90 degrees"
        if len(at_work) == 1:
            return alone
        return several
    stiffnesses = _stiffnesses(advice, at_work)
    if not advice.within:
        strongest = max(advice.unknown, key=lambda u: u.alone)
        return f"{stiffnesses} decides: measure {strongest.name} first"
    if advice.gap_ratio is not None:
        gaps = listed([f"{x:.3g}" for x in advice.gap_ratio], _NAMED)
        return f"gaps of {gaps} delta_c, see ji.theory.gap_scale"
    if advice.reference == "compliant":
        apart = share(advice.reclosing)
        return (
            f"contacts open and close again, where lzb and compliant differ by up to "
            f"{apart}"
        )
    if advice.name == "newton" and _is_plastic(advice.law):
        return "plastic contacts (restitution 0) that stay together"
    if advice.name == advice.reference and not advice.unknown:
        return (
            f"{stiffnesses}, taken as known: {advice.name} is the reference itself, "
            f"and compliant, with springs in the place of its energies, differs from "
            f"it by {share(advice.reclosing)}"
        )
    return (
        f"{stiffnesses}: {advice.name} is within "
        f"{share(advice.candidates[advice.name].worst)}"
    )


def _is_plastic(law: Law) -> bool:
    """True of a law whose `restitution` is 0 at all contacts."""
    e = parameters_of(law)["restitution"].value
    return not np.any(e)


def _stiffnesses(advice: Advice, at_work: list[ContactBlock]) -> str:
    """Phrase: unknown stiffnesses with their ranges, else known ratios within coupled
    contacts.
    """
    words = [f"{u.name} in [{u.low:.3g}, {u.high:.3g}]" for u in advice.unknown]
    if not words:
        k = advice.stiffness
        pairs = [(b.contacts[0], j) for b in at_work for j in b.contacts[1:]]
        words = [f"k{j + 1}/k{i + 1} = {k[j] / k[i]:.3g}" for i, j in pairs]
    if "/" in words[0]:
        kind = "stiffness ratio"
    else:
        kind = "stiffness"
    return f"{kind} {listed(words, _NAMED)}"


def _closest_simpler(advice: Advice) -> str:
    """Phrase: error of the best of the simpler laws, or its failure; '' if there is
    none.
    """
    names = list(advice.candidates)
    simpler_names = names[: names.index(advice.name)]
    simpler = {name: advice.candidates[name] for name in simpler_names}
    if not simpler or not any(block.approaches for block in advice.blocks):
        return ""
    best = min(
        simpler, key=lambda name: (not simpler[name].usable, simpler[name].worst)
    )
    if not simpler[best].usable:
        return f"{best} fails: {simpler[best].status}"
    return (
        f"of the simpler laws {best} comes closest and is off by "
        f"{share(simpler[best].worst)}"
    )
