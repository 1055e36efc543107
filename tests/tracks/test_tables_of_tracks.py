"""Tables of motion capture, long tables, frame numbers: what is read, and what is refused."""

import numpy as np
import pytest
from refusals import argument

import jimpact as ji

PLACES = np.array(
    [[1.5, -2.0, 300.25], [1.75, -2.5, 290.5], [2.0, -3.0, 280.75]]
)  # [mm]
LOST = 1  # the frame in which the second marker was not seen

QUALISYS = """NO_OF_FRAMES\t3
NO_OF_CAMERAS\t8
NO_OF_MARKERS\t2
FREQUENCY\t200
NO_OF_ANALOG\t0
ANALOG_FREQUENCY\t0
DESCRIPTION\t--
TIME_STAMP\t2026-11-29, 10:00:00
DATA_INCLUDED\t3D
MARKER_NAMES\tball\tedge
"""
ROWS = ("1.500\t-2.000\t300.250", "1.750\t-2.500\t290.500", "2.000\t-3.000\t280.750")
EDGE = ("11.0\t12.0\t13.0", "0.000\t0.000\t0.000", "14.0\t15.0\t16.0")


def qualisys(columns):
    lines = [f"{a}\t{b}" for a, b in zip(ROWS, EDGE)]
    if columns:
        lines = [f"{k + 1}\t{k / 200:.5f}\t{x}" for k, x in enumerate(lines)]
        names = "\t".join(f"{m} {a}" for m in ("ball", "edge") for a in "XYZ")
        lines = [f"Frame\tTime\t{names}", *lines]
    return QUALISYS + "\r\n".join(lines) + "\r\n"


def trc(rate="200.00", step=0.005, digits=6, unit="mm"):
    head = [
        "PathFileType\t4\t(X/Y/Z)\ttoss.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame"
        "\tOrigNumFrames",
        f"{rate}\t{rate}\t3\t2\t{unit}\t{rate}\t1\t3",
        "Frame#\tTime\tball\t\t\tedge\t\t",
        "\t\tX1\tY1\tZ1\tX2\tY2\tZ2",
        "",
    ]
    edge = [x if k != LOST else "\t\t" for k, x in enumerate(EDGE)]
    rows = [
        f"{k + 1}\t{k * step:.{digits}f}\t{a}\t{b}\t"
        for k, (a, b) in enumerate(zip(ROWS, edge))
    ]
    return "\n".join([*head, *rows]) + "\n"


OPTITRACK = """Format Version,1.25,Take Name,toss,Export Frame Rate,200.000000,Rotation Type,Quaternion,Length Units,Millimeters,Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Marker,Marker,Marker
,Name,cube,cube,cube,cube,cube,cube,cube,cube,edge,edge,edge
,ID,A,A,A,A,A,A,A,A,B,B,B
,Parent,,,,,,,,,,,
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z
0,0.000000,0.0,0.0,0.6,0.8,1.5,-2.0,300.25,0.1,11.0,12.0,13.0
1,0.005000,0.0,0.0,0.6,0.8,1.75,-2.5,290.5,0.1,,,
2,0.010000,0.0,0.0,0.6,0.8,2.0,-3.0,280.75,0.1,14.0,15.0,16.0
"""
OLDER = """Format Version,1.2,Take Name,toss,Capture Frame Rate,200.0,Length Units,Meters

,,Marker,Marker,Marker
,,toss:ball,toss:ball,toss:ball
,,1,1,1
,,Position,Position,Position
Frame,Time (Seconds),X,Y,Z
0,0.0,.0015,-.002,.30025
1,0.005,.00175,-.0025,.2905
2,0.01,.002,-.003,.28075
"""
VICON = """Trajectories
200
,,toss:ball,,,toss:edge,,
Frame,Sub Frame,X,Y,Z,X,Y,Z
,,mm,mm,mm,mm,mm,mm
41,0,1.5,-2.0,300.25,11,12,13
42,0,1.75,-2.5,290.5,,,
43,0,2.0,-3.0,280.75,14,15,16

Devices
2000
"""
TABLES = {
    "qualisys": (qualisys(False), 0.0),
    "qualisys with columns": (qualisys(True), 0.0),
    "trc": (trc(), 0.0),
    "optitrack": (OPTITRACK.replace("cube", "ball"), 0.0),
    "vicon": (VICON, 0.2),
}


def written(folder, text):
    path = folder / "toss.txt"
    path.write_text(text)
    return path


