"""What a fit says: warnings that decide whether to trust it, a report as text and as JSON."""

from typing import Any

import numpy as np

from jimpact.files.records import as_data, with_error
from jimpact.fits.adequacy import adequacy
from jimpact.fits.experiments import data_defects
from jimpact.fits.matrix_fit import boundary, encloses
from jimpact.fits.multistart import EXACT, Search
from jimpact.fits.problem import FitProblem
from jimpact.fits.profiles import in_words, misleads
from jimpact.fits.scatter import SURE, shown_scatter
from jimpact.fits.uncertainty import Uncertainty
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.status import STATUS

_VELOCITIES_SHOWN = 24
_MINIMA_SHOWN = 5
_PARAMETERS_TOLD = 6  # in one sentence

# Minima whose sums of squares differ by less than this many noise variances fit equally well:
# the difference is what moving by one standard error costs.
EQUALLY_GOOD = 1.0


def report(fit: Any) -> str:
    """Parameters with errors, quality, what stays unseen, minima, warnings, shots, the verdict."""
    return "\n\n".join("\n".join(block) for block in report_blocks(fit).values() if block)


def report_blocks(fit: Any) -> dict[str, list[str]]:
    """The lines of the report, block by block."""
    return {
        "headline": [_headline(fit)],
        "parameters": _parameters(fit),
        "quality": _quality(fit),
        "unseen": _section("What the data cannot see", fit.identifiability),
        "minima": _minima(fit),
        "scatter": _scatter(fit),
        "warnings": _section("Warnings", fit.warnings),
        "shots": _shots(fit),
        "verdict": [verdict(fit)],
    }


def verdict(fit: Any) -> str:
    """One sentence: the values with their errors, what cannot be told, whether to believe it."""
    law, data = type(fit.law).__name__, _these(fit)
    if not fit.converged:
        return f"No answer: the search for the parameters of {law} has not converged."
    known = [i for i in range(len(fit.names)) if _is_told(fit, i)]
    unseen = [_called(fit, i) for i in range(len(fit.names)) if i not in known]
    parts = [_told(fit, i) for i in known]
    if len(known) > _PARAMETERS_TOLD:
        relative = np.nan_to_num(fit.standard_error[known])
        worst = known[int(np.argmax(relative))]
        parts = [f"{len(known)} parameters are found, the least certain {_told(fit, worst)}"]
    if unseen:
        parts.append(f"{' and '.join(unseen)} cannot be told from {data}")
    if any("different minima fit equally well" in line for line in fit.warnings):
        parts.append("other values fit equally well")
    told = "; ".join(parts)
    scattering = shown_scatter(fit)
    if scattering is not None and scattering.explains:
        return f"{law} fits {data} if {scattering}"
    if scattering is not None:
        told += f"; {scattering.name} scatters by {scattering.value:.2g} from shot to shot"
    nearest = f"it comes nearest with {told}" if known else told
    if any(line.startswith("Lack of fit") for line in fit.warnings):
        return f"{law} does not fit {data}; {nearest}."
    if any(line.startswith("The fitted law fails") for line in fit.warnings):
        return f"{law} fails in some of these {'shots' if fit.experiments else 'data'}; {nearest}."
    return f"{told}."


def _is_told(fit: Any, i: int) -> bool:
    anything = bool(fit.profiles) and fit.profiles[i].words == "anything"
    return not (np.isinf(fit.standard_error[i]) or anything)


def _these(fit: Any) -> str:
    if fit.experiments is None:
        return "these data"
    shots = int(np.isfinite(fit.problem.measured).any(axis=1).sum())
    return "this shot" if shots == 1 else f"these {shots} shots"


def _called(fit: Any, i: int) -> str:
    """The name of a parameter; a stiffness is one over that of a contact which is held."""
    name = fit.names[i]
    held = any(note.startswith("stiffness[1] is held") for note in fit.problem.notes)
    return f"the stiffness ratio {name} / stiffness[1]" if "stiffness" in name and held else name


