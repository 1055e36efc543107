"""What masks choose: quotients where they exist, and one of two values or trees."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp

T = TypeVar("T")


def quotient(a: Any, b: Any, where: Any, otherwise: Any = 0.0) -> jax.Array:
    """`a / b` where the mask `where` is True, else `otherwise`.

    Elsewhere it divides by 1, so that derivatives are finite at b = 0.

    >>> import jax.numpy as jnp
    >>> b = jnp.array([0.0, 2.0])
    >>> quotient(1.0, b, where=b > 0).tolist()
    [0.0, 0.5]
    """
    return jnp.where(where, a / jnp.where(where, b, 1.0), otherwise)


def choose(where: Any, new: T, old: T) -> T:
    """`new` where the mask `where` is True, else `old`, leaf by leaf.

    >>> import jax.numpy as jnp
    >>> x, y = choose(jnp.array(True), (1.0, 2.0), (3.0, 4.0))
    >>> float(x), float(y)
    (1.0, 2.0)
    """
    return jax.tree.map(lambda a, b: jnp.where(where, a, b), new, old)
