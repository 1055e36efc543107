"""Tables of motion capture: one name for three columns, units and rates in the head.

Qualisys TSV, TRC, the CSV files of OptiTrack Motive and of Vicon Nexus, and C3D. Axes
are as in the file: x, y, z, and qx .. qw of rigid bodies. A marker that was lost is
NaN, by each format's mark.
"""

import csv
import math
import warnings
from array import array
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice, takewhile
from pathlib import Path

import numpy as np

from jimpact.tools.checks import needed, suggestion

Lines = Iterator[tuple[int, str]]  # numbers of lines, from 1, and their text
PLACE = ("x", "y", "z")
TURN = ("qx", "qy", "qz", "qw")
# Share of a step between frames to which times must agree with a rate that a file
# states beside them, beyond the rounding of their last digit. Ten times more would pass
# 59.94 for 60 frames a second, which is an error of .1 %.
RATE_WITHIN = 5e-4
# Share of a step that the last digit of times may be; where it is more, equally spaced
# frames have the times of their numbers.
DIGIT_WITHIN = 1e-3
# frames of exactly 0, 0, 0 in a row from which on a marker was lost there
AT_AN_END = 2
HEAD = 2  # columns before those of markers: number of the frame, and time
LENGTHS = {
    "meters": "m",
    "metres": "m",
    "millimeters": "mm",
    "centimeters": "cm",
    "m": "m",
}
LENGTHS |= {
    "millimetres": "mm",
    "centimetres": "cm",
    "mm": "mm",
    "cm": "cm",
    "meter": "m",
}


@dataclass(frozen=True)
class Capture:
    """A table of motion capture.

    Fields: format; axes and places (T, k) of each marker; unit of lengths and rate
    [frames a second] that the file states, None where it does not; times t (T,) [s],
    None where it has none.
    """

    format: str
    axes: dict[str, tuple[str, ...]]
    values: dict[str, np.ndarray]
    unit: str | None
    rate: float | None
    t: np.ndarray | None

    def column(self, path: str | Path, name: str) -> tuple[np.ndarray, str]:
        """The column "MARKER axis" (T,), and its axis."""
        marker, _, axis = name.strip().rpartition(" ")
        axis = axis.lower()
        found = self.full_name(marker)
        if found is None or axis not in self.axes[found]:
            raise ValueError(self._missing(path, name, marker, axis))
        place = self.axes[found].index(axis)
        return self.values[found][:, place], axis

    def full_name(self, name: str) -> str | None:
        """Full name of a marker; where 'subject:marker' is meant, the marker alone will
        do.
        """
        if name in self.axes:
            return name
        ends = [x for x in self.axes if x.rpartition(":")[-1] == name]
        if len(ends) == 1:
            return ends[0]
        return None

    def _missing(self, path: str | Path, name: str, marker: str, axis: str) -> str:
        """Sentence of an error: what is missing, and what is there."""
        there = ", ".join(self.axes)
        whole = self.full_name(name.strip())
        if whole is not None:
            axes = ", ".join(self.axes[whole])
            return f"{path}: marker `{name}` needs an axis, '{name} x': it has {axes}."
        if name.strip().lower() in (*PLACE, *TURN):
            return (
                f"{path}: axis `{name}` needs a marker, 'MARKER {name}', one of "
                f"{there}."
            )
        found = self.full_name(marker)
        if found is not None:
            return (
                f"{path}: marker `{marker}` has no axis `{axis}`, but "
                f"{', '.join(self.axes[found])}."
            )
        return (
            f"{path}: marker `{marker or name}` is missing in {there}."
            f"{suggestion(marker or name, self.axes)} A column is 'MARKER axis'."
        )


def capture_of(path: Path) -> Capture | None:
    """The table of motion capture in a file; None where it is none of the formats."""
    with path.open("rb") as file:
        begin = file.read(64)
    if path.suffix.lower() == ".c3d":
        return _c3d(path)
    encoding = encoding_of(path)
    text = begin.decode(encoding, errors="replace").lstrip()
    readers = {
        "NO_OF_FRAMES": _qualisys,
        "FILE_VERSION": _qualisys,
        "PathFileType": _trc,
        "Format Version": _optitrack,
        "Trajectories": _vicon,
    }
    for word, reader in readers.items():
        if text.strip('"').startswith(word):
            with path.open(encoding=encoding, errors="replace") as file:
                lines = enumerate((line.rstrip("\n") for line in file), 1)
                return reader(path, lines)
    return None


