"""Reports and pictures of canned results: no impact is computed."""

import json
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from canned import canned, rocked
from matplotlib.animation import FFMpegWriter, PillowWriter
from PIL import Image
from programs import CODE
from refusals import argument

import jimpact as ji
from jimpact.fits.findings import Finding
from jimpact.fits.intervals import Profile
from jimpact.fits.report import _correlations
from jimpact.fits.selection import LawFit, LawFits
from jimpact.motion.films import positions
from jimpact.motion.record import KIND_CODE, Motion, no_events
from jimpact.tools.progress import wrapped


def test_long_lines_keep_their_column(monkeypatch):
    monkeypatch.setenv("COLUMNS", "30")
    assert wrapped(
        "rms residual   a sentence that is longer than that"
    ).splitlines() == [
        "rms residual   a sentence that",
        "               is longer than",
        "               that",
    ]
    assert wrapped("  - a warning of many words, too").splitlines()[1] == "    too"
    table = "e    0.5    0.01    a row of a table stays as it is"
    assert wrapped(table) == table


@pytest.mark.parametrize("shots", [1, 2, 50])
def test_picture_of_a_fit(shots, tmp_path):
    found = canned(shots)
    figure = ji.plot.fit(found, {"the same": found}, title="simulated")
    top, bottom = figure.axes
    assert top.get_ylabel().endswith("[m/s]")
    assert bottom.get_ylabel().endswith("[m/s]")
    assert len(bottom.get_xticklabels()) == {1: 2, 2: 2, 50: 13}[shots]
    figure.savefig(tmp_path / "fit.png")
    assert (tmp_path / "fit.png").stat().st_size > 5_000


def test_report_of_a_fit():
    text = str(canned(4))
    for words in (
        "restitution[1]",
        "0.6",
        "undetermined",
        "rank",
        "1 of 2",
        "6 degrees of freedom",
    ):
        assert words in text, words
    assert "The data gain energy." in text
    assert "NOT converged" in str(canned(4, converged=False))
    assert max(map(len, text.splitlines())) < 200


def test_correlations_of_a_fit():
    """Of determined parameters, from a tenth on, the largest first."""
    names = tuple("abcd")
    matrix = np.array(
        [
            [1, 0.05, -0.9, 0.5],
            [0.05, 1, 0.3, 0.5],
            [-0.9, 0.3, 1, 0.5],
            [0.5, 0.5, 0.5, 1],
        ]
    )
    seen = np.array([True, True, True, False])
    lines = _correlations(
        SimpleNamespace(names=names, correlation=matrix, determined=seen)
    )
    assert lines[1:] == ["  - a and c: -0.900", "  - b and c: 0.300"]
    assert not _correlations(
        SimpleNamespace(names=names, correlation=np.eye(4), determined=seen)
    )


def test_a_fit_in_one_sentence():
    seen = {"names": ("restitution",), "value": np.array([0.9912]), "findings": ()}
    seen |= {
        "standard_error": np.array([0.0042]),
        "at_bound": np.array([False]),
        "rank": 1,
    }
    assert canned(4, **seen).verdict == "restitution = 0.991 ± 0.004."
    assert str(canned(4)).startswith(f"{canned(4).verdict}\n\n")
    both = canned(1)
    assert both.verdict == (
        "restitution[1] = 0.600 ± 0.010; stiffness[1] cannot be determined from this shot."
    )
    held = replace(both.problem.parameters, ratios=True)
    held = replace(both.problem, parameters=held)
    ratio = canned(1, problem=held, names=("restitution[1]", "stiffness[2]"))
    assert (
        "the stiffness ratio stiffness[2] / stiffness[1] cannot be determined"
        in ratio.verdict
    )
    assert canned(4, converged=False).verdict.startswith("No answer")
    bad = canned(
        4, findings=(Finding("lack_of_fit", "Lack of fit: the residuals are large."),)
    )
    assert bad.verdict.startswith(
        "LZB does not fit these 4 shots; it comes nearest with restit"
    )
    open_end = Profile(
        "restitution[1]", *np.zeros((2, 1)), 4.0, 0.95, ((0.97, 1.0),), (0.0, 1.0)
    )
    flat = replace(open_end, name="stiffness[1]", intervals=((0.0, 1.0),))
    reported = canned(
        4, profiles=(open_end, flat), standard_error=np.array([0.01, 1.0])
    )
    assert reported.verdict == (
        "restitution[1] = 0.600 ± 0.010, at least 0.97 (95 %); stiffness[1] cannot be determined from these 4 shots."
    )


