"""The ways to integrate an LZB impact, side by side: one row a method.

>>> import jimpact as ji
>>> from jimpact.methods.contenders import METHODS
>>> law, balls = ji.LZB(1.0, exponent=1.0), ji.chain([1.0, 1.0])
>>> result = METHODS["verlet"].solve(law, balls, [1.0, 0.0], 0.01)
>>> round(float(result.impulse[0]), 3), int(result.evaluations)
(1.0, 316)
"""

from jimpact.methods.contenders.base import (
    UNCOUNTED as UNCOUNTED,
    Method as Method,
    outcome as outcome,
    time_scale as time_scale,
)
from jimpact.methods.contenders.libraries import DIFFRAX, SCIPY
from jimpact.methods.contenders.schemes import SCHEMES

METHODS: dict[str, Method] = {method.name: method for method in (*SCHEMES, *DIFFRAX, *SCIPY)}