def encoding_of(path: str | Path) -> str:
    """UTF-16 of a text that begins with its mark, as spreadsheets save Unicode text;
    else UTF-8.
    """
    with Path(path).open("rb") as file:
        mark = file.read(2)
    if mark in (BOM_UTF16_LE, BOM_UTF16_BE):
        return "utf-16"
    return "utf-8-sig"


def split_cells(line: str, separator: str) -> list[str]:
    """The cells of a line; separators within quotes belong to their cell."""
    if '"' in line:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return line.split(separator)


def is_number(cell: str, decimal: str = ".") -> bool:
    """True for a cell that is a finite number with this decimal mark; an empty one is
    none.
    """
    try:
        number = float(cell.replace(decimal, "."))
    except ValueError:
        return False
    return math.isfinite(number) and "_" not in cell


def _number(path: Path, line: int, cell: str) -> float:
    """A cell as a number, NaN where it is empty."""
    cell = cell.strip().strip('"')
    if not cell or cell.lower() in ("nan", "null", "na"):
        return np.nan
    if not is_number(cell):
        raise ValueError(f"{path}, line {line}: {cell!r} must be a number.")
    return float(cell)


@dataclass(frozen=True)
class _Numbers:
    """Numbers (T, width) of rows, and the last `digit` of their second cells, times
    [s].
    """

    values: np.ndarray
    digit: float


def _rows(
    path: Path,
    rows: Iterable[tuple[int, list[str]]],
    width: int,
    counted: bool = False,
) -> _Numbers:
    """Numbers of rows of cells, one row after the other; NaN where one is shorter.

    A row whose cells are all empty is left out; where rows are `counted`, as they hold
    neither frame nor time, it is a frame in which nothing was seen, unless it is an
    empty line. A ValueError of a row with something beyond `width`.
    """
    found = array("d")
    digits = 0
    for line, cells in rows:
        frame_without_a_marker = counted and len(cells) > 1
        if not any(cell.strip() for cell in cells) and not frame_without_a_marker:
            continue
        beyond = [cell for cell in cells[width:] if cell.strip()]
        if beyond:
            raise ValueError(
                f"{path}, line {line}: a line must have at most {width} cells, as many "
                f"as the head has columns, but has {len(cells)}."
            )
        row = [_number(path, line, cell) for cell in cells[:width]]
        missing = [np.nan] * (width - len(row))
        found.extend(row + missing)
        if len(cells) > 1:
            *_, decimals = cells[1].strip().partition(".")
            digits = max(digits, len(decimals))
    if not found:
        raise ValueError(
            f"{path}: there are no lines of numbers below the names of the markers."
        )
    numbers = np.array(found).reshape(-1, width)
    return _Numbers(numbers, 10.0**-digits)