@pytest.mark.parametrize("kind", TABLES)
def test_places_units_and_times_of_motion_capture(tmp_path, kind):
    text, first = TABLES[kind]
    path = written(tmp_path, text)
    unit = {"unit": "mm"} if kind.startswith("qualisys") else {}
    t, q = ji.tracks.read(path, ["ball z", "edge X", "ball x"], **unit)
    np.testing.assert_allclose(t, first + np.arange(3) / 200, atol=1e-12)
    np.testing.assert_allclose(q[:, 0], PLACES[:, 2] / 1000)
    np.testing.assert_allclose(q[:, 2], PLACES[:, 0] / 1000)
    np.testing.assert_allclose(q[:, 1], [0.011, np.nan, 0.014])
    for columns, words in (
        (["bal z"], "ball"),
        (["ball"], "axis"),
        (["z"], "ball, .*edge"),
        (["edge qx"], "x, y, z"),
    ):
        with pytest.raises(ValueError, match=words):
            ji.tracks.read(path, columns, **({"unit": "mm"} | unit))
    for more, words in (
        ({"rate": 100}, "200"),
        ({"time": "Time"}, "`time`"),
        ({"unit": "px"}, "px"),
    ):
        with pytest.raises(ValueError, match=words):
            ji.tracks.read(path, "ball z", **(unit | more))


def test_units_that_contradict_the_file_or_are_not_stated(tmp_path):
    with pytest.raises(ValueError, match="unit"):
        ji.tracks.read(written(tmp_path, qualisys(False)), "ball z")
    for text in (trc(), OPTITRACK.replace("cube", "ball"), VICON):
        with pytest.raises(ValueError, match=r"\bmm\b"):
            ji.tracks.read(written(tmp_path, text), "ball z", unit="m")
    _, q = ji.tracks.read(written(tmp_path, OLDER), ["ball x", "toss:ball y"])
    np.testing.assert_allclose(q, PLACES[:, :2] / 1000)


def test_a_rate_beside_that_of_the_file_must_be_the_same(tmp_path):
    """An error of .1 %, as of 59.94 and 60 frames a second, is another rate."""
    path = written(tmp_path, qualisys(False))
    ji.tracks.read(path, "ball z", unit="mm", rate=200.02)
    with pytest.raises(ValueError, match=r"`rate` is 199\.8"):
        ji.tracks.read(path, "ball z", unit="mm", rate=199.8)


@pytest.mark.parametrize("cell", ["inf", "1_0"])
def test_cells_of_motion_capture_that_are_no_finite_numbers_are_refused(tmp_path, cell):
    path = written(tmp_path, VICON.replace("300.25", cell))
    with pytest.raises(ValueError, match=rf"line \d+.*'{cell}'"):
        ji.tracks.read(path, "ball z")


