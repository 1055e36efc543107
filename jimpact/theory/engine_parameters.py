"""Restitution and the parameters of physics engines whose contacts are forces."""

import math
from collections.abc import Callable
from typing import NamedTuple

from scipy.optimize import brentq
from scipy.special import lambertw

from jimpact.tools.checks import check_choice, check_values

# Tsuji, Tanaka and Ishida (1992): damping over sqrt(m k), coefficients of e^0, e^1, ...
_TSUJI = (1.2728, -4.2783, 11.087, -22.348, 27.467, -18.022, 4.8218)
# Dimensionless damping below which e of Hunt and Crossley's force is 1, to 1e-8. Ten
# times more, and it is so to 1e-7.
_NO_DAMPING = 1e-8
# Dimensionless damping from which on e is Lambert's function, below it a root: each
# where it keeps its digits. Ten times more, and the root's bracket ends at an e with an
# infinite logarithm.
_STRONG = 0.5
# Largest dimensionless damping, and least e to ask for, that are tried. Ten times as
# large a damping would lower the least e from .01 to .001.
_MOST_DAMPING = 100.0
_LEAST_ASKED = 1e-6
_CHANGE = 1 / 3  # Exudyn's model 2 changes its formula at this e; both agree there


def _pulling_oscillator(ratio: float) -> float:
    """e of a linear spring and damper of damping ratio D that ends at x = 0, where it
    pulls.

    Equation: `e = exp(-pi D / sqrt(1 - D^2))`, 0 from D = 1 on.
    """
    if ratio < 1:
        frequency = math.sqrt(1 - ratio**2)
        return math.exp(-math.pi * ratio / frequency)
    return 0.0


def _cut_oscillator(ratio: float) -> float:
    """e of a linear spring and damper of damping ratio D that ends where its force
    vanishes.

    Equation: `e = exp(-2 D a / r)` with `r = sqrt(|1 - D^2|)`, `a = atan(r / D)` for D
    < 1,
    `a = ln(D + r)` for D > 1; `exp(-2)` between. Schwager and Poeschel (2007).
    """
    if ratio < 1:
        root = math.sqrt(1 - ratio**2)
        phase = math.atan2(root, ratio)
        return math.exp(-2 * ratio * phase / root)
    if ratio == 1:
        return math.exp(-2)
    root = math.sqrt(ratio**2 - 1)
    growth = math.log(ratio + root)
    return math.exp(-2 * ratio * growth / root)


def _hunt_crossley(damping: float) -> float:
    """e of the force `k x^n (1 + d x')` at dimensionless damping a = d v, for any n.

    Equation: `(1 + e) a = ln((1 + a) / (1 - a e))`; with Lambert's function W0
    `e = (1 + W0(-(1 + a) exp(-(1 + a)))) / a`.
    """
    if damping < _NO_DAMPING:
        return 1.0
    if damping > _STRONG:
        shifted = 1 + damping
        solution = lambertw(-shifted * math.exp(-shifted))
        return (1 + float(solution.real)) / damping

    def excess(e: float) -> float:
        """`(1 + e) a - ln((1 + a) / (1 - a e))`, which falls with e."""
        returned = math.log1p(-damping * e)
        return (1 + e) * damping - math.log1p(damping) + returned

    return float(brentq(excess, 0.0, 1.0))


def _damping_ratio(e: float) -> float:
    """`D = -ln(e) / sqrt(pi^2 + ln(e)^2)`, the inverse of `_pulling_oscillator`."""
    decrement = math.log(e)
    return -decrement / math.hypot(math.pi, decrement)


def _tsuji_alpha(e: float) -> float:
    """Tsuji's `alpha(e)`, damping over sqrt(m k): the polynomial of the coefficients
    `_TSUJI`.
    """
    return sum(factor * e**power for power, factor in enumerate(_TSUJI))


def _exudyn_2(e: float) -> float:
    """Dimensionless damping d v that Exudyn's impact model 2 takes for e.

    Equation: `(1 - e^2) / e` below e = 1/3 (Gonthier), above it
    `1.5 (1 - e) (11 - e) / (1 + 9 e)` (Carvalho and Martins).
    """
    if e < _CHANGE:
        return (1 - e**2) / e
    numerator = 1.5 * (1 - e) * (11 - e)
    return numerator / (1 + 9 * e)


class _Engine(NamedTuple):
    """Functions of an engine: `restitution(dimensionless damping)`,
    `damping(parameter)`.

    Where the parameter is a coefficient of restitution, `damping` gives the
    dimensionless damping that the engine takes for it, and `scale` is None. Where it is
    a damping with a unit, `scale` of the quantities `needs` is the factor that makes it
    dimensionless.
    """

    restitution: Callable[[float], float]
    damping: Callable[[float], float] = lambda parameter: parameter
    needs: tuple[str, ...] = ()
    scale: Callable[..., float] | None = None


_ENGINES = {
    "drake": _Engine(_hunt_crossley, needs=("speed",), scale=lambda speed: speed),
    "drake_sap": _Engine(
        _cut_oscillator,
        needs=("stiffness", "mass"),
        scale=lambda k, m: math.sqrt(k / m) / 2,
    ),
    "exudyn_1": _Engine(_hunt_crossley, lambda e: 1.5 * (1 - e)),
    "exudyn_2": _Engine(_hunt_crossley, _exudyn_2),
    "lammps": _Engine(_pulling_oscillator, _damping_ratio),
    "lammps_limit_damping": _Engine(_cut_oscillator, _damping_ratio),
    "lammps_tsuji_hertz": _Engine(
        _pulling_oscillator, lambda e: _tsuji_alpha(e) / math.sqrt(5)
    ),
    "lammps_tsuji_hooke": _Engine(_pulling_oscillator, lambda e: _tsuji_alpha(e) / 2),
}


