"""The table of engines: its columns, and the nearest laws beside closed forms."""

import csv

import numpy as np
import pytest

import jimpact as ji


def test_a_row_holds_what_was_measured():
    table = ji.data.engine_impacts()
    assert len(table.rows) > 150
    assert len({row.engine for row in table.rows}) >= 30
    for row in table.rows:
        masses, wall, _ = ji.data.ENGINE_SCENES[row.scene]
        m, v = np.array(masses), np.array(row.velocity)
        assert row.energy_ratio == pytest.approx(m @ v**2 / m[0], abs=2e-3 * m.sum() / m[0])
        if not wall:
            assert row.momentum == pytest.approx(m @ v / m[0], abs=2e-3 * m.sum() / m[0])
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
