"""Methods of integration: their order, speed against accuracy, hard points, the advice."""

import dataclasses
import functools
import itertools
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stability_reference
from methods_cases import BALLS, DISC, HERTZ, SLIDES, STRIKE, rod
from programs import failed, names
from refusals import argument
from spatial_scenes import NAMED

import jimpact as ji

HERTZ_AFTER = [-0.0086153561548806457087, 0.10414279851550412011, 0.9044725576393765256]


# settings, and bounds of the order seen over all of them; a change of phase costs the fixed step
# its order, and the rule at E = 0 that of the impulse form
ORDERS = {
    "impulse_euler": (np.logspace(-2, -3.5, 4), 0.8, 1.3, 3e-4),
    "verlet": (np.logspace(-0.7, -2.5, 5), 1.7, 2.5, 5e-6),
    "rk4": (np.logspace(-0.7, -2.5, 5), 1.7, 3.2, 5e-7),
    "time": ([1e-4, 1e-6, 1e-8], 0.5, 1.8, 1e-7),
    "scipy_dop853": ([1e-4, 1e-6, 1e-8], 0.5, 1.8, 1e-6),
}


@pytest.fixture(scope="module")
def chart():
    """All of them on three Hertz balls, e = 0.9, and a law that is another model."""
    ladder = {name: list(map(float, row[0])) for name, row in ORDERS.items()}
    laws = {"binary": ji.Binary(0.9)}
    return ji.work_precision(
        HERTZ,
        BALLS,
        STRIKE,
        list(ladder),
        ladder,
        laws,
        batch=8,
        repeats=2,
        gradients=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ORDERS)
def test_methods_converge_at_their_order(chart, name):
    settings, least, most, finest = ORDERS[name]
    row = chart.points[name]
    error = np.array([point.error["velocity"] for point in row])
    order = np.polyfit(np.log(settings), np.log(error), 1)[0]
    assert least < order < most
    assert error[-1] < finest
    work = [point.evaluations for point in row]
    assert all(a < b for a, b in itertools.pairwise(work))
    for point in row:
        assert point.status == "ok"
        assert point.single.low <= point.single.median <= point.single.high
        assert point.batched.low <= point.batched.median <= point.batched.high


@pytest.mark.slow
def test_chart_in_words_and_picture(chart):
    np.testing.assert_allclose(chart.reference.velocity, HERTZ_AFTER, atol=1e-11)
    (binary,) = chart.points["binary"]  # the error of a model
    after = np.asarray(ji.impact(ji.Binary(0.9), BALLS, STRIKE).velocity)
    error = np.abs(after - np.array(HERTZ_AFTER)).max()
    assert binary.error["velocity"] == pytest.approx(error, rel=1e-9)
    assert math.isnan(binary.error["duration"])
    assert "verlet" in str(chart)
    data = json.loads(json.dumps(chart.to_dict()))
    assert data["points"]["binary"][0]["evaluations"] is None
    figure = ji.plot.work_precision(chart, "three balls")
    assert figure.legends
    assert all(axes.lines for axes in figure.axes)


@pytest.mark.release
def test_gradients_and_the_other_methods():
    linear = ji.LZB([0.9, 0.9], [1.0, 1.0], 1.0)
    others = ("verlet", "tsit5", "scipy_lsoda")  # and one of each kind
    result = ji.work_precision(
        linear, BALLS, STRIKE, others, laws={}, batch=8, repeats=1
    )
    assert not result.left_out
    assert (
        result.reference.uncertainty["velocity"] < 1e-11
    )  # two independent integrators
    for name, row in result.points.items():
        assert all(point.evaluations > 0 for point in row), name
    assert 1e-9 < result.points["verlet"][-1].error["gradient"] < 0.1
    points = {
        name: tuple(dataclasses.replace(point, gradient=None) for point in row)
        for name, row in result.points.items()
    }
    bare = ji.plot.work_precision(dataclasses.replace(result, points=points))
    assert all("gradient" not in axes.get_xlabel() for axes in bare.axes)


def on_the_ground(name):
    """A box of the tables, its v- and a law."""
    mass, normals, tangents, velocity = NAMED[name]()
    return (
        ji.Scene(mass, normals, tangents=tangents),
        velocity,
        ji.LZB(0.3, friction=0.3),
    )


