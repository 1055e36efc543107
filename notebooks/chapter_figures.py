"""The figures of the source chapter by number, for notebook 16: B. Brogliato, Nonsmooth Mechanics, 2016.

>>> chapter_figures.draw("6.9")
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform
from scipy.spatial import ConvexHull

import jimpact as ji

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
GREY = "#777777"
ON_LINES = {
    "fc": "white",
    "ec": "none",
    "pad": 1,
    "alpha": 0.8,
}  # behind a text on lines
SMALL = 8.5  # font size [points]


def new_figure(height: float) -> Figure:
    """A figure of 7.2 in by `height` [in]."""
    return Figure(figsize=(7.2, height), facecolor="white", layout="constrained")


def finish(*panels: Axes) -> None:
    """The frame of panels: two spines, a thin grid."""
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(lw=0.4, alpha=0.5)
        axes.set_axisbelow(True)


def write(axes: Axes, at: Any, text: str, **style: Any) -> None:
    """A small text, centred at a point (2,)."""
    centred: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": SMALL}
    axes.annotate(text, (at[0], at[1]), **centred | style)


def legend_within(axes: Axes) -> None:
    """The legend of one panel."""
    axes.legend(frameon=False, fontsize=SMALL)


def legend_below(figure: Figure, handles: Any, columns: int) -> None:
    """One legend for all panels."""
    place = {"loc": "outside lower center", "frameon": False, "fontsize": SMALL}
    figure.legend(handles=handles, ncols=columns, **place)


_BEADS = 4  # of the column that is drawn
_COILS = 7  # of a spring that is drawn
_TURNED = 0.2  # of the block that is drawn [rad]


def three_balls() -> Figure:
    """Figure 6.4: ball 1 strikes balls 2 and 3, which touch."""
    return ji.plot.system(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])


def column() -> Figure:
    """Figure 6.1: touching beads fall from the height h."""
    figure = new_figure(4.4)
    axes = figure.subplots()
    height = 1.6
    for i in range(_BEADS):
        y = height + 1 + 2 * (_BEADS - 1 - i)
        axes.add_patch(Circle((0, y), 1.0, fc=COLOURS[i], alpha=0.35, ec=COLOURS[i]))
        axes.text(0, y, f"$B_{i + 1}$", ha="center", va="center")
    axes.add_patch(Rectangle((-6, -0.4), 12, 0.4, color=GREY, alpha=0.5, lw=0))
    _distance(axes, (1.6, 0), (1.6, height), "h")
    _arrow(axes, (-2.2, 2 * _BEADS), (-2.2, 2 * _BEADS - 2), "g")
    axes.text(-0.3, height / 2, "contact N", va="center", ha="right")
    _only(axes, (-6, 6), (-0.6, height + 2 * _BEADS + 0.4))
    return figure


def springs() -> Figure:
    """Figure 6.5: the balls as masses between springs that push only."""
    figure = new_figure(2.6)
    axes = figure.subplots()
    for i in range(3):
        axes.add_patch(
            Circle((4 * i, 0), 0.8, fc=COLOURS[i], alpha=0.35, ec=COLOURS[i])
        )
        axes.text(4 * i, 0, f"$m_{i + 1}$", ha="center", va="center")
        _arrow(axes, (4 * i - 0.6, 1.3), (4 * i + 0.6, 1.3), "")
        axes.text(4 * i, 1.6, f"$x_{i + 1}$", ha="center", va="bottom")
    for i in range(2):
        start, end = 4 * i + 0.8, 4 * i + 3.0
        x = np.concatenate(
            [[start], np.linspace(start + 0.3, end - 0.3, 2 * _COILS), [end]]
        )
        y = np.concatenate([[0], 0.3 * (-1.0) ** np.arange(2 * _COILS), [0]])
        axes.plot(x, y, color="black", lw=1.2)
        axes.plot(
            [end, end], [-0.5, 0.5], color="black", lw=3
        )  # a plate, which the ball may leave
        axes.text((start + end) / 2, -1.0, f"$k_{i + 1}$", ha="center", va="center")
    _only(axes, (-1.5, 9.5), (-1.4, 2.3))
    return figure


def block() -> Figure:
    """Figure 6.7a: width L, height l, corners A (contact 2) and B (contact 1)."""
    figure = new_figure(4.6)
    axes = figure.subplots()
    body = ji.Block(width=1.0, height=1.6)
    q = np.asarray(body.touching(_TURNED))
    _drawn(axes, body, q)
    along, up = (
        np.array([np.cos(q[2]), np.sin(q[2])]),
        np.array([-np.sin(q[2]), np.cos(q[2])]),
    )
    corners = [q[:2] - 0.8 * up + s * 0.5 * along for s in (-1, 1)]
    for name, at, side in zip("AB", corners, (-2, 1), strict=True):
        write(
            axes,
            at + np.array([0.1 * side, 0.08]),
            name,
            fontweight="bold",
            fontsize="medium",
        )
    axes.plot(*q[:2], "o", color="black", ms=4)
    axes.text(q[0] + 0.06, q[1] + 0.04, "G")
    top = q[:2] + 0.8 * up
    _distance(axes, top + 0.1 * up - 0.5 * along, top + 0.1 * up + 0.5 * along, "L")
    left = q[:2] - 0.58 * along
    _distance(axes, left - 0.8 * up, left + 0.8 * up, "l")
    axes.set_ylim(-0.1, 2.0)
    foot, part = corners[0], np.linspace(0, q[2], 30)
    axes.plot(
        foot[0] + 0.75 * np.cos(part),
        foot[1] + 0.75 * np.sin(part),
        color="black",
        lw=1,
    )
    axes.text(foot[0] + 0.82, foot[1] + 0.05, r"$\theta$")
    return figure


def dimer() -> Figure:
    """Figure 6.8a: two spheres of radius R on a rod of length L."""
    figure = new_figure(3.6)
    axes = figure.subplots()
    body = ji.Dimer(radius=0.25, length=1.0)
    q = np.asarray(body.touching(0.25)) + np.array([0, 0.15, 0])
    _drawn(axes, body, q)
    along, up = (
        np.array([np.cos(q[2]), np.sin(q[2])]),
        np.array([-np.sin(q[2]), np.cos(q[2])]),
    )
    _distance(axes, q[:2] - 0.5 * along + 0.1 * up, q[:2] + 0.5 * along + 0.1 * up, "L")
    centre = q[:2] + 0.75 * along
    _arrow(axes, centre, centre + 0.25 * up, "")
    write(
        axes, centre + 0.08 * along + 0.12 * up, "R", style="italic", fontsize="medium"
    )
    for name, at in (("2", q[:2] - 0.75 * along), ("1", centre)):
        axes.text(at[0], 0.03, f"$f_{name}$", ha="center")
    axes.set_ylim(-0.15, 1.15)
    return figure


def _drawn(axes: Axes, body: ji.Body, q: Any) -> None:
    """A body above its ground, without axes."""
    for i, points in enumerate(body.outlines(np.asarray(q), 0.05)):
        axes.plot(*np.asarray(points).T, color=COLOURS[i // 2])
    axes.axhline(0.0, color=GREY, lw=2)
    axes.set_aspect("equal")
    axes.axis("off")


def _distance(axes: Axes, start: Any, end: Any, name: str) -> None:
    """A length between two arrows, named at its middle."""
    axes.annotate(
        "", end, start, arrowprops={"arrowstyle": "<|-|>", "color": "black", "lw": 1}
    )
    middle = (np.asarray(start) + np.asarray(end)) / 2
    write(axes, middle, name, fontsize="medium", style="italic", bbox=ON_LINES)


def _arrow(axes: Axes, start: Any, end: Any, name: str) -> None:
    """An arrow with a name at its tail."""
    axes.annotate(
        "", end, start, arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.2}
    )
    if name:
        write(axes, start, f"{name}  ", ha="right", fontsize="medium", style="italic")


def _only(axes: Axes, x: tuple[float, float], y: tuple[float, float]) -> None:
    """A drawing without axes, to scale."""
    axes.set_xlim(x)
    axes.set_ylim(y)
    axes.set_aspect("equal")
    axes.axis("off")


# The column of beads of 6.1.1: mass [kg], stiffness between beads and at the wall [N/m^1.5], their
# energetic coefficients of restitution, and acceleration of gravity [m/s^2].
BEAD = 2.05e-3
STIFFNESS = (6.9716e9, 9.858e9)
RESTITUTION = (0.96, 0.92)
GRAVITY = 9.80665
DROPS = {3.1e-3: (1, 2, 4, 8), 5.1e-3: (5, 8, 12)}  # height [m]: numbers of beads
_AWAY = 1.0  # gap [m] and speed [m/s] of beads that take no part; any other would do
_SAMPLES = 400  # of a force over time


def wall_histories(drops: dict[float, tuple[int, ...]]) -> dict[tuple[float, int], Any]:
    """Impacts of columns of N beads that fall from a height: all of one program.

    Columns shorter than the longest have open contacts above, to beads that fly away.
    """
    cases = [(height, n) for height, beads in drops.items() for n in beads]
    most = max(n for _, n in cases)
    k, e = (np.array([x[0]] * (most - 1) + [x[1]]) for x in (STIFFNESS, RESTITUTION))
    law = ji.LZB(e, k)
    absent = np.stack([np.arange(most) < most - n for _, n in cases])
    speed = np.sqrt(2 * GRAVITY * np.array([height for height, _ in cases]))[:, None]
    leaving = -_AWAY * np.arange(most, 0, -1.0)[None]
    before = jnp.asarray(np.where(absent, leaving, speed))

    def one(gaps: jax.Array, velocity: jax.Array) -> Any:
        """One column."""
        return ji.history(
            law, ji.chain([BEAD] * most, wall=True, gaps=gaps), velocity, _SAMPLES
        )

    gaps = jnp.asarray(np.where(absent, _AWAY, 0.0))
    rows = jax.jit(jax.vmap(one))(gaps, before)
    return {
        case: jax.tree.map(lambda x, i=i: x[i], rows) for i, case in enumerate(cases)
    }


def wall_forces() -> Figure:
    """Figure 6.2: longer columns press longer, not harder."""
    figure = new_figure(6.4)
    panels = figure.subplots(2, 1, sharex=True)
    found = wall_histories(DROPS)
    for axes, (height, beads) in zip(panels, DROPS.items(), strict=True):
        for i, n in enumerate(beads):
            h = found[height, n]
            at, force = np.asarray(h.time) * 1e6, np.asarray(h.force[:, -1])
            axes.plot(at, force, color=COLOURS[i], label=f"N = {n}")
        axes.set_ylabel("force at the wall [N]")
        axes.set_title(
            f"drop height {1e3 * height:g} mm", loc="left", fontsize="medium"
        )
        axes.set_ylim(bottom=0)
        legend_within(axes)
    panels[-1].set_xlabel("impact time [us]")
    finish(*panels)
    return figure


def loop() -> Figure:
    """Figure 6.6: the wall under two balls, which compress it twice."""
    law = ji.LZB([0.9, 0.8], [1.0, 2**0.5], 1.5)
    return ji.plot.contact_loop(
        ji.history(law, ji.chain([1.0, 1.0], wall=True), [1.0, 1.0], _SAMPLES)
    )


_A, _B = (
    np.array([0.0, 0.0, 1.0]),
    np.array([-1 / 3, 2 / 3, 2 / 3]),
)  # ends of the arc AB
_GRID = 31  # values of e1 and of e2 whose outcomes fill a region; ten times more looks the same
_RATIOS = np.geomspace(1e-2, 1e2, 41)  # k2/k1 of the curves of LZB in figure 5.5
_RATIO = 0.8  # impulse correlation ratio of figure 6.3b: from 0.5, where B is, to 1, where A is
_PALE = "#C5DCEE"  # behind lines
_FAILS = np.array([row.failure for row in ji.STATUS])


def reached() -> Figure:
    """Figure 5.5: the plane of the gap velocities after, and the parts of it that laws reach."""
    figure = new_figure(6.0)
    axes = figure.subplots()
    e = np.linspace(0, 1, _GRID)
    pairs = np.stack(np.meshgrid(e, e, indexing="ij"), axis=-1)
    binary, poisson = (
        _gaps(_outcomes(law, pairs.reshape(-1, 2))) for law in (ji.Binary, ji.Poisson)
    )
    _region(axes, binary.reshape(_GRID, _GRID, 2), _PALE, "II: binary collisions")
    around = poisson[ConvexHull(poisson).vertices]
    axes.fill(
        *around.T, fc="none", ec=COLOURS[2], ls="--", lw=1.5, label="Poisson, e <= 1"
    )
    for kept in (0.4, 0.6, 0.8, 1.0):
        axes.plot(*_energy_arc(kept).T, color="black", lw=2 if kept == 1 else 0.8)
        write(axes, _energy_arc(kept)[35], f"K_ER = {kept:g}", bbox=ON_LINES)
    stiffness = jnp.stack([jnp.ones(len(_RATIOS)), jnp.asarray(_RATIOS)], axis=-1)
    for colour, each in zip((1, 3, 5), (1.0, 0.9, 0.5), strict=True):
        gaps = _gaps(_outcomes(ji.LZB, np.full(stiffness.shape, each), stiffness))
        axes.plot(*gaps.T, color=COLOURS[colour], lw=2.4, label=f"LZB, e = {each:g}")
    axes.plot(
        [0, 1], [0, 0], color=COLOURS[4], lw=4, label="Moreau", clip_on=False, zorder=3
    )
    for name, end in (("A", (0, 1.05)), ("B", (1.05, 0.03))):
        write(axes, end, name, fontsize="x-large", fontweight="bold")
    axes.set_xlim(0, 1.3)
    axes.set_ylim(-0.02, 1.15)
    axes.set_aspect("equal")
    axes.set_xlabel("gap velocity after, contact 1 [m/s]")
    axes.set_ylabel("gap velocity after, contact 2 [m/s]")
    finish(axes)
    legend_within(axes)
    return figure


def _outcomes(law: Callable[..., ji.Law], e: Any, *others: Any) -> np.ndarray:
    """v+ (k, 3) of three equal balls by a law with these e (k, 2), ...; NaN where it fails."""
    balls, before = ji.chain([1.0, 1.0, 1.0]), jnp.array([1.0, 0.0, 0.0])

    def one(*values: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of one set of parameters."""
        out = ji.impact(law(*values), balls, before)
        return out.velocity, out.status

    velocity, status = jax.jit(jax.vmap(one))(jnp.asarray(e), *others)
    return np.where(_FAILS[status][:, None], np.nan, velocity)


