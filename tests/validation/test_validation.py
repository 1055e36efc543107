"""Every row of `docs/validation.md`, computed and compared; the page is what the rows give."""

import re

import page
import pytest
import simulated
from rows import CASES

TEXT = page.PAGE.read_text(encoding="utf-8") if page.PAGE.exists() else ""


SLOW = ("vibrating_plate",)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(
            case,
            id=case.rows.__name__,
            marks=[pytest.mark.slow] if case.rows.__name__ in SLOW else [],
        )
        for case in CASES
    ],
)
def test_numbers_by_others(case):
    rows = case.rows()
    assert rows
    wrong = [row for row in rows if not row.error <= row.allowed]
    assert not wrong, wrong
    # the committed page: the same words, digits and sources; errors to within a power of ten
    reported = re.search(rf"## {re.escape(case.title)}\n.*?(?=\n## |\Z)", TEXT, re.S)
    assert reported, f"docs/validation.md lacks {case.title!r}: run python tests/validation/page.py"
    written = reported.group().strip().splitlines()
    given = "\n".join(page.lines(case, rows)).strip().splitlines()
    assert len(written) == len(given)
    for a, b in zip(written, given):
        if a == b:
            continue
        *words, theirs, ours, error, _ = a.split("|")
        *words_now, theirs_now, ours_now, error_now, _ = b.split("|")
        assert words == words_now
        last_digit = 10.0 ** -len(ours.split(".")[-1].strip())
        # their number may come from a computation too: its last digit is rounded where it runs
        assert abs(float(theirs) - float(theirs_now)) <= 1.5 * last_digit
        assert abs(float(ours) - float(ours_now)) <= 10 * last_digit
        assert exponent(error_now) <= exponent(error) + 1


def exponent(text):
    return int(text.split("e")[1]) if "e" in text else -14


def test_page_has_nothing_else():
    assert re.findall(r"^## (.*)$", TEXT, re.M) == [case.title for case in CASES]
    assert TEXT.startswith(page.HEAD)


@pytest.mark.slow
def test_coverage_of_a_few_data_sets():
    """The table is made; the rest of it was made with 500 data sets a row."""
    honest = [row for row in simulated.HONEST if row.what.startswith("Newton, 2")]
    spoiled = [row for row in simulated.SPOILED if row.expected == "No contact approaches"]
    text = simulated.page(40, honest, spoiled, ratios=(), print=lambda *line: None)
    inside = float(re.search(r"e = .8 \| ([\d.]+) \|", text).group(1))
    assert 85 <= inside <= 100
    assert "| No contact approaches | 100.0 |" in text
    committed = simulated.PAGE.read_text(encoding="utf-8")
    for row in (*simulated.HONEST, *simulated.SPOILED):
        assert f"| {row.what} |" in committed
