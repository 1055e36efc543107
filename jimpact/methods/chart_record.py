"""What `work_precision` found: points of error against time and work, as table and JSON."""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

QUANTITIES = ("velocity", "impulse", "energy", "duration", "gradient")


class Timing(NamedTuple):
    """Median and quartiles of the time per impact [s]."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Point:
    """A method at one of its settings, or a law (`setting` None).

    `error[quantity]` is relative, the largest over the sample (of a law: its model error); NaN
    where there is none. `evaluations`: mean number of field evaluations an impact, NaN where there
    are none or nothing counts them. Times are None where there are none. `status`: the gravest.
    """

    name: str
    label: str
    setting: float | None
    error: dict[str, float]
    evaluations: float
    single: Timing
    batched: Timing
    gradient: Timing | None
    status: str


@dataclass(frozen=True)
class Reference:
    """Where the errors are measured from: how it came about, how uncertain it is (relative)."""

    how: str
    uncertainty: dict[str, float]
    velocity: np.ndarray
    impulse: np.ndarray
    duration: float


@dataclass(frozen=True)
class WorkPrecision:
    """Error against time and work; `print` gives a table, `ji.plot.work_precision` a picture.

    `points[name]` from coarse to fine; `compile_time[name]` [s] by program ('single', 'batched',
    'gradient'), traced and compiled; `left_out[name]`: why a method is missing.
    """

    velocity: np.ndarray
    points: dict[str, tuple[Point, ...]]
    reference: Reference
    compile_time: dict[str, dict[str, float]]
    left_out: dict[str, str]
    batch: int
    sample: int
    spread: float
    repeats: int
    without_gradient: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it (NaN: null)."""
        reference = {
            "how": self.reference.how,
            "uncertainty": _json_ready(self.reference.uncertainty),
            "velocity": self.reference.velocity.tolist(),
            "impulse": self.reference.impulse.tolist(),
            "duration_s": _number(self.reference.duration),
        }
        return {
            "velocity": self.velocity.tolist(),
            "reference": reference,
            "points": {n: [_point(p) for p in row] for n, row in self.points.items()},
            "compile_time_s": self.compile_time,
            "left_out": self.left_out,
            "without_gradient": self.without_gradient,
            "batch": self.batch,
            "sample": self.sample,
            "spread": self.spread,
            "repeats": self.repeats,
        }

    def __str__(self) -> str:
        heads = ("dv", "dp", "dT", "d time", "dJ", "evals", "us single", "us batch", "us with J")
        head = f"{'method':16s}{'setting':>9s}" + "".join(f"{h:>10s}" for h in heads)
        lines = [head + "  status"]
        for row in self.points.values():
            lines += [_line(point) for point in row]
        uncertain = ", ".join(f"{k} {v:.0e}" for k, v in self.reference.uncertainty.items())
        lines += [f"reference: {self.reference.how}; uncertain by {uncertain}"]
        lines += [
            f"errors relative, largest of {self.sample} impacts with stiffness spread over a "
            f"factor {self.spread:g}; medians of {self.repeats}, batch of {self.batch}"
        ]
        lines += [f"left out: {name}: {why}" for name, why in self.left_out.items()]
        lines += [f"no gradient: {name}: {why}" for name, why in self.without_gradient.items()]
        return "\n".join(lines)


def _line(point: Point) -> str:
    setting = "law" if point.setting is None else f"{point.setting:.0e}"
    errors = "".join(f"{_short(point.error[q], '.1e'):>10s}" for q in QUANTITIES)
    times = "".join(
        f"{'' if t is None else _short(1e6 * t.median, '.4g'):>10s}"
        for t in (point.single, point.batched, point.gradient)
    )
    evaluations = _short(point.evaluations, ".0f")
    return f"{point.name:16s}{setting:>9s}{errors}{evaluations:>10s}{times}  {point.status}"


def _short(value: float, form: str) -> str:
    return "" if math.isnan(value) else format(value, form)


def _number(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def _json_ready(values: dict[str, float]) -> dict[str, float | None]:
    return {key: _number(value) for key, value in values.items()}


def _point(point: Point) -> dict[str, Any]:
    def time_us(timing: Timing | None) -> dict[str, float] | None:
        return None if timing is None else {k: 1e6 * v for k, v in timing._asdict().items()}

    return {
        "setting": point.setting,
        "error": _json_ready(point.error),
        "evaluations": _number(point.evaluations),
        "single_us": time_us(point.single),
        "batched_us": time_us(point.batched),
        "gradient_us": time_us(point.gradient),
        "status": point.status,
    }
