"""Reading shots, what is refused, and what the data break."""

from importlib.resources import files

import numpy as np
import pytest
from refusals import argument

import jimpact as ji

DATA = files("jimpact") / "data"


CHAIN = ji.chain([1.0, 1.0, 1.0])


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "shots.csv"
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("m/s", 1),
        ("cm/s", 0.01),
        ("mm/s", 0.001),
        ("km/h", 1 / 3.6),
        ("in/s", 0.0254),
        ("ft/s", 0.3048),
    ],
)
def test_units(tmp_path, unit, factor):
    path = written(tmp_path, f"pre_1[m/s],post_1[{unit}],sigma_1[{unit}]\n1,-2,0.5\n")
    data = ji.read_experiments(path)
    np.testing.assert_allclose(
        [data.pre[0, 0], data.post[0, 0]], [1, -2 * factor], rtol=1e-15
    )
    np.testing.assert_allclose(data.sigma[0, 0], 0.5 * factor, rtol=1e-15)


def test_bundled_data():
    balls = ji.read_experiments(DATA / "three_balls.csv")
    np.testing.assert_array_equal(balls.pre, [[1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(balls.post, [[-0.0605, 0.1049, 0.9978]])
    carts = ji.read_experiments(DATA / "air_track.csv")
    assert carts.shots == ("1", "2", "3", "4", "5")
    np.testing.assert_allclose(carts.pre[0], [0.7102, 0.0], rtol=1e-15)  # was in cm/s


def test_turning_keeps_its_unit(tmp_path):
    head = "pre_1[m/s],pre_2[deg/s],post_1[cm/s],post_2[rad/s]\n"
    data = ji.read_experiments(written(tmp_path, head + "1,180,1,2\n"))
    assert data.units == ("m/s", "rad/s")
    np.testing.assert_allclose(data.pre, [[1.0, np.pi]])
    with pytest.raises(ValueError, match=r"line 1: .*\b2\b"):
        ji.read_experiments(
            written(tmp_path, head.replace("rad/s", "m/s") + "1,180,1,2\n")
        )


def test_missing_values_labels_and_foreign_line_ends(tmp_path):
    text = "\ufeffpost_2 [m/s], post_1[m/s],shot,pre_1[m/s],pre_2[m/s]\r\n\r\n,1,first,2,0\r\nNaN,1,,2,0\r\n"
    with pytest.warns(UserWarning, match=r"line 4, column `post_2 \[m/s\]`: "):
        data = ji.read_experiments(written(tmp_path, text))
    np.testing.assert_array_equal(data.pre, [[2, 0], [2, 0]])
    np.testing.assert_array_equal(data.post, [[1, np.nan], [1, np.nan]])
    assert data.sigma is None
    assert data.shots == ("first", "2")


def test_comments_are_not_read(tmp_path):
    text = (
        "comment,pre_1[m/s],comment_camera,post_1[m/s]\nfirst,1,left of it,0.5\n,2,,1\n"
    )
    data = ji.read_experiments(written(tmp_path, text))
    np.testing.assert_array_equal([data.pre, data.post], [[[1], [2]], [[0.5], [1]]])
    with pytest.raises(ValueError, match="line 4: "):
        ji.read_experiments(written(tmp_path, text + "a,1,2\n"))


def test_data_sets_are_joined():
    plain = ji.Experiments(
        [1.0, 0.0], [0.1, np.nan], sigma=0.01, shots=["a"], lost_freedom=1
    )
    read = ji.Experiments(
        [[2.0, 0.0]] * 2, [[0.2, 1.8]] * 2, resolution=0.1, sigma_pre=0.02
    )
    both = plain + read
    assert both.shots == ("a", "1", "2")
    np.testing.assert_array_equal(both.pre, [[1, 0], [2, 0], [2, 0]])
    step = 0.1 / np.sqrt(12)
    np.testing.assert_allclose(both.sigma, [[0.01, np.nan], [step, step], [step, step]])
    np.testing.assert_array_equal(both.sigma_pre, [[0, 0], [0.02, 0.02], [0.02, 0.02]])
    assert both.lost == (1, 0, 0)
    assert both.resolution is None
    np.testing.assert_array_equal((read + read).resolution, [[0.1, 0.1]] * 4)
    np.testing.assert_allclose((read + read).sigma, [[step, step]] * 4)
    assert (read + read).shots == ("1/1", "1/2", "2/1", "2/2")
    placed = ji.Experiments([1.0, 0.0], [0.1, 0.9], 0.01, scenes=[ji.chain([1.0, 1.0])])
    assert len(ji.Experiments.join([placed, placed, placed]).scenes) == 3
    turning = ji.Experiments([1.0, 0.0], [0.1, 0.9], 0.01, units=["m/s", "rad/s"])
    for other, message in (
        (
            ji.Experiments([1.0, 0.0], [0.1, 0.9]),
            "a `sigma` .or `resolution`. in all or in none",
        ),
        (placed, "scenes of their own in all or in none"),
        (turning, "the same units"),
        (ji.Experiments([1.0], [0.1], 0.01), "as many bodies"),
    ):
        with pytest.raises(ValueError, match=f"`many` must have .*{message}"):
            plain + other
    with pytest.raises(ValueError, match=argument("many")):
        ji.Experiments.join([])


def test_sigma_of_an_unmeasured_value_may_be_empty(tmp_path):
    header = "pre_1[m/s],pre_2[m/s],post_1[m/s],post_2[m/s],sigma_1[m/s],sigma_2[m/s]\n"
    data = ji.read_experiments(written(tmp_path, header + "1,0,0.1,,0.01,\n"))
    np.testing.assert_array_equal(data.sigma, [[0.01, np.nan]])


HEAD = "pre_1[m/s],post_1[m/s]\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"shots\.csv: the file is empty"),
        (HEAD, r"shots\.csv: the file has no shots"),
        ("pre_1[m/s],post_1[mph]\n1,1\n", r"line 1: the unit of column `post_1\[mph\]` must be one of m/s, .*'mph'"),
        ("pre_1[m/s],post_1\n1,1\n", r"line 1: column `post_1` must state its unit, as in `post_1\[m/s\]`"),
        ("pre_1[m/s],post_1[]\n1,1\n", r"column `post_1\[\]` must state its unit"),
        ("pre_1[m/s],pre_2[m/s],post_1[m/s]\n1,1,1\n", r"column `post_2\[unit\]` is missing"),
        ("pre_1[m/s],post_1[m/s],pre_3[m/s],post_3[m/s]\n1,1,1,1\n", r"column `pre_2\[unit\]` is missing"),
        ("shot\n1\n", r"column `pre_1\[unit\]` is missing"),
        ("pre_1[m/s],post_1[m/s],pre_2[m/s],post_2[m/s],sigma_1[m/s]\n1,1,1,1,1\n", r"`sigma_2\[unit\]` is missing"),
        ("pre_1[m/s],post_1[m/s],mass\n1,1,1\n", r"column 3 must be one of `shot`.*'mass'"),
        ("pre_0[m/s],post_1[m/s]\n1,1\n", r"column 1 must be one of"),
        ("pre_1[m/s];post_1[m/s]\n1;1\n", r"columns are separated by commas"),
        ("pre_1[m/s],pre_1[m/s],post_1[m/s]\n1,1,1\n", r"column `pre_1\[m/s\]` must occur once"),
        (HEAD + "1,0.5\n2,fast\n", r"line 3, column `post_1\[m/s\]`: the value must be a number, but is 'fast'"),
        (HEAD + "1,inf\n", r"line 2, column `post_1\[m/s\]`: the value must be finite, but is 'inf'"),
        (HEAD + ",1\n", r"column `pre_1\[m/s\]`: a velocity before the impact must be given"),
        (HEAD + "1,1,1\n", r"line 2: a shot must have 2 values, one per column, but has 3"),
        ("pre_1[m/s],post_1[m/s],sigma_1[cm/s]\n1,1,0\n", r"line 2, column `sigma_1\[cm/s\]`: .* must be > 0, but is 0"),
        ("pre_1[m/s],post_1[m/s],sigma_1[m/s]\n1,1,-2\n", r"must be > 0, but is -2"),
        ("pre_1[m/s],post_1[m/s],sigma_1[m/s]\n1,1,\n", r"must be > 0, but is empty"),
        (HEAD + "1,\n", r"`post` must hold a measured value"),
    ],
)  # fmt: skip
def test_bad_files(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        ji.read_experiments(written(tmp_path, text))


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"'nowhere\.csv'"):
        ji.read_experiments("nowhere.csv")
    with pytest.raises(ValueError, match="UTF-8"):
        ji.read_experiments(written(tmp_path, HEAD, encoding="utf-16"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"pre": [], "post": []}, r"`pre` must have shape \(K, n\)"),
        ({"pre": [1.0, 0.0], "post": [1.0]}, r"`pre` and `post` must have the same shape"),
        ({"pre": [np.nan, 0.0], "post": [1.0, 0.0]}, r"`pre` must be finite"),
        ({"pre": [1.0, 0.0], "post": [np.inf, 0.0]}, r"`post` must be finite"),
        ({"pre": [1.0, 0.0], "post": [np.nan, np.nan]}, r"must hold a measured value"),
        ({"pre": [1.0, 0.0], "post": [0.0, 1.0], "sigma": [0.1, 0.0]}, r"`sigma` must lie in \(0, inf\)"),
        ({"pre": [1.0, 0.0], "post": [0.0, 1.0], "sigma": [0.1] * 3}, r"`sigma` must be a scalar or have shape"),
        ({"pre": [[1.0, 0.0]] * 3, "post": [[0.0, 1.0]] * 3, "sigma": [0.1] * 2}, r"numpy\.tile\(sigma, \(3, 1\)\)"),
        ({"pre": [1.0, 0.0], "post": [0.0, 1.0], "shots": ["a", "b"]}, r"`shots` must have 1 labels"),
        ({"pre": [1.0, 0.0], "post": [0.0, 1.0], "units": ["m/s", "m"]}, r"`units` must have 2 entries"),
        ({"pre": [1.0, 0.0], "post": [0.0, 1.0], "scenes": []}, r"`scenes` must have one scene per shot"),
        ({"pre": [1.0, 0.0], "post": [0.0, 1.0], "scenes": [CHAIN]}, r"`scenes` must have 2 bodies"),
    ],
)  # fmt: skip
def test_bad_experiments(arguments, message):
    with pytest.raises(ValueError, match=message):
        ji.Experiments(**arguments)


