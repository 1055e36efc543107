"""Every row of `docs/chapter.md` runs and gives the right numbers; the page is what the rows give."""

import re

import chapter_page
import numpy as np
import pytest
from chapter_rows import BEFORE, SECTIONS, Figure, flat, run

TEXT = (
    chapter_page.PAGE.read_text(encoding="utf-8") if chapter_page.PAGE.exists() else ""
)
ROWS = [
    row for rows in SECTIONS.values() for row in rows if not isinstance(row, Figure)
]
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def check(row):
    """The numbers, and the line of the page, to its last digit."""
    value = run(row.call)
    found, exact = flat(value), flat(row.exact)
    assert found.shape == exact.shape
    np.testing.assert_array_less(
        abs(found - exact), row.allowed * np.maximum(1, abs(exact)) + 1e-300
    )
    line = chapter_page.line(chapter_page.cells(row, value))
    start = chapter_page.line([row.where, row.what, f"`{row.call}`"])[:-2]
    (written,) = [x for x in TEXT.splitlines() if x.startswith(start)]
    assert NUMBER.sub("", written) == NUMBER.sub("", line)
    for a, b in zip(NUMBER.findall(written), NUMBER.findall(line), strict=True):
        assert float(a) == pytest.approx(float(b), rel=1.1e-4, abs=1e-6)


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(
            row,
            id=f"{row.where} {row.what}",
            marks=[pytest.mark.slow] if row.slow else [],
        )
        for row in ROWS
    ],
)
def test_rows_of_the_chapter(row):
    check(row)


def test_the_page_holds_every_row_and_figure():
    lines = TEXT.splitlines()
    for title, rows in SECTIONS.items():
        assert f"## {title}" in lines
        for row in rows:
            first = row.cells[:3] if isinstance(row, Figure) else [row.where, row.what]
            assert any(x.startswith(chapter_page.line(first)[:-1]) for x in lines), (
                first
            )
    drawn = [
        row.number
        for rows in SECTIONS.values()
        for row in rows
        if isinstance(row, Figure)
    ]
    assert sum(x.startswith("| ") for x in lines) == len(ROWS) + len(drawn) + 2 * len(
        SECTIONS
    )
    assert BEFORE in TEXT
