"""What `advise` found, in words with the numbers of the scene: half a page."""

import math
import textwrap
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from jimpact.files.records import as_data, fields_as_data, number, table
from jimpact.law import Law
from jimpact.laws import REGISTRY
from jimpact.laws.binary import Binary
from jimpact.laws.compliant import Compliant
from jimpact.laws.kinematic import Newton
from jimpact.laws.lzb import LZB
from jimpact.montecarlo.gaps import NEARLY_TOUCHING, WIDE
from jimpact.scene import Scene
from jimpact.status import CODE, STATUS

_WIDTH = 80  # of the printed lines
_BODIES = 5  # in the printed table

_TOLD = 4  # stiffness ratios named one by one
_PERCENT_FROM = 1e-4
_ROUNDING = 1e-12
_NONE = 1e-6  # a change of v+ below, relative to max |v-|, is told as none
_PARAMETERS = ("restitution", "stiffness", "exponent")  # that an advice tells
NAMES = {name: row.law.__name__ for name, row in REGISTRY.items()} | {"binary": "binary"}


class Block(NamedTuple):
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

    What it does to v+ by itself, relative to max |v-|: `alone`: largest change over its range;
    `slope`: |d v+ / d ln k|; `needed`: relative accuracy of k at which it moves v+ by the
    tolerance (inf: it does not).
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
    and `worst` error of v+ against the reference over them, relative to max |v-|; `cost` per
    impact in a batch, in units of the cheapest law's (None: not timed).
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
class Advice:
    """What `advise` found; `ji.impact(advice.law, advice.scene, advice.velocity)` applies it.

    Attributes:
        name: of the simplest law; `reason` says why, in words.
        tolerance: as asked for.
        within: whether that law keeps it.
        reference: name of the law that all are compared with.
        velocity: v- (n,) [m/s].
        gap_velocity: gamma- (m,) [m/s].
        candidates: the evidence by law, from the simplest to the reference.
        blocks: contacts that feel each other.
        stiffness: nominal ones (m,).
        unknown: the stiffnesses that are not known and what they do.
        rows: how many stiffnesses were tried.
        gap_ratio: gaps at work in units of delta_c (m,), or None.
    """

    name: str
    tolerance: float
    within: bool
    reference: str
    velocity: np.ndarray
    gap_velocity: np.ndarray
    candidates: dict[str, Candidate]
    blocks: tuple[Block, ...]
    stiffness: np.ndarray
    unknown: tuple[Unknown, ...]
    rows: int
    gap_ratio: np.ndarray | None

    @property
    def law(self) -> Law:
        """The law to use."""
        return self.candidates[self.name].law

    @property
    def scene(self) -> Scene:
        """The scene to use it on: contacts taken as closed or not."""
        return self.candidates[self.name].scene

    @property
    def at_work(self) -> list[Block]:
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
        parts = {"laws": laws, "blocks": blocks, "unknown": unknown}
        return words | fields_as_data(self, "name", "candidates", *parts) | parts

    def __str__(self) -> str:
        verdict = "within" if self.within else "NOT within"
        lines = [
            f"Advice: {as_code(self.law)}, {verdict} {share(self.tolerance)}",
            *_wrapped("because", self.reason),
            *_wrapped("scene", structure(self)),
        ]
        if len(self.unknown) > 1:
            lines += _wrapped("unknown", f"{ratios(self)}; {effects(self)}")
        if also := agreeing(self):
            lines += _wrapped("also", also)
        return "\n".join([*lines, "", *self._table(), "", self._footnote()])

    def _table(self) -> list[str]:
        shown = min(len(self.velocity), _BODIES)
        heads = ["law", "median", "worst", "cost", *(f"v{i + 1}+" for i in range(shown)), "status"]
        rows = []
        for name, c in self.candidates.items():
            v = [f"{x:.4f}" for x in c.velocity[:shown]]
            cost = number(c.cost, ".1f" if (c.cost or 0) < 10 else ".0f")
            mark = "*" if name == self.name else " "
            rows.append([mark + name, share(c.median), share(c.worst), cost, *v, c.status])
        return table(heads, rows, left=["status"])

    def _footnote(self) -> str:
        over = f"; median and worst over {self.rows} stiffnesses" if self.rows > 1 else ""
        timed = all(c.cost is not None for c in self.candidates.values())
        cost = "; cost of an impact in a batch, cheapest = 1" if timed else ""
        words = f"Error of v+ against {title(self.reference)}, relative to max |v-|{over}{cost}."
        return textwrap.fill(words, _WIDTH)


