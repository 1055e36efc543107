"""Compliant contacts: real gaps and a force that depends on indentation and its
rate.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jimpact.core.contact import Contact
from jimpact.core.law import Impulses, Law, OptionalValues, Values, option, parameter
from jimpact.core.scene import Scene
from jimpact.events.contact_flow import Viscous
from jimpact.events.impact_dynamics import (
    METHODS,
    Dynamics,
    ImpactUnits,
    dimensionless,
    solve,
    tangential_of,
)
from jimpact.laws.forces import (
    Bistiffness,
    Force,
    HuntCrossley,
    KelvinVoigt,
    KuwabaraKono,
)
from jimpact.laws.lzb import (
    BISTIFFNESS,
    check_few_contacts,
    check_spring,
    solver_of,
    tangential_spring,
)
from jimpact.numerics.derive import ADJOINTS
from jimpact.numerics.tridiagonal import diagonal
from jimpact.tools.checks import check_choice, check_values
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import check_rtol


class Compliant(Law):
    """Unilateral compliant contacts, each with its own gap: opens, waits, closes again.

    Equation: `M v' = N F`, `x_j' = -gamma_j`, `F_j = max(f(x_j, x_j'), 0)` while
    `x_j > 0`, from `x_j = -gap_j` until no contact is loaded or approaches. Free flight
    between contacts is exact, so that gaps of any size cost nothing. Geometry (M and N)
    is frozen.

    Args:
        force: a contact force: `PowerLaw(k, eta)`, `Hertz(k)`, `LinearSpring(k)`,
            `Bistiffness(k, eta, e)`, `KelvinVoigt(k, c)`, `HuntCrossley(k, d, eta)`,
            `KuwabaraKono(k, A)`, `ElastoPlastic(k, F_y, eta)`,
            `UserForce(function, parameters)`; stiffness k [N / m^eta], exponent eta,
            restitution e, damping c [N s/m], d [s/m], dissipative time A [s], yield
            force F_y [N].
        friction: Coulomb's mu >= 0, scalar or (m,), for a scene with tangents; None:
            none.
        tangential_stiffness: kappa > 0, scalar or (m,), of a tangential spring
            `k_t = kappa dF/dx(x)` with a force of x alone, as in `LZB`; motions by
            contact forces keep it from step to step; None: contacts stick rigidly.
        initial_energy: U_0j >= 0, scalar or (m,) [J]: precompression of closed
            contacts; not with a viscous force.
        rtol: tolerance on v+ relative to max |v-|; default 1e-8 (float32: 1e-5), with
            method 'implicit' 1e-5 (float32: 1e-4).
        max_steps: maximum attempted steps.
        method: 'time', 'implicit' or 'auto' (default), as in `LZB`.
        check_conditioning: solve a second time to detect `ill_conditioned`, as in
            `LZB`.
        adjoint: 'jacobian' (default), 'forward' or 'checkpoints', as in `LZB`.

    Status: `max_steps`; `plastic_limit` where contacts re-close without end;
    `ill_conditioned` if checked.

    Derivatives, forward and reverse, in the force's parameters, gaps, W and gamma-;
    one-sided where a gap is 0 and at grazing events; NaN as in `LZB`, and where a
    contact touches at rest whose force does not begin at 0, F(0) > 0. Where two orders
    of collision meet, the outcome changes within gaps of about `gap_scale`; there
    derivatives are of order |change of v+| / `gap_scale`. Method 'implicit' has first
    derivatives only, as in `LZB`; NaN where forces jump as contacts close or open
    (`KelvinVoigt` with several contacts, F(0) > 0), which its steps do not follow.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.14)-(6.16).

    >>> import jimpact as ji
    >>> law = ji.Compliant(ji.Hertz(1.0))
    >>> out = ji.impact(
    ...     law, ji.chain([1.0, 1.0, 1.0], gaps=[0.0, 0.1]), [1.0, 0.0, 0.0]
    ... )
    >>> [round(float(v), 5) for v in out.velocity]
    [-0.04134, 0.04313, 0.99821]
    """

    uses_gaps: ClassVar[bool] = True

    force: Force
    friction: OptionalValues = parameter(low=0.0, default=None, kw_only=True)
    tangential_stiffness: OptionalValues = tangential_spring()
    initial_energy: Values = parameter(low=0.0, default=0.0, kw_only=True)
    rtol: float | None = option(None, low=0.0, high=1.0, open_low=True)
    max_steps: int = option(100_000, low=1)
    method: str = option("auto", METHODS)
    check_conditioning: bool = option(default=False, choices=(False, True))
    adjoint: str = option("jacobian", ADJOINTS)

    def __check_init__(self) -> None:
        """Raise a TypeError unless `force` is a `Force`, a ValueError for what it does
        not allow.

        A viscous force, F(x, x'), and one that yields (`bound`) allow no
        `initial_energy`: their energy is no function of x alone. One that yields allows
        no friction, no method 'implicit'.
        """
        if not isinstance(self.force, Force):
            raise TypeError(
                "Argument `force` must be a contact force such as Hertz(k), "
                f"but has value {self.force!r}."
            )
        check_spring(self)
        yields = self.force.bound is not None
        # no pair of F(x), to load and to unload
        viscous = self.force.bistiffness is None
        if self.tangential_stiffness is not None and viscous:
            raise ValueError(
                f"Argument `tangential_stiffness` must be None with a force that "
                f"depends on the rate of indentation, as k_t = kappa dF/dx(x), but the "
                f"force is {self.force!r}: PowerLaw, LinearSpring, Hertz and "
                f"Bistiffness have it."
            )
        if viscous or yields:
            check_values("initial_energy", self.initial_energy, low=0.0, high=0.0)
        if yields and (self.friction is not None or self.method == "implicit"):
            raise ValueError(
                f"Argument `force` must not yield with friction or method 'implicit', "
                f"but has value {self.force!r}."
            )

    @property
    def contact_force(self) -> Force:
        """The contact force, its argument `force`."""
        return self.force

    @property
    def has_history(self) -> bool:  # type: ignore[override]
        """True if the force is a `Bistiffness`."""
        return self.force.bistiffness is not None

    def check(self, scene: Scene, dtype: jnp.dtype) -> None:
        """Raise a ValueError for an `rtol` below rounding, or too many contacts with
        friction.
        """
        if self.rtol is not None:
            check_rtol(self.rtol, dtype)
        if self.friction is not None:
            check_few_contacts(scene)

    def accuracy(self, contact: Contact) -> float:
        """`rtol`, or its default at this `contact`."""
        _, rtol = solver_of(self, contact)
        return rtol

    def dynamics(self, contact: Contact) -> Dynamics:
        """The dimensionless dynamics of the whole encounter, gaps included.

        Units are those of a power law k x^eta: of the `Bistiffness`, or, for other
        forces, of the linear spring k = q^2 / x^2 that stores the energy q^2 / 2 of the
        fastest approach q [sqrt(J)] at the indentation x at which the force does, too
        (`indentation_scale`).
        """
        gamma = contact.gap_velocity
        force = self.force
        bistiffness = force.bistiffness
        if bistiffness is not None:
            k = bistiffness.stiffness
            e = bistiffness.restitution
            exponent = bistiffness.exponent
        else:
            k = stiffness_of_units(force, contact)
            e = jnp.ones_like(gamma)
            exponent = 1.0
        method, rtol = solver_of(self, contact)
        problem, units = dimensionless(
            BISTIFFNESS,
            contact.delassus,
            gamma,
            e,
            k,
            exponent,
            contact.stored,
            rtol,
            contact.gaps,
        )
        # F_j = max(f(x_j, x_j'), 0), called in SI units
        if bistiffness is None:
            problem = problem._replace(viscous=viscous_force(force, units))
        # yields where k x^eta = F_y
        if bistiffness is not None and force.bound is not None:
            depth = (force.bound / k) ** (1 / jnp.asarray(exponent, k.dtype))
            problem = problem._replace(limit=depth / units.indentation)
        if self.friction is not None:
            tangential = tangential_of(
                contact, self.friction, self.tangential_stiffness, units
            )
            problem = problem._replace(tangential=tangential)
        return Dynamics(
            problem=problem,
            units=units,
            equations=BISTIFFNESS,
            exponent=exponent,
            structure=contact.structure,
            max_steps=self.max_steps,
            method=method,
            adjoint=self.adjoint,
        )

    @full_precision
    def impulses(self, contact: Contact) -> Impulses:
        """Impulses p (m,), p_t (t,) [N s] over the whole encounter, gaps included, and
        status.
        """
        if self.check_conditioning:
            checked = contact
        else:
            checked = None
        return Impulses(*solve(self.dynamics(contact), checked))


def stiffness_of_units(force: Force, contact: Contact) -> jax.Array:
    """k = q^2 / x^2 (m,) [N/m] of the spring that gives a viscous `force` its units.

    It stores the energy q^2 / 2 of the fastest approach q [sqrt(J)] at the indentation
    x [m] at which the force does, too (`indentation_scale`).
    """
    gamma = contact.gap_velocity
    approach = jnp.where(gamma < 0, -gamma, 0.0)
    q = jnp.max(approach / jnp.sqrt(diagonal(contact.delassus)))
    x = force.indentation_scale(0.5 * q**2 * jnp.ones_like(gamma))
    return jax.lax.stop_gradient((q / x) ** 2)


def viscous_force(force: Force, units: ImpactUnits) -> Viscous:
    """A force F(x, x') with the units of x, x', F and of its onset."""
    speed = units.velocity * units.root
    depth = units.indentation
    onset = jax.lax.stop_gradient(force.onset_scale(depth, speed))
    return Viscous(force, depth, speed, units.momentum / units.time, onset)


RHEOLOGIES = ("bistiffness", "kelvin-voigt", "hunt-crossley", "kuwabara-kono")


def make_compliant(
    stiffness: Any,
    exponent: Any = 1.5,
    restitution: Any = 1.0,
    rheology: str = "bistiffness",
    damping: Any = None,
    friction: Any = None,
    tangential_stiffness: Any = None,
) -> Compliant:
    """`Compliant` from plain parameters, as in a study file.

    Args:
        stiffness: k > 0 [N / m^eta].
        exponent: eta >= 1 of a bistiffness and of Hunt and Crossley's force.
        restitution: e in [0, 1] of a bistiffness.
        rheology: one of `RHEOLOGIES`.
        damping: of a viscous rheology, in the unit of its force; None for a
            bistiffness.
        friction: Coulomb's mu; None: none.
        tangential_stiffness: kappa of a tangential spring; None: contacts stick
            rigidly.
    """
    viscous: dict[str, Callable[..., Force]] = {
        "kelvin-voigt": KelvinVoigt,
        "hunt-crossley": partial(HuntCrossley, exponent=exponent),
        "kuwabara-kono": KuwabaraKono,
    }
    check_choice("rheology", rheology, RHEOLOGIES)
    if (rheology == "bistiffness") != (damping is None):
        raise ValueError(
            f"Argument `damping` must be given for a viscous rheology and only there, "
            f"but `rheology` is {rheology!r} and `damping` has value {damping!r}."
        )
    if rheology == "bistiffness":
        force: Force = Bistiffness(stiffness, exponent, restitution)
    else:
        force = viscous[rheology](stiffness, damping)
    return Compliant(
        force, friction=friction, tangential_stiffness=tangential_stiffness
    )
