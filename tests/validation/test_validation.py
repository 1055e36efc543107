"""Every row of `docs/validation.md`, computed and compared; the page is what the rows give."""

import re

import cube
import numpy as np
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


def test_tosses_of_the_cube_stay_together():
    toss = cube.tosses(["41:3", "7:1", "370:5", "41:9", "8:2"])  # 370 is 41, turned
    assert toss.tolist() == [41, 7, 41, 41, 8]
    group = cube.groups(toss)
    assert group[0] == group[2] == group[3]
    assert len(set(group)) == 3
    draws = cube.resampled(toss)
    assert all(np.sum(draw == 0) == np.sum(draw == 2) == np.sum(draw == 3) for draw in draws)


def test_differences_of_the_cube_are_paired():
    """One law that is .5 % worse in every impact is so in every draw, however they scatter."""
    error, toss = 5 * np.random.default_rng(0).random(40), np.arange(40) // 2
    draws = cube.resampled(toss)
    np.testing.assert_allclose(cube.difference(error, error + 0.5, draws), 0.5, atol=1e-12)
    median, low, high = cube.median_and_interval(error, draws)
    assert low < median == np.median(error) < high


def test_the_page_of_the_cube_has_its_rows():
    text = cube.PAGE.read_text(encoding="utf-8")
    for name in ("Newton", "Moreau", "MuJoCo", "LZB", "Compliant, e falls"):
        assert f"| {name} |" in text
    assert cube.HEAD.format(one=377, two=105, tosses=308, folds=cube.FOLDS) in text


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