@pytest.mark.release
def test_chart_of_a_box_on_a_corner():
    """In space: the exact method at two tolerances, order 1 of Verlet, scipy; slopes in mu."""
    scene, velocity, law = on_the_ground("corner")
    ladder = {"time": [1e-4, 1e-7], "verlet": [0.03, 0.003], "scipy_radau": [1e-6]}
    laws = {"moreau": ji.Moreau(0.3, friction=0.3)}
    sizes = {"batch": 4, "repeats": 1}
    chart = ji.work_precision(law, scene, velocity, list(ladder), ladder, laws, **sizes)
    error = {n: [x.error["velocity"] for x in row] for n, row in chart.points.items()}
    assert error["time"][0] < 1e-3
    assert error["time"][1] < 1e-6
    assert error["verlet"][1] < 0.2 * error["verlet"][0] < 0.01
    assert error["scipy_radau"][0] < 1e-5
    assert 1e-3 < error["moreau"][0] < 1
    assert chart.reference.uncertainty["gradient"] < 1e-6
    assert chart.points["verlet"][1].error["gradient"] < 0.1
    assert all(point.status == "ok" for row in chart.points.values() for point in row)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"law": ji.LZB(0.5, friction=0.1)}, ValueError, "`scene` must have tangents"),
        (
            {
                "scene": DISC,
                "velocity": SLIDES,
                "law": ji.LZB(0.5, friction=0.1),
                "methods": ["rk4"],
            },
            ValueError,
            "it has no friction",
        ),
        ({"velocity": [1.0, 0.0]}, ValueError, "`velocity` must have shape (3,)"),
        (
            {"velocity": [0.0, 0.0, 1.0]},
            ValueError,
            "`velocity` must let a closed contact",
        ),
        ({"velocity": [1.0, np.nan, 0.0]}, ValueError, "`velocity` must be finite"),
        ({"law": ji.Newton(0.5)}, TypeError, "`law` must be an LZB law, but is Newton"),
        (
            {"law": ji.LZB([1, 1, 1.0])},
            ValueError,
            "`restitution` must have shape (2,)",
        ),
        ({"methods": ["magic"]}, ValueError, "`methods` must be one of"),
        ({"methods": "verlet"}, TypeError, "`methods` must be a list"),
        ({"methods": ["rk4", "rk4"]}, ValueError, "one contender or more, each once"),
        ({"methods": []}, ValueError, "one contender or more, each once"),
        ({"law": ji.LZB(0.0), "methods": ["rk4"]}, ValueError, "it divides by e^2"),
        ({"settings": {"rk4": [0.1]}}, ValueError, "`settings` must be one of verlet"),
        (
            {"settings": {"verlet": [0.0]}},
            ValueError,
            "`settings['verlet']` must lie in (0",
        ),
        (
            {"settings": {"verlet": []}},
            ValueError,
            "`settings['verlet']` must be a scalar or",
        ),
        ({"settings": ["verlet"]}, TypeError, "`settings` must be of type Mapping"),
        ({"laws": [ji.Newton(0.5)]}, TypeError, "`laws` must be of type Mapping"),
        ({"laws": {"verlet": ji.Newton(0.5)}}, ValueError, "names that no method has"),
        ({"reference": "verlet"}, ValueError, "`reference` must take an rtol"),
        ({"batch": 0}, ValueError, "`batch` must be an int >= 1"),
        ({"repeats": 1.5}, ValueError, "`repeats` must be an int >= 1"),
    ],
)
def test_chart_refuses(change, error, message):
    arguments = {
        "scene": BALLS,
        "velocity": STRIKE,
        "law": HERTZ,
        "methods": ["verlet"],
    }
    with pytest.raises(error) as raised:
        ji.work_precision(**(arguments | change))
    assert message in str(raised.value)


HELD = np.load(Path(__file__).parents[1] / "held" / "stability_points.npz")


RTOL, HONEST = 1e-8, 10  # the default tolerance; right is within ten times of it


STEPS, MANY_STEPS = 4000, 20_000  # in the default tests, in the slow ones


# right only because the tolerance falls with the number of steps and with slow contacts
HARD = {168: "stiffness ratio 1.7e-8, three balls"}


HARD_LATER = {  # most of these take more than STEPS
    151: "mass ratio 2e-4, e = 1, six balls",
    4: "stiffness ratio 7e-6, e = 1, twenty balls: slow ones are not at rest",
    22: "stiffness ratio 1.4e6, three balls",
    209: "stiffness ratio 1.4e-4, mass ratio 5e-3, e = 9e-3",
}


@functools.cache
def hypercube(n, steps):
    """Indices of the points with n balls; outcome, consistency, and error by the oracle there."""
    at = np.flatnonzero(HELD["points"][:, 4] == n)
    kappa, mu, e, eta, _ = HELD["points"][at].T
    chains = [stability_reference.chain_of(a, b, n) for a, b in zip(kappa, mu)]
    mass, k = (np.array(rows) for rows in zip(*chains))

    @jax.jit
    @jax.vmap
    def run(mass, k, e, eta):
        scene, v = ji.chain(mass), jnp.eye(n)[0]
        out = ji.impact(ji.LZB(e, k, eta, max_steps=steps), scene, v)
        return out, ji.audit(out, scene, v).consistent

    out, consistent = jax.tree.map(np.asarray, run(mass, k, e, eta))
    return (
        at,
        out,
        consistent,
        np.abs(out.velocity - HELD["velocity"][at, :n]).max(axis=1),
    )