def test_a_sentence_to_quote_holds_its_reservations():
    """What it assumes of several contacts, what is wrong with the data, how many shots fail."""
    pre = np.ones((4, 3)) * [1.0, 0.0, -1.0]
    shots, balls = ji.Experiments(pre, pre), ji.chain([1.0, 1.0, 1.0])
    problem = ji.FitProblem.from_shots(ji.LZB(0.6), balls, shots)
    one = {
        "names": ("restitution",),
        "value": np.array([0.77]),
        "at_bound": np.array([False]),
    }
    one |= {
        "standard_error": np.array([0.017]),
        "rank": 1,
        "problem": problem,
        "findings": (),
    }
    broken = "the data violate conservation of momentum in all 4 shots"
    shared = "one restitution for both contacts, equal stiffnesses and the exponent 1.5 (Hertz)"
    known = [
        Finding("momentum", "", broken),
        Finding("suspicious", "", "shot 3 is suspicious"),
    ]
    assert canned(4, **(one | {"findings": known})).verdict == (
        f"restitution = 0.770 ± 0.017, assuming {shared}; but {broken} and shot 3 is suspicious."
    )
    mixed = replace(
        problem, parameters=replace(problem.parameters, names=("restitution[1]",))
    )
    law = ji.LZB([0.6, 0.7], [1.0, 2.0], exponent=(1.5, 1.0))
    mixed = replace(mixed, law=law)
    own = canned(4, **(one | {"problem": mixed, "names": ("restitution[1]",)}))
    assert own.verdict.endswith(
        ", assuming the stiffness of each contact and the exponent of each contact."
    )
    fails = {"findings": (Finding("law_fails", "The fitted law fails in all."),)}
    fails["status"] = np.full(4, CODE["max_steps"])
    assert canned(4, **fails).verdict.startswith(
        "LZB fails in all of these 4 shots; it comes near"
    )
    fails["status"] = fails["status"] * [1, 0, 1, 0]
    assert canned(4, **fails).verdict.startswith(
        "LZB fails in 2 of these 4 shots; it comes near"
    )


def test_values_that_the_data_do_not_determine_are_marked():
    found = canned(4)
    lines = str(found).splitlines()
    assert any(
        line.endswith("start value; not determined by the data") for line in lines
    )
    assert any("restitution[1] 0.4, stiffness[1] (2)" in line for line in lines)
    every = LawFits({"lzb": LawFit("lzb", found, 0.01, np.nan, "fits", "fits")})
    table = str(every)
    assert "restitution[1] 0.6, stiffness[1] (2)" in table
    assert "Values in brackets are starts" in table
    assert table.startswith("The simplest law that fits is lzb: restitution[1] = 0.600")
    np.testing.assert_array_equal(found.determined, [True, False])
    flat = Profile(
        "restitution[1]", *np.zeros((2, 1)), 4.0, 0.95, ((0.0, 1.0),), (0.0, 1.0)
    )
    assert not canned(4, profiles=(flat, flat)).determined.any()


def test_tables_of_a_fit(monkeypatch):
    found = canned(4)
    pytest.importorskip("pandas")
    assert found.to_pandas()["standard_error"][0] == 0.01
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pandas must be installed"):
        found.to_pandas()


def test_json_of_a_fit():
    reported = json.loads(json.dumps(canned(4).to_dict(), allow_nan=False))
    assert reported["rank"] == 1
    assert reported["degrees_of_freedom"] == 6
    assert [row["seen"] for row in reported["parameters"]] == [True, False]
    assert reported["parameters"][1]["standard_error"] is None


