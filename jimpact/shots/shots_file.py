"""Shots and motions in CSV files whose columns carry units; read and checked without
JAX.
"""

import csv
import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

UNITS = {  # of velocities, in m/s or rad/s
    "m/s": 1.0,
    "cm/s": 0.01,
    "mm/s": 0.001,
    "km/h": 1 / 3.6,
    "in/s": 0.0254,
    "ft/s": 0.3048,
    "rad/s": 1.0,
    "deg/s": np.pi / 180,
}
# the units after reading
LINEAR = "m/s"
ANGULAR = "rad/s"
_LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6}  # [m], by unit
_ANGLES = {"rad": 1.0, "deg": np.pi / 180}  # [rad], by unit
_KINDS = {  # of columns, with their units
    **dict.fromkeys(("pre", "post", "sigma", "sigma_pre", "resolution"), UNITS),
    "mass": {"kg": 1.0, "g": 0.001},
    "gap": _LENGTHS,
    "q": _LENGTHS | _ANGLES | {"1": 1.0},
}
_NEEDED = ("pre", "post")
# Standard errors, and the kinds of column whose errors they are.
_ERRORS = {"sigma": "post", "sigma_pre": "pre", "resolution": "post", "sigma_q": "q"}
_OF_MOTIONS = {
    "t": {"s": 1.0, "ms": 0.001},
    **dict.fromkeys(("q", "sigma_q"), _KINDS["q"]),
}
# Share of a step by which times may be off, as they are when rounded to a few digits.
# Ten times more would pass steps that visibly differ.
UNEVENNESS = 1e-3
# Share of a step that the last digit of times may stand for: of more, steps that differ
# look alike.
LAST_DIGIT = 0.25
_HEADER = re.compile(r"(t|[a-z_]+(?=_))(?:_([1-9][0-9]*))?\s*(?:\[([^]]*)\])?")
_COMMENT = re.compile(r"comment(_.*)?")  # a column that is not read
_ALLOWED = (
    "`shot`, `pre_1[unit]`, `post_1[unit]`, `sigma_1[unit]`, and so on for bodies 2, "
    "3, ... (further kinds: `sigma_pre`, `resolution`, `mass`, `gap`, `q`; `comment` "
    "is not read)"
)
_HOW = "columns are separated by commas, numbers have a decimal point"
_ALLOWED_OF_MOTIONS = (
    "`t[s]`, `q_1[unit]`, `sigma_q_1[unit]`, and so on for coordinates 2, 3, ..."
)


class ShotTable(NamedTuple):
    """The columns of a file of shots in SI units, by kind, each (K, number of
    bodies).
    """

    values: dict[str, np.ndarray]
    units: list[str]  # of the velocities
    shots: list[str] | None  # labels


def read_shots(path: str | Path) -> ShotTable:
    """Read and check a file of shots, see `ji.read_experiments`; a warning reports NaN
    cells.
    """
    where, columns, rows = _read(path, _KINDS, _ALLOWED, "shot")
    counts = _check_columns(where, columns)
    values = _values(columns, rows, counts)
    labels = [i for i, column in enumerate(columns) if column.kind == "shot"]
    shots = [row[i] or str(k + 1) for i in labels for k, (_, row) in enumerate(rows)]
    units = {column.body: column.unit for column in columns if column.kind == "pre"}
    in_order = [units[i + 1] for i in range(len(units))]
    return ShotTable(values, in_order, shots or None)


class Positions(NamedTuple):
    """A measured motion: times (S,) [s], positions (S, n), their errors or None; SI
    units.
    """

    time: np.ndarray
    q: np.ndarray
    sigma: np.ndarray | None


def read_positions(path: str | Path) -> Positions:
    """Read and check a motion: columns `t[s]`, `q_1[m]`, ..., perhaps `sigma_q_1[m]`,
    ...

    Times are equally spaced; an empty `q` cell was not measured.
    """
    where, columns, rows = _read(path, _OF_MOTIONS, _ALLOWED_OF_MOTIONS, "sample")
    keys = [(c.kind, c.body) for c in columns]
    size = max(body for _, body in keys)
    kinds = [
        kind
        for kind in ("q", "sigma_q")
        if kind == "q" or any(k == kind for k, _ in keys)
    ]
    of_bodies = ((kind, i + 1) for kind in kinds for i in range(size))
    required = [("t", 1), *of_bodies]
    if sorted(keys) != sorted(required):
        raise ValueError(
            f"{where}: the columns must be "
            f"{', '.join(f'`{k}_{i}`' for k, i in required[1:])} and `t`, each once, "
            f"but are {', '.join(c.header for c in columns)}."
        )
    counts = dict.fromkeys(("t", *kinds), size)
    values = _values(columns, rows, counts)
    time = values["t"][:, 0]
    at = keys.index(("t", 1))
    last_digit = max(_last_digit(cells[at]) for _, cells in rows)
    rounding = last_digit * columns[at].factor
    even = _even(where, time, rounding)
    return Positions(even, values["q"], values.get("sigma_q"))


