"""Outcomes against gaps: where contacts close at once, and linearized in the gaps."""

from dataclasses import dataclass
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.impacts import impact
from jimpact.core.law import Law
from jimpact.core.scene import Scene, with_gaps
from jimpact.laws.gap_scale import gap_scale as gap_scale
from jimpact.tools.checks import as_float_array, as_numbers, check_shape
from jimpact.tools.status import STATUS

# Linearized over sampled standard deviation, less 1, up to which the outcome is called
# linear.
AGREES = 0.2
# a standard deviation below this, relative to the velocities, is rounding
CONSTANT = 1e-12


class Crossover(eqx.Module):
    """`velocity` (s, n) [m/s] and `status` (s,) over `offset` (s,).

    The offset is (gap 1 - gap 2) / delta_c.
    """

    offset: jax.Array
    velocity: jax.Array
    status: jax.Array


def crossover(scene: Scene, law: Law, velocity: Any, offset: Any) -> Crossover:
    """Outcome of a two-contact scene against the difference of its gaps.

    The outcome depends on which contact closes first. Laws of instantaneous collisions
    jump where both close at once. With indentation the jump is a smooth crossover,
    about 2 delta_c wide.

    Args:
        scene: with two contacts; the mean of its gaps (none: closed) is widened as
            needed.
        law: a `Compliant`, or another one with a `contact_force` that uses gaps.
        velocity: v- (n,) [m/s].
        offset: (s,), or one, `(gap_1 - gap_2) / delta_c`, with the larger delta_c of
            the two.

    Returns:
        `Crossover`: `velocity` (s, n) [m/s] and `status` (s,), one row for each
            `offset` (s,).

    Raises:
        ValueError: not two contacts, offsets of another shape. TypeError: another law.

    Source: Brogliato, Nonsmooth Mechanics (2016), section 6.1.1.1: balls of mass (m/4,
    m, m/4).

    >>> import jimpact as ji
    >>> balls = ji.chain([0.25, 1.0, 0.25])
    >>> law = ji.Compliant(ji.Hertz(1.0))
    >>> result = ji.theory.crossover(balls, law, [1.0, 0.0, -1.0], [-9.0, 0.0, 9.0])
    >>> (
    ...     result.velocity.round(4) + 0.0
    ... ).tolist()  # one by one, both at once, the mirror image
    [[-0.6, -0.16, 1.24], [-1.0, 0.0, 1.0], [-1.24, 0.16, 0.6]]
    """
    if scene.contacts != 2:
        raise ValueError(
            f"Argument `scene` must have two contacts, but has {scene.contacts}."
        )
    if not law.uses_gaps or law.contact_force is None:
        raise TypeError(
            f"Argument `law` must use gaps and have a `contact_force` (Compliant), but "
            f"is {law!r}."
        )
    s = as_numbers("offset", offset)
    if s.ndim != 1:
        raise ValueError(
            f"Argument `offset` must have shape (s,), but has shape {s.shape}."
        )
    scale = gap_scale(scene, law, velocity)
    delta = jnp.max(scale.delta)
    # gaps (s, 2) = mean +- delta s / 2, the mean large enough for gaps >= 0
    largest = 0.5 * delta * jnp.max(jnp.abs(s))
    mean = jnp.maximum(jnp.mean(scale.gaps), largest)
    signs = jnp.array([1.0, -1.0], s.dtype)
    gaps = mean + 0.5 * delta * s[:, None] * signs[None, :]
    v = as_float_array("velocity", velocity)
    gaps = jnp.maximum(gaps, 0.0)
    impact_at = jax.vmap(lambda each: impact(law, with_gaps(scene, each), v))
    out = impact_at(gaps)
    return Crossover(s, out.velocity, out.status)


class SampledGaps(Protocol):
    """A result of `ji.monte_carlo`: covariance of its gaps, and statistics of v+
    (n,).
    """

    @property
    def gap_covariance(self) -> np.ndarray:
        """(m, m) [m^2]."""

    @property
    def std(self) -> np.ndarray:
        """Standard deviations of v+ (n,) [m/s]."""

    @property
    def minimum(self) -> np.ndarray:
        """Least v+ (n,) [m/s]."""

    @property
    def maximum(self) -> np.ndarray:
        """Largest v+ (n,) [m/s]."""


