"""A fit as tables of pandas and xarray, where they are installed."""

import importlib
from types import ModuleType
from typing import Any

import numpy as np

from jimpact.status import STATUS


def needed(module: str, how: str) -> ModuleType:
    """The module, or an ImportError that says how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{module} must be installed for this, but is not: {how}.") from error


def parameters_frame(fit: Any) -> Any:
    """A row a parameter: value, standard error, the ends of its 95 % interval, at its bound."""
    interval = fit.confidence_interval()
    columns = {
        "value": fit.value,
        "standard_error": fit.standard_error,
        "low_95": interval[:, 0],
        "high_95": interval[:, 1],
        "at_bound": fit.at_bound,
    }
    index = list(fit.names)
    return needed("pandas", "pip install pandas").DataFrame(columns, index=index)


def dataset(fit: Any) -> Any:
    """By parameter: values and covariance; by shot and body: before, measured, fitted, residual."""
    pair = ("parameter", "parameter_2")
    arrays: dict[str, Any] = {
        "value": ("parameter", fit.value),
        "standard_error": ("parameter", fit.standard_error),
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
    about = {"law": type(fit.law).__name__, "verdict": fit.verdict, "rms": fit.rms}
    return needed("xarray", "pip install xarray").Dataset(arrays, coordinates, about)
