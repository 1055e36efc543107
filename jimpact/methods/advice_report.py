"""What `advise` reports, in words with the numbers of the scene: half a page."""

import math
import shutil
import textwrap
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from jimpact.files.records import Column, Table, Tabular, as_data, fields_as_data
from jimpact.law import Declared, Law, parameters_of
from jimpact.laws import REGISTRY
from jimpact.methods.points import left_out_notes
from jimpact.montecarlo.gaps import NEARLY_TOUCHING, WIDE
from jimpact.scene import Scene
from jimpact.status import CODE, STATUS

_WIDTH = 80  # characters of the printed lines
_NAMED = 4  # stiffness ratios named one by one; the others are "..."
_PERCENT_FROM = 1e-4  # smaller errors are printed as 2e-05, not as 0.002 %
_ROUNDING = 1e-12  # errors up to this are printed as "rounding"
_NO_CHANGE = 1e-6  # a relative change of v+ up to this is reported as no difference
_POSITIONAL = ("restitution", "stiffness", "exponent")  # parameters of a law as it is printed
_KEYWORDS = ("friction", "order", "rtol")  # the same, by name, where they are not the default
NAMES = {name: row.law.__name__ for name, row in REGISTRY.items()} | {"binary": "binary"}


class ContactBlock(NamedTuple):
    """Contacts that feel each other, 0-based; the kinetic angles [deg] between coupled ones."""

    contacts: tuple[int, ...]
    approaches: bool
    angles: tuple[float, float] | None
    law: str | None = None  # the simplest one that is within tolerance in this block

    @property
    def name(self) -> str:
        """Contacts counted from 1."""
        return ", ".join(str(j + 1) for j in self.contacts)


class Unknown(NamedTuple):
    """A stiffness known within a range only: of `contact`, over that of `base` (None: SI).

    What it does to v+ by itself, in the energy norm over that of v-: `alone`: largest change over
    its range; `slope`: |d v+ / d ln k|; `needed`: relative accuracy of k at which it moves v+ by
    the tolerance (inf: it does not).
    """

    contact: int
    base: int | None
    nominal: float
    low: float
    high: float
    alone: float = math.nan
    slope: float = math.nan
    needed: float = math.nan

    @property
    def name(self) -> str:
        """`k2/k1`, contacts counted from 1."""
        return f"k{self.contact + 1}" + ("" if self.base is None else f"/k{self.base + 1}")