def check_hypercube(n, steps):
    """Right or flagged everywhere; what the oracle could not solve is consistent."""
    at, out, consistent, error = hypercube(n, steps)
    flagged = failed(out.status)
    known = np.isfinite(HELD["uncertainty"][at])
    wrong = known & ~flagged & ~(error <= HONEST * RTOL)
    assert not wrong.any(), list(zip(at[wrong], error[wrong]))
    assert consistent[~flagged].all()
    lossless = ~flagged & (HELD["points"][at, 2] == 1)
    assert np.abs(out.energy_change[lossless]).max(initial=0) < HONEST * RTOL
    return np.mean(~flagged)


@pytest.mark.release
def test_right_or_flagged():
    assert check_hypercube(3, STEPS) > 0.6  # and not all flagged


@pytest.mark.long_run
@pytest.mark.parametrize(
    ("n", "share"),
    [
        pytest.param(2, 0.99, marks=pytest.mark.slow),
        pytest.param(3, 0.7, marks=pytest.mark.release),
        pytest.param(6, 0.6, marks=pytest.mark.release),
        pytest.param(20, 0.15, marks=pytest.mark.release),
        pytest.param(100, 0.0, marks=pytest.mark.release),
    ],
)
def test_right_or_flagged_with_more_steps(n, share):
    assert check_hypercube(n, MANY_STEPS) >= share


def check_right(point, steps):
    at, out, _, error = hypercube(int(HELD["points"][point, 4]), steps)
    i = int(np.flatnonzero(at == point)[0])
    assert not failed(out.status[i])
    assert error[i] <= HONEST * RTOL


@pytest.mark.release
@pytest.mark.parametrize("point", HARD, ids=HARD.get)
def test_hard_points(point):
    check_right(point, STEPS)


@pytest.mark.release
@pytest.mark.long_run
@pytest.mark.parametrize("point", HARD_LATER, ids=HARD_LATER.get)
def test_hard_points_after_many_steps(point):
    check_right(point, MANY_STEPS)


def test_points_are_those_of_the_script():
    assert len(HELD["points"]) == 300
    np.testing.assert_allclose(HELD["points"], stability_reference.points(), rtol=1e-12)
    assert (
        HELD["uncertainty"][np.isfinite(HELD["uncertainty"])].max()
        < 0.1 * HONEST * RTOL
    )


# 10 and 30 equal Hertz balls by the oracle of tests/benchmarks/lzb_oracle.cpp
TEN = {
    1.0: "-0.07108501709 -0.03027378936 -0.01583339716 -0.00888569518 -0.00512658316 "
    "-0.00298597820 -0.00173766842 0.00267195495 0.14739030720 0.98586586642",
    0.9: "-0.00867062941 0.02377686943 0.03273912320 0.03351852905 0.03428229479 "
    "0.03516695506 0.03530119785 0.03580539400 0.10718026205 0.67090000398",
}


THIRTY = {  # the first three and the last three
    1.0: "-0.07108501709 -0.03027378936 -0.01583339716 0.00401251210 0.14860045199 0.98567885884",
    0.9: "-0.00867062941 0.01579664307 0.01617678971 0.03547754352 0.04667986304 0.29175885712",
}


@pytest.mark.release
def test_long_chains():
    """Right where Siconos ends with 981 times the energy; long chains re-close below e = 0.5."""

    def after(n):
        run = jax.vmap(
            lambda e: ji.impact(ji.LZB(e), ji.chain(jnp.ones(n)), jnp.eye(n)[0])
        )
        return jax.jit(run)

    out = after(10)(jnp.array([1.0, 0.9, 0.5, 0.4]))
    for i, e in enumerate(TEN):
        held = np.array(TEN[e].split(), float)
        np.testing.assert_allclose(out.velocity[i], held, rtol=0, atol=HONEST * RTOL)
    assert names(out.status) == ["ok"] * 3 + ["plastic_limit"]
    assert abs(float(out.energy_change[0])) < HONEST * RTOL
    assert (np.asarray(out.energy_change[1:]) < 0).all()
    out = after(30)(jnp.array(list(THIRTY)))
    assert names(out.status) == ["ok", "ok"]
    for v, held in zip(np.asarray(out.velocity), THIRTY.values()):
        ends = v[[0, 1, 2, -3, -2, -1]]
        np.testing.assert_allclose(
            ends, np.array(held.split(), float), rtol=0, atol=1e-7
        )
    out = after(100)(jnp.array([1.0]))
    assert names(out.status) == ["ok"]
    assert abs(float(out.energy_change[0])) < 1e-7
    np.testing.assert_allclose(out.velocity[0, -1], 0.985679, atol=1e-6)


