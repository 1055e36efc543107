"""The rocking block: outcomes of its impacts over its shape, restitution matrices,
measurements.
"""

from importlib.resources import files
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.shapes import Block
from jimpact.core.impacts import impact
from jimpact.laws.lzb import LZB
from jimpact.tools.checks import as_axis, as_numbers, check_values
from jimpact.tools.compiling import precise_jit
from jimpact.tools.status import STATUS

# After the impact a corner counts as staying on the ground up to this gap velocity, as
# part of the approach of B: real corners are not sharp, and slow ones touch down again
# at once. Ten times more would call most rocking blocks resting.
STAYS = 0.05
OUTCOMES = ("rest", "rocking", "half-rocking", "free", "unresolved")
_FAILS = np.array([row.failure for row in STATUS])
# grids of the search, each twenty times finer than the one before
_ZOOMS = 6
_POINTS = 41


class RockingRatio(NamedTuple):
    """A measured restitution of angular velocity, beside that of a rigid block.

    `aspect` = height / width; `material` of the interface; `measured_over_housner`: the
    measured restitution over that of the rigid block.
    """

    aspect: float
    material: str
    measured_over_housner: float

    @property
    def restitution(self) -> float:
        """e_theta: the ratio times Housner's value. A conversion, not a fit."""
        housner = float(housner_restitution(self.aspect))
        return self.measured_over_housner * housner


def housner_restitution(aspect: Any) -> jax.Array:
    """Angular velocity after over before, of a rigid block that rocks.

    Equation: `e_theta = 1 - (3/2) sin^2(alpha)`, `tan(alpha) = 1 / aspect`, which is
    `(2 a^2 - 1) / (2 (a^2 + 1))`: conserved angular momentum about the corner that is
    hit.

    Args:
        aspect: a = height / width > 0; scalar or array. Below `1 / sqrt(2)` the value
            is negative: such a block does not rock.

    Returns:
        e_theta, of the shape of `aspect`.

    Raises:
        ValueError: an aspect that is not positive.

    Source: Housner, Bull. Seism. Soc. Am. 53 (1963) 403-417.

    >>> import jimpact as ji
    >>> [round(float(ji.theory.housner_restitution(a)), 6) for a in (1.0, 2.0, 3.0)]
    [0.25, 0.7, 0.85]
    """
    a = as_numbers("aspect", aspect, low=0.0, open_low=True)
    return 1 - 1.5 / (1 + a**2)


def rocking_matrix(restitution: Any) -> jax.Array:
    """Restitution matrix (3, 3) of a block that rocks without slip or rebound.

    Equation: `E = [[0, e, 0], [e, 0, 0], [0, 0, -e]]` in (qn_1, qn_2, qt): rotating
    about one corner and hitting with the other, `gamma_2+ = -e gamma_1-`,
    `gamma_1+ = 0`, `qt+ = e qt-`,
    so that the angular velocity about the new corner is e times the old one.

    Args:
        restitution: e_theta in [0, 1], the ratio of angular velocities.

    Returns:
        E for `RestitutionMatrix`, on a planar scene of one block with its two corners.

    Raises:
        ValueError: e_theta out of range, or more than one.

    Status: an impact with less than Housner's value (`housner_restitution`) is
    `negative_impulse`: the corner that is left behind would have to be pulled down.
    Exactly there its impulse is 0, and derivatives are one-sided.

    Source: Brogliato, Nonsmooth Mechanics (2016), section 6.3.2.2, with the signs of
    `v+ = -E v-`.

    >>> import jimpact as ji
    >>> (10 * ji.theory.rocking_matrix(0.7)).round().tolist()
    [[0.0, 7.0, 0.0], [7.0, 0.0, 0.0], [0.0, 0.0, -7.0]]
    """
    ratio = "one ratio of angular velocities"
    e = as_numbers("restitution", restitution, (), ratio, low=0.0, high=1.0)
    matrix = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
    return e * jnp.array(matrix, e.dtype)