@dataclass(frozen=True, eq=False)
class GapSensitivity:
    """The outcome at given gaps (m,) [m] and its derivatives in them.

    Attributes:
        gaps, velocity: (m,) [m], where it is linearized, and (n,) [m/s], the outcome
            there.
        jacobian: (n, m) [1/s], `d v+_i / d gap_j`.
        status: name of the impact's status.
        sampled: the Monte Carlo run to compare with, or None.
    """

    gaps: np.ndarray
    velocity: np.ndarray
    jacobian: np.ndarray
    status: str
    sampled: SampledGaps | None = None

    def covariance(self, gap_covariance: Any) -> np.ndarray:
        """Linearized covariance (n, n) of velocities, `J Sigma J^T`, Sigma =
        `gap_covariance`.
        """
        sigma = np.asarray(gap_covariance, float)
        shape = (len(self.gaps),) * 2
        check_shape("gap_covariance", sigma, shape, "a row and a column per contact")
        return self.jacobian @ sigma @ self.jacobian.T

    @property
    def explained(self) -> np.ndarray:
        """Linearized over sampled standard deviation (n,): 1 where the linearization
        holds.
        """
        if self.sampled is None:
            raise ValueError(
                "Argument `sampled` must be given for a comparison, but is None."
            )
        covariance = self.covariance(self.sampled.gap_covariance)
        linear = np.sqrt(np.diag(covariance))
        with np.errstate(divide="ignore", invalid="ignore"):
            return linear / self.sampled.std

    def __str__(self) -> str:
        """Report: v+ and its Jacobian in the gaps and, if sampled, the standard
        deviations.
        """
        at = ", ".join(f"{gap:g}" for gap in self.gaps)
        lines = [
            f"Linearized at gaps ({at}) m, status {self.status}; d v+ / d gap [1/s]:"
        ]
        rows = zip(self.velocity, self.jacobian)
        for i, (v, row) in enumerate(rows):
            numbers = "".join(f"{x:13.5g}" for x in row)
            lines.append(f"v{i + 1}+ = {v:10.6f} m/s: {numbers}")
        if self.sampled is not None:
            lines += self._comparison()
        return "\n".join(lines)

    def _comparison(self) -> list[str]:
        """Report lines: linearized against sampled standard deviations [m/s], and a
        verdict.
        """
        assert self.sampled is not None
        ratio = self.explained
        ends = [self.sampled.minimum, self.sampled.maximum]
        largest = np.max(np.abs(ends), initial=0.0)
        if np.all(self.sampled.std <= CONSTANT * largest):
            return ["The outcome does not depend on the gaps."]
        lines = ["standard deviations [m/s], linearized against sampled:"]
        rows = zip(self.sampled.std, ratio)
        for i, (std, part) in enumerate(rows):
            lines.append(f"v{i + 1}+: {part * std:.3g} against {std:.3g}")
        if np.all(np.abs(ratio - 1) <= AGREES):
            lines.append("The outcome is nearly linear over the spread of the gaps.")
        elif not self.jacobian.any():
            lines.append(
                "The outcome does not change with small changes of the gaps, yet it "
                "varies: it jumps where the order of the collisions changes. Trust the "
                "samples."
            )
        else:
            lines.append(
                "The linearization fails over this spread: the gaps reach across a "
                "crossover or a curved part. Trust the samples."
            )
        return lines


def gap_sensitivity(
    law: Law, scene: Scene, velocity: Any, gaps: Any, sampled: SampledGaps | None = None
) -> GapSensitivity:
    """Jacobian of the outcome in the gaps, and the linearized covariance.

    Equation: `J = d v+ / d gap`, `cov(v+) ~ J Sigma J^T`. It holds where the outcome is
    nearly linear over the spread of the gaps, so not across a crossover of the order of
    contacts; for laws that see gaps only in the order of collisions (Binary) J = 0, for
    laws that ignore the sizes of gaps too.

    Args:
        law: as in `impact`.
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s].
        gaps: (m,) >= 0 [m], where to linearize: often `sampled.gap_mean`.
        sampled: a run of `monte_carlo` with random gaps to compare with.

    Returns:
        `GapSensitivity`; `print` puts the linearized next to the sampled spread.

    Raises:
        ValueError: not one gap per contact, gaps < 0; what `impact` refuses.

    Source: own derivation, propagation of errors to first order.

    >>> import jimpact as ji
    >>> law, balls = ji.Binary(1.0, order="earliest"), ji.chain([0.25, 1.0, 0.25])
    >>> found = ji.theory.gap_sensitivity(law, balls, [1.0, 0.0, -1.0], [1e-6, 2e-6])
    >>> found.velocity.round(6).tolist()
    [-0.6, -0.16, 1.24]
    """
    shape = (scene.contacts,)
    at = as_numbers("gaps", gaps, shape, "one gap per contact", low=0.0)
    v = as_float_array("velocity", velocity)

    def outcome(gaps: jax.Array) -> tuple[jax.Array, Any]:
        """v+ (n,) [m/s] at gaps (m,) [m], to be differentiated; v+ and status as they
        are.
        """
        out = impact(law, with_gaps(scene, gaps), v)
        return out.velocity, (out.velocity, out.status)

    differentiated = jax.jacfwd(outcome, has_aux=True)
    jacobian, (after, status) = differentiated(at)
    return GapSensitivity(
        gaps=np.asarray(at),
        velocity=np.asarray(after),
        jacobian=np.asarray(jacobian),
        status=STATUS[int(status)].name,
        sampled=sampled,
    )
