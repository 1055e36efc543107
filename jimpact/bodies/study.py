"""Keys of a table that describes a body in a study."""

import inspect
from typing import Any

import jimpact as ji
from jimpact import bodies
from jimpact.bodies.base import Body
from jimpact.tools.checks import check_word
from jimpact.tools.study_tables import check_keys

# names of the bodies, which a study writes in any case
BODIES = sorted(name for name in dir(bodies) if name in dir(ji))
# Units of the bodies' arguments, which a study writes behind their names. Words and
# directions have no unit here, nor have lists of points [m] or of mixed units
# (`corners` of a Polygon, `planes`, `at`), which the classes document.
_UNITS = {
    **dict.fromkeys(("mass", "masses", "sphere_mass", "rod_mass"), "kg"),
    **dict.fromkeys(
        ("width", "height", "length", "thickness", "radius", "radii", "gaps", "sizes"),
        "m",
    ),
    **dict.fromkeys(("centre", "rounding"), "m"),
    "inertia": "kg_m2",
    "angle": "rad",
}


def body_of(where: str, table: Any, others: tuple[str, ...] = ()) -> Body:
    """Body that a table of a study describes; `where` is the head of the table, for
    errors.

    `kind` is the name of a body's class (`Block`, `Box`, `Bodies`, ..., in any case);
    the other keys are the arguments of that class, with their units behind them:
    `width_m`, `mass_kg`, `inertia_kg_m2`, `angle_rad`. Bodies of `Bodies` are tables of
    this kind themselves.
    `others` are keys of the table that mean something else.

    >>> from jimpact.bodies.study import body_of
    >>> body_of("[scene]", {"kind": "Block", "width_m": 0.2, "height_m": 0.6}).names
    ('x [m]', 'y [m]', 'angle [rad]')
    """
    check_keys(where, table, tuple(table), required=("kind",))
    names = {name.lower(): name for name in BODIES}
    kind = str(table["kind"]).lower()
    name = names.get(kind, table["kind"])
    check_word(f"`kind` in {where}", name, names.values())
    body = getattr(bodies, name)
    parameters = inspect.signature(body).parameters
    # key of the table, with its unit -> argument of the class
    keys = {f"{key}_{_UNITS[key]}" if key in _UNITS else key: key for key in parameters}
    required = tuple(
        x
        for x, key in keys.items()
        if parameters[key].default is inspect.Parameter.empty
    )
    check_keys(where, table, ("kind", *keys, *others), required)
    arguments = {key: table[x] for x, key in keys.items() if x in table}
    for several in {"bodies", "fixed"} & set(arguments):
        within = f"{where.removesuffix(']')}.{several}]"
        if not isinstance(arguments[several], list):
            raise ValueError(f"[{within}] must be tables, each headed by [{within}].")
        arguments[several] = [body_of(within, part) for part in arguments[several]]
    return body(**arguments)