def _last_digit(cell: str) -> float:
    """The value of one unit in the last digit of a number as it is written: .001 of
    '0.033'.
    """
    mantissa, _, power = cell.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(10.0 ** (int(power or 0) - decimals))


def _even(where: str, time: np.ndarray, rounding: float) -> np.ndarray:
    """Times (S,) in equal steps: as they are, or a line through them if they were
    rounded, to at most LAST_DIGIT of a step.

    Args:
        where: beginning of a message.
        time: measured, must rise in equal steps but for rounding.
        rounding: one unit in the last digit of the times as they are written [s].

    Raises:
        ValueError: times that do not rise, or in unequal steps.
    """
    rises = np.diff(time) > 0
    if len(time) < 2 or not rises.all():
        raise ValueError(f"{where}: the times `t` must be two or more, and rise.")
    duration = time[-1] - time[0]
    step = duration / (len(time) - 1)
    number = np.arange(len(time))
    even = time[0] + step * number
    off = np.abs(time - even)
    # each end and the time between may be off by half of the last digit
    allowed = UNEVENNESS * step + min(rounding, LAST_DIGIT * step)
    if off.max() <= UNEVENNESS * step:
        return time
    if off.max() > allowed:
        k = int(off.argmax())
        raise ValueError(
            f"{where}: the times `t` must rise in equal steps, but sample {k + 1} at "
            f"{time[k]:g} s is {off[k]:.2g} s off steps of {step:.6g} s; as they are "
            f"written they may be {allowed:.2g} s off."
        )
    slope, start = np.polyfit(number, time, 1)
    return np.asarray(start + slope * number)


