"""Every row of `docs/validation.md`, computed and compared; the page is what the rows give."""

import re

import cube
import drops
import figures
import numpy as np
import page
import pytest
import simulated
from rows import CASES

TEXT = page.PAGE.read_text(encoding="utf-8") if page.PAGE.exists() else ""


MARKS = {
    "solitary_wave": pytest.mark.release,
    "vibrating_plate": pytest.mark.release,
    "bouncing_ball": pytest.mark.slow,
    "schroedinger": pytest.mark.slow,
    "spring_and_dashpot": pytest.mark.slow,
}


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(
            case,
            id=case.rows.__name__,
            marks=MARKS.get(case.rows.__name__, ()),
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
    assert reported, (
        f"docs/validation.md lacks {case.title!r}: run python tests/validation/page.py"
    )
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
    assert all(
        np.sum(draw == 0) == np.sum(draw == 2) == np.sum(draw == 3) for draw in draws
    )


def test_differences_of_the_cube_are_paired():
    """One law that is .5 % worse in every impact is so in every draw, however they scatter."""
    error, toss = 5 * np.random.default_rng(0).random(40), np.arange(40) // 2
    draws = cube.resampled(toss)
    np.testing.assert_allclose(
        cube.difference(error, error + 0.5, draws), 0.5, atol=1e-12
    )
    median, low, high = cube.median_and_interval(error, draws)
    assert low < median == np.median(error) < high


@pytest.mark.parametrize("nu", [4.0, 1e6])
def test_scatter_of_the_cube_is_found_with_its_tails(nu):
    """Simulated impacts with a known scatter, normal and with tails: regions hold what they say."""
    rng, many = np.random.default_rng(0), 300
    slopes, noise = rng.normal(size=(many, 6, 2)), np.full((many, 6), 0.01)
    residual = np.einsum(
        "kij,kj->ki", slopes, rng.normal(size=(many, 2)) * [0.04, 0.02]
    )
    residual += 1.5 * noise * rng.normal(size=(many, 6))
    residual *= np.sqrt(nu / rng.chisquare(nu, many))[:, None]
    sizes, inside = cube.scatter_of(residual, slopes, noise, np.arange(many))
    np.testing.assert_allclose(sizes[:3], [0.04, 0.02, 1.5], rtol=0.15)
    assert 2.5 < sizes[3] < 6 if nu == 4 else sizes[3] > 30
    for chance, share in inside.items():
        assert abs(share / 100 - chance) < 4 * np.sqrt(chance * (1 - chance) / many)


def test_pages_name_the_command_of_their_figures():
    """Each function of `figures.py` has its page, which names it; no page names another one."""
    for name, made in figures.FIGURES.items():
        text = (page.PAGE.parent / made.__doc__.split(":")[0]).read_text(
            encoding="utf-8"
        )
        assert f"`python tests/validation/figures.py {name}`" in text, name
    pages = "".join(
        path.read_text(encoding="utf-8") for path in page.PAGE.parent.glob("*.md")
    )
    assert {*re.findall(r"figures\.py (\w+)", pages)} <= {*figures.FIGURES}


@pytest.mark.slow
def test_a_figure_is_what_its_page_says(capsys):
    """One of them, that costs least: laws fitted to the measured shot, on other strikes."""
    figures.correlated()
    said = capsys.readouterr().out
    assert "[1.0, 1.0, 0.0] differ by 0.020 of the speed" in said
    assert "[1.0, 0.0, -0.5] differ by 0.091 of the speed" in said


def test_the_page_of_the_cube_has_its_rows():
    text = cube.PAGE.read_text(encoding="utf-8")
    for name in (
        "Newton",
        "Moreau",
        "MuJoCo",
        "MuJoCo, seven numbers",
        "LZB",
        "Compliant, e falls",
    ):
        assert f"| {name} |" in text
    assert cube.HEAD.format(one=377, two=105, tosses=308, folds=cube.FOLDS) in text


def swung(rate, times):
    """Poses of a square that turns about its left lower corner, from flat, by small steps."""
    fine = 400  # steps of a frame; ten times more changes the angle by 1e-7
    q, v, found = np.array([0.5, 0.5, 0.0]) * drops.SIDE, rate, []
    for _ in range(times):
        found.append(q.copy())
        for _ in range(fine):
            v += drops.accelerations(q)[2] * drops.FRAME / fine
            q[2] += v * drops.FRAME / fine
        q[:2] = np.array([np.cos(q[2] + np.pi / 4), np.sin(q[2] + np.pi / 4)])
        q[:2] *= drops.SIDE / 2**0.5
    return np.array(found)


def test_rocking_is_found_in_a_drop():
    """It turns about the left corner, hits with the right one, turns back with .4 of its rate."""
    rise = swung(5.0, 40)
    top = int(rise[:, 2].argmax())
    assert top > 6
    back = swung(2.0, 12)  # the way down is the way up, backwards
    found = drops.rocking(np.concatenate([rise[top:0:-1], back])[None])
    assert len(found.drop) == 1
    np.testing.assert_allclose(found.before, -5.0, rtol=0.03)
    np.testing.assert_allclose(found.after, 2.0, rtol=0.05)
    np.testing.assert_allclose(found.rebound, 0.4, atol=0.03)
    np.testing.assert_allclose(found.left, 0.0, atol=0.03)


def test_measured_rocking_turns_back():
    """Of the bundled drops; LZB says -.37 at mu = .3, Housner +.25."""
    found = drops.rocking(drops.drops())
    assert len(found.drop) == 68
    np.testing.assert_allclose(np.median(found.after / found.before), -0.394, atol=2e-3)
    np.testing.assert_allclose(np.median(found.rebound), 0.395, atol=2e-3)


def test_flights_of_a_drop_and_their_arcs():
    """A parabola and a spin are found as they are; contacts between flights end them."""
    t = drops.FRAME * np.arange(12)
    arc = np.stack(
        [0.1 + 0.5 * t, 0.1 - t - drops.GRAVITY / 2 * t**2, 1 - 6.0 * t], axis=1
    )
    at = drops.state(arc, 10)
    tenth = 10 * drops.FRAME
    np.testing.assert_allclose(at[0], arc[10], atol=1e-12)
    np.testing.assert_allclose(
        at[1], [0.5, -1 - drops.GRAVITY * tenth, -6.0], atol=1e-9
    )
    rests = np.tile([0.0, drops.SIDE / 2, 0.0], (5, 1))
    assert (
        drops.flights(np.concatenate([rests, rests + np.array([0, 0.1, 0]), rests]))
        == []
    )  # too short
    long = np.tile([0.0, 0.1, 0.0], (9, 1))
    assert drops.flights(np.concatenate([rests, long, rests, long])) == [
        (5, 14)
    ]  # the last goes on


def test_the_page_of_the_drops_has_its_rows():
    text = drops.PAGE.read_text(encoding="utf-8")
    for name in (
        "jimpact",
        "MuJoCo",
        "first flight",
        "flight after an impact",
        "an edge",
    ):
        assert f"| {name}" in text
    with np.load(drops.NUMBERS) as stored:
        assert {"first flight, jimpact", "first flight, MuJoCo"} <= set(stored.files)


@pytest.mark.slow
def test_coverage_of_a_few_data_sets():
    """The table is made; the rest of it was made with 500 data sets a row."""
    honest = [row for row in simulated.HONEST if row.what.startswith("Newton, 2")]
    spoiled = [
        row for row in simulated.SPOILED if row.expected == "No contact approaches"
    ]
    text = simulated.page(40, honest, spoiled, ratios=(), print=lambda *line: None)
    inside = float(re.search(r"e = .8 \| ([\d.]+) \|", text).group(1))
    assert 85 <= inside <= 100
    assert "| No contact approaches | 100.0 |" in text
    committed = simulated.PAGE.read_text(encoding="utf-8")
    for row in (*simulated.HONEST, *simulated.SPOILED):
        assert f"| {row.what} |" in committed