def _wrapped(key: str, text: str) -> list[str]:
    """Lines behind a key word; a number keeps its unit."""
    whole = f"{text}.".replace(" %", "\u00a0%")
    lines = textwrap.wrap(whole, _WIDTH, initial_indent=f"{key:9s}", subsequent_indent=" " * 9)
    return [line.replace("\u00a0%", " %") for line in lines]


def title(name: str) -> str:
    """A law's name as it is written in a sentence."""
    return NAMES.get(name, name)


def share(x: float) -> str:
    """A part of max |v-|, rounded up to two digits: 2 %, 3e-05.

    >>> from jimpact.methods.advice_report import share
    >>> share(0.0191), share(2.01e-5), share(0.0)
    ('2 %', '2.1e-05', 'rounding')
    """
    if not x > _ROUNDING:
        return "rounding" if x <= _ROUNDING else "nan"
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    up = math.ceil(x / unit * (1 - _ROUNDING)) * unit
    return f"{100 * up:.3g} %" if x >= _PERCENT_FROM else f"{up:.2g}"


def as_code(law: Law) -> str:
    """The law as one writes it: `LZB(0.9, 1, 1.5, rtol=0.001)`."""

    def value(x: object) -> str:
        array = np.asarray(x)
        if array.size and (array == array.flat[0]).all():
            return f"{array.flat[0]:.6g}"
        return f"[{', '.join(f'{z:.6g}' for z in array)}]"

    holder = law.force if isinstance(law, Compliant) else law
    names = [field.name for field in fields(holder) if field.name in _PARAMETERS]
    words = [value(getattr(holder, name)) for name in names]
    if holder is not law:
        words = [f"{type(holder).__name__}({', '.join(words)})"]
    if isinstance(law, Binary) and law.order != "fastest":
        words.append(repr(law.order))
    if isinstance(law, LZB | Compliant) and law.rtol is not None:
        words.append(f"rtol={law.rtol:g}")
    return f"{type(law).__name__}({', '.join(words)})"


def structure(found: Advice) -> str:
    """Which contacts are coupled: one sentence a block of several, one for all others."""
    words = []
    for block in found.at_work:
        if block.angles is None:
            continue
        low, high = block.angles
        angle = f"angle {low:.4g}" if high - low < 0.05 else f"angles {low:.4g} to {high:.4g}"
        law = f"{title(block.law)} is enough" if block.law else "no law is within tolerance"
        words.append(f"contacts {block.name} are coupled (kinetic {angle} degrees): {law}")
    groups: dict[str, list[int]] = {}
    for block in found.blocks:
        if not block.approaches:
            what = "without an approach"
        elif len(block.contacts) == 1:
            what = f"decoupled: {title(block.law or 'no law')} is enough"
        else:
            continue
        groups.setdefault(what, []).extend(j + 1 for j in block.contacts)
    for what, contacts in groups.items():
        named = ", ".join(str(j) for j in contacts)
        words.append(f"contact{'s' * (len(contacts) > 1)} {named} {what}")
    return "; ".join(words)


def effects(found: Advice) -> str:
    """What each unknown stiffness does by itself, the strongest first."""
    strongest = sorted(found.unknown, key=lambda u: -u.alone)[:_TOLD]
    words = [
        f"{e.name} {share(e.alone)}"
        + (f" (know it within {100 * e.needed:.2g} %)" if e.needed < 1 else "")
        for e in strongest
    ]
    return f"alone they move v+ by: {', '.join(words)}"


def agreeing(found: Advice) -> str:
    """Other laws, not more complex than the reference, that keep the tolerance too."""
    others = [
        title(name)
        for name, c in found.candidates.items()
        if name not in (found.name, found.reference)
        and c.usable
        and c.worst <= found.tolerance
        and found.within
    ]
    return f"within {share(found.tolerance)}: {', '.join(others)}" if others else ""


def ratios(found: Advice) -> str:
    """The stiffness ratios this advice is about."""
    if found.unknown:
        names = [u.name for u in found.unknown[:_TOLD]]
        more = ", ..." if len(found.unknown) > _TOLD else ""
        ends = {(u.low, u.high) for u in found.unknown}
        first = found.unknown[0]
        where = f"in [{first.low:.3g}, {first.high:.3g}]" if len(ends) == 1 else "in their ranges"
        many = len(found.unknown) > 1
        kind = "stiffness" + (" ratio" + "s" * many if first.base is not None else "es" * many)
        return f"{kind} {', '.join(names)}{more} {where}"
    pairs = [(b.contacts[0], j) for b in found.at_work for j in b.contacts[1:]]
    names = [f"k{j + 1}/k{i + 1}" for i, j in pairs[:_TOLD]]
    values = [f"{found.stiffness[j] / found.stiffness[i]:.3g}" for i, j in pairs[:_TOLD]]
    more = ", ..." if len(pairs) > _TOLD else ""
    return f"stiffness ratio{'s' * (len(pairs) > 1)} {', '.join(names)} = {', '.join(values)}{more}"


