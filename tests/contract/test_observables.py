"""What else is measured: energies and bounces, forces and times; motions from files."""

import numpy as np
import pytest

import jimpact as ji
from jimpact import read_motion_study, read_study

COLUMN = """
[scene]
masses_kg = [1.0, 2.0, 3.0]
wall = true

[law]
name = "newton"
restitution = 0.7

"""


def study(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return read_study(path)


def test_energies_and_bounces(tmp_path):
    """One ball on a wall keeps e^2 of its energy, and rises to e^2 of its height."""
    drop = "drop_height_m = 0.2\nbodies = 1\nsigma = 0.01\n"
    rows = [
        f'[[observe]]\nquantity = "energy_ratio"\nvalue = 0.64\n{drop}',
        f'[[observe]]\nquantity = "bounce_height"\nbody = 3\nvalue = [0.128, nan]\n{drop}',
    ]
    found = study(tmp_path, COLUMN + "\n".join(rows))
    seen = np.asarray(found.problem.residual([0.8]))
    np.testing.assert_allclose(seen, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.problem.residual([0.7])[0], -15.0, rtol=1e-9)
    assert found.problem.labels[1] == "bounce height 3, 1 bodies"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ('quantity = "force"\nvalue = 1\ndrop_height_m = 1', r"`quantity` must be one of peak_force"),
        ('quantity = "peak_force"\nvalue = 1\ndrop_height_m = 1', r"a peak_force needs `contact`, from 1 to 3"),
        ('quantity = "peak_force"\ncontact = 4\nvalue = 1\ndrop_height_m = 1', r"`contact` must lie in \[1, 3\]"),
        ('quantity = "duration"\nvalue = 1', r"must have one of velocity_m_per_s, drop_height_m, but has none"),
        ('quantity = "duration"\nvalue = 1\nvelocity_m_per_s = [1.0]', r"must have 3 entries, one for each body"),
        ('quantity = "duration"\nvalue = [1, 2]\nbodies = [1, 2, 3]\ndrop_height_m = 1', r"must be a number or have 2 entries"),
        ('quantity = "duration"\nvalue = 1\nbodies = 4\ndrop_height_m = 1', r"`bodies` must lie in \[1, 3\]"),
        ('quantity = "duration"\nvalue = 1\nsigma = 0\ndrop_height_m = 1', r"must lie in \(0, inf\)"),
        ('quantity = "duration"\nvalue = 1\nforce = 1', r"may have the keys quantity, .*, but has `force`"),
    ],
)  # fmt: skip
def test_bad_observations(tmp_path, row, message):
    with pytest.raises(ValueError, match=message):
        study(tmp_path, f"{COLUMN}[[observe]]\n{row}\n")


@pytest.mark.slow
def test_the_bead_column():
    """The largest force on the wall: 51.66 and 52.90 N of one and more beads."""
    problem = read_study("bead_column.toml").problem
    seen = problem.residuals.observe(problem.law)
    np.testing.assert_allclose(seen.value[1:8], 52.90 / 51.66, atol=3e-4)
    np.testing.assert_allclose(seen.value[8:], 1.0, atol=1e-9)


@pytest.mark.release
def test_times_of_one_ball_on_a_linear_wall(tmp_path):
    """Half a sine: pi / omega, its top half as late, m v omega; loaded above 1 % of it."""
    text = COLUMN.replace("newton", "lzb").replace("0.7", "1.0\nexponent = 1.0\nstiffness = 12.0")
    text += '[fit]\nfree = ["restitution", "stiffness"]\n\n'
    shot = "contact = 3\nbodies = 1\ndrop_height_m = 0.2\nsigma = 1e-6\n"
    v = np.sqrt(2 * 9.80665 * 0.2)
    exact = [6 * v, 0.25 * np.pi, 0.5 * np.pi - np.arcsin(0.01), 0.5 * np.pi]
    names = ["peak_force", "arrival_time", "duration", "duration"]
    rows = [f'[[observe]]\nquantity = "{n}"\nvalue = {x}\n{shot}' for n, x in zip(names, exact)]
    rows[3] = rows[3].replace("contact = 3\n", "")
    problem = study(tmp_path, text + "\n".join(rows)).problem
    np.testing.assert_allclose(problem.residuals.observe(problem.law).value, exact, rtol=2e-5)
    slopes = np.asarray(problem.jacobian(problem.start))[:, -1] * 1e-6  # of the stiffness
    assert "stiffness" in problem.names[-1]
    np.testing.assert_allclose(slopes[0], 6 * v / 24, rtol=1e-4)
    np.testing.assert_allclose(slopes[3], -0.5 * np.pi / 24, rtol=1e-4)


MOTION = """
[system]
kind = "Column"
masses_kg = [1.0]

[law]
name = "newton"
restitution = 0.7

[motion]
q0 = [1.0]
v0 = [0.0]
t_end_s = 1.0

[data]
file = "heights.csv"
"""


@pytest.mark.slow
def test_a_study_of_a_motion_is_fitted(tmp_path):
    ball = ji.ball_system()
    q = np.asarray(ji.simulate(ball, ji.Newton(0.8), [1.0], [0.0], 1.5, samples=16).q)[:, 0]
    lines = [f"{100 * i},{100 * x:.8f}" for i, x in enumerate(q)]
    (tmp_path / "heights.csv").write_text("t[ms],q_1[cm]\n" + "\n".join(lines) + "\n")
    (tmp_path / "study.toml").write_text(MOTION)
    found = read_motion_study(tmp_path / "study.toml").fit()
    np.testing.assert_allclose(found.value, [0.8], atol=1e-6)
    assert "Fit of Newton to 16 measured values" in str(found)
    ji.plot.fit(found)


def test_motions_that_cannot_be_read(tmp_path):
    (tmp_path / "study.toml").write_text(MOTION)
    for text, message in (
        ("t[s],q_1[m]\n0,1\n1,1\n3,1\n", "rising in equal steps"),
        ("t[s],q_2[m]\n0,1\n1,1\n", "the columns must be `q_1`, `q_2` and `t`"),
        ("t[s],v_1[m/s]\n0,1\n1,1\n", r"column 2 must be one of `t\[s\]`, `q_1\[unit\]`"),
        ("t[s],q_1[m],sigma_q_1[m]\n0,1,1\n1,1,0\n", "must be > 0, but is 0"),
        ("t[s],q_1[m]\n", "the file has no samples"),
    ):
        (tmp_path / "heights.csv").write_text(text)
        with pytest.raises(ValueError, match=message):
            read_motion_study(tmp_path / "study.toml")