def rocking_ratios() -> list[RockingRatio]:
    """Measured ratios of freely rocking blocks, bundled with the package.

    Times Housner's value they give e_theta, and with `rocking_matrix` a restitution
    matrix:
    a conversion of published numbers, not a fit.

    Returns:
        A `RockingRatio` a row.

    Source: ElGawady et al., as quoted in public abstracts; see data/README.md.

    >>> import jimpact as ji
    >>> for row in ji.theory.rocking_ratios():
    ...     print(row.material, row.aspect, round(row.restitution, 4))
    concrete 5.0 0.8952
    rubber 5.0 0.6313
    concrete 3.0 0.8245
    """
    file = files("jimpact") / "data" / "rocking_ratio.csv"
    _, *rows = file.read_text(encoding="utf-8").splitlines()  # without the header
    lines = [row.split(",") for row in rows]
    return [RockingRatio(float(a), name, float(ratio)) for a, name, ratio in lines]


class RockingDispersion(eqx.Module):
    """Impacts of a block that rocks about A and hits with B, over aspects, mu, e.

    Attributes:
        aspect: a = height / width (A,).
        friction: mu (B,).
        restitution: energetic e (C,).
        gap_velocity: gamma+ / |gamma_B-| (A, B, C, 2), of B and A.
        angular_ratio: theta'+ / theta'- (A, B, C); compare with
            `housner_restitution(aspect)`.
        slip_velocity: of both corners after, / |gamma_B-| (A, B, C).
        energy_ratio: T+ / T- (A, B, C).
        status: codes (A, B, C); values of failures are NaN.
    """

    aspect: jax.Array
    friction: jax.Array
    restitution: jax.Array
    gap_velocity: jax.Array
    angular_ratio: jax.Array
    slip_velocity: jax.Array
    energy_ratio: jax.Array
    status: jax.Array

    @property
    def kinetic_angle(self) -> jax.Array:
        """theta_12 (A,) [rad]."""
        return rocking_kinetic_angle(self.aspect)

    @property
    def dispersion(self) -> jax.Array:
        """d = y_A'+ / y_B'- <= 0 (A, B, C)."""
        return -self.gap_velocity[..., 1]

    @property
    def over_housner(self) -> jax.Array:
        """theta'+ / theta'- over Housner's value (A, B, C)."""
        housner = housner_restitution(self.aspect)
        return self.angular_ratio / housner[:, None, None]

    def outcomes(self, separation_threshold: float = STAYS) -> np.ndarray:
        """Classes of the impacts (A, B, C), as indices of `OUTCOMES`: which corners
        leave.

        A corner leaves if its gamma+ > `separation_threshold` |gamma_B-|.

        rest: none; rocking: A only, the block goes on about B; half-rocking: B only, it
        turns back about A; free: both; unresolved: the law failed.
        """
        leaves = np.asarray(self.gap_velocity) > separation_threshold  # last axis: B, A
        # 0 none, 1 A only, 2 B only, 3 both
        codes = leaves[..., 1] + 2 * leaves[..., 0]
        unresolved = OUTCOMES.index("unresolved")
        failed = np.isnan(np.asarray(self.gap_velocity[..., 0]))
        return np.where(failed, unresolved, codes)

    def __str__(self) -> str:
        """Report: for each mu the critical angle and the numbers of impacts of each
        class.
        """
        theta = np.degrees(self.kinetic_angle)
        outcomes = self.outcomes()
        lines = [
            f"rocking block, kinetic angle {theta.min():.1f} to {theta.max():.1f} "
            f"degrees ({len(theta)} shapes), {len(self.restitution)} e"
        ]
        for j, mu in enumerate(np.asarray(self.friction)):
            of_friction = outcomes[:, j].ravel()
            counts = np.bincount(of_friction, minlength=len(OUTCOMES))
            pairs = zip(OUTCOMES, counts)
            shares = ", ".join(f"{n} {name}" for name, n in pairs if n)
            critical = float(np.degrees(critical_kinetic_angle(mu)))
            lines.append(
                f"mu = {mu:g}: critical angle {critical:.2f} degrees; {shares}"
            )
        return "\n".join(lines)


