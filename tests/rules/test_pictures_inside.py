"""Pictures of every kind, on small records made by hand: nothing overlaps, every axis is labelled.

Nothing is simulated here, so that the layout of all pictures costs seconds.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from canned import canned, impact_history, rocked
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from pictures_cases import BALLS, STRIKE, force_chains, samples
from refusals import argument

import jimpact as ji
from jimpact.core.audits import Audit
from jimpact.fits.intervals import Profile
from jimpact.fits.profiles import Contour
from jimpact.methods.advice_report import Advice, Candidate
from jimpact.methods.chart import Point, Reference, Timing, WorkPrecision
from jimpact.methods.comparison import Comparison, Entry
from jimpact.methods.pictures import _styles
from jimpact.methods.stability import Confirmation, Slice, StabilityMap
from jimpact.methods.validity import ValidityMap
from jimpact.plot.style import SMALL, WIDTH

pytestmark = pytest.mark.slow

AFTER = np.array([-0.1, 0.2, 0.9])


HERTZ = ji.Compliant(ji.Hertz(1e9))


DIMENSIONLESS = (  # quantities that have no unit
    "ratio", "restitution", "exponent", "setting", "error", "evaluations", "dispersion",
    "share", "method", "balls N", "deviance", "stiffness", "residual / sigma",
)  # fmt: skip


COUNTED = ("law", "force", "body", "shot")  # names stand along the axis


def correlated():
    """Of two parameters, and one that the data do not determine."""
    covariance = np.array([[4e-4, 3e-4, 0.0], [3e-4, 9e-4, 0.0], [0.0, 0.0, np.inf]])
    names = ("restitution[1]", "restitution[2]", "stiffness[2]")
    known = {"names": names, "covariance": covariance}
    error = np.sqrt(np.diag(covariance))
    return canned(4, (0.8, 0.7, 1.0), standard_error=error, **known)


def track():
    """A ball that bounces once."""
    t = np.arange(40) / 60
    since = t - 0.3
    y = np.where(since < 0, -3.0, 2.4) * since - 4.905 * since**2
    y += 0.001 * np.random.default_rng(0).normal(size=40)
    return ji.plot.track(ji.tracks.find_impacts(t, y, acceleration=-9.81), "a ball")


def correlated_draws():
    fit, rng = correlated(), np.random.default_rng(0)
    drawn = rng.multivariate_normal(fit.value[:2], fit.covariance[:2, :2], 200)
    return np.column_stack([drawn, rng.normal(size=200)])


def outcome(velocity, status=0):
    zero = np.zeros(2)
    return ji.Impact(
        jnp.asarray(velocity), zero, zero[:0], np.float64(-0.1), 0.0, np.int32(status)
    )


def entry(law, fine=True):
    yes, no = np.bool_(True), np.bool_(fine)
    audit = Audit(
        yes, yes, no, yes, *([np.float64(0.0)] * (len(dataclasses.fields(Audit)) - 4))
    )
    return Entry(law, outcome(AFTER), audit, 0.9, 0.4, 1e-5, 1.0)


def comparison():
    names = [
        "lzb",
        "newton",
        "moreau",
        "poisson",
        "binary",
        "restitution_matrix",
        "compliant",
    ]
    entries = {name: entry(ji.Newton(0.5), name != "newton") for name in names}
    return ji.plot.comparison(Comparison(BALLS, STRIKE, entries), AFTER, "three balls")


def energy_plane():
    rows = {
        "newton": AFTER,
        "moreau": [-1 / 3, 2 / 3, 2 / 3],
        "binary": [0.0, 0.0, 1.0],
    }
    entries = {
        name: dataclasses.replace(
            entry(ji.Newton(0.5), name != "newton"), outcome=outcome(v)
        )
        for name, v in rows.items()
    }
    return ji.plot.energy_plane(Comparison(BALLS, STRIKE, entries), "three balls")


def chart(gradients):
    time, far = Timing(1.2e-5, 1e-5, 2e-5), Timing(3.4e-5, 3e-5, 6e-5)
    points = {}
    for k, name in enumerate(("time", "rk4", "verlet", "impulse_euler", "scipy_lsoda")):
        points[name] = tuple(
            Point(
                f"method number {k} with a long name (default)",
                setting,
                {"velocity": error / (k + 1), "gradient": 10 * error},
                100.0 / setting**0.2,
                "ok" if k else "max_steps",
                time,
                each,
                time if gradients else None,
            )
            for setting, error, each in ((1e-2, 1e-5, time), (1e-4, 1e-9, far))
        )
    law = {"velocity": 0.5, "gradient": np.nan}
    points["binary"] = (Point("law: binary", None, law, np.nan, "ok", time, time),)
    uncertain = {"velocity": 1e-13, "gradient": 1e-12}
    reference = Reference("order 8", uncertain, AFTER, np.zeros(2), 1.0)
    return ji.plot.work_precision(
        WorkPrecision(STRIKE, points, reference, {}, {}, {}, 64, 16, 10.0, 3),
        "three balls",
    )


NO_TIME = Timing(1.0, 1.0, 1.0)


SETTING = Point("", 0.1, {}, 1.0, "ok", NO_TIME, NO_TIME)


LAW = dataclasses.replace(SETTING, setting=None)


AXES = {
    "setting": np.linspace(0, 1, 5),
    "stiffness_ratio": np.logspace(-6, 6, 7),
    "exponent": np.array([1.0, 1.5, 5.0]),
    "restitution": np.array([0.0, 1e-3, 0.05, 0.3, 0.9, 1.0]),
    "mass_ratio": np.logspace(-6, 6, 7),
    "balls": np.array([2.0, 3, 10, 30, 100]),
}


def stability():
    base = {name: float(values[1]) for name, values in AXES.items()}
    methods = ("time", "rk4", "impulse_euler")

    def piece(names):
        shape = tuple(len(AXES[name]) for name in names)
        codes = np.arange(np.prod(shape)).reshape(shape) % 8
        return Slice(names, codes, codes * 1.0)

    names = [(name,) for name in AXES] + list(itertools.combinations(AXES, 2))
    slices = {method: tuple(piece(x) for x in names) for method in methods}
    confirmation = Confirmation(1, 1, 1, 0.0)
    return StabilityMap(
        methods, AXES, base, slices, np.zeros((0, 7)), {}, confirmation, 100
    )


def validity():
    ratios, eta = np.logspace(-3, 3, 9), np.array([1.0, 1.5, 2.0, 3.0])
    share = 1 / (1 + 1 / ratios)[None, :] ** eta[:, None]
    velocity = AFTER + 0.3 * share[..., None]
    ends = {"moreau": AFTER + 0.3, "binary": AFTER}
    level = {"moreau": 0.6, "binary": 0.0}
    return ji.plot.validity_map(
        ValidityMap(
            BALLS, STRIKE, ratios, eta, velocity, 0.6 * share, share * 0, ends, level
        )
    )


def advice():
    names = ("newton", "moreau", "poisson", "binary", "restitution_matrix", "lzb")
    rows = {
        name: Candidate(
            ji.Newton(0.5),
            BALLS,
            AFTER,
            AFTER - 0.1,
            AFTER + 0.1,
            1e-2,
            0.3,
            "negative_impulse",
        )
        for name in names
    }
    none = np.zeros(2)
    result = Advice(
        "lzb", 0.01, False, "lzb", STRIKE, none, rows, (), none, (), 8, None
    )
    return ji.plot.advice(result, "Three balls, stiffness unknown")


def rocking():
    a, mu, e = (
        np.linspace(0.5, 4, 6),
        np.array([0.0, 0.1, 0.3]),
        np.array([0.1, 0.5, 0.9]),
    )
    shape = (6, 3, 3)
    gamma = np.linspace(0, 1.5, 6)[:, None, None, None] * np.ones((*shape, 2))
    one = np.ones(shape)
    return ji.theory.RockingDispersion(a, mu, e, gamma, one, one, one, one)


def motion(kind):
    system, result = rocked()
    return getattr(ji.plot, kind)(result, title="dimer", system=system)


def outcomes(masses, wall):
    scene = ji.chain(masses, wall=wall)
    v = np.zeros(len(masses))
    v[0] = 1.0
    result = ji.theory.admissible_set(scene, v)
    return ji.plot.admissible_set(
        result, {"Newton's cradle": result.plastic, "at rest": 0 * v}
    )


def region():
    x, k = np.linspace(0.4, 0.6, 5), np.geomspace(0.5, 3.0, 5)
    deviance = ((x - 0.5) / 0.03)[:, None] ** 2 + np.log(k) ** 2 / 0.04
    names = ("restitution[1]", "stiffness[2]")
    return Contour(names, x, k, deviance, 5.99, 0.95, (0.5, 1.0), (False, True))


def valley(name):
    x = np.linspace(0.0, 1.0, 9)
    pieces = ((0.25, 0.5), (0.75, 1.0))
    return Profile(name, x, 40 * (x - 0.5) ** 2, 3.84, 0.95, pieces, (0.0, 1.0))


BLOCK = ji.Block(width=0.2, height=0.6)


PICTURES = {
    "advice": advice,
    "comparison": comparison,
    "fit of a shot": lambda: ji.plot.fit(canned(1), {"the same": canned(1)}, "one shot"),
    "fit of many shots": lambda: ji.plot.fit(canned(50)),
    "contour": lambda: ji.plot.contour(region(), "two parameters"),
    "corner": lambda: ji.plot.corner(correlated(), correlated_draws()),
    "correlation": lambda: ji.plot.correlation(canned(4)),
    "profiles": lambda: ji.plot.profiles([valley("restitution[1]"), valley("stiffness[2]")] * 2),
    "residuals": lambda: ji.plot.residuals(canned(50)),
    "forces": lambda: ji.plot.forces({"soft": impact_history(), "hard": impact_history()}),
    "contact_loop": lambda: ji.plot.contact_loop(impact_history(), title="a loop"),
    "history": lambda: ji.plot.history(impact_history(), "three balls"),
    "energy_plane": energy_plane,
    "stability_map": lambda: ji.plot.stability_map(stability(), "where methods fail"),
    "stability_pairs": lambda: ji.plot.stability_pairs(stability(), "rk4"),
    "validity_map": validity,
    "work_precision": lambda: chart(False),
    "work_precision with gradients": lambda: chart(True),
    "monte_carlo over gaps": lambda: samples(True),
    "monte_carlo over speeds": lambda: samples(False),
    "motion": lambda: motion("motion"),
    "phase_portrait": lambda: motion("phase_portrait"),
    "rocking_dispersion": lambda: ji.plot.rocking_dispersion(rocking(), "by LZB"),
    "rocking_outcomes": lambda: ji.plot.rocking_outcomes(rocking()),
    "rocking_domains": lambda: ji.plot.rocking_domains(
        [ji.theory.rocking_domain(a, s) for a in (1.0, 2.0) for s in (True, False)]
    ),
    "admissible_set": lambda: outcomes([1.0, 1.0, 1.0], False),
    "admissible_set of three contacts": lambda: outcomes([1.0, 1.0, 1.0], True),
    "system, a chain": lambda: ji.plot.system(ji.chain([1.0, 4.0, 0.1], "right", [0, 1, 0]), STRIKE),
    "system, a block": lambda: ji.plot.system(BLOCK, BLOCK.touching(0.2), "a block"),
    "force_chains": lambda: force_chains(),
    "track": track,
}  # fmt: skip


def texts(figure):
    """What is written in a figure, and where [pixels]."""
    renderer, ticks, drawn = figure.canvas.get_renderer(), set(), set()
    for axes in figure.axes:
        sides = (
            (axes.xaxis, axes.viewLim.intervalx),
            (axes.yaxis, axes.viewLim.intervaly),
        )
        for axis, view in sides:
            low, high = sorted(view)
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                labels = {tick.label1, tick.label2}
                ticks |= labels
                if axes.axison and low <= tick.get_loc() <= high:
                    drawn |= {label for label in labels if label.get_visible()}
    all_texts = figure.findobj(lambda x: isinstance(x, Text) and x.get_visible())
    written = [
        x for x in all_texts if x.get_text().strip() and (x not in ticks or x in drawn)
    ]
    return [(x, x.get_window_extent(renderer)) for x in written]


def labelled(label):
    """Whether an axis label names a quantity, and its unit if it has one."""
    has_unit = label.rstrip(")").endswith("]") or "[" in label
    return has_unit or label in COUNTED or any(word in label for word in DIMENSIONLESS)


@pytest.mark.parametrize("name", PICTURES)
def test_layout(name):
    figure = PICTURES[name]()
    FigureCanvasAgg(figure).draw()
    whole = figure.bbox
    assert figure.get_figwidth() == WIDTH  # read at half a page's width
    places = texts(figure)
    for text, place in places:
        inside = place.x0 >= -1 and place.y0 >= -1
        inside = inside and place.x1 <= whole.x1 + 1 and place.y1 <= whole.y1 + 1
        assert inside, f"{text.get_text()!r} is cut off"
        assert text.get_fontsize() >= SMALL - 0.2, f"{text.get_text()!r} is small"
    for (one, a), (two, b) in itertools.combinations(places, 2):
        over = (
            min(a.x1, b.x1) - max(a.x0, b.x0) > 1
            and min(a.y1, b.y1) - max(a.y0, b.y0) > 1
        )
        turned = one.get_rotation() % 90 or two.get_rotation() % 90
        assert turned or not over, f"{one.get_text()!r} and {two.get_text()!r} overlap"
    for axes in figure.axes:
        drawn = [*axes.lines, *axes.collections, *axes.patches, *axes.images]
        assert drawn or axes.get_legend() is not None, "empty axes"
        if not axes.axison or axes.get_label() == "<colorbar>":
            continue
        place = axes.get_subplotspec()
        for label, axis in ((axes.get_xlabel(), "x"), (axes.get_ylabel(), "y")):
            ticks = getattr(axes, f"get_{axis}ticklabels")()
            silent = not any(tick.get_text() and tick.get_visible() for tick in ticks)
            categories = name == "correlation" or (
                axis == "y" and name == "stability_map"
            )
            assert silent or categories or labelled(label), (axis, label, place)


def test_laws_stand_at_their_energy_and_dispersion():
    """A at (1, sqrt 2), B at (1, sqrt 2 / 3); what is allowed lies between 1/3 and 1."""
    axes = energy_plane().axes[0]
    allowed, newton, moreau, binary = axes.lines
    np.testing.assert_allclose(np.ravel(moreau.get_data()), [1, 2**0.5 / 3])
    np.testing.assert_allclose(np.ravel(binary.get_data()), [1, 2**0.5])
    assert newton.get_mfc() == "none"
    kept, spread = allowed.get_data()
    assert 1 / 3 < kept.min() < 0.4
    assert 0.9 < kept.max() < 1
    assert spread.max() < 2**0.5


def test_every_kind_of_picture_is_here():
    known = {name.split(" ")[0].rstrip(",") for name in PICTURES}
    assert known | {"animation"} == set(ji.plot.__all__)


def test_no_two_lines_of_a_chart_look_alike():
    styles = _styles(
        {f"method {i}": (SETTING,) for i in range(10)} | {"law": (LAW,), "b": (LAW,)}
    )
    looks = [
        (style["color"], style["marker"], style["ls"]) for style in styles.values()
    ]
    assert len(set(looks)) == len(looks)
    assert len({style["color"] for style in styles.values()}) == 11  # laws are grey


def test_the_law_closest_to_the_measured_velocities_is_named():
    after = {"far": AFTER + 0.1, "near": AFTER + 0.01, "as near": AFTER - 0.01}
    entries = {
        name: dataclasses.replace(entry(ji.Newton(0.5)), outcome=outcome(v))
        for name, v in after.items()
    }
    result = Comparison(BALLS, STRIKE, entries, measured=AFTER)
    assert result.closest == ("near", "as near")
    assert result.distances["far"] == pytest.approx(0.1)
    assert "closest to the measured velocities: near, as near (rms 0.01 m/s)" in str(
        result
    )
    labels = [x.get_text() for x in ji.plot.comparison(result).legends[0].get_texts()]
    assert "closest to the measured velocities" in labels
    assert dataclasses.replace(result, measured=None).closest == ()


def test_a_history_must_be_one():
    batch = jax.tree.map(lambda x: np.stack([x, x]), impact_history())
    with pytest.raises(ValueError, match=argument("result")):
        ji.plot.history(batch)
    with pytest.raises(TypeError, match=argument("drawn")):
        ji.plot.system(ji.Scene([1.0], [[1.0]]), [1.0])


def test_residuals_are_drawn_over_what_was_fitted():
    fitted, measured = canned(50), ji.plot.residuals(canned(50)).axes[0]
    here = ~np.isnan(fitted.residual)
    dots = measured.lines[-1]
    np.testing.assert_array_equal(dots.get_xdata(), fitted.predicted[here])
    np.testing.assert_allclose(
        dots.get_ydata(), (fitted.predicted + fitted.residual)[here]
    )


def test_regions_of_a_corner_plot_hold_what_they_say():
    """chi^2 of two degrees of freedom exceeds 2.279 with 32 and 5.991 with 5 %."""
    fit = correlated()
    one, pair, other = ji.plot.corner(fit, correlated_draws()).axes
    assert (pair.get_xlabel(), pair.get_ylabel()) == fit.names[:2]
    inverse = np.linalg.inv(fit.covariance[:2, :2])
    for line, limit in zip(pair.lines[1:3], (2.279, 5.991), strict=True):
        away = np.stack(line.get_data()) - fit.value[:2, None]
        np.testing.assert_allclose(
            np.sum(away * (inverse @ away), axis=0), limit, rtol=1e-3
        )
    for axes, error in ((one, 0.02), (other, 0.03)):
        assert max(axes.lines[0].get_ydata()) == pytest.approx(
            1 / (error * np.sqrt(2 * np.pi))
        )
    with pytest.raises(ValueError, match=argument("draws")):
        ji.plot.corner(fit, np.ones((5, 2)))
    with pytest.raises(ValueError, match=argument("fit")):
        ji.plot.corner(fit, names=["stiffness[2]"])
    with pytest.raises(ValueError, match=argument("names", "'friction'")):
        ji.plot.corner(fit, names=["friction"])
