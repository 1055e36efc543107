"""Measured motions from files."""

import numpy as np
import pytest

import jimpact as ji
from jimpact import read_study

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


@pytest.mark.release
def test_a_study_of_a_motion_is_fitted(tmp_path):
    ball = ji.System(ji.Column([1.0]), gravity=True)
    q = np.asarray(ji.simulate(ball, ji.Newton(0.8), [1.0], [0.0], 1.5, samples=16).q)[
        :, 0
    ]
    lines = [f"{100 * i},{100 * x:.8f}" for i, x in enumerate(q)]
    (tmp_path / "heights.csv").write_text("t[ms],q_1[cm]\n" + "\n".join(lines) + "\n")
    (tmp_path / "study.toml").write_text(MOTION)
    found = read_study(tmp_path / "study.toml").fit()
    np.testing.assert_allclose(found.value, [0.8], atol=1e-6)
    assert "Fit of Newton to 16 measured values" in str(found)
    ji.plot.fit(found)


def test_motions_that_cannot_be_read(tmp_path):
    (tmp_path / "study.toml").write_text(MOTION)
    for text, message in (
        ("t[s],q_1[m]\n0,1\n1,1\n3,1\n", "must rise in equal steps"),
        ("t[s],q_2[m]\n0,1\n1,1\n", "the columns must be `q_1`, `q_2` and `t`"),
        (
            "t[s],v_1[m/s]\n0,1\n1,1\n",
            r"column 2 must be one of `t\[s\]`, `q_1\[unit\]`",
        ),
        ("t[s],q_1[m],sigma_q_1[m]\n0,1,1\n1,1,0\n", "must be > 0, but is 0"),
        ("t[s],q_1[m]\n", "the file has no samples"),
    ):
        (tmp_path / "heights.csv").write_text(text)
        with pytest.raises(ValueError, match=message):
            read_study(tmp_path / "study.toml")
