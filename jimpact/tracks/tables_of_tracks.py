"""Tracks in tables, as trackers, loggers, motion capture and spreadsheets write
them.
"""

import re
import warnings
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice, product
from pathlib import Path
from typing import Any

import numpy as np

from jimpact.tools.checks import check_values, short_repr, suggestion
from jimpact.tracks.motion_capture import (
    PLACE,
    RATE_WITHIN,
    TURN,
    Capture,
    capture_of,
    check_not_zero,
    encoding_of,
    is_number,
    split_cells,
)

# In m or rad
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
UNITS |= {"rad": 1.0, "deg": np.pi / 180, "1": 1.0}
TIMES = {"ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}  # in s
_OTHER = r"(?:cm|mm|um|µm|km|in|ft|px|pixels?|deg|°|rad|m)"
_MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--", "#n/a"}
SEPARATORS = ("\t", ";", ",", None)  # None: any white space
HEADER_LINES = 100  # among which the names of columns are looked for
# Names of columns that hold numbers of frames, without blanks, marks and capitals
FRAMES = {
    "frame",
    "frames",
    "frameidx",
    "frameindex",
    "framenumber",
    "frameno",
    "framenr",
}
FRAMES |= {"frameid", "framenum"}
# bytes of a file; ten times more would not go into most memories
LARGEST = 2_000_000_000
MOST_LISTED = 10  # values of a column that an error lists
# steps dt differ by less than that share of themselves; times of frames do not
ALIKE = 0.5
Name = str | int


def read(
    path: str | Path,
    columns: Sequence[Name] | Name,
    *,
    time: Name | None = None,
    frame: Name | None = None,
    rate: float | None = None,
    unit: str | Sequence[str] | None = None,
    decimal: str = ".",
    where: Mapping[Name, Any] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Times and coordinates from a table of a tracker, a logger, or motion capture.

    Text with a line of column names: any separator (tab, semicolon, comma, spaces) and
    any number of lines before the names; `#` may be in names; delimiters at the ends of
    lines and empty cells are allowed. A cell that is empty or NaN was not seen.
    Velocity columns of trackers span the impact: read places.

    Motion capture (Qualisys TSV, TRC, CSV of OptiTrack and Vicon, C3D with the extra
    `motion-capture`): a column is 'MARKER axis', 'ball z'; axes are x, y, z as in the
    file, and qx, qy, qz, qw of rigid bodies. Unit, rate and times are those of the file
    where it states them (Qualisys states no unit). Lost frames are NaN, and are never
    filled.

    Args:
        path: of the file, up to 2 GB.
        columns: names of those to read, as in the file; or their numbers, from 0, in a
            table without names.
        time: name or number of the column of times, in s unless its name or a line of
            units states ms, us or ns ('t [ms]', 't_us'); None: there is none, but a
            `rate`.
        frame: name or number of the column of frame numbers, of which each frame has
            its own; its time is the number over `rate`.
        rate: frames a second, > 0; without `frame` each line is one, unless it is
            empty. A rate that the file states must be this.
        unit: of the columns, one for all or one each: m, cm, mm, um, in, ft, rad, deg,
            or 1 of a quaternion. It is never guessed; a unit that the file or a name
            ('x [mm]') states must be this. None: as stated there.
        decimal: '.' or ','.
        where: of a long table with a row for each body and frame: the column, and what
            it must hold, `{"body": "A"}`; other rows are left out.

    Returns:
        t (T,) [s], q (T, n) [m] or [rad], NaN where not seen: what `find_impacts`
        takes. Times that were rounded stay so: where frames are equally spaced, give
        `rate` instead.

    Raises:
        FileNotFoundError: no such file.
        ImportError: a C3D file without ezc3d.
        ValueError: neither or both of time and rate, an unknown unit, or not that of
            the file, no such column or two, no such marker, text in a number, a line
            of more cells than names, no line of names, times or frames that do not rise
            (steps dt, two takes in one file), frames that are missing while `rate`
            counts lines; with file, line and column.

    Warns:
        UserWarning: `rate` counts lines, but a column of frame numbers repeats them.

    >>> import pathlib, tempfile
    >>> import jimpact as ji
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "ball.txt"
    >>> _ = path.write_text("ball A;;\\nt;y;\\n0,00;12,5\\n0,01;;\\n0,02;12,1\\n")
    >>> t, q = ji.tracks.read(path, ["y"], time="t", unit="cm", decimal=",")
    >>> t.tolist(), q.ravel().round(3).tolist()
    ([0.0, 0.01, 0.02], [0.125, nan, 0.121])
    """
    if isinstance(columns, str | int):
        names = [columns]
    else:
        names = list(columns)
    if not names:
        raise ValueError("Argument `columns` must name a column, but is empty.")
    if rate is not None:
        check_values("rate", np.asarray(rate, float), low=0.0, open_low=True)
    if decimal not in (".", ","):
        raise ValueError(
            f"Argument `decimal` must be '.' or ',', but has value {decimal!r}."
        )
    size = Path(path).stat().st_size
    if size > LARGEST:
        raise ValueError(
            f"{path}: a table must have {LARGEST / 1e9:g} GB at most, but has "
            f"{size / 1e9:.3g}: cut it into takes, or leave out columns."
        )
    capture = capture_of(Path(path))
    if capture is not None:
        given = {"time": time, "frame": frame, "where": where}
        return _of_capture(path, capture, names, rate, unit, given)
    units = _units(unit, names)
    table = _table(path, names, _Rows(time, frame, where), decimal)
    for name, own, below in zip(names, units, table.units):
        for text in (str(name), _in_brackets(below)):
            _check_stated_unit(path, str(name), own, stated_unit(text))
    t = _times(path, table, time, frame, rate)
    return t, table.values * [UNITS[own] for own in units]


def _of_capture(
    path: str | Path,
    capture: Capture,
    names: Sequence[Name],
    rate: float | None,
    unit: str | Sequence[str] | None,
    given: Mapping[str, Any],
) -> tuple[np.ndarray, np.ndarray]:
    """Times and coordinates of a table of motion capture; `given`: arguments it does
    not take.
    """
    wrong = [name for name, value in given.items() if value is not None]
    if wrong:
        raise ValueError(
            f"Argument `{wrong[0]}` is not for {capture.format}: its times and frames "
            f"are known."
        )
    found = [capture.column(path, str(name)) for name in names]
    lengths = [k for k, (_, axis) in enumerate(found) if axis in PLACE]
    own = _unit_of_capture(path, capture, unit, len(found), lengths)
    if (
        rate is not None
        and capture.rate is not None
        and not np.isclose(rate, capture.rate, RATE_WITHIN)
    ):
        raise ValueError(
            f"{path}: the file states {capture.rate:g} frames a second, but argument "
            f"`rate` is {rate:g}."
        )
    if capture.rate is not None:
        rate = capture.rate
    q = np.stack([values for values, _ in found], axis=1)
    if capture.t is not None:
        t = capture.t
    elif rate is not None:
        t = np.arange(len(q)) / rate
    else:
        raise ValueError(
            f"{path}: {capture.format} states no rate here: give argument `rate`."
        )
    _check_rising(path, "the times", t)
    if capture.format != "Qualisys TSV":
        markers = (str(name).rpartition(" ")[0] for name in names)
        for marker in dict.fromkeys(markers):
            _check_seen(path, capture, marker)
    scale = [UNITS[own] if k in lengths else 1.0 for k in range(len(found))]
    return t, q * scale


def _check_seen(path: str | Path, capture: Capture, marker: str) -> None:
    """Raise where a marker lies at exactly 0 at an end, see `check_not_zero`."""
    whole = capture.full_name(marker)
    assert whole is not None  # its column has been found
    axes = capture.axes[whole]
    places = [k for k, axis in enumerate(axes) if axis not in TURN]
    check_not_zero(path, marker, capture.values[whole][:, places])


def _unit_of_capture(
    path: str | Path,
    capture: Capture,
    unit: str | Sequence[str] | None,
    count: int,
    lengths: Sequence[int],
) -> str:
    """Unit of lengths: that of the file, which one that is given beside must be."""
    if isinstance(unit, str):
        given = [unit] * count
    else:
        given = list(unit or ())
    if unit is not None and len(given) != count:
        raise ValueError(
            f"Argument `unit` must be one for all, or one for each of {count} columns."
        )
    if given:
        own = {given[k] for k in lengths}
    else:
        own = set()
    if capture.unit is None and lengths and not own:
        raise ValueError(
            f"{path}: {capture.format} states no unit: give argument `unit`."
        )
    if len(own) > 1 or own - set(UNITS):
        raise ValueError(
            f"Argument `unit` must be one unit of all lengths, one of "
            f"{', '.join(UNITS)}, but has value {short_repr(unit)}."
        )
    stated = capture.unit or next(iter(own), "m")
    if own and own != {stated}:
        raise ValueError(
            f"{path}: the file states the unit {stated}, but `unit` is {own.pop()!r}."
        )
    return stated


@dataclass(frozen=True)
class _Rows:
    """What `read` is told of rows: columns of times and of frame numbers, and which
    rows.
    """

    time: Name | None
    frame: Name | None
    where: Mapping[Name, Any] | None


@dataclass(frozen=True)
class _Table:
    """Columns (T, n), the cells of the line of units below their names and that of
    times or frame numbers, these (T,), and numbers of frames beside them.
    """

    values: np.ndarray
    units: list[str]
    order: np.ndarray | None
    beside: tuple[str, np.ndarray] | None


def _table(
    path: str | Path, names: Sequence[Name], rows: _Rows, decimal: str
) -> _Table:
    """The columns of a table of text, which is read line by line."""
    of_rows = [x for x in (rows.time, rows.frame) if x is not None]
    wanted = [*names, *of_rows, *(rows.where or {})]
    numbered = [isinstance(name, int) for name in wanted]
    if any(numbered) and not all(numbered):
        raise ValueError(
            f"Columns must all be names, or all numbers, but are "
            f"{', '.join(map(repr, wanted))}."
        )
    with Path(path).open(encoding=encoding_of(path), errors="replace") as file:
        first = [line.rstrip("\n") for line in islice(file, HEADER_LINES)]
        if all(numbered):
            start, separator = _without_names(path, first, wanted, decimal)
            header: list[str] = []
            places = [int(name) for name in wanted]
        else:
            texts = [str(x) for x in wanted]
            start, separator, header = _header(path, first, texts, decimal)
            places = [_place(path, header, str(name)) for name in wanted]
        count = len(names) + len(of_rows)
        texts = [str(x) for x in wanted]
        columns = _Columns(path, places[:count], texts, decimal)
        choice = _Choice.of(rows.where or {}, places[count:])
        frames = _frames_beside(header)
        if rows.frame is not None:
            frames = []
        lines = chain(first[start:], file)
        body = _body(lines, start + 1, separator, not of_rows)
        units, body = _line_of_units(body)
        for k, cells in body:
            _check_width(path, k, cells, header)
            if choice.takes(cells):
                columns.add(k, cells)
                frames = [some for some in frames if some.takes(cells)]
    values = columns.values()
    if not len(values):
        choice.raise_for_none(path)
        raise ValueError(
            f"{path}: there are no lines of numbers below the names of the columns."
        )
    order = None
    if of_rows:
        order = values[:, -1]
    beside = None
    if frames:
        number = frames[0]
        beside = (number.name, np.array(number.numbers))
    below = [_cell(units, place) for place in places]
    return _Table(values[:, : len(names)], below, order, beside)


def _body(
    lines: Iterable[str], start: int, separator: str | None, counted: bool
) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line that is not empty.

    A line whose cells are all empty is left out, too, unless lines are `counted`: then
    it is a frame in which nothing was seen.
    """
    for k, line in enumerate(lines, start):
        cells = _cells(line, separator)
        frame_without_a_place = counted and line.strip("\n ") != ""
        if any(cells) or frame_without_a_place:
            yield k, cells


def _line_of_units(
    body: Iterator[tuple[int, list[str]]],
) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """Cells of a first line without digits, which is one of units, and the lines after
    it; without such a line no cells, and all lines.
    """
    first = next(body, None)
    if first is None:
        return [], body
    _, cells = first
    text = "".join(cells)
    if text and not any(char.isdigit() for char in text):
        return cells, body
    return [], chain([first], body)


def _check_width(
    path: str | Path, line: int, cells: list[str], header: list[str]
) -> None:
    """Raise where a line has something behind its last name: a name may be missing."""
    beyond = [cell for cell in cells[len(header) :] if cell]
    if header and beyond:
        raise ValueError(
            f"{path}, line {line}: a line must have at most {len(header)} cells, one "
            f"for each name of a column, but has {len(cells)}: does a name lack, as "
            f"that of row numbers, or is the separator a decimal mark, too?"
        )


@dataclass
class _Choice:
    """Rows whose cells hold what `where` says: names of columns, their places and
    values, how many rows pass each, and some cells that did not.
    """

    names: list[Name]
    places: list[int]
    values: list[Any]
    passed: list[int]
    others: list[set[str]]

    @classmethod
    def of(cls, where: Mapping[Name, Any], places: list[int]) -> "_Choice":
        """The choice before the first row."""
        names = list(where)
        none = [0] * len(names)
        others: list[set[str]] = [set() for _ in names]
        values = list(where.values())
        return cls(names, places, values, none, others)

    def takes(self, cells: list[str]) -> bool:
        """True for a row that holds all values."""
        for k, place in enumerate(self.places):
            cell = _cell(cells, place)
            if not _same(cell, self.values[k]):
                if len(self.others[k]) < MOST_LISTED:
                    self.others[k].add(cell)
                return False
            self.passed[k] += 1
        return True

    def raise_for_none(self, path: str | Path) -> None:
        """Raise a ValueError for the first column whose value no row has."""
        for k, name in enumerate(self.names):
            if not self.passed[k] and self.others[k]:
                listed = ", ".join(sorted(self.others[k]))
                raise ValueError(
                    f"{path}: no row has {self.values[k]!r} in column `{name}`, but "
                    f"{listed}."
                )


@dataclass
class _Columns:
    """Numbers of the columns at `places`, with these names, of one row after the
    other.
    """

    path: str | Path
    places: list[int]
    names: list[str]
    decimal: str
    numbers: array = field(default_factory=lambda: array("d"))

    def add(self, line: int, cells: list[str]) -> None:
        """Add the numbers of a line; NaN where a cell is empty or the line shorter."""
        for place, name in zip(self.places, self.names):
            cell = _cell(cells, place)
            if cell.lower() in _MISSING:
                self.numbers.append(np.nan)
                continue
            if self.decimal == ".":
                other = ","
            else:
                other = "."
            if other in cell or not is_number(cell, self.decimal):
                raise ValueError(
                    f"{self.path}, line {line}, column `{name}`: {cell!r} must be a "
                    f"number with the decimal mark {self.decimal!r} (argument "
                    f"`decimal`)."
                )
            self.numbers.append(float(cell.replace(self.decimal, ".")))

    def values(self) -> np.ndarray:
        """The numbers (T, n)."""
        columns = len(self.places)
        return np.array(self.numbers).reshape(-1, columns)


@dataclass
class _FrameNumbers:
    """A column of frame numbers that was not asked for."""

    name: str
    place: int
    numbers: array = field(default_factory=lambda: array("d"))

    def takes(self, cells: list[str]) -> bool:
        """Add the number of a row; False where its cell is no whole number."""
        cell = _cell(cells, self.place)
        if not re.fullmatch(r"-?\d+(\.0*)?", cell):
            return False
        self.numbers.append(float(cell))
        return True


def _frames_beside(header: Sequence[str]) -> list[_FrameNumbers]:
    """Columns whose name is that of frame numbers."""
    return [
        _FrameNumbers(name, place)
        for place, name in enumerate(header)
        if re.sub(r"[^a-z]", "", name.lower()) in FRAMES
    ]


def _cell(cells: Sequence[str], place: int) -> str:
    """The cell at a place, empty where the line is shorter."""
    if place < len(cells):
        return cells[place]
    return ""


def _same(cell: str, value: Any) -> bool:
    """True if a cell holds a value, as text or as a number."""
    if cell == str(value):
        return True
    try:
        return float(cell) == float(value)
    except (TypeError, ValueError):
        return False


def _times(
    path: str | Path,
    table: _Table,
    time: Name | None,
    frame: Name | None,
    rate: float | None,
) -> np.ndarray:
    """Times (T,) [s] of the rows: of their column, of frame numbers, or of lines."""
    if frame is not None:
        if rate is None or time is not None:
            raise ValueError(
                "Argument `frame` needs `rate`, frames a second, and no `time`."
            )
        assert table.order is not None
        _check_rising(path, f"column `{frame}` of frame numbers", table.order)
        return table.order / rate
    if (time is None) == (rate is None):
        raise ValueError(
            f"Either argument `time` (a column) or `rate` (frames a second) must be "
            f"given, but {'neither' if time is None else 'both'} are."
        )
    if rate is None:
        assert table.order is not None
        _check_times(path, str(time), table.order)
        unit = table.units[table.values.shape[1]]
        return table.order * _seconds(str(time), unit)
    if table.beside is not None:
        _check_lines_are_frames(path, *table.beside)
    return np.arange(len(table.values)) / rate


def _check_lines_are_frames(path: str | Path, name: str, frames: np.ndarray) -> None:
    """Raise where frame numbers jump, though lines are counted; warn where they
    repeat.
    """
    steps = np.diff(frames)
    jumps = (steps > 1) | (steps < 0)
    if jumps.any():
        k = int(jumps.argmax())
        raise ValueError(
            f"{path}: column `{name}` goes from {frames[k]:g} to {frames[k + 1]:g}, "
            f"but argument `rate` counts every line as a frame: give frame={name!r} "
            f"beside it."
        )
    if (steps == 0).any():
        warnings.warn(
            f"{path}: column `{name}` repeats frames, but argument `rate` counts every "
            f"line as one: give frame={name!r}, and `where` to choose a body.",
            UserWarning,
            stacklevel=4,
        )


def _check_times(path: str | Path, name: str, t: np.ndarray) -> None:
    """Raise where a column of times has gaps, holds steps dt, or does not rise."""
    if np.isnan(t).any():
        k = int(np.isnan(t).argmax())
        raise ValueError(
            f"{path}: column `{name}` must have a time in each row, but not in {k + 1}."
        )
    alike = np.ptp(t) < ALIKE * t.mean()
    steady = len(t) > 2 and alike and t.min() > 0
    if steady and not (np.diff(t) > 0).all():
        raise ValueError(
            f"{path}: column `{name}` holds steps between frames, about "
            f"{np.median(t):.4g} s, not times: write their sums into a column, or give "
            f"`rate`."
        )
    _check_rising(path, f"column `{name}`", t)


def _check_rising(path: str | Path, what: str, t: np.ndarray) -> None:
    """Raise where times or frame numbers do not rise."""
    steps = np.diff(t)
    if (steps > 0).all():
        return
    k = int(np.argmin(steps > 0))
    if steps[k] == 0:
        why = "is this a long table of several bodies (`where`)?"
    else:
        why = "are these two takes in one file, or several bodies (`where`)?"
    raise ValueError(
        f"{path}: {what} must rise, but {t[k]:g} is followed by {t[k + 1]:g} in row "
        f"{k + 2}: {why}"
    )


def _units(unit: str | Sequence[str] | None, names: Sequence[Name]) -> list[str]:
    """Unit of each column, one of `UNITS`, from one for all or one each; None: as names
    state.
    """
    if unit is None:
        stated = [stated_unit(str(name)) for name in names]
        if not all(stated):
            raise ValueError(
                "Argument `unit` must be given, as names of columns state none: one of "
                f"{', '.join(UNITS)}."
            )
        units = [str(each) for each in stated]
    else:
        if isinstance(unit, str):
            units = [unit] * len(names)
        else:
            units = list(unit)
    known = all(of_column in UNITS for of_column in units)
    if len(units) != len(names) or not known:
        raise ValueError(
            f"Argument `unit` must be one of {', '.join(UNITS)}, or one for each of "
            f"{len(names)} columns, but has value {short_repr(unit)}. Pixels are no "
            f"lengths: multiply by metres per pixel, and mind that y may point down."
        )
    return units


def stated_unit(name: str) -> str | None:
    """Unit in brackets in the name of a column; None without."""
    stated = re.search(rf"[\[(]\s*({_OTHER})\s*[\])]", name)
    own = {"µm": "um", "°": "deg"}
    if stated:
        return own.get(stated[1], stated[1])
    return None


def _in_brackets(cell: str) -> str:
    """A cell of the line of units as a unit in the name of a column: '[mm]'."""
    return f"[{cell.strip('[]()')}]"


def _seconds(name: str, below: str) -> float:
    """Seconds of one unit of times, which the end of a column's name, or the cell of
    the line of units below it states: 't [ms]', 'time_us'; 1 without.
    """
    for text in (name, _in_brackets(below)):
        stated = re.search(r"[\[(_ ]\s*(ms|us|µs|ns)\s*[\])]?$", text.strip())
        if stated:
            return TIMES[stated[1]]
    return 1.0


def _check_stated_unit(
    path: str | Path, name: str, unit: str, stated: str | None
) -> None:
    """Raise where the file states another unit of a column."""
    if stated and stated != unit:
        raise ValueError(
            f"{path}: column `{name}` states the unit {stated}, but argument `unit` is "
            f"{unit!r}."
        )


def _cells(line: str, separator: str | None) -> list[str]:
    """The cells of a line, without quotes and blanks."""
    if separator is None:
        parts = line.split()
    else:
        parts = split_cells(line.rstrip("\n"), separator)
    bare = (part.strip().strip('"') for part in parts)
    return [part.strip() for part in bare]


def _without_names(
    path: str | Path, lines: list[str], wanted: Sequence[Name], decimal: str
) -> tuple[int, str | None]:
    """Number of lines before the numbers of a table without names, and its separator.

    The first line, and for it the first separator, whose cells with these numbers hold
    numbers.
    """
    last = max(int(name) for name in wanted)
    for k, line in enumerate(lines[:HEADER_LINES]):
        for separator in (x for x in SEPARATORS if x != decimal):
            cells = _cells(line, separator)
            if len(cells) > last and is_number(cells[int(wanted[0])], decimal):
                return k, separator
    raise ValueError(
        f"{path}: no line has a number in column {wanted[0]} and {last + 1} columns "
        f"(they are counted from 0)."
    )


def _header(
    path: str | Path, lines: list[str], wanted: list[str], decimal: str
) -> tuple[int, str | None, list[str]]:
    """Number (from 1) of the line that holds the names `wanted`, its separator, and all
    its names.

    The first line, and for it the first separator, with which all are among its cells.
    A mark of a comment before the first name is none of the names (`numpy.savetxt`
    writes one), unless a wanted name has it.
    """
    separators = [x for x in SEPARATORS if x != decimal]
    for k, line in enumerate(lines[:HEADER_LINES], 1):
        readings = (line, re.sub(r"^\s*[#%]\s", "", line))
        for text, separator in product(readings, separators):
            cells = _cells(text, separator)
            if "#" in cells and "#" not in wanted:
                continue
            if all(name.strip() in cells for name in wanted):
                return k, separator, cells
    likely = max(
        (_cells(line, x) for line in lines[:HEADER_LINES] for x in separators),
        key=lambda cells: sum(not is_number(c, decimal) and c != "" for c in cells),
        default=[],
    )
    missing = next((name for name in wanted if name not in likely), wanted[0])
    named = [cell for cell in likely if cell]
    raise ValueError(
        f"{path}: none of the first {HEADER_LINES} lines holds the names "
        f"{', '.join(f'`{name}`' for name in wanted)} of columns; `{missing}` is "
        f"missing in {', '.join(named) or 'the file'}.{suggestion(missing, named)}"
    )


def _place(path: str | Path, header: list[str], name: str) -> int:
    """Index of the column of this name; a ValueError unless it is there once."""
    if (count := header.count(name.strip())) != 1:
        raise ValueError(
            f"{path}: column `{name}` must be there once, but is {count} times."
        )
    return header.index(name.strip())