def _gaps(velocity: np.ndarray) -> np.ndarray:
    """Gap velocities (k, 2)."""
    return np.diff(velocity, axis=-1)


def _region(axes: Axes, corners: np.ndarray, colour: str, name: str) -> None:
    """The image of a square of parameters, from the images (k, k, 2) of its grid."""
    around = corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]
    cells = np.stack(around, axis=2).reshape(-1, 4, 2)
    cells = cells[np.isfinite(cells).all(axis=(1, 2))]
    axes.add_collection(PolyCollection(cells, fc=colour, ec=colour, lw=0.5, label=name))


def _energy_arc(kept: float) -> np.ndarray:
    """Outcomes (k, 2) of energy ratio `kept`: gamma1^2 + gamma1 gamma2 + gamma2^2 = r^2."""
    angle = np.linspace(0, np.pi / 2, 101)
    x, y = np.cos(angle), np.sin(angle)
    size = np.sqrt((3 * kept - 1) / 2 / (x * x + x * y + y * y))
    return np.stack([size * x, size * y], axis=-1)


def two_balls() -> Figure:
    """Figure 6.3a: momentum is a line, energy a circle, and only one point is admissible."""
    figure = new_figure(5.2)
    axes = figure.subplots()
    angle = np.linspace(0, 2 * np.pi, 200)
    axes.plot(np.cos(angle), np.sin(angle), color="black", label="energy")
    x = np.array([-0.25, 1.25])
    axes.plot(x, 1 - x, color=COLOURS[0], label="momentum")
    side = np.array([-1.3, 1.3])
    axes.plot(side, side, color=GREY, lw=1, ls="--", label="$V_1^+ = V_2^+$")
    axes.fill_between(
        side, side, 1.3, color=COLOURS[4], alpha=0.2, lw=0, label="admissible"
    )
    axes.plot(1, 0, "o", color="black", mfc="none", ms=9, ls="none", label="before")
    axes.plot(0, 1, "o", color=COLOURS[1], ms=9, ls="none", label="after")
    axes.set_aspect("equal")
    axes.set_xlim(-1.3, 1.3)
    axes.set_ylim(-1.3, 1.3)
    axes.set_xlabel("$V_1^+$ [m/s]")
    axes.set_ylabel("$V_2^+$ [m/s]")
    finish(axes)
    legend_below(figure, axes.get_legend_handles_labels()[0], 6)
    return figure