def test_correction_is_the_smallest_change_in_units_of_sigma():
    scene = ji.chain([1.0, 2.0])
    data = ji.Experiments([3.0, 0.0], [0.0, 1.8], sigma=[0.1, 0.3])
    # Lagrange: change_i proportional to sigma_i^2 m_i, momentum excess 0.6 removed
    share = np.array([0.01 * 1.0, 0.09 * 2.0])
    expected = np.array([0.0, 1.8]) - 0.6 * share / (share @ [1.0, 2.0])
    np.testing.assert_allclose(
        data.momentum_corrected(scene).post[0], expected, atol=1e-14
    )


def test_a_wall_takes_all_momentum_and_two_pairs_conserve_two():
    data = ji.Experiments([1.0, 0.0], [-0.5, 0.2])
    assert data.momentum_excess(ji.chain([1.0, 1.0], wall=True)).shape == (1, 0)
    np.testing.assert_array_equal(
        data.momentum_corrected(ji.chain([1.0, 1.0], wall=True)).post, data.post
    )
    pairs = ji.Scene([1.0] * 4, np.array([[-1.0, 1, 0, 0], [0, 0, -1, 1]]).T)
    four = ji.Experiments([1.0, 0, 2, 0], [0.0, 1.1, 0.5, 1.2])
    excess = four.momentum_excess(pairs)
    assert excess.shape == (1, 2)
    corrected = np.asarray(four.momentum_corrected(pairs).post[0])
    np.testing.assert_allclose(corrected, [-0.05, 1.05, 0.65, 1.35], atol=1e-14)