@pytest.mark.release
def test_stability_map():
    axes = {"setting": [0.0, 0.6], "exponent": [1.5, 3.0], "restitution": [0.0, 0.9]}
    result = ji.stability_map(
        ("rk4", "verlet"), axes, slices="pairs", samples=3, max_steps=2000
    )
    assert result.methods == ("rk4", "verlet")
    for name in result.methods:
        setting, exponent = result.slices[name][:2]
        assert setting.error[1] < 1e-3
        assert (exponent.codes == 0).all()
        assert sum(result.counts(name).values()) == 6 + 3 * 4 + 3
    assert result.confirmation.tried == result.confirmation.confirmed > 0
    assert (
        json.loads(json.dumps(result.to_dict()))["methods"]["rk4"]["counts"]["right"]
        > 3
    )
    assert ji.plot.stability_map(result, "title").axes


@pytest.mark.release
def test_stability_map_of_a_scene_with_friction():
    """A rod: Verlet needs fine steps, the default method is right; a rod has no balls."""
    axes = {"setting": [0.35, 0.8], "friction": [0.05, 2.0]}
    base = {"exponent": 1.5, "restitution": 0.6, "friction": 2.0, "setting": 0.6}
    result = ji.stability_map(
        ["time", "verlet"],
        axes,
        base,
        scene=rod(1.2),
        velocity=[0.5, -1, 0],
        max_steps=2000,
    )
    assert result.counts("time")["right"] == 4
    setting, friction = result.slices["verlet"]
    assert setting.error[1] < 0.2 * setting.error[0]
    assert friction.error.max() < 5e-3
    assert set(result.base) == {"setting", "exponent", "restitution", "friction"}
    assert result.confirmation.tried == result.confirmation.confirmed > 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ji.stability_map(["rk5"]), "`methods` must be one of"),
        (lambda: ji.stability_map(axes={"mass": [1]}), "`axes` must be one of"),
        (lambda: ji.stability_map(axes={"balls": [2.5]}), "whole numbers"),
        (
            lambda: ji.stability_map(base={"balls": 2.5}),
            r"`base\['balls'\]` must hold whole numbers",
        ),
        (
            lambda: ji.stability_map(axes={"setting": []}),
            r"`axes\['setting'\]` must be a scalar or",
        ),
        (lambda: ji.stability_map(axes={"restitution": [1.1]}), r"lie in \[0, 1\]"),
        (lambda: ji.stability_map(base={"exponent": 0.5}), r"lie in \[1, 5\]"),
        (lambda: ji.stability_map(base={"speed": 1}), "`base` must be one of"),
        (lambda: ji.stability_map(slices="all"), "`slices` must be one of"),
        (lambda: ji.stability_map(samples=-1), "`samples`"),
        (lambda: ji.stability_map(resolution=1), "`resolution`"),
        (lambda: ji.stability_map(axes={"friction": [0.1]}), "`axes` must be one of"),
        (lambda: ji.stability_map(scene=DISC), "`velocity` must be given"),
        (lambda: ji.stability_map(velocity=SLIDES), "`velocity` must be None"),
        (
            lambda: ji.stability_map(scene=DISC, velocity=[0.0, 1.0, 0.0]),
            "`velocity` must let a closed",
        ),
        (
            lambda: ji.stability_map(["rk4"], scene=DISC, velocity=SLIDES),
            "`methods` must be one of",
        ),
        (
            lambda: ji.stability_map(axes={"balls": [2]}, scene=DISC, velocity=SLIDES),
            "`axes` must be one of",
        ),
    ],
)
def test_stability_map_refuses(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def quick(scene, velocity, tolerance=1e-2, **options):
    return ji.advise(scene, velocity, tolerance, timing=False, samples=32, **options)


@pytest.fixture(scope="module")
def unknown():
    return quick(BALLS, STRIKE)


@pytest.mark.slow
def test_unknown_ratio_decides(unknown):
    """Nothing is within 1 % where k2/k1 is anywhere in [0.1, 10]; the advice is LZB, and what to measure."""
    assert (unknown.name, unknown.within, unknown.reference) == ("lzb", False, "lzb")
    assert "stiffness ratio k2/k1 in [0.1, 10] decides" in unknown.reason
    nominal = [-0.070952353651436871, 0.076403039071206993, 0.99454931458022988]
    np.testing.assert_allclose(unknown.candidates["lzb"].velocity, nominal, atol=1e-7)
    for name, c in unknown.candidates.items():
        assert c.usable, name
        assert c.worst > 0.1, name
        assert c.median <= c.worst
    (effect,) = unknown.unknown
    assert 0 < effect.needed < 0.2
    assert unknown.candidates["lzb"].worst >= effect.alone


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tolerance", "rtol"), [(1e-2, 1e-3), (3e-3, 1e-4), (1e-5, 1e-6)]
)
def test_the_advised_rtol_moves_velocities_by_a_tenth_of_the_tolerance(tolerance, rtol):
    """It is the coarsest power of ten below that tenth, and at most 1e-3."""
    law = quick(BALLS, STRIKE, tolerance).law
    assert law.rtol == rtol
    exact = ji.impact(ji.LZB(1.0, rtol=1e-13), BALLS, STRIKE).velocity
    moved = np.linalg.norm(ji.impact(law, BALLS, STRIKE).velocity - exact)
    assert moved <= tolerance / 10 * np.linalg.norm(STRIKE)


