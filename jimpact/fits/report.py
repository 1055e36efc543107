"""What a fit says: warnings that decide whether to trust it, a report as text and as JSON."""

from typing import Any

import numpy as np

from jimpact.files.records import with_error
from jimpact.fits.intervals import in_words
from jimpact.fits.result import FitResult
from jimpact.fits.scatter import SURE, shown_scatter
from jimpact.status import STATUS

_VELOCITIES_SHOWN = 24
_MINIMA_SHOWN = 5
_PARAMETERS_TOLD = 6  # in one sentence


def report(fit: FitResult) -> str:
    """Parameters with errors, quality, what stays unseen, minima, warnings, shots, the verdict."""
    return "\n\n".join("\n".join(block) for block in report_blocks(fit).values() if block)


def report_blocks(fit: FitResult) -> dict[str, list[str]]:
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


def verdict(fit: FitResult) -> str:
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


def _is_told(fit: FitResult, i: int) -> bool:
    anything = bool(fit.profiles) and fit.profiles[i].words == "anything"
    return not (np.isinf(fit.standard_error[i]) or anything)


def _these(fit: FitResult) -> str:
    if fit.experiments is None:
        return "these data"
    return "this shot" if fit.shot_count == 1 else f"these {fit.shot_count} shots"


def _called(fit: FitResult, i: int) -> str:
    """The name of a parameter; a stiffness is one over that of a contact which is held."""
    name = fit.names[i]
    held = any(note.startswith("stiffness[1] is held") for note in fit.problem.notes)
    return f"the stiffness ratio {name} / stiffness[1]" if "stiffness" in name and held else name


def _told(fit: FitResult, i: int) -> str:
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


def _headline(fit: FitResult) -> str:
    values, law = int(np.isfinite(fit.problem.measured).sum()), type(fit.law).__name__
    if fit.experiments is None:
        return f"Fit of {law} to {values} measured values, {fit.method}"
    shots, bodies = fit.predicted.shape
    return (
        f"Fit of {law} to {shots} shot{'s' * (shots > 1)} of {bodies} bodies "
        f"({values} measured velocities), {fit.method}"
    )


def parameter_rows(fit: FitResult) -> list[list[str]]:
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


def _parameters(fit: FitResult) -> list[str]:
    width = max(9, *(len(name) for name in fit.names))
    head = ["parameter", "value", "std. error", "95 % interval" + " (profile)" * bool(fit.profiles)]
    lines = [
        f"{name:{width}s} {value:>12s} {error:>12s}   {'   '.join(rest)}".rstrip()
        for name, value, error, *rest in [head, *parameter_rows(fit)]
    ]
    if fit.linearization_misleads:
        lines.append("A parabola at the minimum may mislead here: see `ji.profile(fit)`.")
    return lines


def _quality(fit: FitResult) -> list[str]:
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


def _scatter(fit: FitResult) -> list[str]:
    found = shown_scatter(fit)
    if found is None:
        return []
    lines = ["Scatter from shot to shot", f"  - {found}"]
    assert fit.experiments is not None
    speed = fit.experiments.approach_speed(fit.problem.scene)
    chance = found.trend(np.log(np.where(speed > 0, speed, 1.0)))
    if chance < SURE:
        lines.append(
            f"  - It depends on the speed (chance without that {chance:.1g}): see "
            "`ji.VelocityDependent`."
        )
    return lines


def _minima(fit: FitResult) -> list[str]:
    total = fit.start_count
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


def shot_rows(fit: FitResult, most: int | None = None) -> list[list[str]]:
    """Label, number, before, measured, fitted, residual, unit, status; of so many shots."""
    data = fit.experiments
    assert data is not None
    before, measured = np.asarray(data.pre, float), np.asarray(data.post, float)
    rows = []
    for k, i in np.ndindex(*before[:most].shape):
        seen = ["-" if np.isnan(measured[k, i]) else f"{measured[k, i]:.6g}"]
        residual = "-" if np.isnan(fit.residual[k, i]) else f"{fit.residual[k, i]:.3g}"
        values = [f"{before[k, i]:.6g}", *seen, f"{fit.predicted[k, i]:.6g}", residual]
        told = "" if fit.status[k] == 0 or i else STATUS[int(fit.status[k])].name
        rows.append([data.shots[k] if i == 0 else "", str(i + 1), *values, data.units[i], told])
    return rows


def _shots(fit: FitResult) -> list[str]:
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
