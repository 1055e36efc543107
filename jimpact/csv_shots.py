"""The CSV format of measured shots: headers `pre_1[m/s]`, `post_1[m/s]`, `sigma_1[m/s]`, `shot`."""

import csv
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

UNITS = {  # in m/s
    "m/s": 1.0,
    "cm/s": 0.01,
    "mm/s": 0.001,
    "km/h": 1 / 3.6,
    "in/s": 0.0254,
    "ft/s": 0.3048,
}
_KINDS = ("pre", "post", "sigma")
_HEADER = re.compile(r"(pre|post|sigma)_([1-9][0-9]*)\s*(?:\[([^]]*)\])?")
_ALLOWED = "`shot`, `pre_1[unit]`, `post_1[unit]`, `sigma_1[unit]`, and so on for bodies 2, 3, ..."


class Column(NamedTuple):
    """One column: what it holds, of which body (from 1), and its unit in m/s."""

    header: str
    kind: str
    body: int
    factor: float


class Table(NamedTuple):
    """Velocities in m/s, NaN where not measured; sigma is None where the file has none."""

    pre: np.ndarray
    post: np.ndarray
    sigma: np.ndarray | None
    shots: list[str] | None


def read_table(path: str | Path) -> Table:
    """Parse the file; every error names file, line, column, the value and what is allowed."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"Data file '{path}' does not exist or is no file.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: the file must be UTF-8 text, but is not ({error}).") from None
    reader = csv.reader(text.splitlines())
    lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    rows = [(number, row) for number, row in lines if any(row)]
    if not rows:
        raise ValueError(f"{path}: the file is empty; its first line must name the columns.")
    header_line, headers = rows[0]
    columns = [_column(f"{path}, line {header_line}", i, h) for i, h in enumerate(headers)]
    bodies = _check_columns(f"{path}, line {header_line}", columns)
    if len(rows) == 1:
        raise ValueError(f"{path}: the file has no shots; each line below the header is one.")
    values = {kind: np.full((len(rows) - 1, bodies), np.nan) for kind in _KINDS}
    shots = []
    for k, (line, row) in enumerate(rows[1:]):
        if len(row) != len(columns):
            raise ValueError(
                f"{path}, line {line}: a shot must have {len(columns)} values, one per column, "
                f"but has {len(row)}."
            )
        for column, cell in zip(columns, row):
            if column.kind == "shot":
                shots.append(cell or str(k + 1))
            else:
                number = _number(f"{path}, line {line}, column `{column.header}`", column, cell)
                values[column.kind][k, column.body - 1] = number
        _check_sigma(f"{path}, line {line}", columns, values, k)
    has_sigma = any(c.kind == "sigma" for c in columns)
    sigma = values["sigma"] if has_sigma else None
    return Table(values["pre"], values["post"], sigma, shots or None)


def _column(where: str, index: int, header: str) -> Column:
    if header == "shot":
        return Column(header, "shot", 0, 1.0)
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
    return Column(header, kind, int(body), UNITS[unit.strip()])


def _check_columns(where: str, columns: list[Column]) -> int:
    """Number of bodies; every body must have each kind of column once."""
    found = [(c.kind, c.body) for c in columns]
    for column, key in zip(columns, found):
        if found.count(key) > 1:
            raise ValueError(f"{where}: column `{column.header}` must occur once, but is repeated.")
    bodies = max((body for _, body in found), default=0)
    kinds = [k for k in _KINDS if k != "sigma" or any(kind == k for kind, _ in found)]
    for body in range(1, max(bodies, 1) + 1):
        for kind in kinds:
            if (kind, body) not in found:
                raise ValueError(
                    f"{where}: column `{kind}_{body}[unit]` is missing; every body from 1 to "
                    f"{max(bodies, 1)} needs {', '.join(f'`{k}`' for k in kinds)}."
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


def _check_sigma(
    where: str, columns: list[Column], values: dict[str, np.ndarray], shot: int
) -> None:
    for column in columns:
        if column.kind != "sigma":
            continue
        post, sigma = values["post"][shot, column.body - 1], values["sigma"][shot, column.body - 1]
        if not np.isnan(post) and not sigma > 0:
            given = "is empty" if np.isnan(sigma) else f"is {sigma / column.factor:g}"
            raise ValueError(
                f"{where}, column `{column.header}`: the error of a measured value must be > 0, "
                f"but {given}."
            )
