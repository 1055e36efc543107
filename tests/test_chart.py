"""Methods of integration converge to known values; speed against accuracy as record and picture."""

import dataclasses
import json
import math
from itertools import pairwise
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
import jimpact.methods.contenders.base
from jimpact.commands.chart import run
from jimpact.methods.chart import work_precision
from jimpact.methods.chart_programs import in_turns
from jimpact.methods.chart_record import QUANTITIES
from jimpact.methods.contenders import METHODS, outcome, time_scale
from jimpact.status import STATUS

pytestmark = pytest.mark.slow  # compiles every method

BALLS, STRIKE = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
HERTZ = ji.LZB([0.9, 0.9], [1.0, 1.0], 1.5)
HERTZ_AFTER = [-0.0086153561548806457087, 0.10414279851550412011, 0.9044725576393765256]
HERTZ_SLOPES = [  # d v+ / d (k2/k1) and d v+ / d e1
    [-0.066928813512993, 0.068799893104474, -0.0018710795914811],
    [-0.61311351473699, 0.16549672267969, 0.4476167920573],
]
LINEAR = ji.LZB([0.9, 0.9], [1.0, 1.0], 1.0)
LINEAR_AFTER = [-0.06530458667907737467, 0.1671929515716750074, 0.89811163510740236727]


def solved(name, settings, law=HERTZ, scene=BALLS, velocity=STRIKE):
    """Results and outcomes at all settings, one compilation."""
    method, v = METHODS[name], jnp.asarray(velocity)

    def one(setting):
        result = method.solve(law, scene, v, setting)
        return result, outcome(law, scene, v, result)

    if method.jax:
        return jax.jit(jax.vmap(one))(jnp.asarray(settings))
    return jax.tree.map(lambda *a: jnp.stack(a), *[one(s) for s in settings])


def errors(out, after=HERTZ_AFTER):
    return np.abs(np.asarray(out.velocity) - np.array(after)[None, :]).max(axis=1)


# settings, and bounds of the order seen over all of them; a change of phase costs the fixed step
# its order, and the rule at E = 0 that of the impulse form
ORDERS = [
    ("impulse_euler", np.logspace(-2, -3.5, 7), 0.9, 1.2, 2e-4),
    ("impulse_rk4", np.logspace(-1.5, -3.5, 9), 1.1, 1.7, 3e-6),
    ("verlet", np.logspace(-0.7, -2.5, 9), 1.8, 2.3, 2e-6),
    ("rk4", np.logspace(-0.7, -2.5, 9), 1.8, 2.8, 1e-7),
]


@pytest.mark.parametrize(("name", "settings", "least", "most", "finest"), ORDERS)
def test_steps_converge_at_their_order(name, settings, least, most, finest):
    result, out = solved(name, settings)
    error = errors(out)
    order = np.polyfit(np.log(settings), np.log(error), 1)[0]
    assert least < order < most
    assert error[-1] < finest
    np.testing.assert_array_equal(out.status, 0)
    energy = 0.5 * (np.asarray(out.velocity) ** 2).sum(axis=1) - 0.5
    np.testing.assert_allclose(out.energy_change, energy, atol=1e-12)
    assert (np.diff(np.asarray(result.evaluations)) > 0).all()


def test_linear_contacts_too():
    for name, settings in (("verlet", [0.01, 0.003]), ("rk4", [0.01, 0.003])):
        _, out = solved(name, settings, LINEAR)
        assert errors(out, LINEAR_AFTER)[-1] < 1e-5


TOLERANCES = [1e-4, 1e-6, 1e-8, 1e-10]


@pytest.fixture(scope="module")
def aligned():
    return solved("dop853", TOLERANCES)


def test_event_aligned_is_what_impact_does(aligned):
    result, out = aligned
    # values of `impact` at its default tolerance, and `rtol` is one
    assert (errors(out) < 10 * np.array(TOLERANCES)).all()
    default = ji.impact(HERTZ, BALLS, STRIKE)
    np.testing.assert_allclose(np.asarray(out.impulse)[2], default.impulse, atol=1e-13)
    assert (np.asarray(result.evaluations) % 12 == 0).all()


def test_the_pair_of_order_five_takes_more_for_less(aligned):
    result, out = solved("dop5", TOLERANCES)
    assert (errors(out) < 50 * np.array(TOLERANCES)).all()
    few, many = (np.asarray(found.evaluations) for found in (aligned[0], result))
    assert many[-1] / many[1] > 1.5 * few[-1] / few[1]
    assert float(result.duration[-1]) == pytest.approx(float(aligned[0].duration[-1]), rel=1e-9)