def sphere() -> Figure:
    """Figure 6.3b: the plane P1 cuts the sphere of energy; P2 and P3 bound the arc AB."""
    figure = new_figure(6.8)
    axes: Any = figure.add_subplot(projection="3d")
    _ball_of_energy(axes)
    balls, before = ji.chain([1.0, 1.0, 1.0]), np.array([1.0, 0.0, 0.0])
    arc = ji.theory.admissible_set(balls, before).conserving_arc(60)
    axes.plot(*arc.T, color="black", lw=3)
    laws = {
        "newton": ji.Newton(1.0),
        "moreau": ji.Moreau(1.0),
        "binary": ji.Binary(1.0),
        "impulse correlation": ji.ImpulseCorrelation(1.0, ratio=_RATIO),
        "LZB": ji.LZB(1.0, [1.0, 1.0]),
        "LZB, linear": ji.LZB(1.0, [1.0, 1.0], exponent=1.0),
    }
    for i, (name, law) in enumerate(laws.items()):
        axes.plot(
            *ji.impact(law, balls, before).velocity,
            "osD^vP*Xhpd"[i],
            ms=max(10 - i, 4),
            ls="none",
            label=name,
        )
    for i, set_label in enumerate((axes.set_xlabel, axes.set_ylabel, axes.set_zlabel)):
        set_label(f"$V_{i + 1}^+$ [m/s]")
    for axis in "xyz":
        getattr(axes, f"set_{axis}lim")(-1, 1)
        getattr(axes, f"set_{axis}ticks")((-1, 0, 1))
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(20, 62)
    for name, at in (("A", 1.12 * _A), ("B", 1.3 * _B)):
        x, y, _ = proj_transform(*at, axes.get_proj())
        write(axes, (x, y), name, fontsize="x-large", fontweight="bold")
    handles = axes.get_legend_handles_labels()[0]
    legend_below(figure, handles, 4)
    return figure