def test_poses_of_rigid_bodies(tmp_path):
    columns = [f"cube {axis}" for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    _, q = ji.tracks.read(written(tmp_path, OPTITRACK), columns)
    np.testing.assert_allclose(q[:, :3], PLACES / 1000)
    np.testing.assert_allclose(q[:, 3:], np.tile([0.0, 0.0, 0.6, 0.8], (3, 1)))
    path = written(tmp_path, OPTITRACK.replace("Quaternion", "XYZ"))
    with pytest.raises(ValueError, match="`qx`"):
        ji.tracks.read(path, "cube qx")


def test_times_of_trc_and_its_rate(tmp_path):
    """Three decimals at 120 Hz are steps of 8 and 9 ms: the times are those of the frames."""
    t, _ = ji.tracks.read(written(tmp_path, trc("120.00", 1 / 120, 3)), "ball z")
    np.testing.assert_allclose(t, np.arange(3) / 120, atol=1e-12)
    with pytest.raises(ValueError, match=r"\b240\b.*\b0\.0083"):
        ji.tracks.read(written(tmp_path, trc("240.00", 1 / 120)), "ball z")


def test_zeros_at_an_end_are_no_places(tmp_path):
    text = trc().replace(ROWS[-1], "0\t0\t0").replace(ROWS[-2], "0\t0\t0")
    with pytest.raises(ValueError, match="exactly 0, 0, 0"):
        ji.tracks.read(written(tmp_path, text), "ball z")


def test_c3d(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [200.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["ball", "edge"]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    points = np.ones((4, 2, 3))
    points[:3, 0] = PLACES.T
    points[:3, 1, LOST] = np.nan
    file["data"]["points"] = points
    path = tmp_path / "toss.c3d"
    file.write(str(path))
    t, q = ji.tracks.read(path, ["ball z", "edge x"])
    np.testing.assert_allclose(t, np.arange(3) / 200)
    np.testing.assert_allclose(q[:, 0], PLACES[:, 2] / 1000, rtol=1e-6)
    np.testing.assert_allclose(q[:, 1], [0.001, np.nan, 0.001])
    with pytest.raises(ValueError, match="`bell`"):
        ji.tracks.read(path, "bell z")


LONG = "frame,body,x_mm,y_mm\n" + "".join(
    f"{k},{body},{k + shift},{2 * k}\n"
    for k in (0, 1, 2, 4)
    for body, shift in (("A", 0), ("B", 9))
)


def test_rows_of_a_long_table_and_frame_numbers(tmp_path):
    path = written(tmp_path, LONG)
    some = {"rate": 50, "unit": "mm", "frame": "frame"}
    t, q = ji.tracks.read(path, ["x_mm", "y_mm"], where={"body": "B"}, **some)
    np.testing.assert_allclose(t, [0, 0.02, 0.04, 0.08])
    np.testing.assert_allclose(q[:, 0], [0.009, 0.010, 0.011, 0.013])
    with pytest.raises(ValueError, match="`where`"):
        ji.tracks.read(path, "x_mm", **some)
    with pytest.raises(ValueError, match="A, B"):
        ji.tracks.read(path, "x_mm", where={"body": "C"}, **some)
    with pytest.raises(ValueError, match="frame='frame'"):
        ji.tracks.read(path, "x_mm", where={"body": "A"}, rate=50, unit="mm")
    with pytest.raises(ValueError, match=argument("frame")):
        ji.tracks.read(path, "x_mm", where={"body": "A"}, frame="frame", unit="mm")
    path = written(tmp_path, LONG.replace("4,", "3,"))
    with pytest.warns(UserWarning, match="repeats"):
        ji.tracks.read(path, "x_mm", rate=50, unit="mm")


def test_tables_without_names_and_steps_for_times(tmp_path):
    rows = [(0.01, 1.0, 5.0), (0.0101, 2.0, 5.5), (0.0099, 3.0, 5.2), (0.01, 4.0, 5.1)]
    text = "\n".join(" ".join(map(str, row)) for row in rows)
    path = written(tmp_path, text)
    t, q = ji.tracks.read(path, [1, 2], rate=100, unit="m")
    np.testing.assert_allclose(q, [row[1:] for row in rows])
    np.testing.assert_allclose(t, np.arange(4) / 100)
    with pytest.raises(ValueError, match="column `0`"):
        ji.tracks.read(path, [1], time=0, unit="m")
    with pytest.raises(ValueError, match="counted"):
        ji.tracks.read(path, [7], rate=100, unit="m")
    with pytest.raises(ValueError, match="1, 't'"):
        ji.tracks.read(path, [1], time="t", unit="m")


def test_two_takes_in_one_file_and_a_unit_that_a_name_states(tmp_path):
    text = "t;height (cm)\n" + "\n".join(
        f"{x};{y}" for x, y in ((0, 1), (1, 2), (0.5, 3), (2, 4))
    )
    path = written(tmp_path, text)
    with pytest.raises(ValueError, match="column `t`"):
        ji.tracks.read(path, "height (cm)", time="t")
    _, q = ji.tracks.read(path, "height (cm)", rate=10)
    np.testing.assert_allclose(q[:, 0], [0.01, 0.02, 0.03, 0.04])


def test_too_large_tables_are_refused(tmp_path):
    path = tmp_path / "large.csv"
    with path.open("wb") as file:
        file.truncate(2_100_000_000)  # a hole, which takes no room
    with pytest.raises(ValueError, match="2 GB"):
        ji.tracks.read(path, "x", rate=10, unit="m")


def test_a_track_that_was_hardly_seen_is_refused():
    q = np.full(40, np.nan)
    q[[3, 9, 30]] = 1.0
    with pytest.raises(ValueError, match="3 frames"):
        ji.tracks.find_impacts(np.arange(40) / 100, q)


def table(folder, text, encoding="utf-8"):
    path = folder / "table.txt"
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(
    "text",
    [
        "t y\n0 3\n.5 4\n",
        "# t y\n0 3\n.5 4\n",  # numpy.savetxt
        "# t,y\r0,3\r.5,4\r",
        '"t";"note; of two";"y"\n0;"a; b";3\n.5;c;4\n',
        "t,y\n\n(s),[m]\n0,3\n.5,4\n",
        "t,y\n(ms),(m)\n0,3\n500,4\n",
    ],
)
def test_marks_quotes_and_units_of_tables(tmp_path, text):
    t, q = ji.tracks.read(table(tmp_path, text), "y", time="t", unit="m")
    np.testing.assert_allclose(t, [0.0, 0.5])
    np.testing.assert_array_equal(q, [[3.0], [4.0]])


@pytest.mark.parametrize("name", ["t [ms]", "time_ms", "Time (ms)"])
def test_times_in_the_unit_that_their_name_states(tmp_path, name):
    path = table(tmp_path, f"{name},y\n0,3\n8,4\n", "utf-16")
    t, _ = ji.tracks.read(path, "y", time=name, unit="m")
    np.testing.assert_allclose(t, [0.0, 0.008])


@pytest.mark.parametrize("first", ["", ",\n"])
def test_lines_of_empty_cells_are_frames_where_lines_are_counted(tmp_path, first):
    path = table(tmp_path, f"x,y\n{first}1,2\n,\n\n3,4\n,\n")
    t, q = ji.tracks.read(path, ["x", "y"], rate=10.0, unit="m")
    seen = t[np.isfinite(q).all(axis=1)]
    start = len(first) / 20
    np.testing.assert_allclose(seen, [start, start + 0.2])


def test_lines_with_more_cells_than_names_are_refused(tmp_path):
    path = table(tmp_path, "t,y\n1,0.0,3\n2,0.5,4\n")
    with pytest.raises(ValueError, match=r"line 2: .*at most 2 cells"):
        ji.tracks.read(path, "y", time="t", unit="m")


@pytest.mark.parametrize("cell", ['"1,000"', "inf", "1_0"])
def test_cells_that_are_no_finite_numbers_are_refused(tmp_path, cell):
    path = table(tmp_path, f"t,y\n0,3\n1,{cell}\n")
    with pytest.raises(ValueError, match=r"line 3, column `y`"):
        ji.tracks.read(path, "y", time="t", unit="m")


def test_a_line_of_units_that_contradicts_the_argument_is_refused(tmp_path):
    path = table(tmp_path, "t,y\ns,mm\n0,3\n1,4\n")
    with pytest.raises(ValueError, match=r"`y` states the unit mm"):
        ji.tracks.read(path, "y", time="t", unit="m")


@pytest.mark.parametrize("end", ["", "\t"])
def test_markers_that_were_lost_in_frames_of_empty_cells(tmp_path, end):
    lost = "\t" * 5
    rows = [lost, f"{ROWS[0]}\t{EDGE[0]}", lost, f"{ROWS[2]}\t{EDGE[2]}"]
    head = QUALISYS.replace("FRAMES\t3", "FRAMES\t4")
    path = table(tmp_path, head + "".join(f"{x}{end}\n" for x in rows))
    t, q = ji.tracks.read(path, ["ball z", "edge x"], unit="mm")
    seen = np.isfinite(q).all(axis=1)
    np.testing.assert_allclose(t[seen], [1 / 200, 3 / 200])
    np.testing.assert_allclose(q[seen], [[0.30025, 0.011], [0.28075, 0.014]])


def test_a_last_marker_that_is_lost_in_the_first_frame_moves_no_column(tmp_path):
    names = "\t".join(f"{m} {a}" for m in ("ball", "edge") for a in "XYZ")
    rows = f"1\t0.0\t{ROWS[0]}\t\t\t\n2\t0.005\t{ROWS[1]}\t{EDGE[2]}\n"
    head = QUALISYS.replace("FRAMES\t3", "FRAMES\t2")
    path = table(tmp_path, f"{head}Frame\tTime\t{names}\n{rows}")
    t, q = ji.tracks.read(path, ["ball z", "edge x"], unit="mm")
    np.testing.assert_allclose(t, [0.0, 0.005])
    np.testing.assert_allclose(q, [[0.30025, np.nan], [0.2905, 0.014]])


def test_rows_with_more_cells_than_the_head_of_motion_capture_are_refused(tmp_path):
    path = table(tmp_path, trc().replace(f"{ROWS[2]}\t", f"{ROWS[2]}\t7.0\t"))
    with pytest.raises(ValueError, match=r"line 9: .*at most 8 cells"):
        ji.tracks.read(path, "ball z")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (qualisys(True).replace("NO_OF_FRAMES\t3", "NO_OF_FRAMES\t7"), "NO_OF_FRAMES"),
        (trc().replace("\t200.00\t3\t2", "\t200.00\t7\t2"), "NumFrames"),
        (
            OPTITRACK.replace(
                ",Rotation Type", ",Total Exported Frames,7,Rotation Type"
            ),
            "Total Exported Frames",
        ),
    ],
)
def test_a_file_with_fewer_frames_than_it_states_is_warned_of(tmp_path, text, key):
    columns = ["edge x"]
    unit = {"unit": "mm"} if key == "NO_OF_FRAMES" else {}
    with pytest.warns(UserWarning, match=f"{key} is 7, but the file has 3 frames"):
        ji.tracks.read(written(tmp_path, text), columns=columns, **unit)


def test_frames_of_a_qualisys_file_that_jump_keep_their_times(tmp_path):
    """A column of frames alone: the lost one has no line."""
    rows = [f"{k}\t{a}\t{b}" for k, a, b in zip((4, 5, 8), ROWS, EDGE)]
    path = written(tmp_path, QUALISYS + "\n".join(rows) + "\n")
    t, _ = ji.tracks.read(path, columns=["ball x"], unit="mm")
    np.testing.assert_allclose(t, [0.0, 0.005, 0.02], rtol=1e-12)
