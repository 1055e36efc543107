"""Restitution and the parameters of physics engines whose contacts are forces."""

import math
from collections.abc import Callable
from typing import NamedTuple

from scipy.optimize import brentq
from scipy.special import lambertw

from jimpact.tools.checks import check_choice, check_values

# Tsuji, Tanaka and Ishida (1992): damping over sqrt(m k), coefficients of e^0, e^1, ...
_TSUJI = (1.2728, -4.2783, 11.087, -22.348, 27.467, -18.022, 4.8218)
# Dimensionless damping below which e of Hunt and Crossley's force is 1, to 1e-8. Ten times more,
# and it is so to 1e-7.
_NO_DAMPING = 1e-8
# Dimensionless damping from which on e is Lambert's function, below it a root: each where it keeps
# its digits. Ten times more, and the root's bracket ends at an e with an infinite logarithm.
_STRONG = 0.5
# Largest dimensionless damping, and least e to ask for, that are tried. Ten times as large a
# damping would lower the least e from .01 to .001.
_MOST_DAMPING, _LEAST_ASKED = 100.0, 1e-6
_CHANGE = 1 / 3  # Exudyn's model 2 changes its formula at this e; both agree there


def _pulling(ratio: float) -> float:
    """e of a damped oscillator from x = 0 to x = 0: it pulls at the end."""
    return math.exp(-math.pi * ratio / math.sqrt(1 - ratio**2)) if ratio < 1 else 0.0


def _cut(ratio: float) -> float:
    """e of a damped oscillator that ends where its force vanishes: Schwager and Poeschel (2007)."""
    if ratio < 1:
        root = math.sqrt(1 - ratio**2)
        return math.exp(-2 * ratio * math.atan2(root, ratio) / root)
    if ratio == 1:
        return math.exp(-2)
    root = math.sqrt(ratio**2 - 1)
    return math.exp(-2 * ratio * math.log(ratio + root) / root)


def _hunt_crossley(damping: float) -> float:
    """e of `k x^n (1 + d x')` with a = d v: `(1 + e) a = ln((1 + a) / (1 - a e))`, for any n."""
    if damping < _NO_DAMPING:
        return 1.0
    if damping > _STRONG:
        shifted = 1 + damping
        return (1 + float(lambertw(-shifted * math.exp(-shifted)).real)) / damping

    def excess(e: float) -> float:
        """Falls with e."""
        return (1 + e) * damping - math.log1p(damping) + math.log1p(-damping * e)

    return float(brentq(excess, 0.0, 1.0))


def _oscillator(e: float) -> float:
    """Damping ratio of the oscillator whose e, pulling, is this one."""
    return -math.log(e) / math.hypot(math.pi, math.log(e))


def _tsuji(e: float) -> float:
    """Tsuji's alpha."""
    return sum(factor * e**power for power, factor in enumerate(_TSUJI))


def _exudyn_2(e: float) -> float:
    """Gonthier's damping below an e of 1/3, Carvalho's and Martins' above."""
    return (1 - e**2) / e if e < _CHANGE else 1.5 * (1 - e) * (11 - e) / (1 + 9 * e)


class _Engine(NamedTuple):
    """An engine: `result` takes a dimensionless damping, which `damping` takes of the parameter.

    `scale` gives what a parameter of damping is multiplied by, from the quantities that it `needs`;
    without, the parameter is a coefficient of restitution.
    """

    result: Callable[[float], float]
    damping: Callable[[float], float] = lambda asked: asked
    needs: tuple[str, ...] = ()
    scale: Callable[..., float] | None = None


_ENGINES = {
    "drake": _Engine(_hunt_crossley, needs=("speed",), scale=lambda speed: speed),
    "drake_sap": _Engine(
        _cut, needs=("stiffness", "mass"), scale=lambda k, mass: math.sqrt(k / mass) / 2
    ),
    "exudyn_1": _Engine(_hunt_crossley, lambda e: 1.5 * (1 - e)),
    "exudyn_2": _Engine(_hunt_crossley, _exudyn_2),
    "lammps": _Engine(_pulling, _oscillator),
    "lammps_limit_damping": _Engine(_cut, _oscillator),
    "lammps_tsuji_hertz": _Engine(_pulling, lambda e: _tsuji(e) / math.sqrt(5)),
    "lammps_tsuji_hooke": _Engine(_pulling, lambda e: _tsuji(e) / 2),
}