def reason(found: Advice) -> str:
    """Why this law, in one sentence or two."""
    if not found.at_work:
        slowest = float(found.gap_velocity.min())
        return f"no approach: nothing happens (smallest gap velocity {slowest:.3g} m/s)"
    head = _head(found)
    closest = _closest_simpler(found)
    return f"{head}; {closest}" if closest else head


def _head(found: Advice) -> str:
    name, worst = found.name, share(found.candidates[found.name].worst)
    if all(len(block.contacts) == 1 for block in found.at_work):
        if len(found.gap_velocity) == 1:
            return "single contact: every law is Newton's"
        if len(found.at_work) == 1:
            only = f"only contact {found.at_work[0].name} takes part: a single contact"
        else:
            only = "contacts decoupled: kinetic angle 90 degrees"
        if name == "newton":
            return f"{only}, all laws agree"
        return f"{only}; {title(name)} leaves separating contacts alone"
    if not found.within:
        return _undecided(found)
    if found.reference == "compliant":
        return _gaps(found, worst)
    if name == "lzb":
        if not found.unknown:
            return f"{ratios(found)}: no simpler law is within {share(found.tolerance)}"
        return f"{ratios(found)}: whatever they are, LZB at the nominal ones is within {worst}"
    if isinstance(found.law, Newton) and not np.asarray(found.law.restitution).any():
        return f"plastic contacts (restitution 0) that stay together: Newton is within {worst}"
    return f"{ratios(found)}{_idle(found)}: {title(name)} is within {worst}"


def _idle(found: Advice) -> str:
    """Where unknown ratios make no difference, and where angles above 90 degrees explain it."""
    if not found.unknown or max(u.alone for u in found.unknown) > _NONE:
        return ""
    wide = [b.angles[1] for b in found.at_work if b.angles is not None]
    why = ""
    if max(wide) > 90 + _NONE:
        why = f" (kinetic angle {max(wide):.4g} degrees: pushing one contact opens the other)"
    return f" make{'s' * (len(found.unknown) == 1)} no difference{why}"


def _gaps(found: Advice, worst: str) -> str:
    """Where gaps matter: how wide they are, and what that allows."""
    assert found.gap_ratio is not None
    low, high = (float(f(found.gap_ratio)) for f in (np.min, np.max))
    both = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
    verb = f"{title(found.name)} is within {worst}"
    if found.name == "binary" and low > WIDE:
        return f"gaps exceed {WIDE:g} delta_c (they are {both} delta_c): {verb}"
    if found.name == "compliant":
        return f"gaps of {both} delta_c decide the outcome: only contacts with real gaps follow"
    if high < NEARLY_TOUCHING:
        return f"gaps below {NEARLY_TOUCHING:g} delta_c ({both}) are much as if touching: {verb}"
    return f"gaps of {both} delta_c: {verb}"


def _undecided(found: Advice) -> str:
    """Nothing is within tolerance, because the stiffnesses are not known."""
    moved, bound = share(found.candidates[found.name].worst), share(found.tolerance)
    many = len(found.unknown) > 1
    words = (
        f"{ratios(found)} decide{'' if many else 's'}: no law is within {bound}, because "
        f"{'they move' if many else 'it moves'} v+ by up to {moved}"
    )
    most = max(found.unknown, key=lambda u: u.alone)
    if many:
        return f"{words}; measure {most.name} first (alone {share(most.alone)})"
    if most.needed < 1:
        return f"{words}; it would have to be known within {100 * most.needed:.2g} %"
    return words


def _closest_simpler(found: Advice) -> str:
    """How far off the best of the simpler laws is, or what it breaks."""
    names = list(found.candidates)
    simpler = names[: names.index(found.name)]
    if not simpler:
        return ""
    best = min(simpler, key=lambda n: (not found.candidates[n].usable, found.candidates[n].worst))
    other = found.candidates[best]
    if not other.usable:
        return f"{title(best)} fails: {other.status}"
    return f"of the simpler laws {title(best)} comes closest and is off by {share(other.worst)}"