def test_confidence_intervals_are_cut_at_the_bounds():
    edge = canned(4, value=np.array([0.995, 2.0])).confidence_interval()
    assert edge[0, 1] == 1.0
    assert 0.9 < edge[0, 0] < 0.99
    with pytest.raises(ValueError, match=argument("level", "95")):
        canned(4).confidence_interval(95)


def test_motions_are_saved_and_loaded(tmp_path):
    _, found = rocked()
    batch = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), found)
    for motion in (found, batch):
        loaded = ji.load(motion.save(tmp_path / "dimer.npz"))
        assert jax.tree.structure(loaded) == jax.tree.structure(motion)
        for one, other in zip(jax.tree.leaves(loaded), jax.tree.leaves(motion)):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)


def test_files_that_hold_no_motion_are_refused(tmp_path):
    _, found = rocked()
    path = found.save(tmp_path / "dimer.npz")
    with np.load(path) as file:
        arrays = dict(file)
    assert (str(arrays["status"]), arrays["events.kind"][0]) == (
        "ok",
        "impact",
    )  # not codes
    for name, content, message in (
        (
            "later",
            arrays | {"format": 2, "jimpact": "9.0"},
            "has format 2, of jimpact 9.0; .* reads 1",
        ),
        ("other", {"x": np.ones(2)}, "holds something else"),
    ):
        np.savez(tmp_path / name, **content)
        with pytest.raises(ValueError, match=message):
            ji.load(tmp_path / f"{name}.npz")
    path.write_bytes(b"not a file of numbers")
    with pytest.raises(ValueError, match="cannot be read"):
        ji.load(path)
    with pytest.raises(ValueError, match=r"must end in \.npz, but is 'motion\.csv'"):
        found.save("motion.csv")


def test_a_motion_goes_on():
    """From the last sample that was reached; works and events of both make one record."""
    _, found = rocked()
    late = replace(
        found.events, time=found.events.time.at[1].set(0.45), count=jnp.int32(2)
    )
    late = replace(late, kind=late.kind.at[1].set(KIND_CODE["impact"]))
    # it ended after the sample at .4 s and an impact at .45 s, which comes again later
    ended = replace(
        found, q=np.where(np.arange(6)[:, None] < 5, found.q, np.nan), events=late
    )
    end = ended.restart(2.0)
    assert end["t_end"] == (0.4, 2.0)
    np.testing.assert_array_equal(end["q0"], found.q[4])
    np.testing.assert_array_equal(end["v0"], found.velocity[4])
    later = replace(
        found,
        time=0.4 + found.time,
        events=replace(found.events, time=found.events.time + 0.4),
    )
    both = ended.then(later)
    np.testing.assert_array_equal(both.time, [*found.time[:5], *(0.4 + found.time[1:])])
    np.testing.assert_allclose(
        both.contact_work[:, 0, 0], [0] * 3 + [-0.5] * 4 + [-1.0] * 3
    )
    np.testing.assert_allclose(both.event_times(), [0.25, 0.65])
    assert (int(both.events.count), int(both.steps)) == (2, 18)
    with pytest.raises(ValueError, match=argument("later")):
        ended.then(found)
    with pytest.raises(ValueError, match="pick one motion"):
        jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), found).then(later)