# known ratio, tolerance: law; at 1e3 the contacts act together, at 0.01 one after the other
@pytest.mark.slow
@pytest.mark.parametrize(
    ("ratio", "tolerance", "name"),
    [
        (1e3, 0.02, "newton"),
        (50.0, 0.02, "lzb"),
        (1.0, 0.02, "lzb"),
        (0.01, 0.02, "binary"),
    ],
)
def test_known_ratio(ratio, tolerance, name):
    result = quick(BALLS, STRIKE, tolerance, stiffness=[1.0, ratio])
    exact = result.candidates["lzb"].velocity
    assert (result.name, result.within, result.unknown) == (name, True, ())
    assert np.abs(result.candidates[name].velocity - exact).max() <= tolerance
    simple = ["newton", "moreau", "poisson", "binary"]
    for other in simple[: simple.index(name)] if name in simple else simple:
        assert np.abs(result.candidates[other].velocity - exact).max() > tolerance
    assert f"k2/k1 = {ratio:.3g}" in result.reason
    itself = "taken as known: lzb is the reference itself, and compliant, with springs"
    assert (itself in result.reason) == (name == "lzb")
    assert "`jimpact advise --stiffness-range" in " ".join(str(result).split())


@pytest.mark.slow
def test_tolerance_from_both_sides():
    """At the error of binary collisions the advice changes, and nowhere near it."""
    known = {"stiffness": [1.0, 0.5]}
    edge = quick(BALLS, STRIKE, 0.5, **known).candidates["binary"].worst
    assert 0.02 < edge < 0.05
    assert quick(BALLS, STRIKE, 1.001 * edge, **known).name == "binary"
    below = quick(BALLS, STRIKE, 0.999 * edge, **known)
    assert (below.name, below.within) == ("lzb", True)
    assert "binary comes closest and is off by" in below.reason


@pytest.mark.slow
def test_special_scenes():
    """Plastic contacts, no approach, a law that breaks a property."""
    result = quick(BALLS, STRIKE, restitution=0.0)
    assert (result.name, result.within) == ("newton", True)
    assert "plastic contacts" in result.reason
    result = quick(BALLS, [-1.0, 0.0, 2.0])
    assert result.reason.startswith("no approach: nothing happens")
    both = quick(
        ji.chain([0.25, 1.0, 0.25]), [1.0, 0.0, -1.0], 0.9, stiffness=[1.0, 1.0]
    )
    assert both.candidates["binary"].status == "order_dependent"
    assert not both.candidates["binary"].usable
    assert both.name == "newton"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gap", "tolerance", "name"),
    [(2e-3, 1e-3, "binary"), (1e-6, 1e-2, "lzb"), (1e-4, 1e-2, "compliant")],
)
def test_gaps(gap, tolerance, name):
    scene = ji.chain([1.0, 1.0, 1.0], gaps=[0.0, gap])
    result = quick(scene, STRIKE, tolerance, stiffness=1.2e8)
    exact = ji.impact(
        ji.Compliant(ji.Bistiffness(1.2e8, 1.5, 1.0)), scene, STRIKE
    ).velocity
    assert (result.name, result.within) == (name, True)
    got = np.asarray(ji.impact(result.law, result.scene, STRIKE).velocity)
    assert np.abs(got - exact).max() <= tolerance


@pytest.mark.release  # laws with friction compile for half a minute
def test_friction_is_part_of_every_law():
    """A block that slides as it strikes; its upper corners are too far away to take part."""
    block = ji.Block(0.2, 0.6, 2.0)
    scene, v = block.scene(block.touching()), [0.3, -0.1, -1.0]
    advice = quick(scene, v, restitution=0.1, friction=0.5, stiffness=1e8)
    assert (advice.name, advice.reference, advice.far) == ("moreau", "lzb", (2, 3))
    np.testing.assert_allclose(advice.candidates["lzb"].velocity[2], -0.835, atol=1e-6)
    np.testing.assert_allclose(
        ji.impact(advice.law, advice.scene, v).velocity,
        advice.candidates["lzb"].velocity,
        atol=1e-6,
    )
    assert "Moreau(0.1, friction=0.5), within 1 %" in str(advice)
    assert "contacts 3, 4 too far open to close during the impact" in str(
        advice
    ).replace("\n", " ")