def rocking_kinetic_angle(aspect: Any) -> jax.Array:
    """theta_12 [rad] of a homogeneous block on the ground, between two corners.

    Equation: `cos(theta_12) = -(a^2 - 2) / (a^2 + 4)`, a = height / width: pi / 3 flat,
    pi slender.

    Args:
        aspect: a = height / width > 0, scalar or array.

    Returns:
        Angle [rad], of the shape of `aspect`.

    Raises:
        ValueError: an aspect that is not positive.

    Source: Brogliato (2016), section 6.3.2.2.

    >>> import jimpact as ji
    >>> round(float(ji.theory.rocking_kinetic_angle(2.0**0.5)), 6)
    1.570796
    """
    a = as_numbers("aspect", aspect, low=0.0, open_low=True)
    cosine = -(a**2 - 2) / (a**2 + 4)
    return jnp.arccos(cosine)


def critical_kinetic_angle(friction: Any) -> jax.Array:
    """Kinetic angle [rad] at which the hit at B leaves corner A alone.

    Equation: B alone is pressed, slips at mu < 3 a / (4 a^2 + 1) and sticks otherwise;
    A gets no acceleration where `a^2 - 2 + 3 mu a = 0`, or where it sticks at
    `2 a^2 = 1`, Housner's zero: `a_c = (sqrt(9 mu^2 + 8) - 3 mu) / 2` for mu <= 1 /
    sqrt(2), else 1 / sqrt(2). No restitution, stiffness or exponent is in it. Above
    a_c, `gamma_B+ = e`, `gamma_A+ = (1 + e) r` in units of the approach,
    `r = (a^2 - 2 + 3 mu a) / (a^2 + 4 - 3 mu a)` slipping, Housner's value sticking.

    Args:
        friction: mu >= 0, scalar or array.

    Returns:
        Angle [rad], of the shape of `friction`.

    Raises:
        ValueError: friction < 0.

    Source: own derivation; Brogliato (2016), section 6.3.2.2, shows the angle in a
    figure only.

    >>> import jimpact as ji
    >>> [
    ...     round(float(ji.theory.critical_kinetic_angle(mu)), 4)
    ...     for mu in (0.0, 0.3, 1.0)
    ... ]
    [1.5708, 1.3862, 1.231]
    """
    mu = as_numbers("friction", friction, low=0.0)
    slips = jnp.minimum(mu, 0.5**0.5)  # beyond, B sticks
    root = jnp.sqrt(9 * slips**2 + 8)
    aspect = (root - 3 * slips) / 2
    return rocking_kinetic_angle(aspect)


class _BlockImpacts(NamedTuple):
    """Outcomes of blocks of width 1 that turn with theta'- = -1 about A, gamma_B- =
    -1.
    """

    gap_velocity: jax.Array  # gamma+ (n, 2) of B and A
    angular_ratio: jax.Array  # theta'+ / theta'- (n,)
    slip_velocity: jax.Array  # u+ (n,) of both corners
    energy_ratio: jax.Array  # T+ / T- (n,)
    status: jax.Array  # codes (n,)


@precise_jit
def _impacts(a: jax.Array, mu: jax.Array, e: jax.Array, law: LZB) -> _BlockImpacts:
    """Outcomes of blocks (n,) of width 1, height a, friction mu and restitution e by a
    law.

    The block turns about its corner A with theta'- = -1 and hits with B: v- = (a/2,
    -1/2, -1). Values are NaN where the law fails.
    """

    def one(a: jax.Array, mu: jax.Array, e: jax.Array) -> _BlockImpacts:
        """Outcome of one block, failures included."""
        unit = jnp.ones_like(a)
        scene = Block(unit, a, unit, corners="base").scene()
        sinks = jnp.full_like(a, -0.5)
        turns = jnp.full_like(a, -1.0)
        before = jnp.stack([a / 2, sinks, turns])
        with_values = eqx.tree_at(lambda x: (x.friction, x.restitution), law, (mu, e))
        out = impact(with_values, scene, before)
        after_x, _, turns_on = out.velocity
        squares = before**2 * scene.mass
        energy = squares.sum() / 2
        return _BlockImpacts(
            gap_velocity=scene.normals.T @ out.velocity,
            angular_ratio=-turns_on,
            slip_velocity=after_x + a / 2 * turns_on,
            energy_ratio=1 + out.energy_change / energy,
            status=out.status,
        )

    out = jax.vmap(one)(a, mu, e)
    failed = jnp.asarray(_FAILS)[out.status]
    lost = failed[:, None]
    gamma = jnp.where(lost, jnp.nan, out.gap_velocity)
    numbers = out.angular_ratio, out.slip_velocity, out.energy_ratio
    turn, slip, energy = (jnp.where(failed, jnp.nan, x) for x in numbers)
    return _BlockImpacts(gamma, turn, slip, energy, out.status)


