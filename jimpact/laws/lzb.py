"""The LZB law: energetic restitution, distributed over the contacts by their stiffness ratios."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_shape, check_values, is_traced
from jimpact.contact_space import tangential_delassus
from jimpact.laws.base import Law
from jimpact.laws.friction import check_friction
from jimpact.numerics import friction
from jimpact.numerics.dimensionless import METHODS, Inputs, Units, solve, to_dimensionless
from jimpact.numerics.powers import Exponent
from jimpact.scene import Scene
from jimpact.solvers.tridiagonal import Symmetric, Tridiagonal, as_matrix

DEFAULT_RTOL = {"float64": 1e-8, "float32": 1e-5}
DEFAULT_RTOL_IMPULSE = 1e-4  # first order: the step in the primary impulse itself
FINEST_RTOL_IN_EPS = 16  # below this many roundings the error estimate is noise


def default_rtol(method: str, dtype: jnp.dtype) -> float:
    """Tolerance used where the law names none."""
    return DEFAULT_RTOL_IMPULSE if method == "impulse" else DEFAULT_RTOL.get(str(dtype), 1e-5)


def distributing_rule(energy: Any, stiffness: Any, exponent: Any) -> jax.Array:
    """`Gamma_ji = dp_j / dp_i` (m, m), the ratio of impulse increments at two contacts.

    Equation: `Gamma_ji = F_j / F_i`, `F_j = ((1 + eta_j) E_j)^(eta_j / (1 + eta_j))
    k_j^(1 / (1 + eta_j))`.

    Args:
        energy: E_j >= 0 (m,) [J], potential energy of each contact.
        stiffness: k_j > 0, scalar or (m,) [N / m^eta_j].
        exponent: eta_j >= 1, scalar or (m,).

    Returns:
        Row j, column i: Gamma_ji; NaN or inf in columns with E_i = 0 (0/0 at the first touch:
        why the law is integrated in time form, see `LZB`).

    Source: Liu, Zhao and Brogliato (2008); Brogliato (2016), (6.70).

    >>> import jimpact as ji
    >>> round(float(ji.distributing_rule([1.0, 0.3], [1.0, 2.0], 1.5)[1, 0]), 5)
    0.64074
    """
    energy = as_float_array("energy", energy)
    stiffness = as_float_array("stiffness", stiffness)
    eta = as_float_array("exponent", exponent)
    check_values("energy", energy, low=0.0)
    check_values("stiffness", stiffness, low=0.0, open_low=True)
    check_values("exponent", eta, low=1.0)
    force = ((1 + eta) * energy) ** (eta / (1 + eta)) * stiffness ** (1 / (1 + eta))
    return force[:, None] / force[None, :]


class LZB(Law):
    """Impact dynamics of Liu, Zhao and Brogliato with bistiffness contacts.

    Equation, with force `F_j = k_j x_j^eta_j` at the indentation x_j:
    `gamma' = W F`, `p' = F`, `x_j' = -gamma_j` in compression, `-gamma_j / e_j^2` in expansion.
    It is the distributing rule `dp_j / dp_i = Gamma_ji` (6.70) written in time, where it is
    regular. It ends when all contacts are unloaded and none approaches. A contact may open,
    re-close and be compressed repeatedly; geometry is frozen.

    Args:
        restitution: energetic coefficient e_j in [0, 1], scalar or (m,); at 0 the limit e -> 0+.
        stiffness: k_j > 0, scalar or (m,) [N / m^eta_j]. With equal exponents only the ratios
            matter, and v+ is proportional to v-.
        exponent: eta_j >= 1: 1 linear, 1.5 Hertz. A float or a tuple is static (fast for 1, 1.5,
            2); an array is a parameter to differentiate and fit.
        initial_energy: U_0j >= 0, scalar or (m,) [J]: precompression.
        friction: Coulomb's mu >= 0, scalar or (m,), for a scene with tangents (planar or spatial);
            None: none. While contacts slip `lambda = -mu F u / |u|`, while they stick their slip
            velocity is exactly 0 and `|lambda| <= mu F` (see `docs/friction.md`).
        rtol: tolerance on v+ relative to max |v-|; default 1e-8 (float32: 1e-5).
        max_steps: passes of the integrator (or steps, method 'impulse') before it gives up.
        method: 'time' (default), event-aligned, order 8; 'propagator', exact, exponent 1 only;
            'impulse', the published scheme in the impulse of a primary contact, order 1.

    Status: `plastic_limit` where contacts re-close without end; `max_steps`, also where large
    friction wedges contacts that then vibrate for long.

    Derivatives, forward and reverse, in all parameters, W and gamma-; one-sided at e = 0 and
    e = 1, at touching contacts, and at grazing events (e.g. k2/k1 = 6.1713 for three equal
    linear balls), and where slip stops just as a contact opens. In `initial_energy` at 0 the true
    slope may be infinite; 0 is returned.

    Source: Liu, Zhao and Brogliato, Proc. R. Soc. A 464 (2008) 3193 and 465 (2009) 1;
    Brogliato, Nonsmooth Mechanics (2016), (6.67)-(6.73) with the errata of `docs/equations.md`.

    >>> import jimpact as ji
    >>> law = ji.LZB(restitution=[0.9, 0.8], stiffness=[1.0, 0.5], exponent=1.5)
    >>> out = ji.impact(law, ji.chain([1.0, 2.0, 3.0]), [1.0, 0.0, 0.0])
    >>> [round(float(v), 5) for v in out.velocity]
    [-0.27931, -0.04383, 0.45566]
    """

    restitution: jax.Array
    stiffness: jax.Array
    initial_energy: jax.Array
    friction: jax.Array | None
    exponent_array: jax.Array | None
    exponent_static: float | tuple[float, ...] | None = eqx.field(static=True)
    rtol: float | None = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    method: str = eqx.field(static=True)

    def __init__(
        self,
        restitution: Any,
        stiffness: Any = 1.0,
        exponent: Any = 1.5,
        initial_energy: Any = 0.0,
        *,
        friction: Any = None,
        rtol: float | None = None,
        max_steps: int = 100_000,
        method: str = "time",
    ):
        self.restitution = as_float_array("restitution", restitution)
        self.stiffness = as_float_array("stiffness", stiffness)
        self.initial_energy = as_float_array("initial_energy", initial_energy)
        self.friction = None if friction is None else as_float_array("friction", friction)
        if isinstance(exponent, (int, float)):
            self.exponent_static, self.exponent_array = float(exponent), None
        elif isinstance(exponent, tuple) and not is_traced(exponent):
            self.exponent_static, self.exponent_array = tuple(float(x) for x in exponent), None
        else:
            self.exponent_static = None
            self.exponent_array = as_float_array("exponent", exponent)
        self.rtol, self.max_steps, self.method = rtol, max_steps, method
        check_values("restitution", self.restitution, low=0.0, high=1.0)
        check_values("stiffness", self.stiffness, low=0.0, open_low=True)
        check_values("initial_energy", self.initial_energy, low=0.0)
        if self.friction is not None:
            check_values("friction", self.friction, low=0.0)
        check_values("exponent", self.exponent, low=1.0)
        if rtol is not None:
            check_values("rtol", rtol, low=0.0, high=1.0, open_low=True)
        if method not in METHODS:
            raise ValueError(
                f"Argument `method` must be one of {METHODS}, but has value {method!r}."
            )
        if method == "propagator" and self.exponent_static != 1.0:
            raise ValueError(
                "Argument `exponent` must be the float 1.0 for method='propagator', "
                f"but has value {self.exponent}."
            )
        if method != "time" and friction is not None:
            raise ValueError(
                f"Argument `method` must be 'time' with friction, but has value {method!r}."
            )

    @property
    def exponent(self) -> Exponent:
        """The exponents as given: static float or tuple, or an array."""
        static = self.exponent_static
        return static if static is not None else self.exponent_array  # type: ignore[return-value]

    def stored_energy(self, contacts: int) -> jax.Array:
        """`U_0` (m,) [J]."""
        return jnp.broadcast_to(self.initial_energy, (contacts,))

    def with_stored(self, energy: jax.Array) -> "LZB":
        """Open contacts store nothing."""
        return eqx.tree_at(lambda law: law.initial_energy, self, energy)

    def check_options(self, dtype: jnp.dtype, scene: Scene) -> None:
        """A tolerance finer than the precision can hold is an error."""
        if isinstance(self.exponent_static, tuple):
            check_shape("exponent", self.exponent_static, (scene.contacts,), "one per contact")
        finest = FINEST_RTOL_IN_EPS * float(jnp.finfo(dtype).eps)
        if self.rtol is not None and self.rtol < finest:
            raise ValueError(
                f"Argument `rtol` must be at least {finest:.2g} in {dtype}, "
                f"but has value {self.rtol:g}: enable jax_enable_x64 for finer tolerances."
            )
        if self.friction is not None:
            check_friction(self, scene)

    def by_blocks(self) -> bool:
        """Contacts feel each other through W only; a tuple of exponents belongs to all of them."""
        return self.friction is None and not isinstance(self.exponent_static, tuple)

    def impulse(self, delassus: Symmetric, gap_velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Impulses at the end of the impact dynamics."""
        inputs, units = self._dimensionless(delassus, gap_velocity)
        chain = isinstance(delassus, Tridiagonal)
        p, code = solve(inputs, self.exponent, chain, self.max_steps, self.method)
        return p * units.velocity / units.root, code

    def all_impulses(
        self, scene: Scene, delassus: Symmetric, gap_velocity: jax.Array, velocity: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Impulses with friction, where the law has some."""
        if self.friction is None:
            return super().all_impulses(scene, delassus, gap_velocity, velocity)
        inputs, units = self._dimensionless(as_matrix(delassus), gap_velocity)
        w_nt, w_tt, slip = tangential_delassus(scene, velocity)
        side = friction.to_dimensionless(w_nt, w_tt, self.friction, slip, units)
        (p, p_t), code = friction.solve(inputs, side, self.exponent, self.max_steps)
        root = jnp.repeat(units.root, p_t.shape[0] // p.shape[0])
        return p * units.velocity / units.root, p_t * units.velocity / root, code

    def _dimensionless(self, delassus: Symmetric, gap_velocity: jax.Array) -> tuple[Inputs, Units]:
        return to_dimensionless(
            delassus,
            gap_velocity,
            self.restitution,
            self.stiffness,
            self.exponent,
            self.stored_energy(gap_velocity.shape[0]),
            self.rtol or default_rtol(self.method, gap_velocity.dtype),
        )
