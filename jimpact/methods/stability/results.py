"""What `stability_map` returns, and its report in words."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jimpact.methods.stability.causes import CAUSES
from jimpact.methods.stability.references import CONFIRMED, REFERENCE_RTOL, Confirmation
from jimpact.methods.stability.runs import CLASSES, FIXED_STEP_RIGHT, HONEST


class Slice(NamedTuple):
    """Classes and errors over one axis (K,) or two (K1, K2); index of CLASSES, of CAUSES."""

    axes: tuple[str, ...]
    codes: np.ndarray
    error: np.ndarray
    cause: np.ndarray


@dataclass(frozen=True, eq=False)
class StabilityMap:
    """What `stability_map` found; `print` gives shares and causes.

    Attributes:
        methods: the names.
        axes, base: values along every axis; the base point of the slices.
        slices: by method, first those over one axis, then pairs.
        samples: Latin-hypercube points (S, 6), columns `jimpact.methods.stability.points.AXES`.
        sampled: by method, a `Slice` over the samples.
        confirmation: of the reference, by an integrator that shares no code with it.
        max_steps: of every run.
    """

    methods: tuple[str, ...]
    axes: dict[str, np.ndarray]
    base: dict[str, float]
    slices: dict[str, tuple[Slice, ...]]
    samples: np.ndarray
    sampled: dict[str, Slice]
    confirmation: Confirmation
    max_steps: int

    def counts(self, method: str) -> dict[str, int]:
        """Points of each class, over all slices and samples."""
        codes = np.concatenate([s.codes.ravel() for s in self._of(method)])
        return dict(zip(CLASSES, np.bincount(codes, minlength=len(CLASSES)).tolist()))

    def silent(self, method: str) -> int:
        """Points that are not right without a word: wrong or stalled."""
        found = self.counts(method)
        return found["wrong"] + found["stalls"]

    def causes(self, method: str) -> dict[str, int]:
        """Points that are not right, by cause."""
        found = np.concatenate([s.cause.ravel() for s in self._of(method)])
        counts = np.bincount(found[found >= 0], minlength=len(CAUSES)).tolist()
        return {cause.name: count for cause, count in zip(CAUSES, counts) if count}

    def _of(self, method: str) -> tuple[Slice, ...]:
        return (*self.slices[method], self.sampled[method])

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it."""

        def told(found: Slice) -> dict[str, Any]:
            error = np.where(np.isfinite(found.error), found.error, -1.0)  # JSON has no NaN
            return {
                "axes": list(found.axes),
                "codes": found.codes.tolist(),
                "error": error.tolist(),
                "cause": found.cause.tolist(),
            }

        return {
            "classes": list(CLASSES),
            "causes": [cause.name for cause in CAUSES],
            "axes": {name: values.tolist() for name, values in self.axes.items()},
            "base": self.base,
            "max_steps": self.max_steps,
            "confirmation": self.confirmation._asdict(),
            "samples": self.samples.tolist(),
            "methods": {
                name: {
                    "counts": self.counts(name),
                    "causes": self.causes(name),
                    "slices": [told(each) for each in self.slices[name]],
                    "sampled": told(self.sampled[name]),
                }
                for name in self.methods
            },
        }

    def __str__(self) -> str:
        base = ", ".join(f"{name.replace('_', ' ')} {x:g}" for name, x in self.base.items())
        found = self.confirmation
        lines = [
            f"base: {base}; at most {self.max_steps:,} steps",
            f"reference: {found.points} points at rtol {REFERENCE_RTOL:g}; of {found.tried} "
            f"solved by scipy, too, {found.confirmed} agree to {CONFIRMED:g} (largest "
            f"difference {found.difference:.1g})",
            f"right: error in v+ within {HONEST:g} rtol, or {FIXED_STEP_RIGHT:g} for fixed steps, "
            "of the largest |v-|",
            "",
            f"{'points':14s}" + "".join(f"{name:>15s}" for name in CLASSES),
        ]
        for name in self.methods:
            row = "".join(f"{count or '':>15}" for count in self.counts(name).values())
            lines.append(f"{name:14s}{row}")
        lines += ["", "causes where not right"]
        for name in self.methods:
            for cause, count in self.causes(name).items():
                lines.append(f"{name:14s}{count:6d}  {cause}")
        return "\n".join(lines)