def rocking_dispersion(
    aspect: Any,
    friction: Any = 0.0,
    restitution: Any = 1.0,
    stiffness: Any = 1.0,
    exponent: Any = 1.5,
    rtol: float | None = None,
) -> RockingDispersion:
    """A block that rocks about A and hits with B, by LZB with Coulomb friction.

    Equation: `(gamma_B-, gamma_A-) = (-1, 0)`, no slip before; `d = y_A'+ / y_B'-` is 0
    at the critical angle (`critical_kinetic_angle`) and grows in size on either side of
    it: a V.

    Args:
        aspect: a = height / width > 0, scalar or (A,).
        friction: mu >= 0, scalar or (B,), of both corners.
        restitution: energetic e in [0, 1], scalar or (C,), of both corners. At e = 0 no
            corner rebounds, and left of the critical angle d = 0: half a V.
        stiffness: of the corners, scalar or (2,) for B and A.
        exponent: 1 linear, 1.5 Hertz.
        rtol: as in `LZB`.

    Returns:
        `RockingDispersion` over all combinations (A, B, C); NaN where LZB fails:
        `max_steps`, for a few wide blocks left of the critical angle with e below about
        0.1.

    Raises:
        ValueError: arguments out of range or with more than one axis.

    Source: Brogliato, Nonsmooth Mechanics (2016), section 6.3.2.2; classes as in
    `RockingDispersion.outcomes`.

    >>> import jimpact as ji
    >>> ji.theory.rocking_dispersion(-1.0)
    Traceback (most recent call last):
    ...
    ValueError: Argument `aspect` must lie in (0, inf), but has value -1 at index 0.
    """
    a = as_axis("aspect", aspect)
    mu = as_axis("friction", friction)
    e = as_axis("restitution", restitution)
    check_values("aspect", a, low=0.0, open_low=True)
    check_values("friction", mu, low=0.0)
    check_values("restitution", e, low=0.0, high=1.0)
    law = LZB(1.0, stiffness, exponent, friction=0.0, rtol=rtol)
    cases = jnp.meshgrid(a, mu, e, indexing="ij")
    each_a, each_mu, each_e = (x.ravel() for x in cases)
    results = _impacts(each_a, each_mu, each_e, law)
    shape = cases[0].shape
    on_grid = jax.tree.map(lambda x: x.reshape(shape + x.shape[1:]), results)
    return RockingDispersion(a, mu, e, **on_grid._asdict())


def search_critical_angle(
    friction: Any, restitution: Any, stiffness: Any = 1.0, exponent: Any = 1.5
) -> jax.Array:
    """The kinetic angle [rad] at which |d| is least, by impacts alone.

    Grids over 0.5 <= a <= 2, each around the best point of the previous one; to about
    1e-7 where e > 0 (at e = 0 there is no minimum). Arguments as in
    `rocking_dispersion`.

    Args:
        friction: mu >= 0, scalar or (B,).
        restitution: e in (0, 1], scalar or (C,).
        stiffness: of the corners, scalar or (2,) for B and A.
        exponent: 1 linear, 1.5 Hertz.

    Returns:
        Angles (B, C) [rad].

    Raises:
        ValueError: arguments out of range or with more than one axis.

    Source: own; checks `critical_kinetic_angle`.

    >>> import jimpact as ji
    >>> ji.theory.search_critical_angle(0.1, -0.5)
    Traceback (most recent call last):
    ...
    ValueError: Argument `restitution` must lie in (0, 1], but has value -0.5 ...
    """
    mu = as_axis("friction", friction)
    e = as_axis("restitution", restitution)
    check_values("friction", mu, low=0.0)
    check_values("restitution", e, low=0.0, high=1.0, open_low=True)
    law = LZB(1.0, stiffness, exponent, friction=0.0)
    grid = jnp.meshgrid(mu, e, indexing="ij")
    mus, es = (x.ravel() for x in grid)
    low = jnp.full_like(mus, 0.5)
    high = jnp.full_like(mus, 2.0)
    for _ in range(_ZOOMS):
        a = jnp.linspace(low, high, _POINTS, axis=1)
        each_mu, each_e = (jnp.repeat(x, _POINTS) for x in (mus, es))
        gamma = _impacts(a.reshape(-1), each_mu, each_e, law).gap_velocity
        size = jnp.abs(gamma[:, 1]).reshape(a.shape)  # |d| = |gamma_A+|
        place = jnp.nanargmin(size, axis=1)[:, None]
        best = jnp.take_along_axis(a, place, 1)[:, 0]
        step = (high - low) / (_POINTS - 1)
        low = best - step
        high = best + step
    return rocking_kinetic_angle(best).reshape(len(mu), len(e))