def _ball_of_energy(axes: Any) -> None:
    """The sphere of energy and the planes P1 of momentum, P2 and P3 of the contacts."""
    u, w = np.meshgrid(np.linspace(0, 2 * np.pi, 37), np.linspace(0, np.pi, 19))
    x, y, z = np.cos(u) * np.sin(w), np.sin(u) * np.sin(w), np.cos(w)
    axes.plot_wireframe(x, y, z, color=GREY, lw=0.3, alpha=0.5)
    circle = np.linspace(0, 2 * np.pi, 90)[:, None]
    centre, right = np.full(3, 1 / 3), (_A - 1 / 3) / np.linalg.norm(_A - 1 / 3)
    up = np.array([-1, 1, 0]) / np.sqrt(2)
    disc = centre + np.sqrt(2 / 3) * (np.cos(circle) * right + np.sin(circle) * up)
    one = np.ones(3) / np.sqrt(3)
    sides = [
        np.array([[0, 0, 0], out, out + one, one])
        for out in (1.2 * right, 1.2 * (_B - 1 / 3))
    ]
    names = "P1: momentum", "P2: contact 1 closed", "P3: contact 2 closed"
    for i, (shape, name) in enumerate(zip((disc, *sides), names, strict=True)):
        colour = COLOURS[(4, 5, 2)[i]]
        axes.add_collection3d(
            Poly3DCollection([shape], fc=colour, alpha=0.3, lw=0, label=name)
        )