@dataclass(frozen=True)
class Candidate:
    """A law, the scene to use it on (contacts taken as closed or not), and how it fares.

    `velocity` (n,) at the nominal stiffness; `low`, `high` (n,) over the unknown ratios; `median`
    and `worst` error of v+ against the reference over them, in the energy norm over that of v-;
    `cost` per impact in a batch, in units of the cheapest law's (None: not timed).
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
        """Whether the status allows to use the outcome, whatever order contacts are numbered in."""
        code = CODE[self.status]
        return not STATUS[code].failure and self.status != "order_dependent"


@dataclass(frozen=True)
class Advice(Tabular):
    """The result of `advise`; `ji.impact(advice.law, advice.scene, advice.velocity)` applies it.

    Attributes:
        name: of the simplest law; `reason` says why, in words.
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
        gap_ratio: gaps that can close while other contacts are loaded, in units of delta_c
            (`ji.theory.gap_scale`), or None.
        far: open contacts (from 0) that cannot close during the impact and take no part.
        reclosing: largest difference between LZB and Compliant on contacts without gaps: LZB lets
            opened contacts close again at once.
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
    def at_work(self) -> list[ContactBlock]:
        """Blocks in which a contact approaches."""
        return [block for block in self.blocks if block.approaches]

    @property
    def reason(self) -> str:
        """Why this law, with numbers of this scene."""
        return reason(self)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it; contacts counted from 1."""
        laws = {
            name: fields_as_data(c, "law", "scene") | {"law": as_code(c.law), "usable": c.usable}
            for name, c in self.candidates.items()
        }
        words = {"advice": self.name, "law": as_code(self.law), "reason": self.reason}
        blocks = [as_data(b) | {"contacts": [j + 1 for j in b.contacts]} for b in self.blocks]
        unknown = [{"name": u.name} | as_data(u._asdict()) for u in self.unknown]
        for each in unknown:
            del each["contact"], each["base"]
        far = [j + 1 for j in self.far]
        parts = {"laws": laws, "blocks": blocks, "unknown": unknown, "far": far}
        return words | fields_as_data(self, "name", "candidates", *parts) | parts

    @property
    def table(self) -> Table:
        """A row for each law, below the advice: half a page."""
        verdict = "within" if self.within else "NOT within"
        head = [f"Advice: {as_code(self.law)}, {verdict} {share(self.tolerance)}"]
        head += _wrapped("because", self.reason) + _wrapped("scene", structure(self))
        if len(self.unknown) > 1:
            head += _wrapped("unknown", f"{ratios(self)}; {effects(self)}")
        if also := agreeing(self):
            head += _wrapped("also", also)
        columns = (
            Column("law", lambda name: ("*" if name == self.name else " ") + name),
            *(Column(name, share) for name in ("median", "worst")),
            Column("cost", lambda x: "" if x is None else f"{x:.{1 if x < 10 else 0}f}"),
            *(Column(f"v_{i + 1}_plus", ".4f", f"v{i + 1}+") for i in range(len(self.velocity))),
            Column("status"),
        )
        rows = [
            [name, c.median, c.worst, c.cost, *c.velocity.tolist(), c.status]
            for name, c in self.candidates.items()
        ]
        notes = ["", *textwrap.wrap(self._footnote(), _width())]
        notes += left_out_notes(self.left_out)
        return Table(columns, rows, [*head, ""], notes)

    def _footnote(self) -> str:
        """What the columns of the table mean."""
        words = (
            f"Error of v+ against {title(self.reference)}: sqrt(dv^T M dv) over "
            "sqrt(v-^T M v-), dv the difference of v+"
        )
        if self.rows > 1:
            words += f"; median and worst over {self.rows} stiffnesses"
        if all(c.cost is not None for c in self.candidates.values()):
            words += "; cost of an impact in a batch, cheapest = 1"
        if self.gap_ratio is not None:
            words += "; delta_c: the indentation scale of a contact, see ji.theory.gap_scale"
        return f"{words}."


def _width() -> int:
    """Characters of the printed lines."""
    return min(_WIDTH, shutil.get_terminal_size((_WIDTH, 0)).columns)


def _wrapped(key: str, text: str) -> list[str]:
    """Lines behind a key word; a number keeps its unit."""
    whole = f"{text}.".replace(" %", "\u00a0%")
    lines = textwrap.wrap(whole, _width(), initial_indent=f"{key:9s}", subsequent_indent=" " * 9)
    return [line.replace("\u00a0%", " %") for line in lines]


def title(name: str) -> str:
    """A law's name as it is written in a sentence."""
    return NAMES.get(name, name)


def share(x: float) -> str:
    """A relative error, rounded up to two digits: 2 %, 3e-05.

    >>> from jimpact.methods.advice_report import share
    >>> share(0.0191), share(2.01e-5), share(0.0)
    ('2 %', '2.1e-05', 'rounding')
    """
    if math.isnan(x):
        return "nan"
    if x <= _ROUNDING:
        return "rounding"
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    up = math.ceil(x / unit * (1 - _ROUNDING)) * unit
    return f"{100 * up:.3g} %" if x >= _PERCENT_FROM else f"{up:.2g}"


def as_code(law: Declared) -> str:
    """The law as one writes it: `LZB(0.9, 1, 1.5, rtol=0.001)`."""
    words, keywords = [], []
    for each in fields(law):
        value = getattr(law, each.name)
        if isinstance(value, Declared):
            words.append(as_code(value))
        elif each.name in _POSITIONAL:
            words.append(_in_code(value))
        elif each.name in _KEYWORDS and value is not None:
            if not isinstance(value, str):
                keywords.append(f"{each.name}={_in_code(value)}")
            elif value != each.default:
                keywords.append(f"{each.name}={value!r}")
    return f"{type(law).__name__}({', '.join(words + keywords)})"


def _in_code(value: Any) -> str:
    """A number, or a list of them unless all are equal."""
    array = np.asarray(value)
    if array.size and (array == array.flat[0]).all():
        return f"{array.flat[0]:.6g}"
    return f"[{', '.join(f'{x:.6g}' for x in array)}]"


