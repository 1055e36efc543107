"""A fit as data for other programs: JSON, and tables of pandas and xarray where installed."""

import csv
from pathlib import Path
from typing import Any

import numpy as np

from jimpact._checks import needed
from jimpact.files.records import as_data
from jimpact.fits.report import verdict
from jimpact.fits.result import FitResult
from jimpact.status import STATUS


def parameter_columns(fit: FitResult) -> dict[str, np.ndarray]:
    """Value, standard error, ends of the 95 % interval, at its bound, seen (P,)."""
    interval = fit.confidence_interval()
    return {
        "value": fit.value,
        "standard_error": fit.standard_error,
        "low_95": interval[:, 0],
        "high_95": interval[:, 1],
        "at_bound": fit.at_bound,
        "determined": fit.determined,
    }


def parameters_frame(fit: FitResult) -> Any:
    """A row a parameter, see `parameter_columns`."""
    columns, index = parameter_columns(fit), list(fit.names)
    return needed("pandas", "pip install pandas").DataFrame(columns, index=index)


def write_parameters(fit: FitResult, path: Path) -> Path:
    """The same as CSV, in full precision."""
    columns = parameter_columns(fit)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["parameter", *columns])
        for name, *row in zip(fit.names, *(x.tolist() for x in columns.values())):
            writer.writerow([name, *row])
    return path


def dataset(fit: FitResult) -> Any:
    """By parameter: values and covariance; by shot and body: before, measured, fitted, residual."""
    pair = ("parameter", "parameter_2")
    arrays: dict[str, Any] = {
        "value": ("parameter", fit.value),
        "standard_error": ("parameter", fit.standard_error),
        "determined": ("parameter", fit.determined),
        "covariance": (pair, fit.covariance),
        "correlation": (pair, fit.correlation),
    }
    coordinates: dict[str, Any] = {axis: list(fit.names) for axis in pair}
    measured, data = np.asarray(fit.problem.measured, float), fit.experiments
    axes: tuple[str, ...] = tuple(f"value_{i + 1}" for i in range(measured.ndim))
    if data is not None:
        axes = ("shot", "velocity")
        units = data.units
        coordinates |= {"shot": list(data.shots), "unit": ("velocity", list(units))}
        arrays["before"] = (axes, np.asarray(data.pre))
        arrays["status"] = ("shot", [STATUS[code].name for code in fit.status])
    for name, values in (
        ("measured", measured),
        ("predicted", fit.predicted),
        ("residual", fit.residual),
    ):
        arrays[name] = (axes, values)
    about = {"law": type(fit.law).__name__, "verdict": verdict(fit), "rms": fit.rms}
    return needed("xarray", "pip install xarray").Dataset(arrays, coordinates, about)


def as_dict(fit: FitResult) -> dict[str, Any]:
    """Plain numbers, strings and lists; not finite numbers become None."""
    interval = fit.confidence_interval()
    parameters = [
        {
            "name": name,
            "value": as_data(fit.value[i]),
            "standard_error": as_data(fit.standard_error[i]),
            "confidence_interval_95": as_data(interval[i]),
            "at_bound": bool(fit.at_bound[i]),
            "seen": bool(fit.determined[i]),
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
        "reservations": list(fit.reservations),
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
