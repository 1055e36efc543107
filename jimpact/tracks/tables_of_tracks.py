"""Tracks in text tables, as trackers, loggers and spreadsheets write them."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jimpact.tools.checks import check_values, short_repr, suggestion

# In m or rad
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
UNITS |= {"rad": 1.0, "deg": np.pi / 180, "1": 1.0}
_OTHER = r"(?:cm|mm|um|µm|km|in|ft|px|pixels?|deg|°|rad|m)"
_MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--", "#n/a"}
SEPARATORS = ("\t", ";", ",", None)  # None: any white space
HEADER_LINES = 100  # among which the names of columns are looked for


def read(
    path: str | Path,
    columns: Sequence[str] | str,
    *,
    time: str | None = None,
    rate: float | None = None,
    unit: str | Sequence[str],
    decimal: str = ".",
) -> tuple[np.ndarray, np.ndarray]:
    """Times and coordinates from a text table with a line of column names.

    Any separator (tab, semicolon, comma, spaces) and any number of lines before the names; `#` may
    be in names; delimiters at the ends of lines and empty cells are allowed. A cell that is empty
    or NaN was not seen. Velocity columns of trackers span the impact: read places.

    Args:
        path: of the file.
        columns: names of those to read, as in the file.
        time: name of the column of times [s]; None: there is none, but a `rate`.
        rate: frames a second, > 0, where each line is a frame.
        unit: of the columns, one for all or one each: m, cm, mm, um, in, ft, rad, deg, or 1
            of a quaternion. It is never guessed; a unit that a name states ('x [mm]') must be this.
        decimal: '.' or ','.

    Returns:
        t (T,) [s], q (T, n) [m] or [rad], NaN where not seen: what `find_impacts` takes. Times
        that were rounded stay so: where frames are equally spaced, give `rate` instead.

    Raises:
        FileNotFoundError: no such file.
        ValueError: neither or both of time and rate, an unknown unit, or not that of a name, no
            such column or two, text in a number, no line of names; with file, line and column.

    >>> import pathlib, tempfile
    >>> import jimpact as ji
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "ball.txt"
    >>> _ = path.write_text("ball A;;\\nt;y;\\n0,00;12,5\\n0,01;;\\n0,02;12,1\\n")
    >>> t, q = ji.tracks.read(path, ["y"], time="t", unit="cm", decimal=",")
    >>> t.tolist(), q.ravel().round(3).tolist()
    ([0.0, 0.01, 0.02], [0.125, nan, 0.121])
    """
    names = [columns] if isinstance(columns, str) else list(columns)
    if not names:
        raise ValueError("Argument `columns` must name a column, but is empty.")
    if (time is None) == (rate is None):
        raise ValueError(
            "Either argument `time` (a column) or `rate` (frames a second) must be given, but "
            f"{'neither' if time is None else 'both'} are."
        )
    if rate is not None:
        check_values("rate", np.asarray(rate, float), low=0.0, open_low=True)
    if decimal not in (".", ","):
        raise ValueError(f"Argument `decimal` must be '.' or ',', but has value {decimal!r}.")
    units = _units(unit, names)
    text = Path(path).read_bytes().decode("utf-8-sig", errors="replace")
    lines = text.splitlines()
    wanted = names if time is None else [*names, time]
    start, separator, header = _header(path, lines, wanted, decimal)
    places = [_place(path, header, name) for name in wanted]
    for name, own in zip(names, units):
        _check_unit_in_name(path, name, own)
    body = [(k, _cells(line, separator)) for k, line in enumerate(lines, 1) if k > start]
    body = [(k, cells) for k, cells in body if any(cell.strip() for cell in cells)]
    if body and not any(char.isdigit() for cell in body[0][1] for char in cell):
        body = body[1:]  # a line of units
    if not body:
        raise ValueError(f"{path}: there are no lines of numbers below the names of the columns.")
    rows = [_numbers(path, k, cells, places, wanted, decimal) for k, cells in body]
    values = np.array(rows, float)
    q = values[:, : len(names)] * [UNITS[own] for own in units]
    t = np.arange(len(q)) / rate if rate is not None else values[:, -1]
    if np.isnan(t).any():
        k = int(np.isnan(t).argmax())
        raise ValueError(
            f"{path}: column `{time}` must have a time in each row, but not in {k + 1}."
        )
    return t, q


def _units(unit: str | Sequence[str], names: list[str]) -> list[str]:
    """Unit of each column, one of `UNITS`, from one for all or one each."""
    units = [unit] * len(names) if isinstance(unit, str) else list(unit)
    if len(units) != len(names) or not all(each in UNITS for each in units):
        raise ValueError(
            f"Argument `unit` must be one of {', '.join(UNITS)}, or one for each of {len(names)} "
            f"columns, but has value {short_repr(unit)}. Pixels are no lengths: multiply by metres "
            "per pixel, and mind that y may point down."
        )
    return units


def _cells(line: str, separator: str | None) -> list[str]:
    """The cells of a line, without quotes and blanks."""
    parts = line.split() if separator is None else line.split(separator)
    return [part.strip().strip('"').strip() for part in parts]


def _header(
    path: str | Path, lines: list[str], wanted: list[str], decimal: str
) -> tuple[int, str | None, list[str]]:
    """Number (from 1) of the line that holds the names `wanted`, its separator, and all its names.

    The first line, and for it the first separator, with which all are among its cells.
    """
    separators = [x for x in SEPARATORS if x != decimal]
    for k, line in enumerate(lines[:HEADER_LINES], 1):
        for separator in separators:
            cells = _cells(line, separator)
            if all(name.strip() in cells for name in wanted):
                return k, separator, cells
    likely = max(
        (_cells(line, x) for line in lines[:HEADER_LINES] for x in separators),
        key=lambda cells: sum(not _is_number(c, decimal) and c != "" for c in cells),
        default=[],
    )
    missing = next((name for name in wanted if name not in likely), wanted[0])
    named = [cell for cell in likely if cell]
    raise ValueError(
        f"{path}: no line holds the names {', '.join(f'`{name}`' for name in wanted)} of columns; "
        f"`{missing}` is missing{suggestion(missing, named)} in {', '.join(named) or 'the file'}."
    )


def _place(path: str | Path, header: list[str], name: str) -> int:
    """Index of the column of this name; a ValueError unless it is there once."""
    if (count := header.count(name.strip())) != 1:
        raise ValueError(f"{path}: column `{name}` must be there once, but is {count} times.")
    return header.index(name.strip())


def _check_unit_in_name(path: str | Path, name: str, unit: str) -> None:
    """Raise where the name of a column states another unit in brackets."""
    stated = re.search(rf"[\[(]\s*({_OTHER})\s*[\])]", name)
    own = {"µm": "um", "°": "deg"}
    if stated and own.get(stated[1], stated[1]) != unit:
        raise ValueError(
            f"{path}: column `{name}` states the unit {stated[1]}, but argument `unit` is {unit!r}."
        )


def _is_number(cell: str, decimal: str) -> bool:
    """True for a cell that is a number with this decimal mark; an empty one is none."""
    try:
        float(cell.replace(decimal, "."))
    except ValueError:
        return False
    return True


def _numbers(
    path: str | Path,
    line: int,
    cells: list[str],
    places: list[int],
    names: list[str],
    decimal: str,
) -> list[float]:
    """Numbers of a line in the columns `places`; NaN where a cell is empty or the line shorter."""
    values = []
    for place, name in zip(places, names):
        cell = cells[place] if place < len(cells) else ""
        if cell.lower() in _MISSING:
            values.append(np.nan)
            continue
        other = "," if decimal == "." else "."
        if other in cell or not _is_number(cell, decimal):
            raise ValueError(
                f"{path}, line {line}, column `{name}`: {cell!r} must be a number with the decimal "
                f"mark {decimal!r} (argument `decimal`)."
            )
        values.append(float(cell.replace(decimal, ".")))
    return values
