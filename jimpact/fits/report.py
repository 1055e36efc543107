"""The report of a fit as plain text and as JSON-ready data."""

from typing import Any

import numpy as np

from jimpact.status import STATUS

_VELOCITIES_SHOWN = 24
_MINIMA_SHOWN = 5


def report(fit: Any) -> str:
    """Parameters with errors, quality, what stays unseen, minima, warnings, shots."""
    blocks = [
        [_headline(fit)],
        _parameters(fit),
        _quality(fit),
        _told("What the data cannot see", fit.identifiability),
        _minima(fit),
        _told("Warnings", fit.warnings),
        _shots(fit),
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def _headline(fit: Any) -> str:
    shots, bodies = fit.predicted.shape
    values = int(fit.experiments.measured.sum())
    return (
        f"Fit of {type(fit.law).__name__} to {shots} shot{'s' * (shots > 1)} of {bodies} bodies "
        f"({values} measured velocities), {fit.method}"
    )


def _parameters(fit: Any) -> list[str]:
    width = max(9, *(len(name) for name in fit.names))
    lines = [f"{'parameter':{width}s} {'value':>12s} {'std. error':>12s}   95 % interval"]
    for i, (low, high) in enumerate(fit.confidence_interval()):
        error = fit.standard_error[i]
        word = "unseen" if np.isinf(error) else "unknown" if np.isnan(error) else f"{error:.3g}"
        interval = f"{low:.5g} to {high:.5g}" if np.isfinite(error) else "-"
        note = "   at its bound" if fit.at_bound[i] else ""
        lines.append(f"{fit.names[i]:{width}s} {fit.value[i]:12.6g} {word:>12s}   {interval}{note}")
    return lines


def _quality(fit: Any) -> list[str]:
    lines = [f"rms residual   {fit.rms:.4g} m/s"]
    if fit.experiments.sigma is not None:
        squares = f"{fit.starts[0].sum_of_squares:.4g} with {fit.degrees_of_freedom}"
        lines.append(f"chi^2          {squares} degrees of freedom (sigma given)")
    elif np.isfinite(fit.noise):
        lines.append(
            f"noise          {fit.noise:.4g} m/s a velocity, estimated with "
            f"{fit.degrees_of_freedom} degrees of freedom"
        )
    lines.append(f"rank           {fit.rank} of {len(fit.names)} parameters")
    state = "converged" if fit.converged else "NOT converged"
    return [*lines, f"solver         {state}, at most {fit.steps} steps a start"]


def _told(title: str, lines: tuple[str, ...]) -> list[str]:
    return [title, *(f"  - {line}" for line in lines)] if lines else []


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


def _shots(fit: Any) -> list[str]:
    data = fit.experiments
    pre, post = np.asarray(data.pre, float), np.asarray(data.post, float)
    lines = [f"{'shot':>8s} {'body':>5s} {'before':>12s} {'measured':>12s} {'fitted':>12s} [m/s]"]
    shown = max(1, _VELOCITIES_SHOWN // pre.shape[1])
    for k in range(min(len(pre), shown)):
        code = int(fit.status[k])
        note = "" if code == 0 else f"   {STATUS[code].name}"
        for i in range(pre.shape[1]):
            label = data.shots[k] if i == 0 else ""
            seen = "-" if np.isnan(post[k, i]) else f"{post[k, i]:.6g}"
            values = f"{pre[k, i]:12.6g} {seen:>12s} {fit.predicted[k, i]:12.6g}"
            lines.append(f"{label:>8s} {i + 1:5d} {values}{note if i == 0 else ''}")
    if len(pre) > shown:
        lines.append(f"     ... and {len(pre) - shown} more shots")
    return lines


def to_json(fit: Any) -> dict[str, Any]:
    """Plain numbers, strings and lists; not finite numbers become None."""
    interval = fit.confidence_interval()
    parameters = [
        {
            "name": name,
            "value": _plain(fit.value[i]),
            "standard_error": _plain(fit.standard_error[i]),
            "confidence_interval_95": _plain(interval[i]),
            "at_bound": bool(fit.at_bound[i]),
            "seen": bool(not np.isinf(fit.standard_error[i])),
        }
        for i, name in enumerate(fit.names)
    ]
    starts = [
        {"sum_of_squares": s.sum_of_squares, "value": _plain(s.value), "count": s.count}
        for s in fit.starts
    ]
    return {
        "law": type(fit.law).__name__,
        "method": fit.method,
        "parameters": parameters,
        "rms": fit.rms,
        "noise": _plain(fit.noise),
        "degrees_of_freedom": fit.degrees_of_freedom,
        "rank": fit.rank,
        "identifiability": list(fit.identifiability),
        "warnings": list(fit.warnings),
        "converged": fit.converged,
        "covariance": _plain(fit.covariance),
        "correlation": _plain(fit.correlation),
        "starts": starts,
        "shots": list(fit.experiments.shots),
        "predicted": _plain(fit.predicted),
        "residual": _plain(fit.residual),
        "status": [STATUS[code].name for code in fit.status],
    }


def _plain(value: Any) -> Any:
    """Nested lists of floats, None where not finite."""
    array = np.asarray(value, dtype=float)
    if array.ndim:
        return [_plain(entry) for entry in array]
    return float(array) if np.isfinite(array) else None
