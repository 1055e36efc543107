"""No more model than a scene needs: the simplest law within a tolerance, and why."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from jimpact._checks import as_whole, check_per_contact, check_shape, check_values
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.laws.compliant import Compliant
from jimpact.laws.lzb import LZB, default_rtol
from jimpact.methods.advice_evidence import (
    NUDGE,
    Block,
    Candidate,
    Outcomes,
    Rows,
    Situation,
    Trial,
    Unknown,
    block_errors,
    candidate,
    costs,
    outcomes,
    rows,
    situation,
    trials,
    unknowns,
)
from jimpact.methods.advice_report import Advice
from jimpact.montecarlo.gaps import gap_scale
from jimpact.scene import Scene, as_velocity
from jimpact.status import STATUS

FINEST_TOLERANCE = 100  # times the reference's own tolerance
RTOL_PART = 10  # the advised rtol is this part of the tolerance, or a little less
COARSEST_RTOL = 1e-3

UNKNOWN_RANGE = (0.1, 10.0)  # plausible ratio of two stiffnesses where nothing is said


def advise(
    scene: Scene,
    velocity: Any,
    tolerance: float = 1e-2,
    *,
    law: LZB | None = None,
    restitution: Any = None,
    stiffness: Any = None,
    exponent: Any = None,
    stiffness_range: tuple[float, float] | None = None,
    samples: int = 128,
    seed: int = 0,
    timing: bool = True,
    progress: bool | None = None,
) -> Advice:
    """The simplest law whose v+ is within a tolerance of LZB on this scene, with the evidence.

    Every law is compared with LZB over the stiffness ratios that are not known: one at a time, at
    the corners of their ranges, and log-uniformly. Where open contacts can meet others at work
    the reference is `Compliant` with these gaps, and the absolute stiffness must be given.

    Args:
        scene: n coordinates, m contacts. Friction is left out.
        velocity: v- (n,) [m/s].
        tolerance: of v+, relative to max |v-|; at least 100 times the reference's own 1e-8.
        law: an `LZB` with all parameters, in place of the next three.
        restitution: e in [0, 1], scalar or (m,); default 1.
        stiffness: k > 0, scalar or (m,) [N / m^eta]; None: only their ratio's range is known.
        exponent: eta >= 1, as in `LZB`; default 1.5.
        stiffness_range: low and high factor on every stiffness ratio (k_j over that of the first
            contact of its block; on every k_j where not only ratios count); default: (0.1, 10)
            where no stiffness is given, else (1, 1).
        samples: number of log-uniform samples; seed: of them.
        timing: measure the cost of every law (some seconds of compilation).
        progress: bar on stderr; None: on a terminal, for long runs.

    Returns:
        `Advice`; `print` gives half a page.

    Raises:
        ValueError: shapes or ranges; gaps that matter, or unequal exponents, without stiffness.
        RuntimeError: the reference fails on this scene.

    Source: the kind of Brogliato, Nonsmooth Mechanics (2016), section 6.3.3.

    >>> import jimpact as ji
    >>> found = ji.advise(ji.chain([1.0, 1.0]), [1.0, 0.0], restitution=0.9, timing=False)
    >>> found.name, found.reason
    ('newton', "single contact: every law is Newton's")
    """
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    parameters, known = parameters_of(scene, law, restitution, stiffness, exponent)
    span = span_of(stiffness_range, known)
    rtol = default_rtol("time", v.dtype)
    check_tolerance(tolerance, FINEST_TOLERANCE * rtol)
    as_whole("samples", samples, 1)
    as_whole("seed", seed, 0)
    at = situation(scene, np.asarray(v))
    mixed = len(np.unique(np.asarray(parameters["exponent"], float))) > 1
    absolute = bool(at.gapped.any()) or (mixed and bool(at.coupled))
    if absolute and not known:
        raise ValueError(missing_stiffness(at))
    k = np.broadcast_to(np.asarray(parameters["stiffness"], v.dtype), (scene.contacts,))
    laws = trials(at, parameters["restitution"], k, parameters["exponent"])
    tried = rows(k, unknowns(at, k, span, absolute), samples, seed)
    return _found(at, laws, tried, float(tolerance), timing, progress)


def _found(
    at: Situation,
    laws: dict[str, Trial],
    tried: Rows,
    tolerance: float,
    timing: bool,
    progress: bool | None,
) -> Advice:
    name = list(laws)[-1]
    own = {key: outcomes(law, at, tried.stiffness, progress) for key, law in laws.items()}
    reference = _usable_rows(own[name], name)
    evidence = {
        key: candidate(law, at, own[key], reference, tried.random) for key, law in laws.items()
    }
    if timing:
        for key, cost in costs(laws, at, tried.stiffness).items():
            evidence[key] = replace(evidence[key], cost=cost)
    fit = [key for key, c in evidence.items() if c.usable and c.worst <= tolerance]
    chosen = fit[0] if fit else name
    if laws[chosen].knows_stiffness:
        evidence[chosen] = _loosened(evidence[chosen], at, reference, tolerance)
    gap_ratio = None
    if at.gapped.any():
        scale = gap_scale(at.scene, laws["compliant"].law, at.velocity)
        gap_ratio = np.asarray(scale.ratio)[at.gapped]
    return Advice(
        name=chosen,
        tolerance=tolerance,
        within=bool(fit),
        reference=name,
        velocity=at.velocity,
        gap_velocity=at.gap_velocity,
        candidates=evidence,
        blocks=_blocks(at, evidence, own, reference, tolerance),
        stiffness=tried.stiffness[0],
        unknown=_effects(at, tried, reference, tolerance),
        rows=len(tried.stiffness),
        gap_ratio=gap_ratio,
    )


def _loosened(found: Candidate, at: Situation, reference: Outcomes, tolerance: float) -> Candidate:
    """The law with an rtol for this tolerance, tightened until its own error is small beside it."""
    rtol = min(10.0 ** math.floor(math.log10(tolerance / RTOL_PART)), COARSEST_RTOL)
    exact, best = reference.velocity[0], default_rtol("time", at.velocity.dtype)
    while True:
        rtol = max(rtol, best)
        law = _with_rtol(found.law, rtol)
        own = np.asarray(impact(law, found.scene, at.velocity).velocity)
        error = float(np.abs(own - exact).max()) / at.scale
        if rtol == best or error <= tolerance / RTOL_PART:
            return replace(found, law=law, worst=max(found.worst, error))
        rtol /= 10


def _with_rtol(law: Law, rtol: float) -> Law:
    if isinstance(law, Compliant):
        return Compliant(law.force, rtol=rtol)
    assert isinstance(law, LZB)
    return LZB(law.restitution, law.stiffness, law.exponent, rtol=rtol)


def _usable_rows(reference: Outcomes, name: str) -> Outcomes:
    """The reference with NaN where it failed; at the nominal stiffness it must not."""
    failed = np.array([STATUS[int(code)].failure for code in reference.status])
    if failed[0]:
        raise RuntimeError(
            f"The reference law {name} fails on this scene: "
            f"{STATUS[int(reference.status[0])].message}."
        )
    lost = failed[:, None]
    return Outcomes(
        np.where(lost, np.nan, reference.velocity),
        np.where(lost, np.nan, reference.impulse),
        reference.status,
    )


def _blocks(
    at: Situation,
    evidence: dict[str, Candidate],
    own: dict[str, Outcomes],
    reference: Outcomes,
    tolerance: float,
) -> tuple[Block, ...]:
    """The blocks, each with the simplest law that is within tolerance there."""
    errors = {
        name: block_errors(at, outcome, reference)
        for name, outcome in own.items()
        if evidence[name].status != "order_dependent"
    }

    def simplest(i: int) -> str | None:
        return next((name for name, error in errors.items() if error[i] <= tolerance), None)

    return tuple(
        block._replace(law=simplest(i)) if block.approaches else block
        for i, block in enumerate(at.blocks)
    )


def _effects(
    at: Situation, tried: Rows, reference: Outcomes, tolerance: float
) -> tuple[Unknown, ...]:
    """The unknown stiffnesses with what each does by itself."""
    v, found = reference.velocity, []
    for i, unknown in enumerate(tried.unknown):
        alone = float(np.nanmax(np.abs(v[tried.alone[i]] - v[0]))) / at.scale
        up, down = v[tried.nudged[i]]
        slope = float(np.abs(up - down).max()) / (2 * NUDGE) / at.scale
        needed = tolerance / slope if slope > 0 else math.inf
        found.append(unknown._replace(alone=alone, slope=slope, needed=needed))
    return tuple(found)


def parameters_of(
    scene: Scene, law: LZB | None, restitution: Any, stiffness: Any, exponent: Any
) -> tuple[dict[str, Any], bool]:
    """Restitution, stiffness and exponent, and whether the stiffness is known."""
    given = {"restitution": restitution, "stiffness": stiffness, "exponent": exponent}
    if law is not None:
        if not isinstance(law, LZB):
            raise TypeError(f"Argument `law` must be an LZB, but is {law!r}.")
        double = [name for name, value in given.items() if value is not None]
        if double:
            raise ValueError(
                f"Argument `{double[0]}` must be None where `law` is given, "
                f"but has value {given[double[0]]!r}."
            )
        if np.asarray(law.initial_energy).any():
            raise ValueError(
                "Argument `law` must have no initial_energy (no simpler law knows of "
                f"precompression), but has {law.initial_energy}."
            )
        given = {name: getattr(law, name) for name in given}
    known = given["stiffness"] is not None
    defaults = {"restitution": 1.0, "stiffness": 1.0, "exponent": 1.5}
    values = {key: defaults[key] if value is None else value for key, value in given.items()}
    for key, value in values.items():
        check_per_contact(key, value, scene.contacts)
    return values, known


def span_of(given: tuple[float, float] | None, known: bool) -> tuple[float, float]:
    """The range of a stiffness ratio, as factors."""
    if given is None:
        return (1.0, 1.0) if known else UNKNOWN_RANGE
    ends = np.asarray(given)
    check_shape("stiffness_range", ends, (2,), "low and high factor")
    check_values("stiffness_range", ends, low=0.0, open_low=True)
    low, high = float(ends[0]), float(ends[1])
    if low > high:
        raise ValueError(
            f"Argument `stiffness_range` must have low <= high, but has value ({low:g}, {high:g})."
        )
    return low, high


def check_tolerance(tolerance: Any, finest: float) -> None:
    """A number between what the reference can resolve and 1."""
    check_shape("tolerance", tolerance, (), "one number")
    check_values("tolerance", tolerance, low=finest, high=1.0)


def missing_stiffness(at: Situation) -> str:
    """The message where ratios of stiffnesses are not enough."""
    if at.gapped.any():
        named = ", ".join(str(j + 1) for j in np.flatnonzero(at.gapped))
        return (
            "Argument `stiffness` must be given [N/m^eta] where open contacts can meet others at "
            f"work (contact {named}): gaps count in units of the indentation."
        )
    return "Argument `stiffness` must be given where exponents differ: ratios then say nothing."
