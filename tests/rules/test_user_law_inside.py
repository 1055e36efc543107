"""A law in a user's own file: a study and the command line import it (see test_own_law.py)."""

import json

import numpy as np
import pytest
from command_line import main
from refusals import argument

import jimpact as ji
from jimpact import read_study
from jimpact.cli.study_file import import_laws

pytestmark = pytest.mark.slow  # they compile programs of their own

FILE = '''
import jax.numpy as jnp

import jimpact as ji


@ji.register("sluggish", summary="Newton with a share that never returns", right_when="made up",
             fails_when="always", promises={"velocity_scaling"}, source="this file")
class Sluggish(ji.Law):
    """gamma+ = -(e - loss) gamma- at every contact."""

    restitution: float = ji.parameter(low=0, high=1)
    loss: float = ji.parameter(low=0, high=0.5, default=0.0)
    hardness: float = ji.parameter(low=0, open_low=True, log=True, default=2.0, kw_only=True)
    kind: str = ji.option("plain", ("plain", "other"))

    def impulses(self, contact):
        e = self.restitution - self.loss
        return ji.Impulses(jnp.linalg.solve(contact.normal_delassus, -(1 + e) * contact.gap_velocity))


@ji.register("needy", summary="needs two parameters")
class Needy(ji.Newton):
    extra: float = ji.parameter(low=0)

    def __init__(self, restitution, extra):
        super().__init__(restitution)
        self.extra = extra
'''


STUDY = """
title = "a law of my own"
[scene]
masses_kg = [1.0, 2.0]
[law]
name = "sluggish"
module = "my_laws.py"
restitution = 0.8
loss = 0.1
[fit]
free = ["loss"]
starts = 2
[data]
file = "shots.csv"
[monte_carlo]
velocity_m_per_s = [1.0, 0.0]
samples = 100
[monte_carlo.law]
loss = {low = 0.0, high = 0.2}
"""


PAIR, V = ji.chain([1.0, 2.0]), np.array([1.0, 0.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("mine")
    (place / "my_laws.py").write_text(FILE)
    (place / "study.toml").write_text(STUDY)
    after = np.asarray(ji.impact(ji.Newton(0.55), PAIR, V).velocity)
    row = f"1,0,{after[0]},{after[1]}\n"
    (place / "shots.csv").write_text(
        "pre_1[m/s],pre_2[m/s],post_1[m/s],post_2[m/s]\n" + row + row
    )
    import_laws("my_laws.py", place)
    yield place
    for name in ("sluggish", "needy"):
        del ji.REGISTRY[name]


@pytest.fixture
def law(folder):
    return ji.REGISTRY["sluggish"].law(0.8, 0.1)


def test_declared_domains(law):
    kind = type(law)
    with pytest.raises(ValueError, match=argument("loss", "0.6")):
        kind(0.8, 0.6)
    with pytest.raises(ValueError, match=argument("hardness", "0")):
        kind(0.8, hardness=0.0)
    with pytest.raises(ValueError, match=argument("kind", "'third'")):
        kind(0.8, kind="third")
    with pytest.raises(TypeError, match=argument("restitution", "'high'")):
        kind("high")
    with pytest.raises(ValueError, match=argument("restitution")):
        ji.impact(kind([0.8, 0.7, 0.6]), PAIR, V)
    assert ji.REGISTRY["sluggish"].parameters == ("restitution", "loss", "hardness")
    assert ji.REGISTRY["sluggish"].required == ("restitution",)


@pytest.mark.slow
def test_study_fit_and_monte_carlo(folder):
    study = read_study(folder / "study.toml")
    found = study.run()
    assert found.names == ("loss",)
    np.testing.assert_allclose(found.value, 0.25, atol=1e-9)
    assert found.bounds[1].tolist() == [0.5]
    hard = ji.fit(
        found.law, PAIR, study.experiments, free=("loss", "hardness"), starts=1
    )
    assert hard.rank == 1
    assert hard.bounds[0][1] == 2e-4  # fitted in its logarithm
    sampled = ji.monte_carlo(**study.monte_carlo)
    assert sampled.statuses == {"ok": 100}
    with pytest.raises(ValueError, match=argument("loss")):
        ji.RandomLaw(study.law, loss=ji.Uniform(0.0, 0.6))


def test_compare_leaves_out_what_it_cannot_build(folder, monkeypatch):
    monkeypatch.delitem(ji.REGISTRY, "lzb")  # slow to compile
    table = ji.compare(PAIR, V, restitution=0.5)
    assert {"sluggish", "newton"} <= set(table.entries)
    assert table.left_out["needy"] == "needs `extra`"
    assert "needy is left out: it needs `extra`" in str(table)


def test_command_line(folder, capsys, tmp_path):
    assert main(["laws", "--module", str(folder / "my_laws.py"), "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["sluggish"]["parameters"] == ["restitution", "loss", "hardness"]
    out = str(tmp_path / "fit.png")
    assert main(["fit", str(folder / "study.toml"), "--json", "--out", out]) == 0
    fits = json.loads(capsys.readouterr().out)["fits"]
    assert fits["as measured"]["law"] == "Sluggish"
