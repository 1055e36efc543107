"""`jimpact montecarlo`, the [monte_carlo] table, its picture."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from jimpact.cli import main
from jimpact.laws.binary import Binary
from jimpact.laws.compliant import Compliant
from jimpact.laws.kinematic import Newton
from jimpact.montecarlo.distributions import Normal, RandomLaw, Uniform
from jimpact.montecarlo.executors.serial import Serial
from jimpact.montecarlo.running import monte_carlo
from jimpact.plot.montecarlo import plot_monte_carlo
from jimpact.scene import chain
from jimpact.study import read_study

STUDY = """
title = "binary"
[scene]
masses_kg = [0.25, 1.0, 0.25]
[law]
name = "binary"
restitution = 1.0
order = "earliest"
[monte_carlo]
velocity_m_per_s = [1.0, 0.0, -1.0]
samples = 600
seed = 5
chunk = 256
[monte_carlo.gaps_m]
low = 0.0
high = [1e-5, 2e-5]
"""


def written(tmp_path, text=STUDY):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return path


def test_a_study_gives_the_arguments(tmp_path):
    study = read_study(written(tmp_path))
    assert isinstance(study.law, Binary)
    assert study.law.order == "earliest"
    given = study.monte_carlo
    assert isinstance(given["gaps"], Uniform)
    assert (given["samples"], given["key"], given["chunk"]) == (600, 5, 256)
    other = STUDY.replace("[1.0, 0.0, -1.0]", "{ mean = 1.0, std = 0.1 }").replace(
        "low = 0.0\nhigh = [1e-5, 2e-5]", "mean = 1e-5\nstd = 1e-6"
    )
    given = read_study(
        written(tmp_path, other + "[monte_carlo.law]\nrestitution = { low = 0.8, high = 0.9 }\n")
    ).monte_carlo
    assert isinstance(given["velocity"], Normal)
    assert isinstance(given["gaps"], Normal)
    assert isinstance(given["law"], RandomLaw)


def test_the_bundled_study_is_about_its_gaps():
    study = read_study("three_balls_gaps.toml")
    assert isinstance(study.law, Compliant)
    assert study.monte_carlo["samples"] == 20_000
    assert isinstance(study.monte_carlo["gaps"], Uniform)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed = 5", "seeds = 5", r"\[monte_carlo\] may have the keys velocity_m_per_s, .*`seeds`"),
        (
            "velocity_m_per_s = [1.0, 0.0, -1.0]",
            "",
            r"\[monte_carlo\] must have the key `velocity_m_per_s`",
        ),
        (
            "low = 0.0",
            "least = 0.0",
            "`gaps_m` in .monte_carlo. must have low and high, or mean and std",
        ),
        ("low = 0.0", "low = -1.0", "`initial_energy` of LZB|initial_energy"),
        ("samples = 600", "samples = 0", "`samples` must be at least 1"),
        ("samples = 600", "law = 3", r"\[monte_carlo.law\] must be a table"),
        ('order = "earliest"', 'order = "latest"', "`order` must be"),
        ("[monte_carlo]\n", "[montecarlo]\n", "may have the keys"),
    ],
)
def test_what_is_wrong_with_a_study_is_told(tmp_path, capsys, old, new, message):
    assert old in STUDY
    path = written(tmp_path, STUDY.replace(old, new))
    assert main(["montecarlo", str(path), "--out", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert told.startswith("jimpact montecarlo: ")
    with pytest.raises(ValueError, match=message):
        raise ValueError(told)


def test_a_report_and_a_picture(tmp_path, capsys):
    path = written(tmp_path)
    assert main(["montecarlo", str(path), "--out", str(tmp_path / "new")]) == 0
    told = capsys.readouterr().out
    assert (
        "600 samples of Binary, 3 coordinates, 2 contacts; gaps: Uniform(low=0, high=[1e-05, 2e-05])"
        in told
    )
    assert "v3+" in told
    assert "ok: 600" in told
    assert (tmp_path / "new" / "jimpact-montecarlo.png").stat().st_size > 10_000


def test_json_options_and_resume(tmp_path, capsys):
    path = str(written(tmp_path))
    options = [
        "--json",
        "--out",
        str(tmp_path / "a.svg"),
        "--folder",
        str(tmp_path / "run"),
        "--keep-samples",
    ]
    assert main(["montecarlo", path, *options]) == 0
    first = json.loads(capsys.readouterr().out)
    assert main(["montecarlo", path, *options, "--samples", "700"]) == 0
    more = json.loads(capsys.readouterr().out)
    assert (first["samples"], more["samples"], more["resumed"]) == (600, 700, 512)
    given = read_study(path).monte_carlo
    found = monte_carlo(**(given | {"samples": 700}))
    assert more["mean"] == found.mean.tolist()
    assert main(["montecarlo", path, *options, "--seed", "6"]) == 2
    assert "holds another run, which differs in key" in capsys.readouterr().err
    assert main(["montecarlo", path, "--scheduler", "tcp://nowhere:1"]) == 2
    assert "--scheduler needs --executor dask" in capsys.readouterr().err
    assert main(["montecarlo", "three_balls.toml"]) == 2
    assert "must have a [monte_carlo] table" in capsys.readouterr().err
    assert main(["montecarlo", path, "--out", "picture.txt"]) == 2
    assert "--out must end in" in capsys.readouterr().err


def test_ctrl_c_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    path = str(written(tmp_path))

    def stopping(self, plan, tasks):
        for task in tasks:
            yield plan(task)
            if task.number == 1:
                raise KeyboardInterrupt

    monkeypatch.setattr(Serial, "run", stopping)
    arguments = ["montecarlo", path, "--folder", str(tmp_path / "run"), "--out", str(tmp_path)]
    assert main(arguments) == 130
    told = capsys.readouterr().err
    assert "stopped after 512 of 600 samples" in told
    assert "the same call continues from there" in told
    monkeypatch.undo()
    assert main(arguments) == 0
    assert "512 read from the folder" in capsys.readouterr().out


def test_failed_samples_are_told_on_stderr(tmp_path, capsys):
    # Newton's law lets contacts pull, for some of these velocities
    text = STUDY[: STUDY.index("[monte_carlo.gaps_m]")].replace("binary", "newton")
    text = text.replace('order = "earliest"', "").replace(
        "[1.0, 0.0, -1.0]", "{ mean = [1.0, 0.0, -1.0], std = 1.0 }"
    )
    assert main(["montecarlo", str(written(tmp_path, text)), "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr()
    assert shown.err.startswith("jimpact montecarlo: ")
    assert "of 600 samples failed and are left out of the statistics" in shown.err
    assert ", left out (" in shown.out


@pytest.mark.slow
def test_a_real_ctrl_c(tmp_path):
    path = written(tmp_path, STUDY.replace("samples = 600", "samples = 100_000_000"))
    folder = tmp_path / "run"
    command = [
        sys.executable,
        "-m",
        "jimpact.cli",
        "montecarlo",
        str(path),
        "--folder",
        str(folder),
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    try:
        end = time.monotonic() + 60
        while len(list(folder.glob("chunk-*.npz"))) < 3 and time.monotonic() < end:
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGINT)
        told = process.communicate(timeout=60)[1]
    finally:
        process.kill()
    assert process.returncode == 130
    assert "continues from there" in told
    assert "Traceback" not in told


def test_pictures_of_one_gap_and_of_none():
    pair = chain([1.0, 1.0])
    one = monte_carlo(
        Newton(0.5), pair, Normal([1.0, 0.0], 0.1), Uniform(0.0, 1e-3), samples=50, chunk=64
    )
    figure = plot_monte_carlo(one, "one gap")
    assert figure.axes[-1].get_xlabel() == "gap 1 [µm]"
    assert len(figure.axes) == 3
    none = monte_carlo(Newton(0.5), pair, Normal([1.0, 0.0], 0.1), samples=50, chunk=64)
    figure = plot_monte_carlo(none)
    assert len(figure.axes) == 2
    shown = figure.axes[0].patches[0].get_data()
    np.testing.assert_allclose(shown.values.sum(), 100.0)
