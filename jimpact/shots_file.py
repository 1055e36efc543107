"""Shots as a CSV file holds them: columns with units. Read and checked without JAX."""

import csv
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

UNITS = {  # in m/s, and rad/s of bodies that turn
    "m/s": 1.0,
    "cm/s": 0.01,
    "mm/s": 0.001,
    "km/h": 1 / 3.6,
    "in/s": 0.0254,
    "ft/s": 0.3048,
    "rad/s": 1.0,
    "deg/s": np.pi / 180,
}
LINEAR, ANGULAR = "m/s", "rad/s"  # to which all are converted
_KINDS = ("pre", "post", "sigma")
_HEADER = re.compile(r"(pre|post|sigma)_([1-9][0-9]*)\s*(?:\[([^]]*)\])?")
_ALLOWED = "`shot`, `pre_1[unit]`, `post_1[unit]`, `sigma_1[unit]`, and so on for bodies 2, 3, ..."


def read_shots(path: str | Path) -> tuple[dict[str, np.ndarray], list[str], list[str] | None]:
    """Velocities (K, n) by kind ('pre', 'post', 'sigma' if there is one), their units, labels.

    See `ji.read_experiments`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"Data file '{path}' does not exist or is no file.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: the file must be UTF-8 text, but is not ({error}).") from None
    reader = csv.reader(text.splitlines())
    lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    rows = [(f"{path}, line {number}", row) for number, row in lines if any(row)]
    if not rows:
        raise ValueError(f"{path}: the file is empty; its first line must name the columns.")
    where, headers = rows[0]
    columns = [_column(where, i, header) for i, header in enumerate(headers)]
    bodies = _check_columns(where, columns)
    if len(rows) == 1:
        raise ValueError(f"{path}: the file has no shots; each line below the header is one.")
    values = {kind: np.full((len(rows) - 1, bodies), np.nan) for kind in _KINDS}
    shots = []
    for k, (where, row) in enumerate(rows[1:]):
        if len(row) != len(columns):
            raise ValueError(
                f"{where}: a shot must have {len(columns)} values, one per column, "
                f"but has {len(row)}."
            )
        for column, cell in zip(columns, row):
            if column.kind == "shot":
                shots.append(cell or str(k + 1))
            else:
                number = _number(f"{where}, column `{column.header}`", column, cell)
                values[column.kind][k, column.body - 1] = number
        for column in columns:
            if column.kind == "sigma":
                _check_sigma(where, column, *(values[x][k, column.body - 1] for x in _KINDS[1:]))
    if not any(column.kind == "sigma" for column in columns):
        del values["sigma"]
    units = {column.body: column.unit for column in columns if column.kind != "shot"}
    return values, [units[i + 1] for i in range(bodies)], shots or None


class Column(NamedTuple):
    """One column: what it holds, of which body (from 1), its unit in m/s or rad/s, and which."""

    header: str
    kind: str
    body: int
    factor: float
    unit: str


def _column(where: str, index: int, header: str) -> Column:
    if header == "shot":
        return Column(header, "shot", 0, 1.0, "")
    match = _HEADER.fullmatch(header)
    if match is None:
        hint = " (columns are separated by commas)" if ";" in header or "\t" in header else ""
        raise ValueError(
            f"{where}: column {index + 1} must be one of {_ALLOWED}, but has name {header!r}{hint}."
        )
    kind, body, unit = match.groups()
    if not unit:
        raise ValueError(
            f"{where}: column `{header}` must state its unit, as in `{kind}_{body}[m/s]`; "
            f"allowed are {', '.join(UNITS)}."
        )
    if unit.strip() not in UNITS:
        raise ValueError(
            f"{where}: the unit of column `{header}` must be one of {', '.join(UNITS)}, "
            f"but is {unit!r}."
        )
    base = ANGULAR if unit.strip() in ("rad/s", "deg/s") else LINEAR
    return Column(header, kind, int(body), UNITS[unit.strip()], base)


def _check_columns(where: str, columns: list[Column]) -> int:
    """Number of bodies; every body must have each kind of column once."""
    found = [(c.kind, c.body) for c in columns]
    for column, key in zip(columns, found):
        if found.count(key) > 1:
            raise ValueError(f"{where}: column `{column.header}` must occur once, but is repeated.")
        others = {c.unit for c in columns if c.body == column.body and c.kind != "shot"}
        if len(others) > 1:
            raise ValueError(
                f"{where}: all columns of velocity {column.body} must be in m/s or all in rad/s, "
                "but some are in each."
            )
    bodies = max(1, *(body for _, body in found))
    kinds = [kind for kind in _KINDS if kind != "sigma" or any(x == kind for x, _ in found)]
    missing = [f"{k}_{i + 1}" for i in range(bodies) for k in kinds if (k, i + 1) not in found]
    if missing:
        raise ValueError(
            f"{where}: column `{missing[0]}[unit]` is missing; every body from 1 to {bodies} needs "
            f"{', '.join(f'`{kind}`' for kind in kinds)}."
        )
    return bodies


def _number(where: str, column: Column, cell: str) -> float:
    if cell == "" or cell.lower() == "nan":
        if column.kind == "pre":
            raise ValueError(
                f"{where}: a velocity before the impact must be given, but the cell is "
                f"{cell!r}; only `post` may be left empty (not measured)."
            )
        return np.nan
    try:
        number = float(cell)
    except ValueError:
        raise ValueError(f"{where}: the value must be a number, but is {cell!r}.") from None
    if not np.isfinite(number):
        raise ValueError(f"{where}: the value must be finite, but is {cell!r}.")
    return number * column.factor


def _check_sigma(where: str, column: Column, post: float, sigma: float) -> None:
    if not np.isnan(post) and not sigma > 0:
        given = "is empty" if np.isnan(sigma) else f"is {sigma / column.factor:g}"
        raise ValueError(
            f"{where}, column `{column.header}`: the error of a measured value must be > 0, "
            f"but {given}."
        )