def test_a_scene_is_needed():
    data = ji.Experiments([1.0, 0.0], [0.0, 1.0])
    with pytest.raises(ValueError, match=argument("scene")):
        data.momentum_excess()
    own = ji.Experiments([1.0, 0.0], [0.0, 1.1], scenes=[ji.chain([1.0, 1.0])])
    np.testing.assert_allclose(own.momentum_excess(), [[0.1]], atol=1e-15)


MORE = "mass_1[g],mass_2[kg],gap_1[mm],pre_1[m/s],pre_2[m/s],post_1[m/s],post_2[m/s]"


def test_masses_and_gaps_of_each_shot(tmp_path):
    path = written(tmp_path, f"{MORE}\n100,1,0,1,0,0,1\n200,1,2,1,0,0,1\n")
    data = ji.read_experiments(path, ji.chain([1.0, 1.0]))
    np.testing.assert_allclose([s.mass for s in data.scenes], [[0.1, 1.0], [0.2, 1.0]])
    np.testing.assert_allclose([s.gaps for s in data.scenes], [[0.0], [0.002]])
    assert data.contacts.tolist() == [1, 1]
    assert data.only([1]).shots == ("2",)
    with pytest.raises(ValueError, match="columns `mass`"):
        ji.read_experiments(path)


@pytest.mark.parametrize(
    ("unit", "metres"), [("m", 1.0), ("cm", 1e-2), ("mm", 1e-3), ("um", 1e-6)]
)
def test_units_of_gaps(tmp_path, unit, metres):
    head = MORE.replace("gap_1[mm]", f"gap_1[{unit}]")
    data = ji.read_experiments(
        written(tmp_path, f"{head}\n100,1,3,1,0,0,1\n"), ji.chain([1.0, 1.0])
    )
    np.testing.assert_allclose(data.scenes[0].gaps, [3 * metres], rtol=1e-14)