def _cells(lines: Lines, separator: str) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line."""
    for k, line in lines:
        yield k, split_cells(line, separator)


def _head(path: Path, lines: Lines, separator: str, count: int) -> list[list[str]]:
    """Cells, without blanks, of so many lines; a ValueError where there are fewer."""
    rows = list(islice(_cells(lines, separator), count))
    if len(rows) < count:
        raise ValueError(
            f"{path}: the head has {count} lines, this file {len(rows)} in all."
        )
    return [[cell.strip() for cell in cells] for _, cells in rows]


def _in_threes(names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """Places (T, 3) of markers, whose columns follow one another."""
    places = values.reshape(len(values), len(names), 3)
    return {name: places[:, k] for k, name in enumerate(names)}


def _check_once(path: Path, names: Sequence[str]) -> None:
    """Raise a ValueError unless each marker has its own name, and there is one."""
    twice = sorted({x for x in names if names.count(x) > 1})
    if twice or not names:
        if twice:
            what = f"names markers twice: {', '.join(twice)}"
        else:
            what = "names no markers"
        raise ValueError(f"{path}: the file {what}.")


def _qualisys(path: Path, lines: Lines) -> Capture:
    """Qualisys TSV: rows KEY value, perhaps a row of names of columns; a lost marker is
    0, 0, 0.
    """
    head: dict[str, list[str]] = {}
    rows = _cells(lines, "\t")
    for row in rows:
        _, cells = row
        key = cells[0].strip()
        is_head = key.lower() in ("frame", "time")
        if is_number(key) or is_head or (head and not key):
            names_of_columns = any(cells) and not any(map(is_number, cells))
            if not names_of_columns:
                rows = chain([row], rows)
            break
        _, *words = cells
        head[key] = [word.strip() for word in words]
    included = (head.get("DATA_INCLUDED") or ["3D"])[0]
    if included != "3D" or "MARKER_NAMES" not in head:
        raise ValueError(
            f"{path}: DATA_INCLUDED must be 3D, places of markers (MARKER_NAMES), but "
            f"is {included}: export the 3D data."
        )
    names = [name for name in head["MARKER_NAMES"] if name]
    _check_once(path, names)
    of_numbers = (row for row in rows if len(row[1]) > 1)
    first = next(of_numbers, (0, [""]))
    _, cells = first
    before = max(_width(cells) - 3 * len(names), 0)  # frame, time
    if before > 2:
        raise ValueError(
            f"{path}: lines have {before} cells more than {len(names)} markers need."
        )
    width = before + 3 * len(names)
    body = _rows(path, chain([first], rows), width, counted=not before)
    values = body.values
    places = values[:, before:].reshape(len(values), len(names), 3)
    lost = (places == 0).all(axis=2)
    places = np.where(lost[:, :, None], np.nan, places)
    frames_in_words, *_ = head.get("NO_OF_FRAMES") or [""]
    _check_count(path, "NO_OF_FRAMES", frames_in_words, values)
    rate_in_words, *_ = head.get("FREQUENCY") or [""]
    rate = _stated(path, "FREQUENCY", rate_in_words)
    t = _times_of_qualisys(values[:, :before], rate)
    found = dict(zip(names, places.swapaxes(0, 1)))
    return Capture("Qualisys TSV", dict.fromkeys(names, PLACE), found, None, rate, t)


def _times_of_qualisys(head: np.ndarray, rate: float | None) -> np.ndarray | None:
    """Times (T,) [s] by the columns before those of markers, none, one or two.

    The last one holds times; one alone that holds whole numbers, numbers of frames.
    None where lines have neither, or frames no rate.
    """
    count = head.shape[1]
    if count == 0:
        return None
    last = head[:, -1]
    if count == 2 or (last % 1).any():
        return last
    if rate is None:
        return None
    return (last - last[0]) / rate


def _check_count(path: Path, key: str, cell: str, rows: np.ndarray) -> None:
    """Warn where a file has not so many frames as its head says in `cell`."""
    if not is_number(cell) or float(cell) == len(rows):
        return
    warnings.warn(
        f"{path}: {key} is {cell}, but the file has {len(rows)} frames: if it was cut "
        f"off, or lost lines, times may be wrong.",
        UserWarning,
        stacklevel=5,
    )


def _width(cells: Sequence[str]) -> int:
    """Number of cells of a row, without the one behind a separator at its end.

    Lost markers leave three empty cells; a separator at the end leaves one more.
    """
    from_end = reversed(cells)
    empty = len(list(takewhile(lambda cell: not cell.strip(), from_end)))
    return len(cells) - (empty % 3 == 1)


def _stated(path: Path, key: str, cell: str) -> float | None:
    """A rate that a head states, > 0; None where it does not."""
    if not cell.strip():
        return None
    if is_number(cell):
        rate = float(cell)
    else:
        rate = 0.0
    if not 0 < rate < np.inf:
        raise ValueError(f"{path}: {key} must be a rate > 0, but is {cell!r}.")
    return rate


def _without_head(values: np.ndarray) -> np.ndarray:
    """The columns of markers."""
    return values[:, HEAD:]


def _trc(path: Path, lines: Lines) -> Capture:
    """TRC: keys and values in two rows, names above X1 Y1 Z1; a lost marker is
    empty.
    """
    _, keys, words, of_markers, _ = _head(path, lines, "\t", 5)
    head = dict(zip(keys, words))
    names = [x for x in of_markers[HEAD:] if x]
    _check_once(path, names)
    rows = _rows(path, _cells(lines, "\t"), HEAD + 3 * len(names))
    _check_count(path, "NumFrames", head.get("NumFrames", ""), rows.values)
    frames, times, *_ = rows.values.T
    found = _in_threes(names, _without_head(rows.values))
    unit = _unit(path, "Units", head.get("Units", ""))
    rate = _stated(path, "DataRate", head.get("DataRate", ""))
    t = _times(path, frames, times, rate, rows.digit)
    return Capture("TRC", dict.fromkeys(names, PLACE), found, unit, rate, t)


def _unit(path: Path, key: str, cell: str) -> str | None:
    """A unit of lengths that a head states; None where it does not."""
    if not cell.strip():
        return None
    unit = LENGTHS.get(cell.strip().lower())
    if unit is None:
        raise ValueError(f"{path}: {key} must be a unit of lengths, but is {cell!r}.")
    return unit


def _times(
    path: Path, frames: np.ndarray, t: np.ndarray, rate: float | None, digit: float
) -> np.ndarray:
    """Times (T,) [s]: as in the file; those of equally spaced frames where their digits
    are few.

    `digit`: value of the last digit of times [s]. They must agree with the stated rate.
    """
    if rate is None or len(t) < 2:
        return t
    step = float(np.nanmedian(np.diff(t)))
    per_frame = float(np.nanmedian(np.diff(frames)))
    apart = abs(step - per_frame / rate)
    if per_frame > 0 and apart > digit + RATE_WITHIN / rate:
        raise ValueError(
            f"{path}: the file states {rate:g} frames a second, but its times are "
            f"{step:g} s apart, {1 / step:.6g} a second: which one is right? Correct "
            f"the file."
        )
    running = (np.diff(frames) == 1).all()
    if running and digit * rate > DIGIT_WITHIN:
        return t[0] + (frames - frames[0]) / rate
    return t


def _optitrack(path: Path, lines: Lines) -> Capture:
    """CSV of OptiTrack Motive: a row of keys and values, rows with the name, kind and
    axis of each column, then frames.

    The first columns are frame and time; an empty cell is a place that was lost. Of
    rotations quaternions are read, angles are left out.
    """
    rows = _cells(lines, ",")
    _, first = next(rows)
    first = [x.strip().strip('"') for x in first]
    keys = first[::2]
    head = dict(zip(keys, first[1::2]))
    names, kinds, axes = _heads_of_optitrack(path, rows)
    quaternions = head.get("Rotation Type", "Quaternion") == "Quaternion"
    columns = _columns_of_optitrack(names, kinds, axes, quaternions)
    body = _rows(path, rows, len(axes))
    values = body.values
    exported = "Total Exported Frames"
    _check_count(path, exported, head.get(exported, ""), values)
    order = {
        name: tuple(axis for axis in (*PLACE, *TURN) if axis in of_axes)
        for name, of_axes in columns.items()
    }
    found = {
        name: values[:, [columns[name][axis] for axis in order[name]]]
        for name in columns
    }
    export_rate = head.get("Export Frame Rate")
    rate_in_words = export_rate or head.get("Capture Frame Rate", "")
    rate = _stated(path, "rate", rate_in_words)
    unit = _unit(path, "Length Units", head.get("Length Units", ""))
    frames, times, *_ = values.T
    t = _times(path, frames, times, rate, body.digit)
    return Capture("OptiTrack CSV", order, found, unit, rate, t)


def _columns_of_optitrack(
    names: Sequence[str],
    kinds: Sequence[str],
    axes: Sequence[str],
    quaternions: bool,
) -> dict[str, dict[str, int]]:
    """Column of each axis by name: x, y, z, and with `quaternions` qx .. qw."""
    columns: dict[str, dict[str, int]] = {}
    known = min(len(names), len(kinds), len(axes))
    for k in range(HEAD, known):
        axis = axes[k].lower()
        if kinds[k] == "Rotation" and quaternions:
            axis = f"q{axis}"
        elif kinds[k] != "Position":
            continue
        if names[k]:
            columns.setdefault(names[k], {})[axis] = k
    return columns


def _heads_of_optitrack(
    path: Path, rows: Iterable[tuple[int, list[str]]]
) -> tuple[list[str], list[str], list[str]]:
    """The rows of names, of Position or Rotation, and of axes, which is the row Frame
    and the last one of the head.

    Rows are Type, Name, ID, perhaps Parent; older files leave these words out.
    """
    found: list[list[str]] = []
    for _, cells in rows:
        row = [x.strip().strip('"') for x in cells]
        if row[0] == "Frame":
            kinds = [x for x in found if {"Position", "Rotation"} & set(x)]
            # without words in front, names are in the second row
            labelled = [x for x in found if x[1] == "Name"]
            names = labelled or found[1:]
            if kinds and names:
                return names[0], kinds[-1], row
        if any(row) and len(row) > 1:
            found.append(row)
    raise ValueError(
        f"{path}: rows Name, Position or Rotation, and Frame must be in the head."
    )


def _vicon(path: Path, lines: Lines) -> Capture:
    """CSV of Vicon Nexus: its part Trajectories, to the next empty line; lost is
    empty.
    """
    _, (rate_in_words, *_), of_markers, _, of_units = _head(path, lines, ",", 5)
    rate = _stated(path, "the rate in line 2", rate_in_words)
    names = [x for x in of_markers if x]
    _check_once(path, names)
    units = {x for x in of_units if x}
    if len(units) != 1:
        raise ValueError(
            f"{path}, line 5: all units must be the same, but are {sorted(units)}."
        )
    every_row = _cells(lines, ",")
    part = takewhile(lambda row: any(cell.strip() for cell in row[1]), every_row)
    values = _rows(path, part, HEAD + 3 * len(names)).values
    found = _in_threes(names, _without_head(values))
    frames = values[:, 0]
    if rate is None:
        t = None
    else:
        t = (frames - 1) / rate
    unit = _unit(path, "line 5", units.pop())
    return Capture("Vicon CSV", dict.fromkeys(names, PLACE), found, unit, rate, t)


def _c3d(path: Path) -> Capture:
    """C3D by ezc3d; times are (number of the frame - 1) / rate; residual < 0 is
    lost.
    """
    ezc3d = needed("ezc3d", "pip install 'jimpact[motion-capture]'")
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    x, y, z, _ = file["data"]["points"]  # each of markers and frames
    labels = point["LABELS"]["value"][: len(x)]
    names = [str(name).strip() for name in labels]
    _check_once(path, names)
    places = np.stack([x, y, z], axis=-1)  # (markers, T, 3)
    lost = file["data"]["meta_points"]["residuals"][0] < 0
    places[lost] = np.nan
    rate = float(point["RATE"]["value"][0])
    units = point.get("UNITS", {}).get("value") or [""]
    first = int(file["header"]["points"]["first_frame"])  # from 0
    t = (first + np.arange(places.shape[1])) / rate
    unit = _unit(path, "POINT:UNITS", str(units[0]))
    found = dict(zip(names, places))
    return Capture("C3D", dict.fromkeys(names, PLACE), found, unit, rate, t)


def check_not_zero(path: str | Path, name: str, places: np.ndarray) -> None:
    """Raise where a marker (T, k) is at exactly 0 in some frames at an end: it was lost
    there.
    """
    zero = (places == 0).all(axis=1)
    runs = {"first": zero, "last": zero[::-1]}
    for end, some in runs.items():
        if some.all():
            count = len(some)
        else:
            count = int(np.argmin(some))
        if count >= AT_AN_END:
            raise ValueError(
                f"{path}: marker `{name}` is at exactly 0, 0, 0 in the {end} {count} "
                f"frames, as some programs write what was not seen: make these cells "
                f"empty."
            )
