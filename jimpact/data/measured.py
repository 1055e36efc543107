"""Measured impacts and drops that come with the package: a cube, an ellipse and a
square.
"""

import tomllib
from collections.abc import Sequence
from importlib.resources import files

import numpy as np

from jimpact.bodies.shapes import Block, Box
from jimpact.core.scene import Scene
from jimpact.shots.data import Experiments, read_experiments
from jimpact.shots.shots_file import read_shots

_DATA = files("jimpact") / "data"
ELLIPSE_AXES = 0.035, 0.025  # m, half of each, of the measured ellipse
ELLIPSE_MASS = 0.0364  # kg
SQUARE_SIDE = 0.06  # m, of the measured square
# m, m, rad: the units of the stored poses, about the noise of a pose. Ten times more
# and the rounding is what a fit sees.
POSE_UNITS = 2e-5, 2e-5, 5e-4


def ellipse_impacts() -> Experiments:
    """1378 measured impacts of a flat ellipse (semi-axes 35 and 25 mm) on a table.

    Velocities are those of the centre (m/s) and the angular velocity (rad/s), each shot
    in the scene of its angle: `gamma = y' + c theta'`, slip `x' + h theta'`, h the
    height of the centre above the lowest point, c how far that lies to the right. The
    inertia is a guess:
    m (a^2 + b^2) / 4 of the semi-axes a, b.

    Returns:
        `Experiments` of 1378 shots of 3 velocities, with scenes, without sigma.

    No law of contact at a point fits them: an impulse of any size and direction at the
    lowest point leaves 18 % of the velocity jump (median, energy norm).

    Source: Fazeli et al., as kept in DAIRLab/ImpactModeling, see `planar_NOTICE.txt` in
    `data`.

    >>> import jimpact as ji
    >>> shots = ji.data.ellipse_impacts()
    >>> shots.pre.shape, shots.units[2], shots.scenes[0].contacts
    ((1378, 3), 'rad/s', 1)
    """
    values, units, labels = read_shots(str(_DATA / "ellipse_impacts.csv"))
    a, b = ELLIPSE_AXES
    sine = np.sin(values["q"][:, 2])
    cosine = np.cos(values["q"][:, 2])
    height = np.hypot(a * sine, b * cosine)  # h
    arm = (b**2 - a**2) * sine * cosine / height  # c
    radius_squared = (a**2 + b**2) / 4  # of gyration
    mass = ELLIPSE_MASS * np.array([1.0, 1.0, radius_squared])
    scenes = [
        Scene(mass, [[0.0], [1.0], [x]], tangents=[[1.0], [0.0], [h]])
        for x, h in zip(arm, height)
    ]
    pre = values["pre"]
    post = values["post"]
    return Experiments(pre, post, scenes=scenes, shots=labels, units=units)


def square_impacts(near: float = 2e-3) -> Experiments:
    """265 measured impacts of a square (side 60 mm) on a table, on a corner or an edge.

    Velocities are those of the centre (m/s) and the angular velocity (rad/s), with
    standard errors before and after, each shot in the scene of its pose. A label is
    "drop:frame", in frames of 4 ms. The mass is 1 kg: impacts with the table do not
    depend on it.

    Args:
        near: corners up to so far above the lowest one touch, too [m].

    Returns:
        `Experiments` of 265 shots of 3 velocities, with sigma and scenes.

    Source: Fazeli et al., as kept in DAIRLab/ImpactModeling, see `planar_NOTICE.txt` in
    `data`.

    >>> import jimpact as ji
    >>> shots = ji.data.square_impacts()
    >>> [int((shots.contacts == m).sum()) for m in (1, 2)]
    [250, 15]
    """
    body = Block(SQUARE_SIDE, SQUARE_SIDE)
    return read_experiments(str(_DATA / "square_impacts.csv"), body, near)


def square_drops() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """100 measured drops of a square, seen from the side at 250 Hz.

    It lands on corners and edges, tumbles, rocks and comes to rest.

    Returns:
        Numbers of the drops (100,); times (200,) [s]; poses (100, 200, 3): x, y [m] of
        the centre above the table y = 0, and the angle of the sides [rad].

    Source: Fazeli et al., as kept in DAIRLab/ImpactModeling, see `planar_NOTICE.txt` in
    `data`.

    >>> import jimpact as ji
    >>> drops, time, q = ji.data.square_drops()
    >>> q.shape, round(float(time[1]), 3)
    ((100, 200, 3), 0.004)
    """
    with np.load(str(_DATA / "square_drops.npz")) as stored:
        steps = stored["steps"]
        drops = stored["drop"]
    counts = np.cumsum(steps, axis=1, dtype=np.int32)
    q = counts * np.array(POSE_UNITS)
    return drops, np.arange(q.shape[1]) / 250.0, q


def cube_impacts(
    contacts: int | Sequence[int] | None = None,
    near: float = 2e-3,
    nearly_clean: bool = False,
) -> Experiments:
    """400 measured impacts of a tossed acrylic cube on a board, with its poses.

    Velocities are those of the centre of mass (m/s, axes of the board) and the angular
    velocity (rad/s, axes of the cube), before and after, with standard errors; a label
    is "toss:frame", the frame being the last one before the impact. The cube is the
    `Box` of `tossed_cube.toml`.

    Args:
        contacts: only impacts on this number of corners (or several numbers); None:
            all.
        near: corners up to so far above the lowest one touch, too (board and cube are
            flat to 1.4 mm) [m].
        nearly_clean: True: also 84 impacts on two corners that are less clean (flights
            before and after meet within .5 mm, not .3 mm). `docs/cube.md` compares laws
            on all of them.

    Returns:
        `Experiments` of up to 484 shots of 6 velocities, with sigma and scenes.

    Raises:
        ValueError: no shot on so many contacts.

    Source: ContactNets (Pfrommer, Halm and Posa, CoRL 2020), see `cube_NOTICE.txt` in
    `data`.

    >>> import jimpact as ji
    >>> two = ji.data.cube_impacts(contacts=2)
    >>> two.pre.shape, two.scenes[0].contacts, two.units[5]
    ((21, 6), 2, 'rad/s')
    """
    text = (_DATA / "tossed_cube.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)["scene"]
    names = ("sizes_m", "mass_kg", "inertia_kg_m2", "centre_m", "rounding_m")
    cube = Box(*(table[name] for name in names))
    sources = (
        "cube_impacts.csv",
        *(("cube_nearly_clean.csv",) if nearly_clean else ()),
    )
    paths = (str(_DATA / name) for name in sources)
    parts = [read_experiments(path, cube, near) for path in paths]
    if nearly_clean:
        shots = Experiments.join(parts)
    else:
        shots = parts[0]
    if contacts is None:
        return shots
    return shots.with_contacts(contacts)