class RockingDomain(NamedTuple):
    """Admissible `E = [[own, cross], [cross, own]]` of a block flat on the ground.

    `aspect`, `sliding`; `coupling` g: G = [[1, g], [g, 1]]; `corners` (k, 2): the
    vertices of the domain in the plane (own, cross).
    """

    aspect: float
    sliding: bool
    coupling: float
    corners: np.ndarray

    def contains(self, own: Any, cross: Any) -> np.ndarray:
        """True for admissible entries `own` and `cross`, ends included; arrays
        broadcast.

        Equation: `own >= 0`, `cross >= 0`, `own + cross <= 1`, `cross >= g (1 + own)`.
        """
        a = np.asarray(own, float)
        b = np.asarray(cross, float)
        within = (a >= 0) & (b >= 0) & (a + b <= 1)
        inside: np.ndarray = within & (b >= self.coupling * (1 + a))
        return inside

    @property
    def rocking(self) -> tuple[float, float]:
        """Least and largest `cross` at own = 0: the corner that hits stays, the other
        leaves.
        """
        return max(self.coupling, 0.0), 1.0

    @property
    def half_rocking(self) -> tuple[float, float] | None:
        """Least and largest `own` at cross = 0: the corner that hits leaves, the other
        stays.
        """
        if self.coupling <= 0:
            return (0.0, 1.0)
        return None


def rocking_domain(aspect: Any, sliding: bool = True) -> RockingDomain:
    """Restitution matrices of a homogeneous block that mechanics allows.

    Equation: with `E = [[a, b], [b, a]]` for (qn_1, qn_2), where a corner hits alone it
    returns a of its velocity and the other one gets b of it. Prop. 6.2: a, b >= 0 and
    `b >= g (1 + a)`; Prop. 6.4: `a + b <= 1`. Free (both corners leave): a, b > 0;
    half-rocking (it turns back about the same corner): b = 0; rocking (from corner to
    corner): a = 0.
    `g = (A^2 - 2) / (A^2 + 4)` of the aspect A where both corners slide without
    friction, and Housner's value `(2 A^2 - 1) / (2 A^2 + 2)` where they stick before
    and after.

    Args:
        aspect: A = height / width > 0.
        sliding: True: without tangential impulses (E_33 = -1); False: both corners
            stick.

    Returns:
        `RockingDomain`.

    Raises:
        ValueError: an aspect that is not positive.

    Host function, not differentiable.

    Source: own derivation from Brogliato (2016), Props. 6.2 and 6.4; the admissible
    entries of the source's reference [228] were not at hand.

    >>> import jimpact as ji
    >>> domain = ji.theory.rocking_domain(2.0)
    >>> domain.corners.round(
    ...     4
    ... ).tolist()  # slender: it never turns back about the same corner
    [[0.0, 0.25], [0.6, 0.4], [0.0, 1.0]]
    >>> domain.half_rocking, ji.theory.rocking_domain(2.0, sliding=False).rocking
    (None, (0.7, 1.0))
    """
    checked = as_numbers("aspect", aspect, (), "one block", low=0.0, open_low=True)
    a = float(checked)
    if sliding:
        g = (a**2 - 2) / (a**2 + 4)
    else:
        g = float(housner_restitution(a))
    # a, b >= 0, a + b <= 1, cut by b = g (1 + a)
    wide = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    corner = [(1 - g) / (1 + g), 2 * g / (1 + g)]
    slender = [[0.0, g], corner, [0.0, 1.0]]
    corners = np.array(wide if g <= 0 else slender)
    return RockingDomain(a, sliding, g, corners)