def _told(fit: Any, i: int) -> str:
    """A parameter with its error, and the interval where that is one-sided or of several pieces."""
    value, error, name = fit.value[i], fit.standard_error[i], _called(fit, i)
    if np.isnan(error):
        return f"{name} = {value:.5g}, its error unknown"
    told = f"{value:g}" if fit.at_bound[i] else with_error(value, error)
    if fit.profiles:
        words = fit.profiles[i].words
        if words.startswith("at ") or " or " in words:
            return f"{name} = {told}, {words} ({100 * fit.profiles[i].level:g} %)"
    return f"{name} = {told}{', the end of what is allowed' if fit.at_bound[i] else ''}"


def _headline(fit: Any) -> str:
    values, law = int(np.isfinite(fit.problem.measured).sum()), type(fit.law).__name__
    if fit.experiments is None:
        return f"Fit of {law} to {values} measured values, {fit.method}"
    shots, bodies = fit.predicted.shape
    return (
        f"Fit of {law} to {shots} shot{'s' * (shots > 1)} of {bodies} bodies "
        f"({values} measured velocities), {fit.method}"
    )


def parameter_rows(fit: Any) -> list[list[str]]:
    """Name, value, standard error, 95 % interval, remark of every parameter."""
    rows = []
    for i, pieces in enumerate(fit.intervals()):
        error = fit.standard_error[i]
        word = "unseen" if np.isinf(error) else "unknown" if np.isnan(error) else f"{error:.3g}"
        told = np.isfinite(error) or bool(fit.profiles)
        interval = in_words(pieces, (fit.bounds[0][i], fit.bounds[1][i])) if told else "-"
        note = "at its bound" if fit.at_bound[i] else ""
        rows.append([fit.names[i], f"{fit.value[i]:.6g}", word, interval, note])
    return rows


def _parameters(fit: Any) -> list[str]:
    width = max(9, *(len(name) for name in fit.names))
    head = ["parameter", "value", "std. error", "95 % interval" + " (profile)" * bool(fit.profiles)]
    lines = [
        f"{name:{width}s} {value:>12s} {error:>12s}   {'   '.join(rest)}".rstrip()
        for name, value, error, *rest in [head, *parameter_rows(fit)]
    ]
    if misleads(fit):
        lines.append("A parabola at the minimum may mislead here: see `ji.profile(fit)`.")
    return lines


def _quality(fit: Any) -> list[str]:
    unit, one = (" m/s", "velocity") if fit.experiments is not None else ("", "value")
    lines = [f"rms residual   {fit.rms:.4g}{unit}"]
    if fit.problem.sigma is not None:
        squares = f"{fit.starts[0].sum_of_squares:.4g} with {fit.degrees_of_freedom}"
        lines.append(f"chi^2          {squares} degrees of freedom (sigma given)")
        lines += _said_of_sigma(fit.experiments)
        if fit.noise > 1 and fit.loss == "squares":
            lines.append(
                f"errors         stretched by {fit.noise:.3g}, the root of chi^2 over that"
            )
    elif np.isfinite(fit.noise):
        lines.append(
            f"noise          {fit.noise:.4g}{unit} a {one}, estimated with "
            f"{fit.degrees_of_freedom} degrees of freedom"
        )
    lines.append(f"rank           {fit.rank} of {len(fit.names)} parameters")
    state = "converged" if fit.converged else "NOT converged"
    return [*lines, f"solver         {state}, at most {fit.steps} steps a start"]


def _said_of_sigma(data: Any) -> list[str]:
    """What went into the stated errors."""
    if data is None:
        return []
    lines = []
    if data.resolution is not None:
        steps = np.unique(np.asarray(data.resolution)[data.measured])
        told = f"{steps[0]:.3g}" if len(steps) == 1 else f"{steps[0]:.3g} to {steps[-1]:.3g}"
        lines.append(f"               with that of readings in steps of {told}: step / sqrt(12)")
    if data.sigma_pre is not None:
        lines.append("               with those of the velocities before, passed on by the law")
    return lines


def _section(title: str, lines: tuple[str, ...]) -> list[str]:
    return [title, *(f"  - {line}" for line in lines)] if lines else []


def _scatter(fit: Any) -> list[str]:
    found = shown_scatter(fit)
    if found is None:
        return []
    lines = ["Scatter from shot to shot", f"  - {found}"]
    speed = fit.experiments.approach_speed(fit.problem.scene)
    chance = found.trend(np.log(np.where(speed > 0, speed, 1.0)))
    if chance < SURE:
        lines.append(
            f"  - It depends on the speed (chance without that {chance:.1g}): see "
            "`ji.VelocityDependent`."
        )
    return lines