@pytest.mark.slow
def test_picture_of_a_motion(tmp_path):
    system, found = rocked(ji.HarmonicBase(0.01, 4.0, direction="vertical"))
    figure = ji.plot.motion(found, "dimer", system=system)
    axes = {x.get_ylabel(): x for x in figure.axes}
    assert set(axes) == {
        *("coordinates [m]", "angle [rad]", "velocities [m/s]", "angle' [rad/s]"),
        *("gaps [m]", "energy [J]"),
    }
    words = [
        text.get_text() for text in axes["coordinates [m]"].get_legend().get_texts()
    ]
    assert words == ["x", "y", "base y"]
    turn = axes["angle' [rad/s]"].lines[0]
    np.testing.assert_array_equal(turn.get_xdata()[3:5], [0.25, 0.25])
    np.testing.assert_array_equal(turn.get_ydata()[2:6], [-2.0, -2.0, 3.0, 3.0])
    first, second = axes["gaps [m]"].lines[:2]
    assert (min(first.get_ydata()), min(second.get_ydata())) == (0.0, 0.1)
    energy, gained = (
        axes["energy [J]"].lines[0],
        0.5 * system.body.inertia * (3.0**2 - 2.0**2),
    )
    np.testing.assert_allclose(np.diff(energy.get_ydata()[3:5]), [gained], rtol=1e-12)
    bare = [
        x.get_ylabel() for x in ji.plot.motion(found, names=["x [m]", "y [m]"]).axes
    ]
    assert bare[:2] == ["coordinates [m]", "velocities [m/s]"]
    assert {"q3", "q3'"} <= set(bare)
    film = ji.plot.animation(system, found, tmp_path / "dimer.gif")
    assert film.read_bytes().startswith(b"GIF89a")


def many_discs(count=8):
    """As if simulated: disc i rises by i, disc 1 only by rounding; contact i strikes i times."""
    system = ji.System(ji.Bodies([ji.Disc(0.1)] * count, planes=[0.0], pairs=[]))
    time, number = np.linspace(0.0, 1.0, 5), np.arange(count)
    q = np.zeros((5, count, 3))
    q[:, :, 1] = 1.0 + number * time[:, None]
    q[:, 0, 1] = 1.0 + 1e-16 * time
    rows = np.arange(count)[:, None] < number  # (E, m)
    events = no_events(count, jnp.asarray(q[0].ravel()), jnp.zeros(3 * count), count)
    events = replace(events, kind=jnp.asarray(rows.any(axis=1) * KIND_CODE["impact"]))
    events = replace(
        events, contacts=jnp.asarray(rows), time=jnp.linspace(0.1, 0.9, count)
    )
    zero = np.zeros(5)
    velocity = np.zeros((5, count, 3))
    return system, Motion(
        *(time, q.reshape(5, -1), velocity.reshape(5, -1), zero, 1 + zero, zero, zero),
        *(
            np.full((5, 2, count), 1e-17),
            np.full((5, count), 0.1),
            events,
            jnp.int32(9),
        ),
        status=jnp.int32(0),
    )


def test_pictures_of_many_bodies_show_those_that_move_most():
    system, found = many_discs()

    def legend(axes):
        words = [text.get_text() for text in axes.get_legend().get_texts()]
        return axes.get_legend().get_title().get_text(), words

    axes = {x.get_ylabel(): x for x in ji.plot.motion(found, system=system).axes}
    assert legend(axes["coordinates [m]"]) == (
        "6 of 16",
        [f"y{i}" for i in range(3, 9)],
    )
    assert legend(axes["gaps [m]"]) == ("6 of 8", [f"contact {i}" for i in range(3, 9)])
    assert len(axes["gaps [m]"].lines[0].get_xdata()) == 5 + 2  # contact 3, 2 events
    assert [line.get_label() for line in axes["energy [J]"].lines[:3]] == [
        *("T + V − min V", "T", "contacts absorbed")
    ]
    assert len(axes["energy [J]"].lines) == 3  # friction absorbed 1e-16 J
    chosen = ji.plot.motion(found, system=system, bodies=[0])
    one = {x.get_ylabel(): x for x in chosen.axes}
    assert legend(one["coordinates [m]"]) == ("", ["x1", "y1"])
    assert len(one["gaps [m]"].lines) - 7 == 1  # and an event line for each impact
    flat = {
        x.get_ylabel(): x
        for x in ji.plot.motion(found, system=system, contacts=[0]).axes
    }
    assert np.ptp(flat["gaps [m]"].get_ylim()) == pytest.approx(
        8.0
    )  # the largest coordinate
    assert np.ptp(flat["coordinates [rad]"].get_ylim()) == pytest.approx(1.0)
    with pytest.raises(ValueError, match=argument("bodies", "8")):
        ji.plot.motion(found, system=system, bodies=[8])
    with pytest.raises(ValueError, match=argument("contacts", "8")):
        ji.plot.motion(found, system=system, contacts=[8])


