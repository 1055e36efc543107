"""No more model than a scene needs: the simplest law within a tolerance, and why."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from jimpact._checks import as_whole, check_values
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.laws.compliant import Compliant
from jimpact.laws.lzb import LZB, default_rtol
from jimpact.methods.advice.evidence import (
    Candidate,
    Outcomes,
    block_errors,
    candidate,
    candidates,
    costs,
    one_outcome,
    outcomes,
)
from jimpact.methods.advice.findings import Effect
from jimpact.methods.advice.inputs import (
    check_tolerance,
    missing_stiffness,
    parameters_of,
    span_of,
)
from jimpact.methods.advice.report import Advice
from jimpact.methods.advice.structure import (
    NUDGE,
    Block,
    Rows,
    Situation,
    rows,
    situation,
    unknowns,
)
from jimpact.montecarlo.gap_scales import gap_scale
from jimpact.scene import Scene, as_velocity
from jimpact.status import STATUS

FINEST_TOLERANCE = 100  # times the reference's own tolerance
RTOL_PART = 10  # the advised rtol is this part of the tolerance, or a little less
COARSEST_RTOL = 1e-3


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
    tried = rows(k, unknowns(at, k, span, absolute), samples, seed)
    return _found(at, parameters, tried, float(tolerance), timing, progress)


def _found(
    at: Situation,
    parameters: dict[str, Any],
    tried: Rows,
    tolerance: float,
    timing: bool,
    progress: bool | None,
) -> Advice:
    laws = candidates(at, parameters)
    name = list(laws)[-1]
    own = {
        key: one_outcome(law, at, scene)
        if key not in ("lzb", "compliant")
        else outcomes(law, at, scene, tried.stiffness, progress)
        for key, (law, scene) in laws.items()
    }
    reference = _usable_rows(own[name], name)
    evidence = {
        key: candidate(law, at, scene, own[key], reference, tried.random)
        for key, (law, scene) in laws.items()
    }
    if timing:
        for key, cost in costs(laws, at, tried).items():
            evidence[key] = replace(evidence[key], cost=cost)
    fit = [key for key, c in evidence.items() if c.usable and c.worst <= tolerance]
    chosen = fit[0] if fit else name
    if chosen in ("lzb", "compliant"):
        evidence[chosen] = _loosened(evidence[chosen], at, reference, tolerance)
    blocks = _blocks(at, evidence, own, reference, tolerance)
    gap_ratio = None
    if at.gapped.any():
        scale = gap_scale(at.scene, laws["compliant"][0], at.velocity)
        gap_ratio = np.asarray(scale.ratio)[at.gapped]
    return Advice(
        name=chosen,
        law=evidence[chosen].law,
        scene=evidence[chosen].scene,
        velocity=at.velocity,
        gap_velocity=at.gap_velocity,
        tolerance=tolerance,
        within=bool(fit),
        reference=name,
        candidates=evidence,
        blocks=blocks,
        stiffness=tried.stiffness[0],
        unknown=tried.unknown,
        effects=_effects(at, tried, reference, tolerance),
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
) -> tuple[Effect, ...]:
    """What each unknown stiffness does by itself, the strongest first."""
    v, found = reference.velocity, []
    for i, unknown in enumerate(tried.unknown):
        alone = float(np.nanmax(np.abs(v[tried.alone[i]] - v[0]))) / at.scale
        up, down = v[tried.nudged[i]]
        slope = float(np.abs(up - down).max()) / (2 * NUDGE) / at.scale
        needed = tolerance / slope if slope > 0 else math.inf
        found.append(Effect(unknown.name, alone, slope, needed))
    return tuple(found)