def _minima(fit: Any) -> list[str]:
    total = sum(start.count for start in fit.starts) + fit.lost_starts
    late = f"{fit.lost_starts} of {total} starts did not converge." if fit.lost_starts else ""
    if len(fit.starts) == 1:
        one = f"{total - fit.lost_starts} of {total} starts ended in this minimum. {late}"
        return [one.rstrip()] if total > 1 else []
    what = "minima" if fit.rank == len(fit.names) else "end points in a valley"
    lines = [f"{len(fit.starts)} {what} of {total} starts:  sum of squares, starts, values"]
    for start in fit.starts[:_MINIMA_SHOWN]:
        values = ", ".join(f"{name} {v:.4g}" for name, v in zip(fit.names, start.value))
        lines.append(f"  {start.sum_of_squares:12.5g} {start.count:4d}   {values}")
    if len(fit.starts) > _MINIMA_SHOWN:
        lines.append(f"  ... and {len(fit.starts) - _MINIMA_SHOWN} more")
    return [*lines, late] if late else lines


def shot_rows(fit: Any, most: int | None = None) -> list[list[str]]:
    """Label, number, before, measured, fitted, residual, unit, status; of so many shots."""
    data = fit.experiments
    before, measured = np.asarray(data.pre, float), np.asarray(data.post, float)
    rows = []
    for k, i in np.ndindex(*before[:most].shape):
        seen = ["-" if np.isnan(measured[k, i]) else f"{measured[k, i]:.6g}"]
        residual = "-" if np.isnan(fit.residual[k, i]) else f"{fit.residual[k, i]:.3g}"
        values = [f"{before[k, i]:.6g}", *seen, f"{fit.predicted[k, i]:.6g}", residual]
        told = "" if fit.status[k] == 0 or i else STATUS[int(fit.status[k])].name
        rows.append([data.shots[k] if i == 0 else "", str(i + 1), *values, data.units[i], told])
    return rows