@pytest.mark.slow
def test_films_run_in_time(tmp_path):
    """Frames are equally spaced in time, and files last as long as they say."""
    system, found = rocked()
    path = ji.plot.animation(
        system, found, tmp_path / "dimer.gif", speed=0.25, frames_per_second=30
    )
    with Image.open(path) as film:
        frames = [
            film.info["duration"] for k in range(film.n_frames) if film.seek(k) is None
        ]
    assert frames == [30] * 67  # 100 / 3 in a second, .5 s at a quarter of the speed
    page = ji.plot.animation(
        system, found, tmp_path / "a.html", "Dimer", speed=0.5
    ).read_text()
    assert len(re.findall(r"frames\[\d+\] = ", page)) == 26
    with pytest.raises(ValueError, match=argument("path", "'a.avi'")):
        ji.plot.animation(system, found, "a.avi")
    with pytest.raises(ValueError, match="`speed`"):
        ji.plot.animation(system, found, tmp_path / "a.gif", speed=0.0)


def test_a_film_that_is_stopped_keeps_the_earlier_one(tmp_path, monkeypatch):
    path = tmp_path / "dimer.gif"
    path.write_bytes(b"earlier")

    grab = PillowWriter.grab_frame

    def stopped_at_the_second(writer, **options):
        if writer._frames:
            raise KeyboardInterrupt
        grab(writer, **options)

    monkeypatch.setattr(PillowWriter, "grab_frame", stopped_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        ji.plot.animation(*rocked(), path)
    assert path.read_bytes() == b"earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_films_in_mp4_need_ffmpeg(tmp_path, monkeypatch):
    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
    system, found = rocked()
    with pytest.raises(RuntimeError, match=argument("path")):
        ji.plot.animation(system, found, tmp_path / "dimer.mp4")


def test_positions_between_states_follow_their_velocities():
    """Two parabolas that meet at an event, where the velocity jumps from 1 to -1."""
    at = np.array([0.0, 1.0, 1.0, 2.0])
    q, slopes = (
        np.array([[0.0], [0.5], [0.5], [0.0]]),
        np.array([[0.0], [1.0], [-1.0], [0.0]]),
    )
    time = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    expected = [0.0, 0.125, 0.5, 0.125, 0.0]
    np.testing.assert_allclose(
        positions(at, q, slopes, time)[:, 0], expected, atol=1e-15
    )


def test_phase_portrait_of_what_moves():
    system, found = rocked()
    axes = ji.plot.phase_portrait(found, system=system).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("angle [rad]", "angle' [rad/s]")
    jump = axes.lines[1]
    np.testing.assert_array_equal(jump.get_ydata().ravel(), [-2.0, 3.0])
    (legend,) = axes.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["jump at an event"]
    unnamed = ji.plot.phase_portrait(found).axes[0].get_xlabel()
    assert unnamed == "q3  (`system=` or `names=` name it)"
    with pytest.raises(ValueError, match=argument("coordinate", "3")):
        ji.plot.phase_portrait(found, 3)


def test_report_of_a_motion():
    text = str(rocked()[1])
    assert "the contacts absorbed 0.5 J" in text
    assert "friction" not in text.splitlines()[3]


def test_columns_of_shots_with_long_labels_are_aligned():
    labels = ["the first drop of all", "b"]
    pair = ji.chain([1.0, 1.0])
    pre, post = [[1.0, 0.0], [2.0, 0.0]], [[0.3, 0.7], [0.6, 1.4]]
    data = ji.Experiments(pre, post, 0.02, shots=labels)
    lines = str(ji.fit(ji.Newton(0.5), pair, data)).splitlines()
    head, *rows = lines[-5:]
    end = head.index("measured") + len("measured")
    for row, value in zip(rows, ("0.3", "0.7", "0.6", "1.4"), strict=True):
        assert row[:end].endswith(value)
