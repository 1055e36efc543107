"""Compliant penalization: contacts with real gaps and a force-indentation law."""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jimpact.contact import Contact
from jimpact.law import Impulses, Law, option
from jimpact.laws.forces import Bistiffness, Force, HuntCrossley, KelvinVoigt, KuwabaraKono
from jimpact.laws.lzb import check_rtol, default_rtol
from jimpact.numerics.dimensionless import solve, to_dimensionless
from jimpact.numerics.flow import Viscous
from jimpact.scene import Scene
from jimpact.solvers.tridiagonal import Symmetric, Tridiagonal, diagonal


class Compliant(Law):
    """Unilateral compliant contacts, each with its own gap: opens, waits, closes again.

    Equation: `M v' = N F`, `x_j' = -gamma_j`, `F_j = max(f(x_j, x_j'), 0)` while `x_j > 0`, from
    `x_j = -gap_j` until nothing approaches any more. Free flight between contacts is exact, so
    that gaps of any size cost nothing. Geometry (M and N) is frozen.

    Args:
        force: of `rheology.py`: `PowerLaw(k, eta)`, `Hertz(k)`, `LinearSpring(k)`,
            `Bistiffness(k, eta, e)`, `KelvinVoigt(k, c)`, `HuntCrossley(k, d, eta)`,
            `KuwabaraKono(k, A)`, `UserForce(function, parameters)`.
        rtol: tolerance on v+ relative to max |v-|; default 1e-8 (float32: 1e-5).
        max_steps: passes of the integrator before it gives up.

    Status: `max_steps`; `plastic_limit` where contacts re-close without end.

    Derivatives, forward and reverse, in the force's parameters, gaps, W and gamma-; one-sided
    where a gap is 0 and at grazing events. Where two orders of collision meet the outcome changes
    within gaps of about `gap_scale`, and the derivative there is as large as that says.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.14)-(6.16).

    >>> import jimpact as ji
    >>> law = ji.Compliant(ji.Hertz(1.0))
    >>> out = ji.impact(law, ji.chain([1.0, 1.0, 1.0], gaps=[0.0, 0.1]), [1.0, 0.0, 0.0])
    >>> [round(float(v), 5) for v in out.velocity]
    [-0.04134, 0.04313, 0.99821]
    """

    uses_gaps: ClassVar[bool] = True

    force: Force
    rtol: float | None = option(None, low=0.0, high=1.0, open_low=True)
    max_steps: int = option(100_000, low=1)

    def __check_init__(self) -> None:
        if not isinstance(self.force, Force):
            raise TypeError(
                "Argument `force` must be a contact force such as Hertz(k), "
                f"but has value {self.force!r}."
            )

    def check(self, scene: Scene, dtype: jnp.dtype) -> None:
        """A tolerance that the precision can hold."""
        check_rtol(self.rtol, dtype)

    def impulses(self, contact: Contact) -> Impulses:
        """Impulses over the whole encounter, gaps included."""
        p, code = self._solve(contact.delassus, contact.gap_velocity, contact.gaps)
        return Impulses(p, None, code)

    def _solve(
        self, delassus: Symmetric, gamma: jax.Array, gaps: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        m, force = gamma.shape[0], self.force
        ones, none = jnp.ones_like(gamma), jnp.zeros_like(gamma)
        rtol = self.rtol or default_rtol("time", gamma.dtype)
        chain, viscous = isinstance(delassus, Tridiagonal), None
        if isinstance(force, Bistiffness):
            k, e = (jnp.broadcast_to(z, (m,)) for z in (force.stiffness, force.restitution))
            exponent = force.exponent
        else:  # in units of a spring that stores the impact's energy at the force's indentation
            q = jnp.max(jnp.where(gamma < 0, -gamma, 0.0) / jnp.sqrt(diagonal(delassus)))
            k = (q / force.indentation_scale(0.5 * q**2 * ones)) ** 2
            k, e, exponent = jax.lax.stop_gradient(k), ones, 1.0
        inputs, units = to_dimensionless(delassus, gamma, e, k, exponent, none, rtol, gaps)
        momentum = units.velocity / units.root
        if not isinstance(force, Bistiffness):
            speed = units.velocity * units.root
            viscous = Viscous(force, units.indentation, speed, momentum / units.time)
        p, code = solve(inputs, exponent, chain, self.max_steps, viscous=viscous)
        return p * momentum, code


RHEOLOGIES = ("bistiffness", "kelvin-voigt", "hunt-crossley", "kuwabara-kono")


def make_compliant(
    stiffness: Any,
    exponent: Any = 1.5,
    restitution: Any = 1.0,
    rheology: str = "bistiffness",
    damping: Any = None,
) -> Compliant:
    """`Compliant` from plain parameters, as a study file gives them."""
    viscous: dict[str, Callable[..., Force]] = {
        "kelvin-voigt": KelvinVoigt,
        "hunt-crossley": partial(HuntCrossley, exponent=exponent),
        "kuwabara-kono": KuwabaraKono,
    }
    if rheology not in RHEOLOGIES:
        raise ValueError(
            f"Argument `rheology` must be one of {RHEOLOGIES}, but has value {rheology!r}."
        )
    if (rheology == "bistiffness") != (damping is None):
        raise ValueError(
            "Argument `damping` must be given for a viscous rheology and only there, but "
            f"`rheology` is {rheology!r} and `damping` has value {damping!r}."
        )
    if rheology == "bistiffness":
        return Compliant(Bistiffness(stiffness, exponent, restitution))
    return Compliant(viscous[rheology](stiffness, damping))