def _shots(fit: Any) -> list[str]:
    data = fit.experiments
    if data is None:
        return []
    mixed = len(set(data.units)) > 1
    unit = "" if mixed else f" [{data.units[0]}]"
    lines = [f"{'shot':>8s} {'body':>5s} {'before':>12s} {'measured':>12s} {'fitted':>12s}{unit}"]
    shots, bodies = data.pre.shape
    shown = max(1, _VELOCITIES_SHOWN // bodies)
    for label, body, before, seen, fitted, _, own, told in shot_rows(fit, shown):
        row = f"{label:>8s} {body:>5s} {before:>12s} {seen:>12s} {fitted:>12s}"
        lines.append(f"{row}{' ' + own if mixed else ''}{'   ' + told if told else ''}")
    if shots > shown:
        lines.append(f"     ... and {shots - shown} more shots")
    return lines


def to_json(fit: Any) -> dict[str, Any]:
    """Plain numbers, strings and lists; not finite numbers become None."""
    interval = fit.confidence_interval()
    parameters = [
        {
            "name": name,
            "value": as_data(fit.value[i]),
            "standard_error": as_data(fit.standard_error[i]),
            "confidence_interval_95": as_data(interval[i]),
            "at_bound": bool(fit.at_bound[i]),
            "seen": bool(not np.isinf(fit.standard_error[i])),
            "profile_95": as_data(fit.profiles[i].intervals) if fit.profiles else None,
        }
        for i, name in enumerate(fit.names)
    ]
    starts = [
        {"sum_of_squares": s.sum_of_squares, "value": as_data(s.value), "count": s.count}
        for s in fit.starts
    ]
    return {
        "law": type(fit.law).__name__,
        "method": fit.method,
        "parameters": parameters,
        "rms": fit.rms,
        "noise": as_data(fit.noise),
        "degrees_of_freedom": fit.degrees_of_freedom,
        "rank": fit.rank,
        "identifiability": list(fit.identifiability),
        "warnings": list(fit.warnings),
        "verdict": verdict(fit),
        "seed": fit.seed,
        "converged": fit.converged,
        "covariance": as_data(fit.covariance),
        "correlation": as_data(fit.correlation),
        "starts": starts,
        "shots": [] if fit.experiments is None else list(fit.experiments.shots),
        "predicted": as_data(fit.predicted),
        "residual": as_data(fit.residual),
        "status": [STATUS[code].name for code in fit.status],
    }


def fit_warnings(
    problem: FitProblem, found: Search, spread: Uncertainty, robust: bool
) -> list[str]:
    """All warnings, those about the data first."""
    lines, data = list(problem.left_out), problem.experiments
    if data is not None:
        contacts = data.largest_scene(problem.scene).contacts
        stored = float(np.sum(np.broadcast_to(np.asarray(problem.law.stored), contacts)))
        lines += data_defects(data, problem.scene, stored)
    if not found.converged:
        lines.append(
            "The fit has not converged: allow more `max_steps` or `starts` (or the minimum sits on "
            "a kink of the law, where the sequence of contacts changes)."
        )
    if data is not None:
        lines += _statuses(found.status, data.shots)
        lines += _matrix(problem, found, contacts)
    lines += _no_numbers(problem, found)
    lines += adequacy(problem, found, spread.rank, robust)
    if data is not None and problem.sigma is None and len(set(data.units)) > 1:
        lines.append(
            "Without sigma, velocities in rad/s weigh like those in m/s of the same kinetic energy."
        )
    names = problem.names
    for i in np.flatnonzero(found.at_bound):
        lines.append(
            f"{names[i]} ends at its bound {found.value[i]:g}: its error holds for one side."
        )
    if spread.rank < len(names):
        lines.append(
            f"The data determine {spread.rank} of {len(names)} parameters (rank "
            f"{spread.rank} of {len(names)}); the values given are one choice of many."
        )
    elif (several := _equally_good(problem, found, spread)) > 1:
        lines.append(f"{several} different minima fit equally well: see the starts.")
    if spread.degrees_of_freedom < 1 and problem.sigma is None:
        lines.append(
            "No degree of freedom is left to estimate the noise: errors are unknown without sigma."
        )
    if problem.residuals.offset.dtype == np.float32:
        lines.append(
            "Computed in float32: values are good to about 1e-3, and the rank is judged coarsely. "
            'jax.config.update("jax_enable_x64", True) gives float64.'
        )
    return lines


def _statuses(status: np.ndarray, shots: tuple[str, ...]) -> list[str]:
    lines = []
    for code in np.unique(status):
        if STATUS[code].failure:
            at = ", ".join(shots[k] for k in np.flatnonzero(status == code)[:6])
            count = int(np.sum(status == code))
            lines.append(
                f"The fitted law fails in {count} of {len(shots)} shots ({at}): "
                f"{STATUS[code].name}, {STATUS[code].message}."
            )
    return lines


def _no_numbers(problem: FitProblem, found: Search) -> list[str]:
    """Where what the user's own function gives is no number at the parameters found."""
    if problem.experiments is not None:
        return []
    lost = np.flatnonzero(np.isfinite(problem.measured) & ~np.isfinite(found.seen))
    if not len(lost):
        return []
    which = ", ".join(str(i + 1) for i in lost[:6]) + ", .." * (len(lost) > 6)
    return [
        f"The fitted law fails in {len(lost)} of {problem.values} values ({which}): what is "
        "observed is no number there, and counts as a large error."
    ]


def _matrix(problem: FitProblem, found: Search, contacts: int) -> list[str]:
    """Where the conditions on a restitution matrix hold it back, or are not asked for."""
    edges = boundary(problem.residuals.region, found.entries)
    if edges:
        return [
            f"The matrix ends at the edge of the admissible ones ({'; '.join(edges)}): the errors "
            "hold for the side inside."
        ]
    if isinstance(problem.law, RestitutionMatrix) and not encloses(problem.law, contacts):
        return [
            "Nothing keeps this matrix consistent for other approach velocities than the measured: "
            "the conditions are for (m, m) matrices with admissible=True."
        ]
    return []


def _equally_good(problem: FitProblem, found: Search, spread: Uncertainty) -> int:
    size, dtype = float(problem.residuals.size), str(problem.residuals.offset.dtype)
    noise = spread.noise / size if np.isfinite(spread.noise) else 0.0
    more = max(EQUALLY_GOOD * noise**2, EXACT[dtype])
    return sum(end.squares <= found.minima[0].squares + more for end in found.minima)
