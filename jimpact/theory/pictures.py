"""Pictures of admissible sets and of rocking blocks."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jimpact.core.contact import kinetic_norm
from jimpact.core.scene import dense_mass
from jimpact.plot.style import (
    COLOURS,
    COLUMNS,
    GREY,
    SMALL,
    by_code,
    legend_below,
    mark,
    new_figure,
    new_panels,
    styled,
    write,
)
from jimpact.theory.admissible import AdmissibleSet
from jimpact.theory.rocking import (
    OUTCOMES,
    STAYS,
    RockingDispersion,
    RockingDomain,
    critical_kinetic_angle,
)

_FILL = "#DCE9F3"
# Beyond two contacts: projections onto pairs of the first ones up to this number.
_MOST_CONTACTS = 4
_SAMPLES = 2000  # points drawn of a set of outcomes
# sides shorter than this part of the radius are not drawn: no space for a name
_SHORTEST = 0.5

# as OUTCOMES
_OUTCOME_COLOURS = ("#999999", "#009E73", "#E69F00", "#56B4E9", "#EEEEEE")


@styled(AdmissibleSet)
def admissible_set(
    result: AdmissibleSet, outcomes: Mapping[str, Any] | None = None, title: str = ""
) -> Figure:
    """The set of admissible outcomes, and labelled outcomes v+ (n,) of laws.

    Two contacts: the plane of kinetic coordinates, where energy is the squared distance
    from the point of common velocity; the arc A-B conserves it (Brogliato 2016, Fig.
    6.3). Otherwise samples of the set, in the normalized gap velocities of pairs of
    contacts, coloured by the energy ratio T+/T-; for one contact, against it.

    Args:
        result: what `admissible_set` returned.
        outcomes: label -> v+ (n,) [m/s], an `Impact.velocity` for instance; drawn even
            when they are not admissible (hollow).
        title: empty for a default one.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: an outcome of another size.

    >>> import jimpact as ji
    >>> result = ji.theory.admissible_set(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])
    >>> len(ji.plot.admissible_set(result, {"Newton's cradle": [0.0, 0.0, 1.0]}).axes)
    1
    """
    given = (outcomes or {}).items()
    marked = {name: np.asarray(v, float) for name, v in given}
    for name, v in marked.items():
        if v.shape != (result.scene.size,):
            raise ValueError(
                f"Argument `outcomes` must have arrays of shape "
                f"({result.scene.size},), but {name!r} has shape {v.shape}."
            )
    closed = np.flatnonzero(np.asarray(result.scene.closed))
    plane = result.dimension == 2 and len(closed) == 2
    if not len(closed):
        closed = np.arange(result.scene.contacts)
    if plane:
        draw = _draw_plane
    else:
        draw = _draw_projections
    default = "Admissible: unilateral contact, pushing impulses, no energy gained"
    return draw(result, marked, closed, title or default)


def _draw_plane(
    result: AdmissibleSet,
    marked: Mapping[str, np.ndarray],
    closed: np.ndarray,
    title: str,
) -> Figure:
    """Draw the set of two contacts in the plane of kinetic coordinates, with marked
    outcomes.

    Sides are `gamma_k+ = 0` and `p_k = 0`, the arc is T+ = T-; `closed` are both
    contacts.
    """
    frame = _TurnedCoordinates(result, closed)
    figure, axes = new_figure(7.6, title)
    circle = np.linspace(0, 2 * np.pi, 400)
    r = frame.radius
    x = r * np.cos(circle)
    y = r * np.sin(circle)
    axes.plot(x, y, color=GREY, lw=0.8, ls=(0, (4, 3)))
    boundary = frame(result.boundary(400))
    axes.fill(*boundary.T, color=_FILL, lw=0)
    # gamma_k+ = 0 from u = 0; p_k = 0 from v- along the other contact's push
    for k in (0, 1):
        number = closed[k] + 1
        words = f"contact {number} remains closed"
        _draw_side(axes, frame, np.zeros(2), frame.walls[k], words, "-")
        away = frame.push[1 - k]
        _draw_side(
            axes, frame, frame.before, away, f"no impulse at contact {number}", ":"
        )
    arc = frame(result.conserving_arc(200))
    axes.plot(*arc.T, color="black", lw=2.4, solid_capstyle="round")
    middle = arc[len(arc) // 2]
    write(axes, middle * 1.13, "$T^+ = T^-$", fontsize="medium")
    ends = (("A", arc[0]), ("B", arc[-1]))
    for name, end in ends:
        write(axes, end * 1.09, name, fontsize="x-large", fontweight="bold")
    label = "before the impact"
    axes.plot(*frame.before, "o", color="black", ms=8, ls="none", label=label)
    plastic = frame(result.plastic)
    mark(axes, plastic, "plastic, least energy", i=-1, admissible=True)
    for i, (name, v) in enumerate(marked.items()):
        admissible = bool(result.contains(v))
        mark(axes, frame(v), name, i, admissible)
    axes.grid(visible=False)
    limits = (-1.22 * r, 1.22 * r)
    axes.set(aspect="equal", xlim=limits, ylim=limits)
    axes.set_xlabel("kinetic coordinate $u_1$ [√J];  energy is $T^+ = T_c + |u|^2/2$")
    axes.set_ylabel("kinetic coordinate $u_2$ [√J]")
    legend_below(figure, 3)
    return figure


class _TurnedCoordinates:
    """Kinetic coordinates u (2,) [sqrt(J)] turned so that outcomes with gamma+ >= 0
    open upwards.

    `push` and `walls` (2, 2): a unit vector for each contact, along the change of u by
    its impulse, and along the line on which it stays closed and the other contact
    opens. `before`: u of v-.
    """

    def __init__(self, result: AdmissibleSet, closed: np.ndarray):
        """Turn the coordinates of a set with two closed contacts (indices)."""
        self._set = result
        self._metric = result.axes.T @ dense_mass(result.scene)
        self.radius = result.coordinates.radius
        n = np.asarray(result.scene.normals, float)[:, closed]
        normals = n.T @ result.axes
        push = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        sum_of_pushes = push.sum(0)
        up = sum_of_pushes / np.linalg.norm(sum_of_pushes)
        right = np.array([up[1], -up[0]])
        if right @ push[0] < 0:
            right = -right
        self._turn = np.stack([right, up])
        self.push = push @ self._turn.T
        # perpendicular to push k, on the side to which the other impulse pushes
        walls = np.stack([[-p[1], p[0]] for p in self.push])
        towards = np.sum(walls * self.push[::-1], axis=1)
        self.walls = walls * np.sign(towards)[:, None]
        self.before = self(result.velocity)

    def __call__(self, velocity: np.ndarray) -> np.ndarray:
        """Turned coordinates `u = R axes^T M (v - centre)` (..., 2) of velocities v
        (..., n).
        """
        from_centre = velocity - self._set.centre
        return from_centre @ self._metric.T @ self._turn.T


def _draw_side(
    axes: Axes,
    frame: _TurnedCoordinates,
    start: np.ndarray,
    direction: np.ndarray,
    text: str,
    style: str,
) -> None:
    """Draw a side of the set as a ray from `start` (2,) to the circle |u| = r, with its
    name.

    Equation: `|start + length direction| = r`, direction (2,) of length 1.
    """
    b = start @ direction
    square = b * b + frame.radius**2 - start @ start
    length = -b + np.sqrt(max(square, 0.0))
    end = start + length * direction
    if length < _SHORTEST * frame.radius:
        return
    ends = np.stack([start, end])
    axes.plot(*ends.T, color=GREY, lw=1.0, ls=style)
    # of the name, never upside down
    x, y = direction
    angle = np.degrees(np.arctan2(y, x))
    if angle > 90:
        angle = angle - 180
    elif angle < -90:
        angle = angle + 180
    if style == "-":
        share = 0.45
        side = "top"
    else:
        share = 0.3
        side = "bottom"
    turned: dict[str, Any] = {"rotation": angle, "rotation_mode": "anchor", "va": side}
    place = start + share * length * direction
    write(axes, place, text, color=GREY, **turned)


def _draw_projections(
    result: AdmissibleSet,
    marked: Mapping[str, np.ndarray],
    closed: np.ndarray,
    title: str,
) -> Figure:
    """Draw samples of the set over pairs of normalized gap velocities qn+ [sqrt(J)].

    Coloured by T+/T-; for one contact T+/T- over its qn+.
    """
    contacts = closed[:_MOST_CONTACTS]
    samples = result.sample(0, _SAMPLES)
    norm = np.asarray(kinetic_norm(result.scene), float)
    # qn = unit^T v
    normals = np.asarray(result.scene.normals, float)
    unit = (normals / norm)[:, contacts]
    cloud = samples @ unit
    energies = _energy_ratio(result, samples)
    contacts_shown = range(len(contacts))
    pairs = list(combinations(contacts_shown, 2)) or [(0, 0)]
    figure, grid = new_panels(len(pairs), 3.1, 0.8, title)
    energy = "energy ratio $T^+ / T^-$"
    for axes, (i, j) in zip(grid, pairs):
        single = i == j
        if single:
            y = energies
        else:
            y = cloud[:, j]
        scale = {"vmin": 0, "vmax": 1}
        dots = axes.scatter(cloud[:, i], y, c=energies, s=5, lw=0, **scale)
        for k, (name, v) in enumerate(marked.items()):
            point = v @ unit
            if single:
                height = _energy_ratio(result, v)
            else:
                height = point[j]
            admissible = bool(result.contains(v))
            mark(axes, (point[i], height), name, k, admissible)
        labels = [
            f"normalized gap velocity {contacts[c] + 1} after [√J]" for c in (i, j)
        ]
        axes.set_xlabel(labels[0], fontsize=SMALL)
        axes.set_ylabel(energy if single else labels[1], fontsize=SMALL)
    figure.colorbar(dots, ax=grid.tolist(), label=energy)
    legend_below(figure, 4)
    return figure


def _energy_ratio(result: AdmissibleSet, velocity: np.ndarray) -> np.ndarray:
    """T+ / T- (...,) of velocities (..., n)."""
    momenta = velocity @ dense_mass(result.scene)
    energy = 0.5 * np.sum(momenta * velocity, axis=-1)
    if result.energy:
        return energy / result.energy
    return np.ones_like(energy)


@styled(RockingDispersion)
def rocking_dispersion(result: RockingDispersion, title: str = "") -> Figure:
    """Dispersion against the kinetic angle: a panel for each mu, a line for each e.

    The dotted line is `critical_kinetic_angle`.

    Args:
        result: what `ji.theory.rocking_dispersion` returned.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    >>> import jimpact as ji
    >>> import numpy as np
    >>> zero = np.zeros((2, 1, 1))
    >>> axes = map(np.array, ([1.0, 2], [0.1], [0.5]))
    >>> d = ji.theory.RockingDispersion(
    ...     *axes, np.zeros((2, 1, 1, 2)), zero, zero, zero, zero
    ... )
    >>> len(ji.plot.rocking_dispersion(d).axes)
    1
    """
    figure, panels = _panels(result, title, r"dispersion $|\dot y_A^+ / \dot y_B^-|$")
    theta = np.degrees(result.kinetic_angle)
    size = np.abs(result.dispersion)
    for j, axes in enumerate(panels):
        labels = [f"e = {e:g}" for e in np.asarray(result.restitution)]
        axes.plot(theta, size[:, j], label=labels)
    _critical_lines(panels, result)
    panels[0].set_ylim(bottom=0)  # shared by all, so last
    legend_below(figure, 6)
    return figure


@styled(RockingDispersion)
def rocking_outcomes(
    result: RockingDispersion, title: str = "", separation_threshold: float = STAYS
) -> Figure:
    """Rest, rocking, half-rocking, free over the kinetic angle and e, by mu.

    The dotted line is `critical_kinetic_angle`.

    Args:
        result: what `ji.theory.rocking_dispersion` returned.
        title: above the picture.
        separation_threshold: largest speed, over |gamma_B-|, of a corner that remains
            closed.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    >>> import jimpact as ji
    >>> import numpy as np
    >>> zero = np.zeros((2, 1, 2))
    >>> axes = map(np.array, ([1.0, 2], [0.1], [0.5, 1]))
    >>> d = ji.theory.RockingDispersion(
    ...     *axes, np.zeros((2, 1, 2, 2)), zero, zero, zero, zero
    ... )
    >>> len(ji.plot.rocking_outcomes(d).axes)
    1
    """
    figure, panels = _panels(result, title, "restitution e")
    codes = result.outcomes(separation_threshold)
    coloured = by_code(_OUTCOME_COLOURS)
    theta = np.degrees(result.kinetic_angle)
    e = np.asarray(result.restitution)
    for j, axes in enumerate(panels):
        axes.grid(visible=False)
        of_friction = codes[:, j].T
        axes.pcolormesh(theta, e, of_friction, shading="nearest", **coloured)
    _critical_lines(panels, result)
    handles = [
        Patch(color=_OUTCOME_COLOURS[i], label=OUTCOMES[i]) for i in np.unique(codes)
    ]
    legend_below(figure, 5, handles)
    return figure


@styled()
def rocking_domains(domains: Sequence[RockingDomain], title: str = "") -> Figure:
    """Admissible restitution matrices of blocks: own entry against cross entry.

    Args:
        domains: what `ji.theory.rocking_domain` returned, for one or several blocks.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: no domain.

    >>> import jimpact as ji
    >>> len(ji.plot.rocking_domains([ji.theory.rocking_domain(2.0)]).axes)
    1
    """
    if not len(domains):
        raise ValueError(
            "Argument `domains` must hold at least one domain, but is empty."
        )
    default = "Admissible restitution matrices of a block"
    heading = title or default
    figure, panels = new_panels(
        len(domains), 3.2, 0.6, heading, sharex=True, sharey=True
    )
    for axes, domain in zip(panels, domains):
        label = "free: both corners leave"
        axes.fill(*domain.corners.T, color=_FILL, lw=0, label=label)
        axes.plot([0, 0], domain.rocking, color=COLOURS[0], lw=4, label="rocking")
        if domain.half_rocking is not None:
            style = {"color": COLOURS[1], "lw": 4, "label": "half-rocking"}
            axes.plot(domain.half_rocking, [0, 0], **style)
        if domain.sliding:
            way = "sliding"
        else:
            way = "sticking"
        axes.set_title(f"height / width {domain.aspect:g}, {way}")
        limits = (-0.05, 1.1)
        axes.set(aspect="equal", xlim=limits, ylim=limits)
    _label_outer(panels, "restitution, corner that hits", "restitution, other corner")
    legend_below(figure, 3)
    return figure


def _panels(result: RockingDispersion, title: str, label: str) -> tuple[Figure, Any]:
    """Figure and panels of rocking blocks, one for each mu, over the kinetic angle
    [degrees].
    """
    count = len(result.friction)
    figure, panels = new_panels(count, 2.8, 0.6, title, sharex=True, sharey=True)
    for axes, mu in zip(panels, np.asarray(result.friction)):
        axes.set_title(f"mu = {mu:g}")
    _label_outer(panels, r"kinetic angle $\theta_{12}$ [degrees]", label)
    return figure, panels


def _critical_lines(panels: np.ndarray, result: RockingDispersion) -> None:
    """Draw the critical kinetic angle of each mu as a dotted line in its panel."""
    critical = np.degrees(critical_kinetic_angle(result.friction))
    for axes, angle in zip(panels, critical):
        axes.axvline(float(angle), color="black", ls=":", lw=1)


def _label_outer(panels: np.ndarray, x: str, y: str) -> None:
    """Label y on the left, and x below the last panel of each column."""
    for axes in panels[::COLUMNS]:
        axes.set_ylabel(y)
    for axes in panels[-COLUMNS:]:
        axes.set_xlabel(x)
        axes.tick_params(labelbottom=True)