def engine_restitution(
    engine: str,
    parameter: float,
    speed: float | None = None,
    stiffness: float | None = None,
    mass: float | None = None,
) -> float:
    """Coefficient of restitution from the damping parameter of a physics engine.

    Equation, with F the contact force, x its indentation, v the speed, m the reduced
    mass:

    | engine | parameter | force |
    |---|---|---|
    | `drake` | dissipation d [s/m] | `k x (1 + d x')`, cut at 0; continuous, or small
    steps |
    | `drake_sap` | both relaxation times together [s] | `k (x + tau x')`, cut at 0;
    small steps |
    | `exudyn_1` | e, impact model 1 | `k x^n (1 + d x')`, `d v = 1.5 (1 - e)` |
    | `exudyn_2` | e, impact model 2 | the same with Gonthier's d, or Carvalho's and
    Martins' |
    | `lammps` | e, damping coeff_restitution | damping ratio of a spring that may pull
    |
    | `lammps_limit_damping` | the same with limit_damping | the same, cut at 0 |
    | `lammps_tsuji_hertz` | e, damping tsuji | Tsuji's alpha over sqrt(5) as damping
    ratio |
    | `lammps_tsuji_hooke` | the same | alpha / 2 as damping ratio |

    LIGGGHTS does as `lammps` for hooke and hertz, with limitForce as
    `lammps_limit_damping`. YADE's Mindlin contacts give the e that is asked for,
    without pulling. MuJoCo: `ji.mujoco_restitution`.

    Args:
        engine: a name of the table.
        parameter: e in (0, 1], or a damping >= 0.
        speed: of approach v > 0 [m/s], for `drake`.
        stiffness: of the contact k > 0 [N/m], for `drake_sap`: `k1 k2 / (k1 + k2)` of
            two bodies.
        mass: reduced mass m > 0 [kg], for `drake_sap`.

    Returns:
        e of one contact of two bodies that come from a distance; in a row that touches
        it does not determine the outcome (docs/engines.md).

    Raises:
        ValueError: no such engine, a value out of range, or one that the engine needs
            is missing.

    Source: manuals of the engines and the papers they name; measured in
    docs/engines.md.

    >>> import jimpact as ji
    >>> round(ji.theory.engine_restitution("lammps_tsuji_hertz", 0.5), 3)
    0.616
    >>> round(
    ...     ji.theory.engine_restitution("drake", 50.0, speed=1.0), 3
    ... )  # Drake's default
    0.02
    """
    row, scale = _engine_and_scale(engine, speed=speed, stiffness=stiffness, mass=mass)
    if scale is None:
        check_values("parameter", parameter, low=0.0, open_low=True, high=1.0)
        return row.restitution(row.damping(parameter))
    check_values("parameter", parameter, low=0.0)
    return row.restitution(scale * parameter)


def engine_parameter(
    engine: str,
    restitution: float,
    speed: float | None = None,
    stiffness: float | None = None,
    mass: float | None = None,
) -> float:
    """The damping parameter of an engine that gives a pair a restitution.

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
    >>> round(
    ...     ji.theory.engine_parameter("lammps_limit_damping", 0.5), 3
    ... )  # what to ask for
    0.436
    >>> round(ji.theory.engine_parameter("drake", 0.5, speed=2.0), 3)  # [s/m]
    0.716
    """
    check_values("restitution", restitution, low=0.0, open_low=True, high=1.0)
    row, scale = _engine_and_scale(engine, speed=speed, stiffness=stiffness, mass=mass)
    # parameters with the least and the largest e; a damping is dimensionless here
    if scale is None:
        ends = (_LEAST_ASKED, 1.0)
    else:
        ends = (_MOST_DAMPING, 0.0)

    def excess(parameter: float) -> float:
        """The coefficient of restitution of this parameter minus the wanted one."""
        return row.restitution(row.damping(parameter)) - restitution

    low = excess(ends[0])
    high = excess(ends[1])
    if low > 0 or high < 0:
        raise ValueError(
            f"Argument `restitution` must lie in [{restitution + low:.4g}, "
            f"{restitution + high:.4g}] for engine {engine!r}, but has value "
            f"{restitution:g}."
        )
    return float(brentq(excess, *ends)) / (scale or 1.0)


def _engine_and_scale(
    engine: str, **given: float | None
) -> tuple[_Engine, float | None]:
    """Functions of an engine, and the factor that makes its damping dimensionless,
    checked.

    `given` are speed [m/s], stiffness [N/m] and mass [kg]. The factor is None where the
    parameter is a coefficient of restitution.
    """
    check_choice("engine", engine, _ENGINES)
    row = _ENGINES[engine]
    values = []
    for name in row.needs:
        value = given[name]
        if value is None:
            raise ValueError(
                f"Argument `{name}` must be given for engine {engine!r}, but is None."
            )
        check_values(name, value, low=0.0, open_low=True)
        values.append(float(value))
    return row, row.scale(*values) if row.scale else None