def _read(
    path: str | Path, kinds: dict[str, dict[str, float]], allowed: str, what: str
) -> tuple[str, list["CsvColumn"], list[tuple[str, list[str]]]]:
    """Place of the header in words, its columns, and the rows below: (place, cells).

    Args:
        path: CSV file.
        kinds: units by kind of column, with their factors.
        allowed: the columns that may be there, in words.
        what: the noun for a row, 'shot' or 'sample'.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"Data file '{path}' does not exist or is not a file (looked for in "
            f"{path.absolute().parent})."
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: the file must be UTF-8 text, but is not ({error})."
        ) from None
    reader = csv.reader(text.splitlines())
    lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    rows = [(f"{path}, line {number}", row) for number, row in lines if any(row)]
    if not rows:
        raise ValueError(
            f"{path}: the file is empty; its first line must name the columns."
        )
    where, headers = rows[0]
    read = [i for i, header in enumerate(headers) if not _COMMENT.fullmatch(header)]
    columns = [_column(where, i, headers[i], kinds, allowed) for i in read]
    if len(rows) == 1:
        raise ValueError(
            f"{path}: the file has no {what}s; each line below the header is one."
        )
    for line, row in rows[1:]:
        if len(row) != len(headers):
            raise ValueError(
                f"{line}: a {what} must have {len(headers)} values, one per column, "
                f"but has {len(row)} ({_HOW})."
            )
    below = [(line, [row[i] for i in read]) for line, row in rows[1:]]
    return where, columns, below


class CsvColumn(NamedTuple):
    """A column: its kind, of which body (from 1), and its unit."""

    header: str
    kind: str
    body: int
    factor: float  # SI units in one of the file's
    unit: str  # LINEAR or ANGULAR, of velocities


def _column(
    where: str,
    index: int,
    header: str,
    kinds: dict[str, dict[str, float]],
    allowed: str,
) -> CsvColumn:
    """The column that a header cell such as `post_1[m/s]` names; a ValueError for any
    other text.

    Args:
        where: beginning of a message.
        index: of the column, from 0.
        header: text of the cell.
        kinds: units by kind of column, with their factors.
        allowed: the columns that may be there, in words.
    """
    if header == "shot" and kinds is _KINDS:
        return CsvColumn(header, "shot", 0, 1.0, "")
    match = _HEADER.fullmatch(header)
    if match:
        kind, body, unit = match.groups()
    else:
        kind = ""
        body = None
        unit = ""
    if kind not in kinds or (body is None) != (kind == "t"):
        separated = ";" in header or "\t" in header
        if separated:
            advice = _HOW
        else:
            advice = "the first line names columns, bodies count from 1"
        raise ValueError(
            f"{where}: column {index + 1} must be one of {allowed}, but has name "
            f"{header!r} ({advice})."
        )
    units = kinds[kind]
    if body is None:
        name = kind
    else:
        name = f"{kind}_{body}"
    if not unit:
        raise ValueError(
            f"{where}: column `{header}` must state its unit, as in "
            f"`{name}[{next(iter(units))}]`; allowed are {', '.join(units)}."
        )
    if unit.strip() not in units:
        raise ValueError(
            f"{where}: the unit of column `{header}` must be one of "
            f"{', '.join(units)}, but is {unit!r}."
        )
    if unit.strip() in ("rad/s", "deg/s"):
        base = ANGULAR
    else:
        base = LINEAR
    number = int(body or 1)
    return CsvColumn(header, kind, number, units[unit.strip()], base)


def _check_columns(where: str, columns: list[CsvColumn]) -> dict[str, int]:
    """Number of columns of each kind; a ValueError for repeated, missing and mixed
    ones.
    """
    keys = [(c.kind, c.body) for c in columns]
    of_velocities = (*_NEEDED, *_ERRORS)
    velocities = [c for c in columns if c.kind in of_velocities]
    for column, key in zip(columns, keys):
        if keys.count(key) > 1:
            raise ValueError(
                f"{where}: column `{column.header}` must occur once, but is repeated."
            )
        others = {c.unit for c in velocities if c.body == column.body}
        if column in velocities and len(others) > 1:
            raise ValueError(
                f"{where}: all columns of velocity {column.body} must be in m/s or all "
                f"in rad/s, but some are in each."
            )
    given = {kind for kind, _ in keys}
    kinds = [kind for kind in _KINDS if kind in _NEEDED or kind in given]
    if velocities:
        bodies = max(1, *(c.body for c in velocities))
    else:
        bodies = 1
    counts = {  # one for each body; gaps and coordinates q may be more or fewer
        kind: bodies
        if kind in (*_NEEDED, *_ERRORS, "mass")
        else max(body for other, body in keys if other == kind)
        for kind in kinds
    }
    # of every kind, columns 1 to its count
    bodies_at_most = max(counts.values())
    required = [
        (i + 1, k) for i in range(bodies_at_most) for k in kinds if i < counts[k]
    ]
    missing = [f"{kind}_{i}" for i, kind in required if (kind, i) not in keys]
    if missing:
        raise ValueError(
            f"{where}: column `{missing[0]}[unit]` is missing; every body from 1 to "
            f"{bodies} needs "
            f"{', '.join(f'`{kind}`' for kind in kinds if kind not in ('gap', 'q'))}."
        )
    return counts


def _values(
    columns: list[CsvColumn], rows: list[tuple[str, list[str]]], counts: dict[str, int]
) -> dict[str, np.ndarray]:
    """The cells in SI units by kind (rows, `counts[kind]`), checked; NaN where they are
    empty.

    A warning reports cells with the text NaN.
    """
    count = len(rows)
    values = {kind: np.full((count, n), np.nan) for kind, n in counts.items()}
    not_numbers = []
    for k, (line, row) in enumerate(rows):
        for column, cell in zip(columns, row):
            if column.kind == "shot":
                continue
            where = f"{line}, column `{column.header}`"
            number = _number(where, column, cell)
            values[column.kind][k, column.body - 1] = number
            if _is_nan(cell):
                not_numbers.append(where)
        for column in columns:
            if column.kind in _ERRORS:
                measured = values[_ERRORS[column.kind]][k, column.body - 1]
                error = values[column.kind][k, column.body - 1]
                _check_error(line, column, not np.isnan(measured), error)
    if not_numbers:
        warnings.warn(
            f"{not_numbers[0]}: the cell is NaN and counts as not measured, as an "
            f"empty one does; {len(not_numbers)} cells of the file are.",
            stacklevel=1,  # one place for all callers: Python reports it once
        )
    return values


def _is_nan(cell: str) -> bool:
    """True if the text of a cell is NaN."""
    return cell.lower() == "nan"


def _number(where: str, column: CsvColumn, cell: str) -> float:
    """The number in a cell, in SI units; NaN if it is empty, where the column allows
    that.
    """
    if cell == "" or _is_nan(cell):
        if column.kind in ("pre", "mass", "gap", "t"):
            if column.kind == "pre":
                what = "a velocity before the impact"
            else:
                what = "this"
            raise ValueError(
                f"{where}: {what} must be given, but the cell is "
                f"{cell!r}; only `post` may be left empty (not measured)."
            )
        return np.nan
    try:
        number = float(cell)
    except ValueError:
        raise ValueError(
            f"{where}: the value must be a number, but is {cell!r} ({_HOW})."
        ) from None
    if not np.isfinite(number):
        raise ValueError(f"{where}: the value must be finite, but is {cell!r}.")
    if column.kind == "mass" and number <= 0:
        raise ValueError(f"{where}: a mass must be > 0, but is {cell!r}.")
    return number * column.factor


def _check_error(where: str, column: CsvColumn, measured: bool, error: float) -> None:
    """Raise a ValueError if the standard error of a measured value is missing or not
    positive; before the impact, of bodies known to be at rest, it may be 0.
    """
    exact = column.kind == "sigma_pre" and error == 0
    if measured and not error > 0 and not exact:
        if np.isnan(error):
            value = "is empty"
        else:
            value = f"is {error / column.factor:g}"
        raise ValueError(
            f"{where}, column `{column.header}`: the error of a measured value must be "
            f"> 0, but {value}."
        )