def test_a_body_where_each_shot_found_it(tmp_path):
    head = "q_1[m],q_2[cm],q_3[deg]," + ",".join(
        f"{k}_{i}[{u}]"
        for k in ("pre", "post")
        for i, u in ((1, "m/s"), (2, "m/s"), (3, "rad/s"))
    )
    path = written(
        tmp_path, f"{head}\n0,100,0,0,-1,0,0,0.5,0\n0,100,30,0,-1,0,0,0.5,0\n"
    )
    data = ji.read_experiments(path, ji.Block(width=1.0, height=2.0), near=1e-3)
    assert data.contacts.tolist() == [2, 1]  # its base, its corner
    assert data.units == ("m/s", "m/s", "rad/s")
    with pytest.raises(ValueError, match="columns `q`"):
        ji.read_experiments(path, CHAIN)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pre_1[m/s],post_1[m/s],mass_1[m]\n1,1,1\n", r"the unit of column `mass_1\[m\]` must be one of kg, g"),
        ("pre_1[m/s],post_1[m/s],mass_1[g]\n1,1,0\n", r"column `mass_1\[g\]`: a mass must be > 0, but is '0'"),
        ("pre_1[m/s],post_1[m/s],gap_1[mm]\n1,1,\n", r"column `gap_1\[mm\]`: this must be given"),
        ("pre_1[m/s],post_1[m/s],sigma_1[m/s],sigma_pre_1[m/s]\n1,1,1,-1\n", r"must be > 0, but is -1"),
        ("pre_1[m/s],post_1[m/s],sigma_pre_1[m/s]\n1,1,1\n", r"`sigma` must be given where `sigma_pre` is"),
        ("pre_1[m/s],post_1[m/s],q_2[m]\n1,1,1\n", r"column `q_1\[unit\]` is missing"),
        ("pre_1[m/s],post_1[m/s],resolution_1[m/s]\n1,1,0\n", r"must be > 0, but is 0"),
    ],
)  # fmt: skip
def test_bad_further_columns(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        ji.read_experiments(written(tmp_path, text), CHAIN)


def test_readings_in_steps_have_the_error_of_their_rounding():
    data = ji.Experiments([1.0, 0.0], [0.2, 0.8], resolution=0.1)
    np.testing.assert_allclose(data.sigma, 0.1 / np.sqrt(12))
    both = ji.Experiments([1.0, 0.0], [0.2, 0.8], sigma=0.03, resolution=0.1)
    np.testing.assert_allclose(both.only([0]).sigma, np.hypot(0.03, 0.1 / np.sqrt(12)))
    rounded = np.random.default_rng(0).uniform(-1, 1, 4000)
    np.testing.assert_allclose(
        (rounded - rounded.round(1)).std(), 0.1 / np.sqrt(12), rtol=0.02
    )