@pytest.mark.release
def test_contacts_that_close_again():
    """Two balls at a wall: LZB re-closes at once, Compliant waits for its gap and is right."""
    options = {"exponent": 1.0, "stiffness": 1.0, "tolerance": 5e-3}
    advice = quick(ji.chain([1.0, 1.0], wall=True), [1.0, 0.0], **options)
    at_once = [
        -0.97547042321005322912,
        -0.22013053727822418238,
    ]  # integrated piece by piece
    waiting = [-0.976928618648904904, -0.213566088283562787]
    np.testing.assert_allclose(advice.candidates["lzb"].velocity, at_once, atol=1e-7)
    np.testing.assert_allclose(
        advice.candidates["compliant"].velocity, waiting, atol=1e-7
    )
    apart = np.linalg.norm(np.subtract(at_once, waiting))  # equal masses, |v-| = 1
    assert advice.reclosing == pytest.approx(apart, rel=1e-4)
    assert (advice.name, advice.reference) == ("compliant", "compliant")
    assert advice.candidates["lzb"].worst == pytest.approx(apart, rel=1e-4)
    assert "contacts open and close again" in advice.reason


class EachAlone(ji.Law):
    """Every contact as if it were alone, elastic, and sticking where it has friction: it compiles quickly."""

    friction: jax.Array | None = ji.parameter(low=0, default=None)

    def impulses(self, contact):
        w = contact.normal_delassus
        p = jnp.maximum(-2 * contact.gap_velocity, 0.0) / jnp.diagonal(w)
        if self.friction is None:
            return p, None, jnp.int32(0)
        return p, -contact.slip / jnp.diagonal(contact.tangential), jnp.int32(0)


def rolling_balls():
    """Three balls on a floor; (x, y, z) and two turns of each. Tangents are those of a point below."""
    m, r = 2.0, 0.1
    one = np.diag([m, m, m, 0.4 * m * r**2, 0.4 * m * r**2])
    tangents = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, r], [-r, 0.0]])
    normal = np.array([[0.0], [0.0], [1.0], [0.0], [0.0]])
    return ji.Scene(*(np.kron(np.eye(3), x) for x in (one, normal, tangents)))


def test_contacts_that_an_impact_needs():
    """Ball 1 falls and slides, ball 2 falls at half the speed, ball 3 rises."""
    scene, v = rolling_balls(), np.zeros(15)
    v[[0, 1, 2, 7, 12]] = 0.006, 0.008, -1.0, -0.5, 0.5
    law = EachAlone(jnp.ones(()))
    advice = ji.simplest_scene(law, scene, v, names="abc")
    assert advice.law.friction is None  # slip is small
    assert advice.scene.tangents is None
    assert advice.kept == (0, 1)
    np.testing.assert_array_equal(np.isinf(advice.scene.gaps), [False, False, True])
    expected = [2 / np.sqrt(1.5001), 1 / np.sqrt(1.5001), 0]
    np.testing.assert_allclose(advice.errors, expected, atol=1e-12)
    np.testing.assert_allclose(advice.changes, [2, 1, 0], atol=1e-12)
    assert [b.approaches for b in advice.blocks] == [True, True, False]
    assert advice.reason(2) == "left out: nothing approaches"
    assert "2 of 3 contacts suffice" in str(advice)
    assert "3 c" in str(advice)
    second = ji.simplest_scene(law, scene, v, watched=[7])
    np.testing.assert_allclose(second.errors, [0, 1 / np.sqrt(1.5001), 0], atol=1e-12)
    assert second.to_dict()["kept"] == [2]
    assert second.reason(0) == "left out: no effect"
    v[[2, 7, 12]] = -0.5, -0.4, 5.0  # either of the first two may be missing, not both
    assert ji.simplest_scene(law, scene, v, 0.2).kept == (0,)


@pytest.mark.slow
def test_one_of_two_contacts_at_the_same_place_is_left_out():
    """Two balls fall, each on two contacts that act alike: any two of one ball are too many."""
    scene = ji.Scene(
        jnp.ones(2), jnp.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
    )
    advice = ji.simplest_scene(ji.Moreau(0.5), scene, [-1.0, -1.0])
    np.testing.assert_allclose(advice.errors, 0, atol=1e-12)
    assert [contact // 2 for contact in advice.kept] == [0, 1]
    assert advice.error == pytest.approx(0, abs=1e-12)


def test_friction_that_an_impact_needs():
    """A ball rolls on after 2/7 of its slip, which is oblique to both tangents."""
    v = np.zeros(15)
    v[[0, 1, 2]] = 0.6, 0.8, -1.0
    advice = ji.simplest_scene(EachAlone(jnp.ones(())), rolling_balls(), v)
    assert advice.friction["one direction"] == pytest.approx(0, abs=1e-9)
    # v- has m (s^2 + 1) / 2, and the impulse 2 m s / 7 does half the work 2/7 m s^2
    assert advice.friction["none"] == pytest.approx(np.sqrt(2 / 7 / 2))
    np.testing.assert_allclose(
        np.abs(advice.scene.tangents[:5, 0]), [0.6, 0.8, 0, 0.08, 0.06]
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 1.5}, "tolerance"),
        ({"watched": [3]}, "`watched` must be indices of coordinates from 0 to 2"),
        ({"names": ["a"]}, "names"),
        ({"runs": 0}, "runs"),
    ],
)
def test_simplest_scene_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        ji.simplest_scene(
            **({"law": EachAlone(), "scene": BALLS, "velocity": STRIKE} | options)
        )


