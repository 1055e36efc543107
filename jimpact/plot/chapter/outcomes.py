"""Figures of outcomes: what mechanics allows, what laws reach, how they spread the energy."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform
from scipy.spatial import ConvexHull

from jimpact.bodies.blocks import Block
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.laws.binary import Binary
from jimpact.laws.lzb import LZB
from jimpact.laws.poisson import Poisson
from jimpact.methods.comparison import energy_dispersion
from jimpact.methods.validity import validity_map
from jimpact.plot.style import (
    COLOURS,
    GREY,
    ON_LINES,
    finish,
    legend_below,
    legend_within,
    logarithmic,
    mark,
    new_figure,
    write,
)
from jimpact.registry import registered_laws
from jimpact.scene import chain
from jimpact.status import STATUS
from jimpact.theory.admissible import admissible_set
from jimpact.theory.rocking import critical_kinetic_angle, rocking_dispersion

_A, _B = np.array([0.0, 0.0, 1.0]), np.array([-1 / 3, 2 / 3, 2 / 3])  # ends of the arc AB
_GRID = 31  # values of e1 and of e2 whose outcomes fill a region; ten times more looks the same
_RATIOS = np.geomspace(1e-2, 1e2, 41)  # k2/k1 of the curves of LZB in figure 5.5
_RATIO = 0.8  # impulse correlation ratio of figure 6.3b: from 0.5, where B is, to 1, where A is
_PALE = "#C5DCEE"  # behind lines
_FAILS = np.array([row.failure for row in STATUS])


def reached() -> Figure:
    """Figure 5.5: the plane of the gap velocities after, and the parts of it that laws reach."""
    figure = new_figure(6.0)
    axes = figure.subplots()
    e = np.linspace(0, 1, _GRID)
    pairs = np.stack(np.meshgrid(e, e, indexing="ij"), axis=-1)
    binary, poisson = (_gaps(_outcomes(law, pairs.reshape(-1, 2))) for law in (Binary, Poisson))
    _region(axes, binary.reshape(_GRID, _GRID, 2), _PALE, "II: binary collisions")
    around = poisson[ConvexHull(poisson).vertices]
    axes.fill(*around.T, fc="none", ec=COLOURS[2], ls="--", lw=1.5, label="Poisson, e <= 1")
    for kept in (0.4, 0.6, 0.8, 1.0):
        axes.plot(*_energy_arc(kept).T, color="black", lw=2 if kept == 1 else 0.8)
        write(axes, _energy_arc(kept)[35], f"K_ER = {kept:g}", bbox=ON_LINES)
    stiffness = jnp.stack([jnp.ones(len(_RATIOS)), jnp.asarray(_RATIOS)], axis=-1)
    for colour, each in zip((1, 3, 5), (1.0, 0.9, 0.5), strict=True):
        gaps = _gaps(_outcomes(LZB, np.full(stiffness.shape, each), stiffness))
        axes.plot(*gaps.T, color=COLOURS[colour], lw=2.4, label=f"LZB, e = {each:g}")
    axes.plot([0, 1], [0, 0], color=COLOURS[4], lw=4, label="Moreau", clip_on=False, zorder=3)
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


def _outcomes(law: Callable[..., Law], e: Any, *others: Any) -> np.ndarray:
    """v+ (k, 3) of three equal balls by a law with these e (k, 2), ...; NaN where it fails."""
    balls, before = chain([1.0, 1.0, 1.0]), jnp.array([1.0, 0.0, 0.0])

    def one(*values: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of one set of parameters."""
        out = impact(law(*values), balls, before)
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
    axes.fill_between(side, side, 1.3, color=COLOURS[4], alpha=0.2, lw=0, label="admissible")
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
    balls, before = chain([1.0, 1.0, 1.0]), np.array([1.0, 0.0, 0.0])
    arc = admissible_set(balls, before).conserving_arc(60)
    axes.plot(*arc.T, color="black", lw=3)
    values = {"restitution": 1.0, "stiffness": [1.0, 1.0], "matrix": np.eye(2), "ratio": _RATIO}
    laws, _ = registered_laws(values)
    for i, (name, law) in enumerate(laws.items()):
        mark(axes, np.asarray(impact(law, balls, before).velocity), name, i, True)
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
        np.array([[0, 0, 0], out, out + one, one]) for out in (1.2 * right, 1.2 * (_B - 1 / 3))
    ]
    names = "P1: momentum", "P2: contact 1 closed", "P3: contact 2 closed"
    for i, (shape, name) in enumerate(zip((disc, *sides), names, strict=True)):
        colour = COLOURS[(4, 5, 2)[i]]
        axes.add_collection3d(Poly3DCollection([shape], fc=colour, alpha=0.3, lw=0, label=name))


def block_domain() -> Figure:
    """Figure 6.7b: heights and angles at which no corner of the block is below the ground."""
    figure = new_figure(4.2)
    axes = figure.subplots()
    theta = np.linspace(-np.pi / 2, np.pi / 2, 201)
    for i, (width, height) in enumerate(((1.0, 0.5), (1.0, 2.0))):
        block = Block(width, height, corners="base")
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
    cosine = np.cos(critical_kinetic_angle(mus))
    tips = np.sqrt((2 - 4 * cosine) / (1 + cosine))  # the aspects that have these kinetic angles
    aspects = np.sort(np.concatenate([np.linspace(0.35, 4.5, 36), tips]))
    found = rocking_dispersion(aspects, mus, es)
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
    angle = np.degrees(critical_kinetic_angle(friction))
    right.plot(friction, angle, color="black", label="for every e")
    right.plot(mus, np.degrees(critical_kinetic_angle(mus)), "o", color=COLOURS[1], ls="none")
    right.set_xlabel(r"friction ratio $\mu$")
    right.set_ylabel("critical kinetic angle [degrees]")
    finish(left, right)
    legend_within(right)
    legend_below(figure, left.get_legend_handles_labels()[0], 6)
    return figure


def dispersion() -> Figure:
    """Figure 6.9: LZB between binary collisions, which disperse nothing, and Moreau's law."""
    balls, before = chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
    found = validity_map(balls, before)
    figure = new_figure(4.6)
    axes = figure.subplots()
    spread = jax.vmap(jax.vmap(lambda v: energy_dispersion(balls, v)))(jnp.asarray(found.velocity))
    for i, eta in enumerate(found.exponents):
        axes.plot(found.ratios, spread[i], color=COLOURS[i], lw=2, label=rf"LZB, $\eta$ = {eta:g}")
    for name, style in (("binary", "--"), ("moreau", ":")):
        level = float(energy_dispersion(balls, found.laws[name]))
        axes.axhline(level, color="black", ls=style, label=name)
    axes.set_ylim(0, 1.5)
    logarithmic(axes, "x")
    axes.set_xlabel("stiffness ratio k2/k1")
    axes.set_ylabel("energy dispersion C_KE")
    finish(axes)
    legend_below(figure, axes.get_legend_handles_labels()[0], 6)
    return figure
