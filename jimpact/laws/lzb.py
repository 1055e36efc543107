"""The LZB law: energetic restitution, distributed over the contacts by their stiffness
ratios.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact
from jimpact.core.law import (
    LARGEST_EXPONENT,
    Impulses,
    Law,
    OptionalValues,
    StaticOrValues,
    Values,
    option,
    parameter,
)
from jimpact.core.scene import Scene
from jimpact.events.contact_flow import ContactEquations, Exponent, power
from jimpact.events.impact_dynamics import (
    METHODS,
    Dynamics,
    dimensionless,
    method_for,
    solve,
    tangential_of,
)
from jimpact.laws.forces import Bistiffness
from jimpact.numerics.derive import ADJOINTS
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import check_rtol

# ---- The equations of a contact j, Brogliato (2016), 6.3.1, with the errata of
# docs/equations.md. They are written in time, dp_j = F_j dt, and in the indentation x_j
# that stores the energy E_j. Of all contacts (6.69) is gamma' = W F.


# Eq. (6.70): dp_j / dp_i = Gamma_ji = F_j / F_i,
# F_j = ((1 + eta_j) E_j)^(eta_j / (1 + eta_j)) k_j^(1 / (1 + eta_j))
def force(x: jax.Array, k: jax.Array, eta: Exponent) -> jax.Array:
    """`F_j = k_j x_j^eta_j` in loading and unloading; 0 where x_j <= 0."""
    return k * power(x, eta)


# Eq. (6.71) loading, (6.72) unloading: dE_j = -gamma_j / s_j^2 dp_j, so that
# x_j' = -gamma_j / s_j^2
def scale(unloads: jax.Array, e: jax.Array) -> jax.Array:
    """s_j: 1 in loading, e_j in unloading, so that e_j^2 of the work is returned."""
    return jnp.where(unloads, e, 1.0)


# E_j = k_j x_j^(eta_j + 1) / (eta_j + 1), the work of loading W_c,j of 6.3.1
def depth(q: jax.Array, k: jax.Array, eta: jax.Array) -> jax.Array:
    """x_j at which E_j = q^2 / 2, q [sqrt(J)]."""
    # q^2 / k may be too small or too large for a number where x_j is not
    return (jnp.sqrt((eta + 1) / 2) * q / jnp.sqrt(k)) ** (2 / (eta + 1))


BISTIFFNESS = ContactEquations(force, scale, depth)

# Tolerances of v+ if the law has no `rtol`, relative to max |v-|. Ten times more would
# make every outcome right to one digit less.
DEFAULT_RTOL = {"float64": 1e-8, "float32": 1e-5}
# Method 'implicit': finer than what is measured, some 100 steps. Ten times more saves
# half of them.
DEFAULT_RTOL_IMPLICIT = {"float64": 1e-5, "float32": 1e-4}

# Contacts with friction up to which impact dynamics are tried: each of their events
# involves all of them. Ten times more would not end within hours, and no status would
# ever say so.
MOST_WITH_FRICTION = 200


def default_rtol(method: str, dtype: jnp.dtype) -> float:
    """Tolerance of v+, relative to max |v-|, if the law has no `rtol`."""
    if method == "implicit":
        table = DEFAULT_RTOL_IMPLICIT
    else:
        table = DEFAULT_RTOL
    return table.get(str(dtype), table["float32"])


def solver_of(law: Any, contact: Contact) -> tuple[str, Any]:  # law: LZB, Compliant
    """The `method` of a law with impact dynamics at these contacts, 'auto' decided, and
    its rtol.

    The tolerance is the law's, else the contact's, else the default of the method.
    """
    springs = law.tangential_stiffness is not None
    method = method_for(law.method, contact, law.friction is not None, springs)
    if law.rtol is not None:
        return method, law.rtol
    if contact.rtol is not None:
        return method, contact.rtol
    return method, default_rtol(method, contact.gap_velocity.dtype)


def check_few_contacts(scene: Scene) -> None:
    """Raise a ValueError for a scene of more than `MOST_WITH_FRICTION` contacts, with
    friction.
    """
    if scene.contacts > MOST_WITH_FRICTION:
        raise ValueError(
            f"Argument `scene` must have at most {MOST_WITH_FRICTION} contacts for "
            f"impact dynamics with friction, but has {scene.contacts}: algebraic laws "
            f"such as Moreau take more."
        )


def tangential_spring() -> Any:
    """The parameter kappa > 0 of laws with tangential springs; None: contacts stick
    rigidly.
    """
    return parameter(low=0.0, open_low=True, log=True, default=None, kw_only=True)


def check_spring(law: Any) -> None:  # law: LZB, Compliant
    """Raise a ValueError for a `tangential_stiffness` without friction, or by method
    'implicit'.
    """
    if law.tangential_stiffness is None:
        return
    if law.friction is None:
        raise ValueError(
            "Argument `friction` must be given with `tangential_stiffness`, whose "
            "force mu limits, but has value None."
        )
    if law.method == "implicit":
        raise ValueError(
            "Argument `method` must be 'time' or 'auto' with `tangential_stiffness`, "
            "but has value 'implicit': its steps know contacts that stick rigidly."
        )


class LZB(Law):
    """Impact dynamics of Liu, Zhao and Brogliato with bistiffness contacts.

    Equation, with force `F_j = k_j x_j^eta_j` at the indentation x_j:
    `gamma' = W F`, `p' = F`, `x_j' = -gamma_j` in compression, `-gamma_j / e_j^2` in
    expansion. It is the distributing rule `dp_j / dp_i = Gamma_ji` (6.70), written in
    time because the ratio form is singular at first contact. It ends when all contacts
    are unloaded and none approaches. A contact may open, re-close and be compressed
    repeatedly; geometry is frozen.

    Args:
        restitution: energetic coefficient e_j in [0, 1], scalar or (m,); at 0 the limit
            e -> 0+.
        stiffness: k_j > 0, scalar or (m,) [N / m^eta_j]. With equal exponents only the
            ratios matter, and v+ is proportional to v-.
        exponent: eta_j >= 1: 1 linear, 1.5 Hertz. A float or a tuple is static (fast
            for 1, 1.5, 2); an array is a parameter to differentiate and fit.
        initial_energy: U_0j >= 0, scalar or (m,) [J]: precompression
            (`precompression_energy` has it of a force).
        friction: Coulomb's mu >= 0, scalar or (m,), for a scene with tangents (planar
            or spatial); None: none. While a contact slips, the tangential force is
            `lambda = -mu F u / |u|`; while it sticks, u is exactly 0 and
            `|lambda| <= mu F` (`docs/friction.md`).
        tangential_stiffness: kappa > 0, scalar or (m,), of a spring along each contact
            with friction, `k_t = kappa dF/dx`; None: contacts stick rigidly. While it
            holds `xi' = u`, `lambda = -k_t xi`; while it slides
            `lambda = -mu F u_s / |u_s|`, `xi = -lambda / k_t`, `u_s = u - xi'`. Each
            impact begins with xi = 0. In expansion k_t is that of the loading curve at
            the same F. A linear spring returns what it took but for what slides; with
            another exponent k_t changes with x, and `k_t' xi^2 / 2` comes from nowhere:
            a nearly elastic impact may gain energy, status `energy_gain`
            (`docs/friction.md`).
        rtol: tolerance on v+ relative to max |v-|; default 1e-8 (float32: 1e-5), with
            method 'implicit' 1e-5 (float32: 1e-4), in fits 1e-4 where that is a tenth
            of the noise.
        max_steps: maximum attempted steps.
        method: 'time', event-aligned, order 8; 'implicit', steps that know no events,
            order 2 to 3, compiled as soon for many contacts with friction as for one;
            'auto' (default): 'time', but 'implicit' for several contacts with friction
            in space, where events may be endless.
        check_conditioning: solve a second time with rtol / 100 and with perturbed last
            digits, and set `ill_conditioned` if gap velocities or slips differ by more
            than 10 rtol of the fastest approach (cost and float32:
            `docs/speed_accuracy.md`).
        adjoint: how derivatives are computed. 'jacobian' (default): both modes, by the
            Jacobian in all numbers of the contacts that depend on what is
            differentiated; 'forward': forward mode only, along the directions asked
            for: faster where these are few and contacts many; 'checkpoints': reverse
            mode only, faster from some 64 numbers on. Another mode than these raises.

    Status: `plastic_limit` where contacts re-close without end; `max_steps`, also
    because large friction can jam contacts, which then vibrate for a long time;
    `ill_conditioned` if checked.

    Derivatives, forward and reverse, in all parameters, W and gamma-; one-sided at e =
    0 and e = 1, at touching contacts, at grazing events (e.g. k2/k1 = 6.1713 for three
    equal linear balls), and where slip stops just as a contact opens. They are NaN
    where two contacts with e = 0 that act on each other end their compression at once
    (a block that lands flat): slopes there depend on the direction. Method 'implicit'
    returns those of equal e_j -> 0 there, has first derivatives only, of what it
    computes (at the default `rtol` right to 1e-3 or 5e-3), and raises for second ones.
    In `initial_energy` at 0 the true slope may be infinite; 0 is returned.

    Source: Liu, Zhao and Brogliato, Proc. R. Soc. A 464 (2008) 3193 and 465 (2009) 1;
    Brogliato, Nonsmooth Mechanics (2016), (6.67)-(6.73) with the errata of
    `docs/equations.md`.

    >>> import jimpact as ji
    >>> law = ji.LZB(restitution=[0.9, 0.8], stiffness=[1.0, 0.5], exponent=1.5)
    >>> out = ji.impact(law, ji.chain([1.0, 2.0, 3.0]), [1.0, 0.0, 0.0])
    >>> [round(float(v), 5) for v in out.velocity]
    [-0.27931, -0.04383, 0.45566]
    """

    separable: ClassVar[bool] = True
    has_history: ClassVar[bool] = True

    restitution: Values = parameter(low=0.0, high=1.0)
    stiffness: Values = parameter(low=0.0, open_low=True, log=True, default=1.0)
    exponent: StaticOrValues = parameter(
        low=1.0, static_numbers=True, searched_high=LARGEST_EXPONENT, default=1.5
    )
    initial_energy: Values = parameter(low=0.0, default=0.0)
    friction: OptionalValues = parameter(low=0.0, default=None, kw_only=True)
    tangential_stiffness: OptionalValues = tangential_spring()
    rtol: float | None = option(None, low=0.0, high=1.0, open_low=True)
    max_steps: int = option(100_000, low=1)
    method: str = option("auto", METHODS)
    check_conditioning: bool = option(default=False, choices=(False, True))
    adjoint: str = option("jacobian", ADJOINTS)

    def __check_init__(self) -> None:
        """Raise a ValueError for a `tangential_stiffness` that does not go with the
        rest.
        """
        check_spring(self)

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

    @property
    def pads_scenes(self) -> bool:  # type: ignore[override]
        """True without friction."""
        return self.friction is None

    @property
    def only_stiffness_ratios(self) -> bool:  # type: ignore[override]
        """True if all exponents are equal."""
        return len(np.unique(np.asarray(self.exponent, float))) == 1

    @property
    def contact_force(self) -> Bistiffness:
        """The Bistiffness force of each contact; in SI units only if the stiffness
        is.
        """
        return Bistiffness(self.stiffness, self.exponent, self.restitution)

    def dynamics(self, contact: Contact, rtol: Any = None) -> Dynamics:
        """The dimensionless dynamics of the contacts; `rtol` replaces that of the
        law.
        """
        method, default = solver_of(self, contact)
        if rtol is None:
            rtol = default
        problem, units = dimensionless(
            BISTIFFNESS,
            contact.delassus,
            contact.gap_velocity,
            self.restitution,
            self.stiffness,
            self.exponent,
            contact.stored,
            rtol,
            closed=contact.closed,
        )
        if self.friction is not None:
            tangential = tangential_of(
                contact, self.friction, self.tangential_stiffness, units
            )
            problem = problem._replace(tangential=tangential)
        return Dynamics(
            problem=problem,
            units=units,
            equations=BISTIFFNESS,
            exponent=self.exponent,
            structure=contact.structure,
            max_steps=self.max_steps,
            method=method,
            adjoint=self.adjoint,
        )

    @full_precision
    def impulses(self, contact: Contact) -> Impulses:
        """Impulses p (m,), p_t (t,) [N s] at the end of the impact dynamics, and
        status.
        """
        if self.check_conditioning:
            checked = contact
        else:
            checked = None
        return Impulses(*solve(self.dynamics(contact), checked))
