"""Pictures of laws side by side, of contact forces and of force histories."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from jimpact.files.records import readable_unit
from jimpact.laws.histories import History
from jimpact.methods.comparison import Comparison
from jimpact.plot.style import (
    COLOURS,
    GREY,
    HIGHLIGHT,
    SMALL,
    colour_of,
    legend_below,
    mark,
    new_figure,
    side_by_side,
    styled,
    wrapped,
    write,
)
from jimpact.theory.admissible import admissible_set
from jimpact.theory.dispersion import energy_dispersion, energy_ratio

_UPRIGHT = 8  # names that stand side by side, at most
_OUTCOMES = 4000  # dots of a set of outcomes; ten times more would only be one area


@styled(Comparison)
def comparison(result: Comparison, measured: np.ndarray | None = None, title: str = "") -> Figure:
    """Velocities after the impact by law, energy ratios T+/T- and dispersion indices.

    Measured velocities are horizontal lines, and the laws closest to them are highlighted; a law
    whose outcome fails the audit is crossed.

    Args:
        result: what `ji.compare` returned.
        measured: v+ (n,) [m/s]; None: those of `result`, if it has any.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> result = ji.compare(ji.chain([1.0, 1.0]), [1.0, 0.0], {"Newton": ji.Newton(0.5)})
    >>> len(ji.plot.comparison(result).axes)
    2
    """
    if measured is not None:
        result = dataclasses.replace(result, measured=np.asarray(measured))
    entries, chain = list(result.entries.values()), result.scene.walls is not None
    figure, panels = new_figure(6.0, title, 2, 1, sharex=True, height_ratios=(3, 1.4))
    top, bottom = panels
    velocity = np.array([entry.outcome.velocity for entry in entries])
    laws, bodies = velocity.shape
    at = np.arange(laws)
    x = at[:, None] + side_by_side(bodies)
    for i in range(bodies):
        label = f"{'body' if chain else 'coordinate'} {i + 1}"
        top.plot(x[:, i], velocity[:, i], "o", color=colour_of(i), label=label)
        if result.measured is not None:
            style: dict[str, Any] = {"lw": 1, "ls": "--", "zorder": 0, "color": colour_of(i)}
            top.plot([-0.5, laws - 0.5], [result.measured[i]] * 2, **style)
    top.axhline(0, color="black", lw=0.6)
    if result.measured is not None:
        top.plot([], [], color="black", lw=1, ls="--", label="measured")
    wrong = ~np.array([bool(entry.audit.consistent) for entry in entries])
    if wrong.any():
        crosses = x[wrong].ravel(), velocity[wrong].ravel()
        top.plot(*crosses, "x", color="black", ms=10, label="audit failed")
    top.set_ylabel(f"velocity after the impact [{'m/s' if chain else 'm/s, rad/s'}]")
    kept, spread = [x.energy_ratio for x in entries], [x.dispersion_index for x in entries]
    bottom.bar(at - 0.18, kept, 0.32, color=GREY, label="energy ratio T+/T-")
    bottom.bar(at + 0.18, spread, 0.32, color=COLOURS[4], label="dispersion index")
    bottom.set(xlabel="law", ylabel="ratio, index")
    many = laws > _UPRIGHT
    labels = [name if many else wrapped(name) for name in result.entries]
    bottom.set_xticks(at, labels, fontsize=SMALL, rotation=90 if many else 0)
    for axes in panels:
        axes.grid(False, axis="x")
        for name in result.closest:
            place, label = list(result.entries).index(name), "closest to the measured velocities"
            axes.axvspan(place - 0.48, place + 0.48, color=HIGHLIGHT, lw=0, zorder=-1, label=label)
    legend_below(figure, 4)
    return figure


@styled(Comparison)
def energy_plane(result: Comparison, title: str = "") -> Figure:
    """Every law in the plane of energy kept (K_ER = T+/T-) and of its dispersion (C_KE).

    Dots are samples of the outcomes that mechanics allows; a law whose outcome fails the audit is
    hollow.

    Args:
        result: what `ji.compare` returned.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> result = ji.compare(ji.chain([1.0, 1.0]), [1.0, 0.0], {"Newton": ji.Newton(0.5)})
    >>> ji.plot.energy_plane(result).axes[0].get_xlabel()
    'energy ratio K_ER = T+/T-'
    """
    figure, axes = new_figure(5.4, title)
    allowed = admissible_set(result.scene, result.velocity).sample(0, _OUTCOMES)
    axes.plot(
        *_kept_and_spread(result, allowed), ".", color=COLOURS[4], alpha=0.3, ms=3, label="allowed"
    )
    for i, (name, entry) in enumerate(result.entries.items()):
        at = _kept_and_spread(result, np.asarray(entry.outcome.velocity)[None])
        mark(axes, np.ravel(at), name, i, bool(entry.audit.consistent))
    axes.set(xlabel="energy ratio K_ER = T+/T-", ylabel="energy dispersion C_KE (0: equal shares)")
    legend_below(figure, 4)
    return figure


def _kept_and_spread(result: Comparison, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """K_ER and C_KE (k,) of velocities after (k, n)."""
    v, scene = jnp.asarray(after), result.scene
    kept = jax.vmap(lambda x: energy_ratio(scene, result.velocity, x))(v)
    return np.asarray(kept), np.asarray(jax.vmap(lambda x: energy_dispersion(scene, x))(v))


@styled()
def forces(histories: Mapping[str, History], contact: int = -1) -> Figure:
    """Force at one contact over impact time, one line a history.

    Args:
        histories: label -> what `ji.history` returned.
        contact: counted from 0; -1: the last one.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    >>> import jimpact as ji
    >>> h = ji.history(ji.LZB(1.0), ji.chain([1.0], wall=True), [1.0])
    >>> len(ji.plot.forces({"one ball": h}).axes[0].lines)
    1
    """
    figure, axes = new_figure(4.2)
    unit, size = readable_unit("s", max(float(h.duration) for h in histories.values()))
    for j, (name, h) in enumerate(histories.items()):
        time, force = np.asarray(h.time) / size, np.asarray(h.force[:, contact])
        axes.plot(time, force, color=colour_of(j), label=name)
    axes.set(xlabel=f"impact time [{unit}]", ylabel="force [N]")
    axes.set_ylim(bottom=0)
    axes.legend()
    return figure


@styled(History)
def contact_loop(result: History, contact: int = -1, title: str = "") -> Figure:
    """Force of one contact against its true approach; between the ends it encloses the lost energy.

    O begins, M1, M2, ... end compressions, R1, R2, ... are where a contact that expands is
    compressed again, B is the end with the residual indentation.

    Args:
        result: what `ji.history` returned, of one impact.
        contact: counted from 0; -1: the last one.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a batch of impacts. TypeError: something else.

    >>> import jimpact as ji
    >>> h = ji.history(ji.LZB(0.8), ji.chain([1.0], wall=True), [1.0])
    >>> [text.get_text() for text in ji.plot.contact_loop(h).axes[0].texts]
    ['O', 'M1', 'B']
    """
    _check_one(result)
    force, rate = np.asarray(result.force[:, contact]), np.asarray(result.gap_velocity[:, contact])
    touching = np.flatnonzero(force > 0)
    until = slice(0, touching[-1] + 2 if len(touching) else 1)
    unit, size = readable_unit("m", float(np.max(np.abs(result.approach[:, contact]))))
    x, force = np.asarray(result.approach[until, contact]) / size, force[until]
    figure, axes = new_figure(4.4, title)
    axes.plot(x, force, color=COLOURS[0], lw=1.8)
    axes.fill(x, force, color=COLOURS[4], alpha=0.2, lw=0)
    turns = np.flatnonzero(np.diff(rate[until] > 0)) if len(touching) else np.zeros(0, int)
    names = [f"{'MR'[i % 2]}{i // 2 + 1}" for i in range(len(turns))]
    for name, i in zip(["O", *names, "B"], [0, *turns, len(x) - 1], strict=True):
        above = (0, -10) if name[0] == "R" else (0, 10)
        axes.plot(x[i], force[i], "o", color="black", ms=4)
        write(axes, (x[i], force[i]), name, xytext=above, textcoords="offset points")
    axes.margins(y=0.12)
    axes.set(xlabel=f"approach of the bodies [{unit}]", ylabel="force [N]")
    return figure


def _check_one(result: History) -> None:
    """Refuse batches of impacts."""
    if np.ndim(result.status):
        raise ValueError("Argument `result` must be of one impact, but is a batch: pick one of it.")


@styled(History)
def history(result: History, title: str = "") -> Figure:
    """One impact over its time: forces, gap velocities and stored energy of every contact.

    Args:
        result: what `ji.history` returned, of one impact.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a batch of impacts. TypeError: something else.

    >>> import jimpact as ji
    >>> h = ji.history(ji.LZB(1.0), ji.chain([1.0], wall=True), [1.0])
    >>> [axes.get_ylabel() for axes in ji.plot.history(h).axes]
    ['force [N]', 'gap velocity [m/s]', 'stored energy [J]']
    """
    _check_one(result)
    unit, size = readable_unit("s", float(result.duration))
    time, rows = np.asarray(result.time) / size, [result.force, result.gap_velocity, result.energy]
    figure, panels = new_figure(6.8, title, 3, 1, sharex=True)
    words = ("force [N]", "gap velocity [m/s]", "stored energy [J]")
    for axes, values, label in zip(panels, rows, words, strict=True):
        for j, y in enumerate(np.asarray(values).T):
            axes.plot(time, y, color=colour_of(j), label=f"contact {j + 1}")
        axes.set_ylabel(label)
    friction = np.asarray(result.tangential_force)
    each = friction.shape[1] // result.force.shape[1]
    for j, y in enumerate(friction.T):
        colour = colour_of(j // each)
        panels[0].plot(time, y, "--", color=colour, label="tangential" if j == 0 else None)
    panels[1].axhline(0, color=GREY, lw=0.8)
    panels[-1].set_xlabel(f"impact time [{unit}]")
    legend_below(figure, 5, panels[0].get_legend_handles_labels()[0][: len(COLOURS)])
    return figure
