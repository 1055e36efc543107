"""Pictures of laws side by side, of contact forces and of force histories."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from jimpact.laws.histories import History
from jimpact.methods.comparison import Comparison
from jimpact.plot.style import (
    COLOURS,
    GREY,
    HIGHLIGHT,
    colour_of,
    legend_below,
    mark,
    new_figure,
    panels_of_laws,
    side_by_side,
    styled,
    write,
)
from jimpact.theory.admissible import admissible_set
from jimpact.theory.dispersion import energy_dispersion, energy_ratio
from jimpact.tools.records import readable_unit

_OUTCOMES = 4000  # dots of a set of outcomes; ten times more would only be one area


@styled(Comparison)
def comparison(
    result: Comparison,
    measured: np.ndarray | None = None,
    title: str = "",
    names: Sequence[str] = (),
) -> Figure:
    """Velocities after the impact by law, energy ratios T+/T- and dispersion indices.

    Measured velocities are horizontal lines, and the laws closest to them are highlighted; a law
    whose outcome fails the audit is crossed.

    Args:
        result: what `ji.compare` returned.
        measured: v+ (n,) [m/s]; None: those of `result`, if it has any.
        title: above the picture.
        names: of the velocities with their units, as `body.velocity_names`: each unit has a panel
            of its own. Without names those of a chain are in m/s; others stand times the root of
            their inertia, in √J.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else. ValueError: another number of names.

    >>> import jimpact as ji
    >>> result = ji.compare(ji.chain([1.0, 1.0]), [1.0, 0.0], {"Newton": ji.Newton(0.5)})
    >>> len(ji.plot.comparison(result).axes)
    2
    """
    if measured is not None:
        result = dataclasses.replace(result, measured=np.asarray(measured))
    laws, entries = list(result.entries), list(result.entries.values())
    figure, tops, bottom = panels_of_laws(laws, result.scene, names, title, 1.2)
    at, velocity = np.arange(len(entries)), np.array([x.outcome.velocity for x in entries])
    wrong = ~np.array([bool(entry.audit.consistent) for entry in entries])
    for top, velocities in tops:  # a panel for each unit: index, name and factor of each velocity
        for (i, label, factor), offset in zip(velocities, side_by_side(len(velocities))):
            x, y, colour = at + offset, factor * velocity[:, i], colour_of(i)
            top.plot(x, y, "o", color=colour, label=label)
            top.plot(x[wrong], y[wrong], "x", color="black", ms=10)
            if result.measured is not None:
                level = [factor * result.measured[i]] * 2
                top.plot([-0.5, len(at) - 0.5], level, "--", color=colour, lw=1, zorder=0)
        top.axhline(0, color="black", lw=0.6)
    if result.measured is not None:
        bottom.plot([], [], "--", color="black", lw=1, label="measured")
    if wrong.any():
        bottom.plot([], [], "x", color="black", ms=10, label="audit failed")
    kept, spread = [x.energy_ratio for x in entries], [x.dispersion_index for x in entries]
    bottom.bar(at - 0.18, kept, 0.32, color=GREY, label="energy ratio T+/T-")
    bottom.bar(at + 0.18, spread, 0.32, color=COLOURS[4], label="dispersion index")
    bottom.set_ylabel("ratio, index")
    for place in map(laws.index, result.closest):
        label = "closest to the measured velocities"
        for axes in figure.axes:
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
    """Energy ratio K_ER = T+/T- (k,) and energy dispersion C_KE (k,) of velocities v+ (k, n)."""
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
    for name, h in histories.items():
        axes.plot(np.asarray(h.time) / size, h.force[:, contact], label=name)
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
    until = slice(0, touching[-1] + 2 if len(touching) else 1)  # to the first state without force
    unit, size = readable_unit("m", float(np.max(np.abs(result.approach[:, contact]))))
    x, force = np.asarray(result.approach[until, contact]) / size, force[until]
    figure, axes = new_figure(4.4, title)
    axes.plot(x, force, color=COLOURS[0], lw=1.8)
    axes.fill(x, force, color=COLOURS[4], alpha=0.2, lw=0)
    # states at which the gap velocity changes sign
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
    time, contacts = np.asarray(result.time) / size, result.force.shape[1]
    figure, panels = new_figure(6.8, title, 3, 1, sharex=True)
    rows = {
        "force [N]": result.force,
        "gap velocity [m/s]": result.gap_velocity,
        "stored energy [J]": result.energy,
    }
    for axes, (label, values) in zip(panels, rows.items(), strict=True):
        axes.plot(time, values, label=[f"contact {j + 1}" for j in range(contacts)])
        axes.set_ylabel(label)
    for j, y in enumerate(np.asarray(result.tangential_force).T):
        colour = colour_of(j * contacts // result.tangential_force.shape[1])
        panels[0].plot(time, y, "--", color=colour, label="tangential" if j == 0 else None)
    panels[1].axhline(0, color=GREY, lw=0.8)
    panels[-1].set_xlabel(f"impact time [{unit}]")
    legend_below(figure, 5, panels[0].get_legend_handles_labels()[0][: len(COLOURS)])
    return figure
