"""Results as data for a JSON file, and as tables: in text, CSV and pandas."""

import csv
import dataclasses
import io
import re
import shutil
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jimpact.tools.checks import needed

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import

# share of a scale that is printed as 0; ten times more hides small velocities
_ROUNDING = 1e-12
# characters of a column whose text is wrapped; narrower ones are not readable
_LEAST_WIDTH = 20


def as_data(value: Any) -> Any:
    """Records, arrays and mappings as dicts, lists and numbers of a JSON file; NaN, inf
    as None.

    >>> import numpy as np
    >>> from jimpact.tools.records import as_data
    >>> as_data({"velocity": np.array([1.0, np.nan]), "bodies": (1, 2)})
    {'velocity': [1.0, None], 'bodies': [1, 2]}
    """
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if hasattr(value, "_asdict"):
        value = value._asdict()
    elif dataclasses.is_dataclass(value):
        value = {
            field.name: getattr(value, field.name)
            for field in dataclasses.fields(value)
        }
    elif hasattr(value, "__array__"):
        value = np.asarray(value).tolist()
    if isinstance(value, Mapping):
        return {key: as_data(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [as_data(each) for each in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def fields_as_data(record: Any, *left_out: str) -> dict[str, Any]:
    """The fields of a record but for those left out, see `as_data`."""
    return {
        name: as_data(x) for name, x in vars(record).items() if name not in left_out
    }


def number(value: float | None, form: str) -> str:
    """A number as text in the format `form`, '' for None and NaN.

    >>> from jimpact.tools.records import number
    >>> number(0.25, ".1f"), number(float("nan"), ".1f"), number(None, ".1f")
    ('0.2', '', '')
    """
    if value is None or np.isnan(value):
        return ""
    return format(value, form)


def one_digit(x: float | None) -> str:
    """A number that another run may change by a few times, as text; '' for None.

    >>> from jimpact.tools.records import one_digit
    >>> one_digit(27.7), one_digit(1.41), one_digit(None)
    ('30', '1', '')
    """
    if x is None:
        return ""
    return number(float(f"{x:.1g}"), "g")


def microseconds(time: float | None) -> str:
    """A time [s] in microseconds as text, '' for None: one digit, as it was measured.

    >>> from jimpact.tools.records import microseconds
    >>> microseconds(1.234e-5)
    '10'
    """
    return one_digit(None if time is None else 1e6 * time)


def listed(labels: Sequence[str], most: int = 6) -> str:
    """The first labels of a list as text, "..." in the place of the others; at most
    `most`.

    >>> from jimpact.tools.records import listed
    >>> listed(["1", "2"]), listed("abcd", 3)
    ('1, 2', 'a, b, c, ...')
    """
    return ", ".join([*labels[:most], *(["..."] if len(labels) > most else [])])


def readable_unit(unit: str, largest: float) -> tuple[str, float]:
    """Multiple of an SI unit in which `largest` has 1 to 3 digits before the point, and
    its size.

    >>> from jimpact.tools.records import readable_unit
    >>> readable_unit("m", 3e-5), readable_unit("s", 2.0)
    (('µm', 1e-06), ('s', 1.0))
    """
    sizes = {unit: 1.0, f"m{unit}": 1e-3, f"µ{unit}": 1e-6, f"n{unit}": 1e-9}
    return next((row for row in sizes.items() if largest >= row[1]), (f"n{unit}", 1e-9))


def counted(count: int, noun: str, plural: str = "") -> str:
    """A number of things in words: `count` and the noun, in the plural unless it is 1.

    `plural`: the plural of a noun where this is not the noun and s.

    >>> from jimpact.tools.records import counted
    >>> counted(1, "shot"), counted(2000, "sample"), counted(2, "body", "bodies")
    ('1 shot', '2,000 samples', '2 bodies')
    """
    return f"{count:,} {noun if count == 1 else plural or f'{noun}s'}"


def degrees(count: int) -> str:
    """A number of degrees of freedom, in words.

    >>> from jimpact.tools.records import degrees
    >>> degrees(1), degrees(2)
    ('1 degree of freedom', '2 degrees of freedom')
    """
    return counted(count, "degree of freedom", "degrees of freedom")


def formatted(value: Any, form: str) -> str:
    """A number or text by Python's `format`; a number that rounds to 0 has no minus
    sign.

    >>> from jimpact.tools.records import formatted
    >>> formatted(-0.0, "6g"), formatted(-4e-9, ".5f"), formatted(-0.01, ".1e")
    ('     0', '0.00000', '-1.0e-02')
    >>> formatted("air-track", "")
    'air-track'
    """
    text = format(value, form)
    if isinstance(value, str):
        return text
    mantissa = re.split("[eE]", text)[0]
    rounds_to_zero = not re.search("[1-9]|inf", mantissa, re.IGNORECASE)
    if rounds_to_zero and "-" in mantissa:
        return format(abs(value), form)
    return text


def plain(value: float, scale: float = 1.0) -> float:
    """The value, 0 where it is rounding beside `scale`, so that no report has a -0.

    >>> from jimpact.tools.records import plain
    >>> plain(-0.0), plain(-1e-17), plain(-0.5)
    (0.0, 0.0, -0.5)
    """
    if abs(value) <= _ROUNDING * abs(scale):
        return 0.0
    return value


def with_error(value: float, error: float) -> str:
    """A value and its standard error as text, to the error's first digit (two if this
    is 1).

    >>> from jimpact.tools.records import with_error
    >>> with_error(0.99123, 0.0042), with_error(131.7, 18.2), with_error(0.4, 0.0)
    ('0.991 ± 0.004', '132 ± 18', '0.4 ± 0')
    """
    if not 1e-9 * abs(value) < error < np.inf:
        return f"{value:.6g} ± {error:.2g}"
    power = int(np.floor(np.log10(error)))
    # two digits of an error that begins with 1
    digits = max(0, -power + (error < 2 * 10.0**power))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def table(
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    left: Sequence[str] = (),
    keys: int = 1,
) -> list[str]:
    """Lines of a table; the first column and those with a head in `left` are text,
    others numbers.

    On a terminal that is too narrow the columns are split into several tables, one
    below the other, each with the first `keys` columns; text at the end of a line is
    wrapped.

    >>> from jimpact.tools.records import table
    >>> table(["law", "e", "status"], [["newton", "0.5", "ok"]], left=["status"])
    ['law       e  status', 'newton  0.5  ok']
    """
    all_rows = [list(heads), *map(list, rows)]
    widths = [max(map(len, column)) for column in zip(*all_rows)]
    is_text = [i == 0 or head in left for i, head in enumerate(heads)]
    # no terminal: all
    room = shutil.get_terminal_size((sum(widths) + 2 * len(widths), 0)).columns
    lines: list[str] = []
    for part in _parts(widths, keys, room):
        if lines:
            lines += [""]
        else:
            lines += []
        # characters before the last column
        before = sum(widths[i] + 2 for i in part[:-1])
        for row in all_rows:
            cells = (
                row[i].ljust(widths[i]) if is_text[i] else row[i].rjust(widths[i])
                for i in part
            )
            line = "  ".join(cells).rstrip()
            wrapped = is_text[part[-1]] and len(line) > room > before + _LEAST_WIDTH
            if wrapped:
                lines += textwrap.wrap(line, room, subsequent_indent=" " * before)
            else:
                lines += [line]
    return lines


class Column(NamedTuple):
    """A column: its name in data and CSV, head and unit in print, and the form of its
    numbers.

    `form`: as of `format`, or a function of the value. Text stands on the left.
    """

    name: str
    form: str | Callable[[Any], str] = ""
    head: str = ""
    unit: str = ""

    @property
    def title(self) -> str:
        """The head with its unit."""
        return (self.head or self.name) + (f" [{self.unit}]" if self.unit else "")

    def cell(self, value: Any) -> str:
        """A value as it is printed; '' for None and NaN, unless `form` is a
        function.
        """
        if callable(self.form):
            return self.form(value)
        if value is None or value != value:
            return ""
        return formatted(value, self.form)


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of values under columns; `print` leaves out columns that are empty.

    Attributes:
        columns: the columns.
        rows: a value for each column; None or NaN: an empty cell.
        head: lines above.
        notes: lines below.
        keys: how many columns are repeated where a terminal is too narrow for one
            table.

    >>> from jimpact.tools.records import Column, Table
    >>> columns = Column("law"), Column("e", ".2f"), Column("time_s", "g", "time", "s")
    >>> print(Table(columns, [("newton", 0.5, None)], notes=["One law."]))
    law        e
    newton  0.50
    One law.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[Any]]
    head: Sequence[str] = ()
    notes: Sequence[str] = ()
    keys: int = 1

    def __str__(self) -> str:
        """The table with its head and notes."""
        cells = [[c.cell(x) for c, x in zip(self.columns, row)] for row in self.rows]
        # not empty
        used = [i for i in range(len(self.columns)) if any(row[i] for row in cells)]
        text = [any(isinstance(x, str) for x in column) for column in zip(*self.rows)]
        left = [c.title for c, is_text in zip(self.columns, text) if is_text]
        titles = [self.columns[i].title for i in used]
        rows = [[row[i] for i in used] for row in cells]
        if rows:
            lines = table(titles, rows, left, self.keys)
        else:
            lines = []
        return "\n".join([*self.head, *lines, *self.notes])

    def to_dict(self) -> list[dict[str, Any]]:
        """A mapping by column for each row, as a JSON file can hold it."""
        return [
            as_data({c.name: x for c, x in zip(self.columns, row)}) for row in self.rows
        ]

    def to_csv(self, path: str | Path | None = None) -> str:
        """Lines of a CSV file, also written to the path; what is None or NaN is an
        empty cell.
        """
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([c.name for c in self.columns])
        writer.writerows([[None if x != x else x for x in row] for row in self.rows])
        if path is not None:
            Path(path).write_text(text.getvalue(), encoding="utf-8")
        return text.getvalue().rstrip("\n")

    def to_pandas(self) -> Any:
        """A pandas `DataFrame`."""
        pandas = needed("pandas", "pip install pandas")
        return pandas.DataFrame(list(self.rows), columns=[c.name for c in self.columns])


class Tabular:
    """A result whose main part is a table: it prints, exports and draws itself."""

    picture = ""  # its function in `ji.plot`

    @property
    def table(self) -> Table:
        """The result as a `Table`."""
        raise NotImplementedError

    def __str__(self) -> str:
        """The table."""
        return str(self.table)

    def to_csv(self, path: str | Path | None = None) -> str:
        """The table as CSV, see `Table`."""
        return self.table.to_csv(path)

    def to_pandas(self) -> Any:
        """The table as a pandas `DataFrame`."""
        return self.table.to_pandas()

    def plot(self, title: str = "") -> "Figure":
        """The figure that `ji.plot` draws of the result; raise a TypeError if there is
        none.
        """
        if not self.picture:
            raise TypeError(f"{type(self).__name__} has no picture, only a `table`.")
        # late: matplotlib takes long to import
        pictures = import_module("jimpact.plot")
        return getattr(pictures, self.picture)(self, title=title)


def _parts(widths: Sequence[int], keys: int, room: int) -> list[list[int]]:
    """Numbers of the columns of tables that fit the `room` [characters], the first
    `keys` in each.

    `widths` are those of the columns; two spaces stand between them.

    >>> from jimpact.tools.records import _parts
    >>> _parts([6, 6, 6, 6], 1, 22), _parts([6, 60], 1, 22)
    ([[0, 1, 2], [0, 3]], [[0, 1]])
    """
    first = list(range(keys))
    parts = [list(first)]
    for i in range(keys, len(widths)):
        longer = [*parts[-1], i]
        fits = sum(widths[j] + 2 for j in longer) - 2 <= room
        if not fits and parts[-1] != first:
            parts.append([*first, i])
        else:
            parts[-1] = longer
    return parts