def test_scipy_and_durations(aligned):
    settings = [1e-4, 1e-6, 1e-8]
    result, out = solved("scipy_dop853", settings)
    assert (errors(out) < 100 * np.array(settings)).all()
    assert (np.diff(np.asarray(result.evaluations)) > 0).all()
    assert float(aligned[0].duration[-1]) == pytest.approx(float(result.duration[-1]), rel=1e-6)
    loose, out = solved("scipy_lsoda", [1e-5])
    assert errors(out)[0] < 1e-3
    assert float(loose.duration[0]) == pytest.approx(float(result.duration[-1]), rel=1e-3)


def test_a_linear_contact_lasts_half_a_period():
    pair, law = ji.chain([1.0, 3.0]), ji.LZB([0.5], [8.0], 1.0)
    unit = math.sqrt(0.75 / 8.0)  # 1 / omega
    assert float(time_scale(law, pair, [1.0, 0.0])) == pytest.approx(unit)
    for name, setting in (("verlet", 1e-3), ("scipy_dop853", 1e-8)):
        result, _ = solved(name, [setting], law, pair, [1.0, 0.0])
        assert float(result.duration[0]) == pytest.approx(0.75 * math.pi * unit, rel=1e-3)


def test_evaluations_are_those_that_happen(monkeypatch):
    """Every call of the field from inside the compiled loop is told to the host."""
    calls = []
    real = jimpact.methods.contenders.base.power

    def told(*given):
        jax.debug.callback(lambda: calls.append(1))
        return real(*given)

    monkeypatch.setattr(jimpact.methods.contenders.base, "power", told)
    for name, per_evaluation in (("rk4", 1), ("tsit5", 1), ("verlet", 2)):
        method = METHODS[name]
        calls.clear()
        # nothing jitted before: the counting function must be traced
        found = jax.jit(lambda s, method=method: method.solve(HERTZ, BALLS, STRIKE, s))(
            jnp.asarray({"rk4": 0.03, "tsit5": 1e-5, "verlet": 0.03}[name])
        )
        jax.block_until_ready(found)
        jax.effects_barrier()
        # Verlet asks for both rates where it needs one; the first force of RK4 is not used
        assert abs(len(calls) - per_evaluation * int(found.evaluations)) <= 1, name


def test_nothing_happens_and_open_contacts():
    result, out = solved("verlet", [0.01], velocity=[0.0, 0.0, 1.0])
    assert (int(result.code[0]), float(result.duration[0])) == (0, 0.0)
    np.testing.assert_array_equal(out.impulse, np.zeros((1, 2)))
    parted = ji.chain([1.0, 1.0, 1.0], gaps=[0.0, 0.1])
    _, out = solved("verlet", [0.003], scene=parted)
    np.testing.assert_allclose(out.velocity[0], [0.05, 0.95, 0.0], atol=1e-5)


def test_status_of_what_goes_wrong():
    few = ji.LZB([0.9, 0.9], [1.0, 1.0], 1.5, max_steps=5)
    result, _ = solved("rk4", [0.01], few)
    assert STATUS[int(result.code[0])].name == "max_steps"
    stiff = ji.LZB([1.0, 1.0], [1.0, 1e4], 1.0)
    _, out = solved("verlet", [3.0], stiff)  # beyond the stability limit 2 of the fastest contact
    assert STATUS[int(out.status[0])].failure