def block_domain() -> Figure:
    """Figure 6.7b: heights and angles at which no corner of the block is below the ground."""
    figure = new_figure(4.2)
    axes = figure.subplots()
    theta = np.linspace(-np.pi / 2, np.pi / 2, 201)
    for i, (width, height) in enumerate(((1.0, 0.5), (1.0, 2.0))):
        block = ji.Block(width, height, corners="base")
        at = jnp.asarray(np.stack([0 * theta, 0 * theta, theta], axis=1))
        gaps = jax.vmap(block.gap_function)(at)
        lowest = -np.asarray(gaps).min(axis=1)
        name = f"l/L = {height / width:g}"
        axes.plot(theta, lowest, color=COLOURS[i], lw=2, label=name)
        axes.fill_between(theta, lowest, 1.6, color=COLOURS[i], alpha=0.12, lw=0)
        for j, style in enumerate((":", "--")):
            axes.plot(theta, -np.asarray(gaps)[:, j], style, color=COLOURS[i], lw=1)
    axes.plot([], [], ":", color="black", label="$f_1 = 0$ (B)")
    axes.plot([], [], "--", color="black", label="$f_2 = 0$ (A)")
    axes.set_xlim(theta[0], theta[-1])
    axes.set_ylim(0, 1.6)
    axes.set_xlabel(r"$\theta$ [rad]")
    axes.set_ylabel("height y of the centre over L = 1 m [m]")
    finish(axes)
    legend_below(figure, axes.get_legend_handles_labels()[0], 4)
    return figure