@pytest.mark.release
def test_several_ratios():
    """Five unknown ratios: which of them matters."""
    result = quick(ji.chain(jnp.ones(7)), [1.0, 0, 0, 0, 0, 0, 0])
    assert [u.name for u in result.unknown] == [f"k{j}/k1" for j in range(2, 7)]
    strongest = max(result.unknown, key=lambda u: u.alone)
    assert f"measure {strongest.name} first" in result.reason


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"tolerance": 0.0}, ValueError, "`tolerance` must lie in"),
        ({"tolerance": [0.1]}, ValueError, "`tolerance` must have shape"),
        (
            {"stiffness_range": (2.0, 1.0)},
            ValueError,
            "`stiffness_range` must have low <= high",
        ),
        ({"stiffness_range": (0.0, 1.0)}, ValueError, "`stiffness_range` must lie in"),
        ({"samples": 0}, ValueError, "`samples` must be an int >= 1"),
        ({"seed": -1}, ValueError, "`seed` must be an int >= 0"),
        ({"restitution": 1.5}, ValueError, "`restitution` must lie in"),
        ({"stiffness": [1.0, 2.0, 3.0]}, ValueError, "`stiffness` must be a scalar or"),
        ({"exponent": 0.5}, ValueError, "`exponent` must lie in"),
        (
            {"exponent": (1.0, 1.5)},
            ValueError,
            "`stiffness` must be given where exponents differ",
        ),
        (
            {"scene": ji.chain([1.0] * 3, gaps=[0.0, 2e-3])},
            ValueError,
            r"`stiffness` must be given .* \(contact 2\)",
        ),
        ({"friction": 0.3}, ValueError, "must have tangents where LZB has `friction`"),
        ({"friction": -0.3}, ValueError, "`friction` must lie in"),
    ],
)
def test_advice_refuses(options, error, message):
    with pytest.raises(error, match=message):
        ji.advise(**({"scene": BALLS, "velocity": STRIKE} | options))


@pytest.mark.slow
def test_advice_in_words_and_picture(unknown):
    data = json.loads(json.dumps(unknown.to_dict()))
    assert data["laws"]["lzb"]["worst"] == unknown.candidates["lzb"].worst
    assert data["unknown"][0]["name"] == "k2/k1"
    text = str(unknown)
    assert max(len(line) for line in text.splitlines()) <= 100
    assert len(text.splitlines()) < 25
    assert "NOT within 1 %" in text
    axes = ji.plot.advice(unknown, "balls").axes
    assert len(axes) == 2
    assert "not within 1 %" in axes[0].get_title(loc="left")


EXACT = {  # three equal balls, exponent 1, e = 1: unilateral springs, closed form
    0.25: (-0.0301850562872225066, 0.0311254645544743804, 0.99905959173274812616),
    1.0: (-0.1302616950645210470, 0.1502295694347740893, 0.98003212562972695774),
    2.0: (-0.2454016724823200310, 0.3361128425708038889, 0.90928882991151614209),
    10.0: (-0.3309938917272272135, 0.6171716226279141425, 0.71382226909931307106),
}


RATIOS = [1e-6, 1e-3, *EXACT, 1e3, 1e6]


@pytest.fixture(scope="module")
def valid():
    return ji.validity_map(BALLS, STRIKE, RATIOS, (1.0, 1.5, 2.0, 3.0))


@pytest.mark.slow
def test_validity_map(valid):
    """Closed form; k2/k1 -> 0: binary; -> inf: Moreau; the larger the exponent, the later."""
    assert not valid.status.any()
    np.testing.assert_allclose(valid.velocity[0, 2:-2], list(EXACT.values()), atol=1e-7)
    hertz = [-0.070952353651436871, 0.076403039071206993, 0.99454931458022988]
    np.testing.assert_allclose(valid.velocity[1, RATIOS.index(1.0)], hertz, atol=1e-7)
    assert valid.law_dispersion["moreau"] == pytest.approx(2 / 3)
    assert valid.law_dispersion["binary"] == pytest.approx(0.0)
    binary = valid.error("binary")
    np.testing.assert_allclose(
        binary[:, 0] / binary[:, 1], 1e-3, rtol=0.01
    )  # first order in k2/k1
    assert (np.diff(binary[:, 1]) < 0).all()
    moreau = valid.error("moreau")[:, -2:]
    assert (moreau[:, 1] < moreau[:, 0]).all()
    assert (np.diff(moreau[:, 1]) > 0).all()
    for law, step in (("binary", 1), ("moreau", -1)):
        error, limit = valid.error(law), valid.limit(law, 0.05)
        for i in range(4):
            at = RATIOS.index(limit[i])
            run = error[i, : at + 1] if step == 1 else error[i, at:]
            assert (run <= 0.05).all()
            assert error[i, at + step] > 0.05
    assert len(ji.plot.validity_map(valid).axes) == 2
    json.dumps(valid.to_dict())
    with pytest.raises(ValueError, match=argument("law", "'newton'")):
        valid.error("newton")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((ji.chain([1.0, 1.0]), [1.0, 0.0]), "`scene` must have two or more contacts"),
        ((BALLS, [0.0, 0.0, 0.0]), "`velocity` must not be zero"),
        ((BALLS, STRIKE, [2.0, 1.0]), "`ratios` must rise"),
        ((BALLS, STRIKE, [0.0, 1.0]), "`ratios` must lie in"),
        ((BALLS, STRIKE, [1.0], [0.5]), "`exponents` must lie in"),
        ((BALLS, STRIKE, [1.0], [1.0], 2.0), "`restitution` must lie in"),
    ],
)
def test_validity_map_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        ji.validity_map(*arguments)