def test_what_is_not_supported_is_told():
    dead = ji.LZB(0.0)
    assert "divides by e^2" in METHODS["rk4"].supports(dead, BALLS)
    assert METHODS["dop853"].supports(dead, BALLS) is None
    assert "exponent 1.0" in METHODS["propagator"].supports(HERTZ, BALLS)
    assert "Newton" in METHODS["verlet"].supports(ji.Newton(0.5), BALLS)
    assert "3 entries" in METHODS["verlet"].supports(ji.LZB([1, 1, 1.0]), BALLS)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"velocity": [1.0, 0.0]}, ValueError, "`velocity` must have shape (3,)"),
        ({"velocity": [0.0, 0.0, 1.0]}, ValueError, "`velocity` must let a closed contact"),
        ({"velocity": [1.0, np.nan, 0.0]}, ValueError, "`velocity` must be finite"),
        ({"velocity": jnp.zeros(3, jnp.float32)}, ValueError, "double precision"),
        ({"law": ji.Newton(0.5)}, TypeError, "`law` must be an LZB law, but is Newton"),
        ({"law": ji.LZB([1, 1, 1.0])}, ValueError, "`restitution` must have shape (2,)"),
        ({"methods": ["magic"]}, ValueError, "has 'magic'"),
        ({"methods": ["propagator"]}, ValueError, "'propagator': it is exact for the exponent"),
        ({"law": ji.LZB(0.0), "methods": ["rk4"]}, ValueError, "it divides by e^2"),
        ({"settings": {"rk4": [0.1]}}, ValueError, "`settings` must be of chosen methods"),
        ({"settings": {"verlet": [0.0]}}, ValueError, "`settings['verlet']` must lie in (0"),
        ({"reference": "verlet"}, ValueError, "`reference` must take an rtol"),
        ({"batch": 0}, ValueError, "`batch` must be a whole number >= 1"),
        ({"repeats": 1.5}, ValueError, "`repeats` must be a whole number >= 1"),
    ],
)
def test_bad_input(change, error, message):
    given = {"scene": BALLS, "velocity": STRIKE, "law": HERTZ, "methods": ["verlet"]}
    if (
        change.get("velocity") is not None
        and getattr(change["velocity"], "dtype", None) == "float32"
    ):
        single = lambda tree: jax.tree.map(lambda a: a.astype(jnp.float32), tree)  # noqa: E731
        given |= {"scene": single(BALLS), "law": single(HERTZ)}
    with pytest.raises(error) as told:
        work_precision(**(given | change))
    assert message in str(told.value)


@pytest.fixture(scope="module")
def found():
    laws = {"binary": ji.Binary(0.9)}
    ladder = {"verlet": [0.1, 0.01, 0.001], "scipy_dop853": [1e-4, 1e-7]}
    return work_precision(BALLS, STRIKE, HERTZ, list(ladder), ladder, laws, batch=32, repeats=3)


def test_record(found):
    np.testing.assert_allclose(found.reference.velocity, HERTZ_AFTER, atol=1e-12)
    assert all(0 <= found.reference.uncertainty[q] < 1e-10 for q in QUANTITIES)
    for name in ("verlet", "scipy_dop853"):
        row = found.points[name]
        for quantity in QUANTITIES[: 5 if name == "verlet" else 4]:
            error = [point.error[quantity] for point in row]
            assert all(b < 0.5 * a for a, b in pairwise(error)), (name, quantity)
        assert all(a.evaluations < b.evaluations for a, b in pairwise(row))
        assert all(p.single.low <= p.single.median <= p.single.high for p in row)
        assert all(p.batched.low <= p.batched.median <= p.batched.high for p in row)
    fine = found.points["verlet"][-1]
    # one impact among those of the sample
    _, out = solved("verlet", [0.001])
    assert errors(out)[0] <= fine.error["velocity"] * (1 + 1e-6) + 1e-12
    assert set(found.compile_time["verlet"]) == {"single", "batched", "gradient"}
    assert found.without_gradient.keys() == {"scipy_dop853"}


def test_model_error_of_a_law(found):
    (binary,) = found.points["binary"]
    after = np.asarray(ji.impact(ji.Binary(0.9), BALLS, STRIKE).velocity)
    error = np.abs(after - np.array(HERTZ_AFTER)).max()
    assert binary.error["velocity"] == pytest.approx(error, rel=1e-9)
    assert math.isnan(binary.error["duration"])
    assert math.isnan(binary.evaluations)
    assert (binary.setting, binary.gradient) == (None, None)


def test_gradient_error_is_that_of_the_gradient(found):
    law, method = HERTZ, METHODS["verlet"]

    def velocity(ratio, e):
        moved = eqx.tree_at(
            lambda old: (old.stiffness, old.restitution),
            law,
            (jnp.stack([jnp.ones(()), ratio]), jnp.stack([e, jnp.asarray(0.9)])),
        )
        return outcome(moved, BALLS, STRIKE, method.solve(moved, BALLS, STRIKE, 0.001)).velocity

    slopes = jax.jit(jax.jacfwd(velocity, argnums=(0, 1)))(jnp.ones(()), jnp.asarray(0.9))
    error = np.abs(np.array(slopes) - np.array(HERTZ_SLOPES)).max()
    # the largest over all columns and a sample, so at least that of this impact
    assert 1e-9 < error <= found.points["verlet"][-1].error["gradient"]


def test_table_json_and_picture(found):
    text = str(found)
    assert "verlet" in text
    assert "law" in text
    told = json.loads(json.dumps(found.to_dict()))
    assert told["points"]["verlet"][0]["error"].keys() == set(QUANTITIES)
    assert told["points"]["binary"][0]["evaluations"] is None
    figure = ji.plot.work_precision(found, "three balls")
    assert len(figure.axes) == 4
    labels = [text.get_text() for text in figure.axes[3].get_legend().get_texts()]
    assert labels == [row[0].label for row in found.points.values()]


