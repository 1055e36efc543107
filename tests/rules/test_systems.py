"""Closed forms: every law that claims one is run on it, outcomes and slopes, in its own programs."""

import numpy as np
import programs
import pytest
from closed_forms import SYSTEMS
from programs import LAWS, SLOW_SLOPES


def claimed(name):
    """The closed forms that a law claims, by name."""
    systems = {key: system for key, system in SYSTEMS.items() if name in system.laws}
    if not systems:
        pytest.skip(
            f"{name} is in `laws` of no closed form (tests/rules/closed_forms.py)"
        )
    return systems


@pytest.mark.parametrize("name", LAWS)
def test_outcomes(name):
    systems = claimed(name)
    out, _ = programs.values(name)([s.state() for s in systems.values()])
    wrong = []
    for i, (key, system) in enumerate(systems.items()):
        expected = system.outcome()
        known = np.isfinite(expected)
        error = np.abs(out.velocity[i, : len(expected)] - expected)[known].max()
        if not error <= max(2e-12, LAWS[name].accuracy):
            wrong.append((key, error))
        reported = programs.names(out.status[i])[0]
        if system.status and reported != system.status:
            wrong.append((key, reported))
        assert reported in ("ok", "plastic_limit")
    assert not wrong, wrong


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(x, marks=[pytest.mark.slow] if x in SLOW_SLOPES else [])
        for x in LAWS
    ],
)
def test_slopes(name):
    """dv+ by velocities, restitution, stiffness, exponent: forward and reverse, exact slopes."""
    systems = {key: s for key, s in claimed(name).items() if s.by}
    keys, wrong = [*systems], []
    allowed = max(1e-10, 10 * LAWS[name].accuracy)
    for begin in range(0, len(keys), programs.FEW):
        part = keys[begin : begin + programs.FEW]
        both = programs.derivatives(name)([systems[key].state() for key in part])
        for i, key in enumerate(part):
            n, m = systems[key].state().size
            for argument, expected in systems[key].slopes().items():
                j = ("v", "e", "k", "eta").index(argument)
                known = np.isfinite(expected[:, 0])
                for mode in both:
                    got = mode[j][i][:n, : n if argument == "v" else m]
                    error = np.abs(got - expected)[known].max()
                    if not error <= allowed * (1 + np.abs(expected[known]).max()):
                        wrong.append((key, argument, error, got, expected))
    assert not wrong, wrong
