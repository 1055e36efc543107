"""MuJoCo's contact between two bodies: the coefficient of restitution that its
parameters give.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from jimpact.tools.checks import check_shape, check_values

# MuJoCo keeps impedances, and the middle of their rise, at least this far from 0 and
# from 1.
_LEAST_IMPEDANCE = 1e-4

# Instants within a time step at which the contact may begin, equally likely. Ten times
# more changes the mean by a thousandth at 20 steps a contact.
_PHASES = 64

# Steps of the longest contact. Ten times more would take seconds to say that a step is
# too short.
_MOST_STEPS = 100_000

# Time steps a contact lasts by default: the restitution then varies by some hundredths
# with the instant at which the contact begins. Ten times more and bodies sink ten times
# deeper.
_STEPS_A_CONTACT = 20

# MuJoCo's default impedance: dmin, dmax, width [m], midpoint, power. Ten times the
# width, and slow contacts are softer.
DEFAULT_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)


class MujocoRestitution(NamedTuple):
    """Restitution of a contact in MuJoCo, by the instant at which it begins.

    Equation: `e = v+ / |v-|`.

    Args:
        mean: over the time step during which the contact begins.
        least: the smallest of these coefficients.
        most: the largest one; above 1 the time steps generate energy.

    >>> import jimpact as ji
    >>> coarse = ji.mujoco_restitution((0.02, 0.1), timestep=0.01)
    >>> coarse.most - coarse.least > 0.1
    True
    """

    mean: float
    least: float
    most: float


def mujoco_restitution(
    solref: tuple[float, float],
    timestep: float,
    solimp: tuple[float, ...] = DEFAULT_SOLIMP,
    speed: float = 1.0,
) -> MujocoRestitution:
    """Coefficient of restitution of MuJoCo's `solref` and `solimp` at a time step.

    Equation: with `r < 0` the penetration, `d(r)` the impedance, D = dmax,

        r'' = max(0, -d (b r' + k d r)),  k = 1 / (D T z)^2, b = 2 / (D T)  for solref
        (T, z),
        k = K / D^2, b = B / D  for solref (-K, -B),

    in semi-implicit Euler steps, MuJoCo's default: `v += h r''(r, v); r += h v`. For
    one contact of two bodies without friction, gravity or other forces this is what
    MuJoCo computes, to rounding; with gravity g the coefficient changes by about
    `g T / speed`.

    Args:
        solref: (timeconst [s], dampratio), or (-stiffness [1/s^2], -damping [1/s]).
        timestep: h > 0 [s]; a timeconst below 2 h counts as 2 h, as in MuJoCo.
        solimp: (dmin, dmax, width [m], midpoint, power) of the impedance.
        speed: of approach > 0 [m/s]; where dmin is not dmax, the coefficient depends on
            it.

    Returns:
        `MujocoRestitution`: mean, least and most over the instants at which the contact
            may begin.

    Raises:
        ValueError: solref of mixed or zero signs, values out of range, a contact that
            lasts more than 100 000 steps.

    Source: MuJoCo documentation, Solver parameters; Todorov (2014), ICRA, 6054-6061.

    >>> import jimpact as ji
    >>> zeta = 0.554  # the linear oscillator with this damping ratio has e = .27
    >>> fine = ji.mujoco_restitution(
    ...     (0.02, zeta), 1e-5, solimp=(0.95, 0.95, 0.001, 0.5, 2.0)
    ... )
    >>> round(fine.mean, 2)
    0.27
    >>> coarse = ji.mujoco_restitution(
    ...     (0.002, zeta), 1e-3, solimp=(0.95, 0.95, 0.001, 0.5, 2.0)
    ... )
    >>> print(f"{coarse.mean:.2f}, from {coarse.least:.2f} to {coarse.most:.2f}")
    0.41, from 0.01 to 0.81
    """
    _check(timestep, solimp, speed)
    e = _restitution(solref, timestep, solimp, speed)
    return MujocoRestitution(float(e.mean()), float(e.min()), float(e.max()))


def mujoco_solref(
    restitution: float,
    timestep: float,
    duration: float | None = None,
    solimp: tuple[float, ...] = DEFAULT_SOLIMP,
    speed: float = 1.0,
) -> tuple[float, float]:
    """The `solref` that gives a coefficient of restitution in MuJoCo at a time step.

    Equation: `solref = (-K, -B)` with `K = (pi / duration)^2`, and B so that the mean
    of `mujoco_restitution` over the instants in a step at which contact begins is
    `restitution` (for e = 1 none, where the steps themselves lose energy). Give it to
    one geom with a higher `priority`, or to a `<pair>`: MuJoCo mixes the values of both
    geoms otherwise. It holds for one contact; in a chain of bodies that touch, MuJoCo
    has no stiffness ratio, and e does not determine the outcome.

    Args:
        restitution: 0 < e <= 1.
        timestep: h > 0 [s].
        duration: of the contact without damping > 0 [s]; None: 20 time steps. Bodies
            sink into each other by about `speed * duration / pi`.
        solimp: (dmin, dmax, width [m], midpoint, power) of the impedance.
        speed: of approach > 0 [m/s].

    Returns:
        (-stiffness [1/s^2], -damping [1/s]).

    Raises:
        ValueError: values out of range, or a coefficient that no damping gives at this
            time step.

    Source: own derivation, see `mujoco_restitution`.

    >>> import jimpact as ji
    >>> solref = ji.mujoco_solref(0.8, timestep=0.002)
    >>> round(ji.mujoco_restitution(solref, timestep=0.002).mean, 6)
    0.8
    """
    check_values("restitution", restitution, low=0.0, open_low=True, high=1.0)
    _check(timestep, solimp, speed)
    if duration is None:
        duration = _STEPS_A_CONTACT * timestep
    check_values("duration", duration, low=0.0, open_low=True)
    stiffness = (np.pi / duration) ** 2

    def excess(damping: float) -> float:
        """Mean coefficient of restitution with this damping [1/s], less the one asked
        for.
        """
        e = _restitution((-stiffness, -damping), timestep, solimp, speed)
        return float(e.mean()) - restitution

    ends = 0.0, 1.0 / timestep  # beyond, a step reverses the velocity
    # e = 1, of which the steps lose less than 1e-6 without damping
    if excess(ends[0]) <= 0.0:
        return -stiffness, 0.0
    if excess(ends[1]) > 0.0:
        raise ValueError(
            f"Argument `restitution` must be at least "
            f"{restitution + excess(ends[1]):.3g} with timestep={timestep:g} and "
            f"duration={duration:g}, but has value {restitution:g}: give a shorter "
            f"timestep or a longer duration."
        )
    return -stiffness, -float(brentq(excess, *ends))


def _check(timestep: float, solimp: tuple[float, ...], speed: float) -> None:
    """Raise a ValueError for a time step, an impedance or a speed out of range."""
    check_values("timestep", timestep, low=0.0, open_low=True)
    check_values("speed", speed, low=0.0, open_low=True)
    check_shape(
        "solimp", np.asarray(solimp), (5,), "dmin, dmax, width, midpoint, power"
    )
    check_values("solimp", np.asarray(solimp), low=0.0)


def _stiffness_and_damping(
    solref: tuple[float, float], timestep: float, largest: float
) -> tuple[float, float]:
    """k [1/s^2] and b [1/s] of the reference acceleration `-b r' - k d r`.

    Equation: for solref (T, z) `k = 1 / (D T z)^2`, `b = 2 / (D T)`, T at least two
    time steps [s]; for (-K, -B) `k = K / D^2`, `b = B / D`; D = `largest`, the
    impedance dmax.
    """
    check_shape("solref", np.asarray(solref), (2,), "timeconst and dampratio")
    first, second = solref
    if first > 0 and second > 0:
        time = max(first, 2 * timestep)
        return 1 / (largest * time * second) ** 2, 2 / (largest * time)
    if first < 0 and second <= 0:
        return -first / largest**2, -second / largest
    raise ValueError(
        f"Argument `solref` must be (timeconst, dampratio), both > 0, or (-stiffness, "
        f"-damping), but has value ({first:g}, {second:g})."
    )


class _Impedance(NamedTuple):
    """MuJoCo's `solimp`: the impedance d rises from dmin to dmax over a width of
    penetration.
    """

    dmin: float
    dmax: float
    width: float  # [m]
    midpoint: float  # of the rise, over the width
    power: float

    def clipped(self) -> "_Impedance":
        """The impedance with numbers confined to the ranges that MuJoCo allows."""
        low = _LEAST_IMPEDANCE
        high = 1 - _LEAST_IMPEDANCE
        dmin, dmax, midpoint = (
            min(max(x, low), high) for x in (self.dmin, self.dmax, self.midpoint)
        )
        return _Impedance(dmin, dmax, self.width, midpoint, max(self.power, 1.0))

    def at(self, depth: np.ndarray) -> np.ndarray:
        """Impedance d at depths of penetration [m], a smooth step.

        Equation: `d = dmin + y (dmax - dmin)` with `x = min(depth / width, 1)`, the
        midpoint c and the power p: `y = x^p / c^(p - 1)` up to c, beyond
        `1 - (1 - x)^p / (1 - c)^(p - 1)`.
        """
        if self.dmin == self.dmax or self.width == 0:
            return np.full_like(depth, (self.dmin + self.dmax) / 2)
        x = np.minimum(depth / self.width, 1.0)
        c = self.midpoint
        p = self.power
        begin = x**p / c ** (p - 1)
        end = 1 - (1 - x) ** p / (1 - c) ** (p - 1)
        return self.dmin + np.where(x <= c, begin, end) * (self.dmax - self.dmin)


def _restitution(
    solref: tuple[float, float],
    timestep: float,
    solimp: tuple[float, ...],
    speed: float,
) -> np.ndarray:
    """e = v+ / speed for each of `_PHASES` instants within a step at which the contact
    may begin.

    Semi-implicit Euler steps of `r'' = max(0, -d (b r' + k d r))` until the contact
    opens, see `mujoco_restitution`.
    """
    impedance = _Impedance(*solimp).clipped()
    stiffness, damping = _stiffness_and_damping(
        solref, timestep, largest=impedance.dmax
    )
    v = np.full(_PHASES, -speed)
    # depths at the end of the step in which contact begins, at equally likely instants
    r = -speed * timestep * (np.arange(_PHASES) + 0.5) / _PHASES
    in_contact = np.ones(_PHASES, bool)
    for _ in range(_MOST_STEPS):
        d = impedance.at(-r)
        push = np.maximum(-d * (damping * v + stiffness * d * r), 0.0)
        # without push they part at this speed
        in_contact &= (r < 0) & ((push > 0) | (v < 0))
        if not in_contact.any():
            return v / speed
        v = np.where(in_contact, v + timestep * push, v)
        r = np.where(in_contact, r + timestep * v, r)
    raise ValueError(
        f"Argument `timestep` must be longer: with value {timestep:g} the contact "
        f"lasts more than {_MOST_STEPS} steps."
    )
