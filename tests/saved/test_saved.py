"""Files that a build before 0.2 saved, when classes had other modules: read, or refused with a sentence."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import jimpact as ji

SAVED = Path(__file__).parents[1] / "held" / "saved_0_1"


def test_a_fit_is_read_and_saved_by_public_names(tmp_path):
    fit = ji.load(SAVED / "fit.json")
    assert type(fit.law) is ji.LZB
    np.testing.assert_allclose(
        fit.value, [0.8912947587740866, 0.8102045696860172, 2.088638444090552]
    )
    assert fit.verdict.startswith(
        "restitution[1] and restitution[2] and the stiffness ratio"
    )
    again = fit.save(tmp_path / "fit.json")
    assert str(ji.load(again)) == str(fit)
    assert "jimpact." not in json.dumps(json.loads(again.read_text())["result"])


def test_a_motion_is_read():
    motion = ji.load(SAVED / "ball.npz")
    assert float(motion.event_times()[0]) == pytest.approx(np.sqrt(2 / 9.80665))


def test_a_run_is_not_continued(tmp_path):
    """Its identity named modules, so that nobody can tell whether it is the same."""
    folder = shutil.copytree(SAVED, tmp_path / "run")
    with pytest.raises(
        ValueError, match="holds a run that an earlier build of jimpact began"
    ):
        ji.monte_carlo(
            ji.Compliant(ji.Hertz(1e9)), ji.chain([0.1] * 3), [1.0, 0, 0],
            gaps=ji.Uniform(0.0, 1e-5), samples=1000, folder=folder,
        )  # fmt: skip


def test_an_unknown_law_is_named(tmp_path):
    text = (SAVED / "fit.json").read_text().replace("jimpact.laws.lzb:LZB", "ji.Zorn")
    (tmp_path / "fit.json").write_text(text)
    with pytest.raises(ValueError, match="Zorn is no class of jimpact"):
        ji.load(tmp_path / "fit.json")


@pytest.mark.parametrize("loss", ["huber", "student"])
def test_a_robust_fit_is_read_as_it_was_saved(tmp_path, loss):
    """The factors of its errors are NumPy numbers, which a file has to hold, too."""
    before = np.array([[1.0, 0.0], [1.5, -0.2], [2.0, 0.1], [1.2, -0.4], [1.1, 0.3]])
    after = before + np.outer(1.7 * (before[:, 0] - before[:, 1]) / 2, [-1, 1])
    after[2] += 0.3  # an outlier
    data = ji.Experiments(before, after, sigma=0.01)
    fit = ji.fit(
        ji.Newton(0.5), ji.chain([1.0, 1.0]), data, search=ji.Search(loss=loss)
    )
    again = ji.load(fit.save(tmp_path / "fit.json"))
    assert str(again) == str(fit)
    np.testing.assert_array_equal(again.standard_error, fit.standard_error)
