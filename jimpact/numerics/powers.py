"""Powers `x^eta` of indentations and energies, and roots, with finite derivatives at 0."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.numerics.contacts import along_contacts

LARGE = 6.0  # exponents below it that are whole or half are products

Exponent = float | tuple[float, ...] | jax.Array


def power(x: jax.Array, exponent: Exponent) -> jax.Array:
    """`max(x, 0)^exponent` with finite derivatives at 0; fast for static halves."""
    if isinstance(exponent, tuple) and len(set(exponent)) == 1:
        exponent = exponent[0]
    if isinstance(exponent, float) and exponent == 1.0:
        return jnp.where(x >= 0, x, 0.0)  # at 0 the derivative of a contact that closes
    positive = x > 0
    x = jnp.where(positive, x, 0.0)
    if isinstance(exponent, float) and exponent < LARGE and (2 * exponent).is_integer():
        root = jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)
        whole = [x] * int(exponent)
        return functools.reduce(jnp.multiply, whole if exponent.is_integer() else [*whole, root])
    eta = along_contacts(jnp.asarray(exponent, x.dtype), x)
    return jnp.where(positive, jnp.exp(eta * jnp.log(jnp.where(positive, x, 1.0))), 0.0)


def plus_one(exponent: Exponent) -> Exponent:
    """`exponent + 1`, static where `exponent` is."""
    return tuple(e + 1 for e in exponent) if isinstance(exponent, tuple) else exponent + 1


def root_order(exponent: Exponent) -> int:
    """`r` of the START and ROOT_X variables: powers `xi^(r eta)` are then smooth enough.

    At 4 other than whole and half exponents take half the steps, but the errors of many closings
    reach 100 tolerances.
    """
    known = isinstance(exponent, (float, tuple))
    etas = np.atleast_1d(np.asarray(exponent)) if known else np.array([0.1])
    return 2 if np.all(2 * etas == np.round(2 * etas)) else 8


def root_of(x: jax.Array, order: int) -> jax.Array:
    """`x^(1/order)` of x > 0, for orders that are powers of 2."""
    return x if order == 1 else root_of(jnp.sqrt(x), order // 2)


def factor(exponent: Exponent, like: jax.Array) -> jax.Array:
    """`(eta + 1) / 2`, to multiply values (m, ...) such as `like`."""
    return along_contacts((jnp.asarray(exponent, like.dtype) + 1) / 2, like)