def structure(advice: Advice) -> str:
    """Which contacts are coupled: one sentence a block of several, one for all others."""
    words = []
    for block in advice.at_work:
        if block.angles is None:
            continue
        low, high = block.angles
        angle = f"angle {low:.4g}" if high - low < 0.05 else f"angles {low:.4g} to {high:.4g}"
        law = f"{title(block.law)} is enough" if block.law else "no law is within tolerance"
        words.append(f"contacts {block.name} are coupled (kinetic {angle} degrees): {law}")
    groups: dict[str, list[int]] = {}
    for block in advice.blocks:
        if not block.approaches:
            what = "without an approach"
        elif len(block.contacts) == 1:
            what = f"decoupled: {title(block.law or 'no law')} is enough"
        else:
            continue
        groups.setdefault(what, []).extend(block.contacts)
    if advice.far:
        groups["too far open to close during the impact"] = list(advice.far)
    for what, contacts in groups.items():
        named = ", ".join(str(j + 1) for j in contacts)
        words.append(f"contact{'s' * (len(contacts) > 1)} {named} {what}")
    return "; ".join(words)


def effects(advice: Advice) -> str:
    """What each unknown stiffness does by itself, the strongest first."""
    words = []
    for unknown in sorted(advice.unknown, key=lambda u: -u.alone)[:_NAMED]:
        needed = f" (know it within {100 * unknown.needed:.2g} %)" if unknown.needed < 1 else ""
        words.append(f"{unknown.name} {share(unknown.alone)}{needed}")
    return f"alone they move v+ by: {', '.join(words)}"


def agreeing(advice: Advice) -> str:
    """Other laws, simpler than the reference, that are within tolerance too."""
    names = list(advice.candidates)
    simpler = names[: names.index(advice.reference)] if advice.within else []
    others = [
        title(name)
        for name in simpler
        if name != advice.name
        and advice.candidates[name].usable
        and advice.candidates[name].worst <= advice.tolerance
    ]
    return f"within {share(advice.tolerance)}: {', '.join(others)}" if others else ""


def ratios(advice: Advice) -> str:
    """The stiffness ratios this advice is about."""
    if advice.unknown:
        names = [u.name for u in advice.unknown]
        ends = {(u.low, u.high) for u in advice.unknown}
        first = advice.unknown[0]
        values = f"in [{first.low:.3g}, {first.high:.3g}]" if len(ends) == 1 else "in their ranges"
        ending = "es" if first.base is None else "s"
        kind = "stiffness" if first.base is None else "stiffness ratio"
    else:
        pairs = [(b.contacts[0], j) for b in advice.at_work for j in b.contacts[1:]]
        names = [f"k{j + 1}/k{i + 1}" for i, j in pairs]
        each = [f"{advice.stiffness[j] / advice.stiffness[i]:.3g}" for i, j in pairs[:_NAMED]]
        values = f"= {', '.join(each)}"
        kind, ending = "stiffness ratio", "s"
    more = ", ..." if len(names) > _NAMED else ""
    plural = ending if len(names) > 1 else ""
    return f"{kind}{plural} {', '.join(names[:_NAMED])}{more} {values}"


def reason(advice: Advice) -> str:
    """Why this law, in one sentence or two."""
    if not advice.at_work:
        slowest = float(advice.gap_velocity.min())
        return f"no approach: nothing happens (smallest gap velocity {slowest:.3g} m/s)"
    main = _main_reason(advice)
    closest = _closest_simpler(advice)
    return f"{main}; {closest}" if closest else main


def _main_reason(advice: Advice) -> str:
    """Why the advised law is within tolerance, or why none is."""
    name, worst = advice.name, share(advice.candidates[advice.name].worst)
    verb = f"{title(name)} is within {worst}"
    if all(len(block.contacts) == 1 for block in advice.at_work):
        return _single_contacts(advice, verb)
    if not advice.within:
        return _undecided(advice)
    if advice.gap_ratio is not None:
        return _gaps(advice, verb)
    if advice.reference == "compliant":
        return f"{_reclosing(advice)}: {verb}"
    if name == "lzb":
        if not advice.unknown:
            return f"{ratios(advice)}: no simpler law is within {share(advice.tolerance)}"
        return f"{ratios(advice)}: whatever they are, LZB at the nominal ones is within {worst}"
    if name == "newton" and not np.any(parameters_of(advice.law)["restitution"].value):
        return f"plastic contacts (restitution 0) that stay together: {verb}"
    return f"{ratios(advice)}{_no_difference(advice)}: {verb}"


