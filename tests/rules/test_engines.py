"""The table of engines: its columns, and the nearest laws beside closed forms."""

import csv

import numpy as np
import pytest
from refusals import argument
from scipy.integrate import solve_ivp

import jimpact as ji


def test_a_row_holds_what_was_measured():
    table = ji.data.engine_impacts()
    assert len(table.rows) > 150
    assert len({row.engine for row in table.rows}) >= 30
    for row in table.rows:
        masses, wall, _ = ji.data.ENGINE_SCENES[row.scene]
        m, v = np.array(masses), np.array(row.velocity)
        assert row.energy_ratio == pytest.approx(
            m @ v**2 / m[0], abs=2e-3 * m.sum() / m[0]
        )
        if not wall:
            assert row.momentum == pytest.approx(
                m @ v / m[0], abs=2e-3 * m.sum() / m[0]
            )
        assert row.distance <= row.second_distance + 3e-3


def test_nearest_laws_are_those_of_closed_forms():
    """Three equal balls: Moreau's v+ is v- + (1 + e) (1/3 - v-); plastic: 1/3."""
    before = np.array([1.0, 0.0, 0.0])
    for row in ji.data.engine_impacts(scene="S1").rows:
        if row.nearest_law in ("Moreau", "plastic"):
            law = before + (1 + row.nearest_e) * (1 / 3 - before)
            distance = np.linalg.norm(np.array(row.velocity) - law)
            assert row.distance == pytest.approx(distance, abs=1e-4)


def test_it_prints_and_exports(tmp_path):
    table = ji.data.engine_impacts("siconos", "S1")
    assert "Moreau" in str(table)
    table.to_csv(tmp_path / "engines.csv")
    with (tmp_path / "engines.csv").open() as file:
        first = next(csv.DictReader(file))
    assert [first[f"v{i}"] for i in (1, 2, 3)] == ["-0.333", "0.667", "0.667"]
    assert first["nearest_law"] == "Moreau"


@pytest.mark.parametrize(("name", "value"), [("engine", "unity"), ("scene", "S9")])
def test_an_unknown_engine_or_scene_is_named(name, value):
    with pytest.raises(ValueError, match=f"`{name}` must be one of .*{value}"):
        ji.data.engine_impacts(**{name: value})


# e of pairs, as the engines gave it (`tests/validation/engines/pairs.py`; LAMMPS 2025-07-22 at 1 us,
# Exudyn 1.13.6 at 10 us, Drake 1.58.0 continuous and by SAP at 1 us): their steps cost up to 8e-4
MEASURED = {
    "lammps": {0.1: 0.0999, 0.5: 0.5, 0.9: 0.9},
    "lammps_limit_damping": {0.1: 0.2527, 0.5: 0.5503, 0.9: 0.902},
    "lammps_tsuji_hertz": {0.1: 0.235, 0.5: 0.6161, 0.9: 0.9284},
    "lammps_tsuji_hooke": {0.1: 0.1892, 0.5: 0.5813, 0.9: 0.9204},
    "exudyn_1": {0.1: 0.5158, 0.5: 0.663, 0.9: 0.909},
    "exudyn_2": {0.1: 0.101, 0.3: 0.3042, 0.5: 0.5002, 0.9: 0.9},
    "drake": {0.1: 0.9375, 0.5: 0.7484, 1.0: 0.5936, 10.0: 0.1},
    "drake_sap": {0.0: 0.9995, 1e-3: 0.6359, 2e-3: 0.4347, 4e-3: 0.2352},
}
GIVEN = {"drake": {"speed": 1.0}, "drake_sap": {"stiffness": 5e4, "mass": 0.5}}


@pytest.mark.parametrize("engine", MEASURED)
def test_restitution_of_engines_is_as_measured(engine):
    for parameter, e in MEASURED[engine].items():
        found = ji.theory.engine_restitution(engine, parameter, **GIVEN.get(engine, {}))
        assert found == pytest.approx(e, abs=8e-4)
        if parameter > 0.0 and found < 1:
            back = ji.theory.engine_parameter(engine, found, **GIVEN.get(engine, {}))
            assert back == pytest.approx(parameter, rel=1e-6)


@pytest.mark.slow
def test_restitution_of_engines_is_that_of_their_forces():
    """Beside jimpact's forces, cut at 0, and an integration of one that pulls."""
    drake = ji.theory.engine_restitution("drake", 0.8, speed=1.7)
    force = ji.HuntCrossley(3.0, 0.8, exponent=1.0)
    assert drake == pytest.approx(
        float(ji.measured_restitution(force, 0.6, 1.7)), abs=1e-9
    )
    sap = ji.theory.engine_restitution("drake_sap", 0.3, stiffness=3.0, mass=0.6)
    spring = ji.KelvinVoigt(3.0, 0.9)
    assert sap == pytest.approx(
        float(ji.measured_restitution(spring, 0.6, 1.7)), abs=1e-12
    )
    ratio = -np.log(0.4) / np.hypot(np.pi, np.log(0.4))
    c = ratio * np.sqrt(5 * 0.6 * 3.0)

    def pull(_, state):
        x, v = state
        return v, -(3.0 * max(x, 0) ** 1.5 + c * max(x, 0) ** 0.25 * v) / 0.6

    def apart(_, state):
        return state[0]

    apart.terminal, apart.direction = True, -1
    run = solve_ivp(pull, (0, 20), (1e-12, 1.7), events=apart, rtol=1e-10, atol=1e-13)
    lammps = ji.theory.engine_restitution("lammps", 0.4)
    assert lammps == pytest.approx(-run.y[1, -1] / 1.7, abs=1e-6)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("unity", 0.5), "`engine` must be one of .*drake_sap.*'unity'"),
        (("drake", 0.5), "`speed` must be given for engine 'drake'"),
        (("drake_sap", 0.5, None, 1e5, 0.0), "`mass` must lie in .* has value 0"),
        (("lammps", 1.2), "`restitution` must lie in .* has value 1.2"),
        (
            ("exudyn_1", 0.3),
            r"`restitution` must lie in \[0.4877, 1\] for engine 'exudyn_1'",
        ),
    ],
)
def test_parameters_that_no_engine_takes_are_named(arguments, told):
    with pytest.raises(ValueError, match=told):
        ji.theory.engine_parameter(*arguments)


def test_a_parameter_out_of_range_is_named():
    with pytest.raises(ValueError, match=argument("parameter", "1.5")):
        ji.theory.engine_restitution("lammps", 1.5)
    with pytest.raises(ValueError, match=argument("parameter", "-1")):
        ji.theory.engine_restitution("drake", -1.0, speed=1.0)