def engine_restitution(
    engine: str,
    parameter: float,
    speed: float | None = None,
    stiffness: float | None = None,
    mass: float | None = None,
) -> float:
    """Which coefficient of restitution a pair gets from the damping parameter of an engine.

    Equation, with F the contact force, x its indentation, v the speed, m the reduced mass:

    | engine | parameter | force |
    |---|---|---|
    | `drake` | dissipation d [s/m] | `k x (1 + d x')`, cut at 0; continuous, or small steps |
    | `drake_sap` | both relaxation times together [s] | `k (x + tau x')`, cut at 0; small steps |
    | `exudyn_1` | e, impact model 1 | `k x^n (1 + d x')`, `d v = 1.5 (1 - e)` |
    | `exudyn_2` | e, impact model 2 | the same with Gonthier's d, or Carvalho's and Martins' |
    | `lammps` | e, damping coeff_restitution | damping ratio of a spring that may pull |
    | `lammps_limit_damping` | the same with limit_damping | the same, cut at 0 |
    | `lammps_tsuji_hertz` | e, damping tsuji | Tsuji's alpha over sqrt(5) as damping ratio |
    | `lammps_tsuji_hooke` | the same | alpha / 2 as damping ratio |

    LIGGGHTS does as `lammps` for hooke and hertz, with limitForce as `lammps_limit_damping`. YADE's
    Mindlin contacts give the e that is asked for, without pulling. MuJoCo: `ji.mujoco_restitution`.

    Args:
        engine: a name of the table.
        parameter: e in (0, 1], or a damping >= 0.
        speed: of approach v > 0 [m/s], for `drake`.
        stiffness: of the contact k > 0 [N/m], for `drake_sap`: `k1 k2 / (k1 + k2)` of two bodies.
        mass: reduced mass m > 0 [kg], for `drake_sap`.

    Returns:
        e of one contact of two bodies that come from a distance; in a row that touches it does not
        determine the outcome (docs/engines.md).

    Raises:
        ValueError: no such engine, a value out of range, or one that the engine needs is missing.

    Source: manuals of the engines and the papers they name; measured in docs/engines.md.

    >>> import jimpact as ji
    >>> round(ji.theory.engine_restitution("lammps_tsuji_hertz", 0.5), 3)
    0.616
    >>> round(ji.theory.engine_restitution("drake", 50.0, speed=1.0), 3)  # Drake's default
    0.02
    """
    row, scale = _row(engine, speed=speed, stiffness=stiffness, mass=mass)
    if scale is None:
        check_values("parameter", parameter, low=0.0, open_low=True, high=1.0)
        return row.result(row.damping(parameter))
    check_values("parameter", parameter, low=0.0)
    return row.result(scale * parameter)


def engine_parameter(
    engine: str,
    restitution: float,
    speed: float | None = None,
    stiffness: float | None = None,
    mass: float | None = None,
) -> float:
    """The damping parameter of an engine that gives a pair a coefficient of restitution.

    Equation: the root of `engine_restitution(engine, parameter, ...) = restitution`.

    Args:
        engine: as of `engine_restitution`, with its units.
        restitution: 0 < e <= 1.
        speed: of approach > 0 [m/s], for `drake`.
        stiffness: of the contact > 0 [N/m], for `drake_sap`.
        mass: reduced mass > 0 [kg], for `drake_sap`.

    Returns:
        The parameter.

    Raises:
        ValueError: as `engine_restitution`; a coefficient that no parameter gives.

    Source: as `engine_restitution`.

    >>> import jimpact as ji
    >>> round(ji.theory.engine_parameter("lammps_limit_damping", 0.5), 3)  # what to ask for
    0.436
    >>> round(ji.theory.engine_parameter("drake", 0.5, speed=2.0), 3)  # [s/m]
    0.716
    """
    check_values("restitution", restitution, low=0.0, open_low=True, high=1.0)
    row, scale = _row(engine, speed=speed, stiffness=stiffness, mass=mass)
    ends = (_LEAST_ASKED, 1.0) if scale is None else (_MOST_DAMPING, 0.0)

    def excess(asked: float) -> float:
        """The coefficient of this parameter (of a damping: dimensionless) over the wanted one."""
        return row.result(row.damping(asked)) - restitution

    low, high = excess(ends[0]), excess(ends[1])
    if low > 0 or high < 0:
        raise ValueError(
            f"Argument `restitution` must lie in [{restitution + low:.4g}, "
            f"{restitution + high:.4g}] for engine {engine!r}, but has value {restitution:g}."
        )
    return float(brentq(excess, *ends)) / (scale or 1.0)


def _row(engine: str, **given: float | None) -> tuple[_Engine, float | None]:
    """The row of an engine, and what its parameter is multiplied by; None: nothing."""
    check_choice("engine", engine, _ENGINES)
    row = _ENGINES[engine]
    values = []
    for name in row.needs:
        value = given[name]
        if value is None:
            raise ValueError(f"Argument `{name}` must be given for engine {engine!r}, but is None.")
        check_values(name, value, low=0.0, open_low=True)
        values.append(float(value))
    return row, row.scale(*values) if row.scale else None