def test_picture_without_gradients(found):
    """No empty panel."""
    points = {
        name: tuple(dataclasses.replace(point, gradient=None) for point in row)
        for name, row in found.points.items()
    }
    figure = ji.plot.work_precision(dataclasses.replace(found, points=points))
    left, right, legend = figure.axes
    assert all(axes.lines for axes in (left, right))
    assert "gradient" not in left.get_xlabel() + right.get_xlabel()
    assert legend.get_legend() is not None


def test_turns():
    order = []
    tasks = [(lambda i=i: order.append(i), 2) for i in range(3)]
    times = in_turns(tasks, 4, lambda: None)
    assert len(times) == 3
    turns = [i for i, before in zip(order, [None, *order]) if i != before]
    assert turns == [0, 1, 2] * 5  # once to see how fast, then in turns


OPTIONS = {"study": Path("three_balls.toml"), "velocity": None, "shot": 1, "full": False}
OPTIONS |= {"no_gradients": True, "batch": 4, "repeats": 1}


def test_command(capsys, tmp_path, monkeypatch, found):
    asked = []

    def same(*given, **options):
        asked.append((*given, options))
        return found

    monkeypatch.setattr("jimpact.commands.chart.work_precision", same)
    out = tmp_path / "chart.svg"
    assert run(**OPTIONS, methods=None, out=out, json=True) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["points"]) == list(found.points)
    assert out.stat().st_size > 10_000
    _, velocity, law, names, options = asked[0]
    assert (velocity.tolist(), float(law.restitution)) == (STRIKE, 0.95)
    assert {"verlet", "dop853"} < set(names) < set(METHODS) - {"propagator", "kvaerno5"}
    assert options == {"batch": 4, "repeats": 1, "gradients": False}
    # another law: what it says of stiffness and exponent, no losses
    gaps = {"study": Path("three_balls_gaps.toml"), "velocity": (1.0, 0.0, -1.0)}
    assert run(**(OPTIONS | gaps), methods=None, out=tmp_path, json=False) == 0
    assert (float(asked[1][2].restitution), float(asked[1][2].stiffness)) == (1.0, 1.06e10)
    assert "scipy_dop853" in capsys.readouterr().out
    assert (tmp_path / "jimpact-chart.png").stat().st_size > 10_000


def test_command_refuses(capsys, tmp_path):
    out = tmp_path / "chart.svg"
    for change, message in (
        ({"methods": ("magic",)}, "has 'magic'"),
        ({"shot": 2}, "--shot must lie in [1, 1], but is 2"),
        ({"out": tmp_path / "a.txt"}, "--out must end in"),
        ({"study": Path("three_balls_gaps.toml")}, "--velocity must be given"),
    ):
        wrong = OPTIONS | {"methods": ("verlet",), "out": out, "json": False} | change
        assert run(**wrong) == 2
        assert message in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tsit5", "dopri8", "kvaerno5"])
def test_the_other_methods(name):
    result, out = solved(name, [1e-3, 1e-5, 1e-7], HERTZ)
    error = errors(out, HERTZ_AFTER)
    assert (np.diff(error) < 0).all()
    assert error[-1] < 1e-4
    np.testing.assert_array_equal(result.code, 0)


@pytest.mark.slow
def test_command_measures(capsys, tmp_path):
    assert run(**OPTIONS, methods=("verlet",), out=tmp_path, json=True) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["points"]) == ["verlet", "newton", "moreau", "poisson", "binary"]


@pytest.mark.slow
def test_passes_are_evaluations_of_the_aligned_method():
    evaluations = int(solved("dop853", [1e-8])[0].evaluations[0])
    for spare, code in ((0, "ok"), (-1, "max_steps")):
        limited = ji.LZB([0.9, 0.9], [1.0, 1.0], 1.5, max_steps=evaluations // 12 + spare)
        result, _ = solved("dop853", [1e-8], limited)
        assert STATUS[int(result.code[0])].name == code


@pytest.mark.slow
def test_all_methods_on_one_chart():
    found = work_precision(BALLS, STRIKE, LINEAR, laws={}, batch=16, repeats=1, gradients=False)
    assert not found.left_out
    assert set(METHODS) <= set(found.points)
    assert found.reference.uncertainty["velocity"] < 1e-11  # two independent integrators
    assert found.points["propagator"][0].error["velocity"] < 1e-12
    for name in METHODS:
        assert all(point.evaluations > 0 for point in found.points[name]), name