@pytest.mark.slow
def test_compare_gives_every_law_its_outcome():
    result = ji.compare(BALLS, STRIKE, restitution=0.9, stiffness=[1.0, 2.0])
    assert {"lzb", "newton", "moreau", "poisson", "binary"} <= set(result.entries)
    for name, entry in result.entries.items():
        assert entry.time > 0
        ratio = 2 * (0.5 + float(entry.outcome.energy_change))
        assert entry.energy_ratio == pytest.approx(ratio)
        assert name in str(result)
    assert float(result.entries["lzb"].law.stiffness[1]) == 2.0
    data = json.loads(json.dumps(result.to_dict()))
    assert data["moreau"]["consistent"] is True
    slender = ji.Scene(np.linalg.inv([[1.0, 0.25], [0.25, 1.0]]), np.eye(2))
    table = str(ji.compare(slender, [0.0, -1.0], {"mine": ji.Newton(0.5)}))
    assert "kinetic violated, negative_impulse" in table


def test_dispersion_index_and_energy_ratio():
    for v, index in (
        ([0, 0, 1.0], 0.0),
        ([-1 / 3, 2 / 3, 2 / 3], 2 / 3),
        ([1, -1, 1.0], 1.0),
    ):
        assert float(ji.theory.dispersion_index(BALLS, v)) == pytest.approx(
            index, abs=1e-14
        )
    heavy = ji.chain([4.0, 1.0])
    assert float(ji.theory.energy_dispersion(heavy, [1.0, 0.0])) == pytest.approx(1.0)
    assert float(ji.theory.dispersion_index(heavy, [1.0, -2.0])) == pytest.approx(1.0)
    assert float(
        ji.theory.energy_ratio(heavy, [1.0, 0.0], [0.5, 0.0])
    ) == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("after", "kept", "spread"),
    [
        ((0.0, 0.0, 1.0), 1.0, 1.41421),  # A
        ((-1 / 3, 2 / 3, 2 / 3), 1.0, 0.47140),  # B
        ((0.0, 0.5, 0.5), 0.5, 0.70711),  # Moreau, e = 1/2
        ((0.203125, 0.234375, 0.5625), 0.41260, 0.92055),  # binary, e = 1/2
        (
            (-0.130261695064521, 0.150229569434774, 0.980032125629747),
            1.0,
            1.33036,
        ),  # LZB, eta 1
        (
            (-0.070952353651437, 0.076403039071207, 0.994549314580230),
            1.0,
            1.39115,
        ),  # 1.5
        ((-0.037880398123056, 0.039374137379719, 0.998506260743337), 1.0, 1.40788),  # 2
        ((-0.010396841805953, 0.010506083831368, 0.999890757974585), 1.0, 1.41375),  # 3
    ],
)
def test_energy_kept_and_its_dispersion(after, kept, spread):
    """Of three equal balls, k2/k1 = 1; outcomes are closed forms, or held in test_values."""
    assert float(ji.theory.energy_ratio(BALLS, STRIKE, after)) == pytest.approx(
        kept, abs=6e-6
    )
    assert float(ji.theory.energy_dispersion(BALLS, after)) == pytest.approx(
        spread, abs=6e-6
    )


def test_dispersion_falls_along_the_arc():
    """From A to B, where Moreau's law has the least."""
    arc = ji.theory.admissible_set(BALLS, STRIKE).conserving_arc(13)
    spread = [float(ji.theory.energy_dispersion(BALLS, v)) for v in arc]
    assert (np.diff(spread) < 0).all()
    np.testing.assert_allclose(
        [spread[0], spread[-1]], [2**0.5, 2**0.5 / 3], rtol=1e-12
    )


@pytest.mark.long_run
@pytest.mark.release
def test_docs_hold_the_chooser_table():
    import chooser

    lines, silent = chooser.table()
    assert silent == 0  # whatever a law breaks, a status tells
    text = (Path(__file__).parents[2] / "docs" / "laws.md").read_text(encoding="utf-8")
    for line in lines:
        assert line in text