def _single_contacts(advice: Advice, verb: str) -> str:
    """The reason if no two loaded contacts are coupled."""
    if len(advice.gap_velocity) == 1:
        words = "single contact"
    elif len(advice.at_work) == 1:
        words = f"only contact {advice.at_work[0].name} takes part: a single contact"
    else:
        words = "contacts decoupled: kinetic angle 90 degrees"
    if _has_friction(advice):
        return f"{words}, with friction: {verb}"
    if len(advice.gap_velocity) == 1:
        return f"{words}: every law is Newton's"
    if advice.name == "newton":
        return f"{words}, all laws agree"
    return f"{words}; {title(advice.name)} leaves separating contacts alone"


def _has_friction(advice: Advice) -> bool:
    """Whether the laws have friction."""
    friction = parameters_of(advice.law).get("friction")
    return friction is not None and friction.value is not None


def _reclosing(advice: Advice) -> str:
    """Why Compliant is the reference although no contact has a gap."""
    return (
        "contacts open and close again: LZB lets them close at once, Compliant when the gap is "
        f"closed, and they are up to {share(advice.reclosing)} apart"
    )


def _no_difference(advice: Advice) -> str:
    """Where unknown ratios make no difference, and where angles above 90 degrees explain it."""
    if not advice.unknown or max(u.alone for u in advice.unknown) > _NO_CHANGE:
        return ""
    widest = max(b.angles[1] for b in advice.at_work if b.angles is not None)
    words = " makes no difference" if len(advice.unknown) == 1 else " make no difference"
    if widest > 90 + _NO_CHANGE and not _has_friction(advice):
        words += f" (kinetic angle {widest:.4g} degrees: pushing one contact opens the other)"
    return words


def _gaps(advice: Advice, verb: str) -> str:
    """Where gaps matter: how wide they are, and what that allows."""
    assert advice.gap_ratio is not None
    low, high = float(np.min(advice.gap_ratio)), float(np.max(advice.gap_ratio))
    both = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
    if advice.name == "binary" and low > WIDE:
        return f"gaps exceed {WIDE:g} delta_c (they are {both} delta_c): {verb}"
    if advice.name == "compliant":
        return f"gaps of {both} delta_c decide the outcome: only contacts with real gaps follow"
    if high < NEARLY_TOUCHING:
        return f"gaps below {NEARLY_TOUCHING:g} delta_c ({both}) are much as if touching: {verb}"
    return f"gaps of {both} delta_c: {verb}"


def _undecided(advice: Advice) -> str:
    """Nothing is within tolerance, because the stiffnesses are not known."""
    moved, bound = share(advice.candidates[advice.name].worst), share(advice.tolerance)
    most, several = max(advice.unknown, key=lambda u: u.alone), len(advice.unknown) > 1
    decide, they_move = ("decide", "they move") if several else ("decides", "it moves")
    words = (
        f"{ratios(advice)} {decide}: no law is within {bound}, because {they_move} v+ by up to "
        f"{moved}"
    )
    if several:
        return f"{words}; measure {most.name} first (alone {share(most.alone)})"
    if most.needed < 1:
        words += f"; it would have to be known within {100 * most.needed:.2g} %"
    return words


def _closest_simpler(advice: Advice) -> str:
    """How far off the best of the simpler laws is, or what it violates."""
    names = list(advice.candidates)
    simpler = {name: advice.candidates[name] for name in names[: names.index(advice.name)]}
    if not simpler:
        return ""
    best = min(simpler, key=lambda name: (not simpler[name].usable, simpler[name].worst))
    if not simpler[best].usable:
        return f"{title(best)} fails: {simpler[best].status}"
    error = share(simpler[best].worst)
    return f"of the simpler laws {title(best)} comes closest and is off by {error}"