def critical_angle() -> Figure:
    """Figure 6.8b: the V of the dispersion factor, and where its tip is for every mu."""
    figure = new_figure(4.2)
    left, right = figure.subplots(1, 2)
    mus, es = [0.0, 0.1, 0.3, 0.8], [0.5, 1.0]
    cosine = np.cos(ji.theory.critical_kinetic_angle(mus))
    tips = np.sqrt(
        (2 - 4 * cosine) / (1 + cosine)
    )  # the aspects that have these kinetic angles
    aspects = np.sort(np.concatenate([np.linspace(0.35, 4.5, 36), tips]))
    found = ji.theory.rocking_dispersion(aspects, mus, es)
    theta, size = np.degrees(found.kinetic_angle), np.abs(found.dispersion)
    for j, mu in enumerate(mus):
        for k, style in enumerate(("--", "-")):
            left.plot(theta, size[:, j, k], style, color=COLOURS[j], lw=1.4)
        left.plot([], [], color=COLOURS[j], label=rf"$\mu$ = {mu:g}")
    left.plot([], [], "--", color="black", label="e = 0.5")
    left.plot([], [], "-", color="black", label="e = 1")
    left.set_xlabel(r"kinetic angle $\theta_{12}$ [degrees]")
    left.set_ylabel(r"dispersion $|\dot y_A^+ / \dot y_B^-|$")
    left.set_ylim(bottom=0)
    friction = np.linspace(0, 1, 101)
    angle = np.degrees(ji.theory.critical_kinetic_angle(friction))
    right.plot(friction, angle, color="black", label="for every e")
    right.plot(
        mus,
        np.degrees(ji.theory.critical_kinetic_angle(mus)),
        "o",
        color=COLOURS[1],
        ls="none",
    )
    right.set_xlabel(r"friction ratio $\mu$")
    right.set_ylabel("critical kinetic angle [degrees]")
    finish(left, right)
    legend_within(right)
    legend_below(figure, left.get_legend_handles_labels()[0], 6)
    return figure


def dispersion() -> Figure:
    """Figure 6.9: LZB between binary collisions, which disperse nothing, and Moreau's law."""
    balls, before = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
    found = ji.validity_map(balls, before)
    figure = new_figure(4.6)
    axes = figure.subplots()
    spread = jax.vmap(jax.vmap(lambda v: ji.theory.energy_dispersion(balls, v)))(
        jnp.asarray(found.velocity)
    )
    for i, eta in enumerate(found.exponents):
        axes.plot(
            found.ratios,
            spread[i],
            color=COLOURS[i],
            lw=2,
            label=rf"LZB, $\eta$ = {eta:g}",
        )
    for name, style in (("binary", "--"), ("moreau", ":")):
        level = float(ji.theory.energy_dispersion(balls, found.laws[name]))
        axes.axhline(level, color="black", ls=style, label=name)
    axes.set_ylim(0, 1.5)
    axes.set_xscale("log")
    axes.set_xlabel("stiffness ratio k2/k1")
    axes.set_ylabel("energy dispersion C_KE")
    finish(axes)
    legend_below(figure, axes.get_legend_handles_labels()[0], 6)
    return figure


FIGURES = {
    "5.5": ("outcomes of the 3-ball chain: which part each law can reach", reached),
    "6.1": ("a column of beads falls on the ground", column),
    "6.2": ("force at the wall under columns of beads", wall_forces),
    "6.3a": ("outcomes of two balls: a line and a circle meet once", two_balls),
    "6.3b": ("outcomes of three balls: the arc AB of the sphere", sphere),
    "6.4": ("the 3-ball system", three_balls),
    "6.5": ("three balls with unilateral elastic contacts", springs),
    "6.6": ("force and indentation of a contact compressed twice", loop),
    "6.7a": ("the rocking block", block),
    "6.7b": ("admissible domain of the rocking block", block_domain),
    "6.8a": ("the bouncing dimer", dimer),
    "6.8b": ("critical kinetic angle of the rocking block", critical_angle),
    "6.9": ("C_KE against k2/k1: Moreau, binary collisions, LZB", dispersion),
}


def draw(number: str) -> Figure:
    """The figure with this number."""
    caption, function = FIGURES[number]
    figure = function()
    figure.suptitle(f"Figure {number}: {caption}", x=0.01, ha="left", fontsize="large")
    return figure
