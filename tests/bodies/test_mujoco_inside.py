"""Scenes from MuJoCo: its own constraint rows, distances and energies, and our bodies, agree."""

import pytest
from refusals import argument

import jimpact as ji


def test_bad_parameters_of_contacts_are_named(monkeypatch):
    for name, call in {
        "solref": lambda: ji.mujoco_restitution((0.02, -1.0), 0.002),
        "solimp": lambda: ji.mujoco_restitution((0.02, 1.0), 0.002, (0.9, 0.95)),
        "timestep": lambda: ji.mujoco_restitution((0.02, 1.0), 0.0),
        "speed": lambda: ji.mujoco_solref(0.5, 0.002, speed=-1.0),
        "restitution": lambda: ji.mujoco_solref(1.2, 0.002),
        "duration": lambda: ji.mujoco_solref(0.5, 0.002, duration=0.0),
    }.items():
        with pytest.raises(ValueError, match=argument(name)):
            call()
    with pytest.raises(ValueError, match=argument("restitution", "0.01")):
        ji.mujoco_solref(0.01, 0.002, duration=0.008)
    monkeypatch.setattr("jimpact.laws.mujoco_contact._MOST_STEPS", 1000)
    with pytest.raises(ValueError, match=argument("timestep")):
        ji.mujoco_restitution((100.0, 0.1), 1e-4)
