"""Impacts of several bodies by some fifty physics engines, and the law nearest to
each.
"""

import csv
from dataclasses import dataclass
from importlib.resources import files
from typing import NamedTuple

from jimpact.tools.checks import check_choice
from jimpact.tools.records import Column, Table, Tabular


class EngineScene(NamedTuple):
    """Balls in a row that touch: `masses` (n,) [kg], `wall` as of `ji.chain`, the e
    asked for.
    """

    masses: tuple[float, ...]
    wall: bool
    restitution: float


# Ball 1 comes at 1 m/s, the others rest. Velocities that an engine was given are
# divided by v1-.
ENGINE_SCENES = {
    "S1": EngineScene((1.0, 1.0, 1.0), wall=False, restitution=1.0),
    "S2": EngineScene((1.0, 1.0, 1.0, 1.0, 1.0), wall=False, restitution=1.0),
    "S3": EngineScene((1.0, 1.0, 1.0), wall=False, restitution=0.5),
    "S4": EngineScene((1.0, 1.0), wall=True, restitution=1.0),
    "S8": EngineScene((10.0, 1.0, 10.0), wall=False, restitution=1.0),
}


class EngineImpact(NamedTuple):
    """Outcome of one scene by one engine.

    `velocity` (n,): v+ over v1-. `momentum` and `energy_ratio`: after over before (None
    with a wall). `nearest_law` with `nearest_e`, among Moreau, Binary and LZB with
    Hertz contacts or linear springs and any e, and the `distance` of its v+, over |v-|,
    in the energy norm; then the second.
    """

    engine: str
    version: str
    scene: str
    setting: str
    velocity: tuple[float, ...]
    momentum: float | None
    energy_ratio: float
    nearest_law: str
    nearest_e: float
    distance: float
    second_law: str
    second_distance: float


@dataclass(frozen=True)
class EngineImpacts(Tabular):
    """The table of `engine_impacts`: `rows`, and all of `Tabular`."""

    rows: tuple[EngineImpact, ...]

    @property
    def table(self) -> Table:
        """Table: a row for each measurement; velocities v+ of up to five balls over
        v1-.
        """
        columns = [Column(name) for name in ("engine", "version", "scene", "setting")]
        columns += [Column(f"v{i}", "+.3f") for i in range(1, 6)]
        columns += [Column("momentum", ".3f"), Column("energy_ratio", ".3f", "energy")]
        columns += [
            Column("nearest_law", head="nearest law"),
            Column("nearest_e", ".2f", "e"),
        ]
        columns += [Column("distance", ".3f"), Column("second_law", head="second")]
        columns += [Column("second_distance", ".3f", "its distance")]
        cells = []
        for row in self.rows:
            missing = [None] * (5 - len(row.velocity))
            v = [*row.velocity, *missing]
            cells.append([*row[:4], *v, *row[5:]])
        notes = [
            "Measured with the versions in the table; v in units of v1-. "
            "See docs/engines.md."
        ]
        return Table(columns, cells, notes=notes, keys=4)


def engine_impacts(
    engine: str | None = None, scene: str | None = None
) -> EngineImpacts:
    """Impacts of touching balls by some fifty physics engines, and the nearest laws.

    Each engine was asked for e in its own documented way. Scenes
    `ji.data.ENGINE_SCENES`: S1 three balls, e = 1; S2 five; S3 three, e = .5; S4 two
    and a wall; S8 a light ball between two heavy ones.

    Args:
        engine: only of this one; None: all.
        scene: only this one; None: all.

    Returns:
        `EngineImpacts`: prints as a table; `rows` are records; `to_csv`, `to_pandas`.

    Raises:
        ValueError: no such engine or scene.

    Source: own measurements of the versions in the table; nearest laws by
    `tests/validation/engines/nearest.py`.

    >>> import jimpact as ji
    >>> row = ji.data.engine_impacts("rapier2d", "S1").rows[0]
    >>> row.velocity, row.energy_ratio
    ((-0.174, 0.349, 0.826), 0.834)
    """
    path = files("jimpact") / "data" / "engine_impacts.csv"
    with path.open(encoding="utf-8") as file:
        every = [_row(line) for line in csv.DictReader(file)]
    for name, value in (("engine", engine), ("scene", scene)):
        known = list(dict.fromkeys(getattr(row, name) for row in every))
        if value is not None:
            check_choice(name, value, known)
    chosen = (
        row
        for row in every
        if engine in (None, row.engine) and scene in (None, row.scene)
    )
    return EngineImpacts(tuple(chosen))


def _row(line: dict[str, str]) -> EngineImpact:
    """The measurement of a line of the bundled file, values by column."""
    count = len(ENGINE_SCENES[line["scene"]].masses)
    return EngineImpact(
        engine=line["engine"],
        version=line["version"],
        scene=line["scene"],
        setting=line["setting"],
        velocity=tuple(float(line[f"v{i + 1}"]) for i in range(count)),
        momentum=float(line["momentum"]) if line["momentum"] else None,
        energy_ratio=float(line["energy_ratio"]),
        nearest_law=line["nearest_law"],
        nearest_e=float(line["nearest_e"]),
        distance=float(line["distance"]),
        second_law=line["second_law"],
        second_distance=float(line["second_distance"]),
    )
