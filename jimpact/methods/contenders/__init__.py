"""The ways to integrate an LZB impact, side by side: one row a method.

>>> import jimpact as ji
>>> from jimpact.methods.contenders import METHODS
>>> law, balls = ji.LZB(1.0, exponent=1.0), ji.chain([1.0, 1.0])
>>> found = METHODS["verlet"].solve(law, balls, [1.0, 0.0], 0.01)
>>> round(float(found.impulse[0]), 3), int(found.evaluations)
(1.0, 316)
"""

from jimpact.methods.contenders import (
    libraries,
    schemes,
)
from jimpact.methods.contenders.base import (
    UNCOUNTED,
    Method,
    MethodResult,
    checked,
    outcome,
    time_scale,
)

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        schemes.IMPULSE_EULER,
        schemes.IMPULSE_RK4,
        schemes.TIME_RK4,
        schemes.VERLET,
        schemes.DOP853_ALIGNED,
        *libraries.DIFFRAX,
        *libraries.SCIPY,
    )
}

__all__ = [
    "METHODS",
    "UNCOUNTED",
    "Method",
    "MethodResult",
    "checked",
    "outcome",
    "time_scale",
]
