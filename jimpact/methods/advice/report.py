"""The advice: findings that print as half a page."""

import math
import textwrap
from typing import Any

from jimpact.methods.advice.findings import Findings
from jimpact.methods.advice.words import (
    agreeing,
    as_code,
    effects,
    ratios,
    reason,
    share,
    structure,
    title,
)

_WIDTH = 92  # of the printed lines
_BODIES = 5  # in the printed table


class Advice(Findings):
    """What `advise` found; `ji.impact(advice.law, advice.scene, advice.velocity)` applies it.

    `within`: the law keeps the tolerance; `reason` in words; `candidates[name]` the evidence, from
    the simplest law to the `reference`; `unknown` and `effects` of the stiffnesses not known.
    """

    @property
    def reason(self) -> str:
        """Why this law, with numbers of this scene."""
        return reason(self)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it; contacts counted from 1."""
        laws = {
            name: {
                "law": as_code(c.law),
                "velocity": c.velocity.tolist(),
                "low": c.low.tolist(),
                "high": c.high.tolist(),
                "median_error": c.median,
                "worst_error": c.worst,
                "status": c.status,
                "usable": c.usable,
                "cost": c.cost,
            }
            for name, c in self.candidates.items()
        }
        return {
            "advice": self.name,
            "law": as_code(self.law),
            "within": self.within,
            "tolerance": self.tolerance,
            "reason": self.reason,
            "reference": self.reference,
            "laws": laws,
            "blocks": [
                {
                    "contacts": [j + 1 for j in block.contacts],
                    "approaches": block.approaches,
                    "kinetic_angles_deg": block.angles,
                    "law": block.law,
                }
                for block in self.blocks
            ],
            "unknown": [
                {"name": u.name, "nominal": u.nominal, "low": u.low, "high": u.high}
                | {"alone": e.alone, "slope": e.slope}
                | {"needed": e.needed if math.isfinite(e.needed) else None}
                for u, e in zip(self.unknown, self.effects)
            ],
            "rows": self.rows,
            "gaps_in_delta_c": None if self.gap_ratio is None else self.gap_ratio.tolist(),
        }

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
        title_v = "v+" if shown == len(self.velocity) else f"v+ (first {shown})"
        head = f" {'law':10s}{'median':>9s}{'worst':>9s}{'cost':>7s}"
        lines = [f"{head}  {title_v:>8s}{'':{9 * shown - 8}s}  status"]
        for name, c in self.candidates.items():
            v = "".join(f"{x:9.4f}" for x in c.velocity[:shown])
            cost = "" if c.cost is None else f"{c.cost:.{0 if c.cost >= 10 else 1}f}"
            mark = "*" if name == self.name else " "
            error = f"{share(c.median):>9s}{share(c.worst):>9s}"
            lines.append(f"{mark}{name:10s}{error}{cost:>7s} {v}  {c.status}")
        return lines

    def _footnote(self) -> str:
        over = f"; median and worst over {self.rows} stiffnesses" if self.rows > 1 else ""
        timed = all(c.cost is not None for c in self.candidates.values())
        cost = "; cost of an impact in a batch, cheapest = 1" if timed else ""
        told = f"Error of v+ against {title(self.reference)}, relative to max |v-|{over}{cost}."
        return textwrap.fill(told, _WIDTH)


def _wrapped(key: str, text: str) -> list[str]:
    """Lines behind a key word; a number keeps its unit."""
    whole = f"{text}.".replace(" %", "\u00a0%")
    lines = textwrap.wrap(whole, _WIDTH, initial_indent=f"{key:9s}", subsequent_indent=" " * 9)
    return [line.replace("\u00a0%", " %") for line in lines]
