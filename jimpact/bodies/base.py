"""A mechanical system as functions of its configuration: gaps, tangents, mass matrix."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_shape, check_values, is_traced
from jimpact.scene import CLOSED_BELOW, Scene

_ROUNDINGS = 16  # of the largest coordinate: a gap that small is zero, in float32 too


class Mechanism(eqx.Module):
    """What a motion needs of a system with contacts; at one instant it is a `Scene`.

    Equation: gaps `f(q)`, normals `N = grad f`, tangents `H_t`, mass matrix `M(q)`.

    A system of your own gives `coordinates`, `gap_function(q) -> (m,)`, `mass_matrix(q)` and, for
    friction, `tangent_function(q) -> (m,)` (or `tangents(q)` itself). It is a pytree: its numbers
    may be traced, batched and differentiated.

    >>> import jimpact as ji
    >>> block = ji.Block(width=1.0, height=2.0)
    >>> block.gap_function(block.touching(0.0)).tolist()
    [0.0, 0.0]
    """

    @property
    @abc.abstractmethod
    def coordinates(self) -> int:
        """Number n of coordinates q."""

    @abc.abstractmethod
    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps f(q) (m,) [m]; negative in penetration."""

    @abc.abstractmethod
    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q) (n, n), or (n,) its diagonal."""

    def tangent_function(self, q: jax.Array) -> jax.Array:
        """Displacements (m,) [m] along the contact planes; their rates are the sliding speeds."""
        raise NotImplementedError(f"{type(self).__name__} has no planar tangents.")

    def tangents(self, q: jax.Array) -> jax.Array:
        """H_t (n, m), planar, or (n, 2 m), contact-major: `v_t = H_t^T v`."""
        return jax.jacobian(self.tangent_function)(q).T

    def scene(self, q: Any) -> Scene:
        """The scene at configuration q (n,).

        Gaps up to 1e-12 m (or a few roundings of q) count as closed.

        Raises:
            ValueError: q of another size or not finite; penetration.
        """
        q = as_float_array("q", q)
        check_shape("q", q, (self.coordinates,), "one per coordinate of the system")
        check_values("q", q)
        mass, normals, tangents, f = _at(self, q)
        eps = float(jnp.finfo(f.dtype).eps)
        none = jnp.maximum(CLOSED_BELOW, _ROUNDINGS * eps * jnp.maximum(1.0, jnp.abs(q).max()))
        if not is_traced((f, none)) and bool(jnp.any(f < -none)):
            worst = int(jnp.argmin(f))
            raise ValueError(
                f"Argument `q` must have no penetration, but gap {worst} has value "
                f"{float(f[worst]):g} m."
            )
        gaps = jnp.where(f > none.astype(f.dtype), f, 0.0)
        parts = (mass, normals, tangents, gaps)
        return Scene(*jax.tree.map(lambda x: x.astype(f.dtype), parts))


@eqx.filter_jit
def _at(
    system: Mechanism, q: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array | None, jax.Array]:
    tangents = None if _frictionless(system) else system.tangents(q)
    normals = jax.jacobian(system.gap_function)(q).T
    return system.mass_matrix(q), normals, tangents, system.gap_function(q)


def _frictionless(system: Mechanism) -> bool:
    kind = type(system)
    own = kind.tangents is not Mechanism.tangents
    return not own and kind.tangent_function is Mechanism.tangent_function


def positive(name: str, value: Any, low_allowed: bool = False) -> jax.Array:
    """A scalar > 0, or >= 0 where `low_allowed`."""
    number = as_float_array(name, value)
    check_shape(name, number, (), "one number")
    check_values(name, number, low=0.0, open_low=not low_allowed)
    return number


def number(name: str, value: Any) -> jax.Array:
    """A finite scalar."""
    found = as_float_array(name, value)
    check_shape(name, found, (), "one number")
    check_values(name, found)
    return found


def positives(name: str, value: Any, count: int | None = None) -> jax.Array:
    """Numbers (count,) > 0; a scalar stands for all of them."""
    found = as_float_array(name, value)
    if count is not None and found.ndim == 0:
        found = jnp.full(count, found)
    if found.ndim != 1 or (count is not None and found.shape[0] != count):
        size = "n" if count is None else count
        raise ValueError(f"Argument `{name}` must have shape ({size},), but has {found.shape}.")
    check_values(name, found, low=0.0, open_low=True)
    return found
