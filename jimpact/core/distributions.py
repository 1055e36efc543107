"""Distributions that samples are drawn from: uniform, normal, rows of an array, own
functions.
"""

import abc
import operator
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.law import Domain, Law, free_parameters_of
from jimpact.tools.checks import (
    ABBREVIATIONS,
    as_float_array,
    as_numbers,
    check_kind,
    check_shape,
    suggestion,
)

OVERLAP = (
    "a negative gap is an overlap, that is a precompressed contact: give LZB the "
    "energy stored in it (`initial_energy`) and leave the gap at 0."
)


class Distribution(eqx.Module):
    """Independent entries, each with its own parameters, or the same for all."""

    def __repr__(self) -> str:
        """The distribution as one writes it."""
        words = ", ".join(
            f"{name}={_short(value)}" for name, value in vars(self).items()
        )
        return f"{type(self).__name__}({words})"

    @abc.abstractmethod
    def sample(
        self, key: jax.Array, size: int, dtype: Any, non_negative: bool
    ) -> jax.Array:
        """One draw (size,); with `non_negative` truncated at 0."""

    def check(self, name: str, size: int, non_negative: bool) -> None:
        """Raise a ValueError unless each parameter is a scalar or has `size` values.

        `non_negative`: raise also where draws of the argument `name` could be negative.
        """
        for field, value in vars(self).items():
            if np.shape(value) not in ((), (size,)):
                raise ValueError(
                    f"Argument `{name}` must have scalars or {size} values in "
                    f"`{field}`, but is {self!r}."
                )


class Uniform(Distribution):
    """Independent and uniform between `low` and `high`.

    Args:
        low: scalar or one per entry (m,), in the unit of what is drawn.
        high: likewise, >= low.

    Raises:
        ValueError: not finite, high < low.

    >>> import jimpact as ji
    >>> ji.Uniform(0.0, [1e-6, 2e-6])
    Uniform(low=0, high=[1e-06, 2e-06])
    """

    low: jax.Array
    high: jax.Array

    def __init__(self, low: Any, high: Any):
        """Check both ends."""
        self.low = as_numbers("low", low)
        self.high = as_numbers("high", high)
        if np.any(np.asarray(self.low) > np.asarray(self.high)):
            raise ValueError(
                f"Argument `high` must be at least `low`, but has {self!r}."
            )

    def sample(
        self, key: jax.Array, size: int, dtype: Any, non_negative: bool
    ) -> jax.Array:
        """One draw (size,): `low + (high - low) u`, u uniform in [0, 1)."""
        low = jnp.broadcast_to(self.low, (size,)).astype(dtype)
        high = jnp.broadcast_to(self.high, (size,)).astype(dtype)
        u = jax.random.uniform(key, (size,), dtype)
        return jnp.minimum(low + (high - low) * u, high)  # rounding only

    def check(self, name: str, size: int, non_negative: bool) -> None:
        """Raise a ValueError for another shape, and, where `non_negative`, for a `low`
        below 0.
        """
        super().check(name, size, non_negative)
        if non_negative and np.any(np.asarray(self.low) < 0):
            raise ValueError(
                f"Argument `{name}` must not yield negative values, but {self!r} does; "
                f"{OVERLAP}"
            )


class Normal(Distribution):
    """Independent and normal.

    As a distribution of gaps it is truncated at 0 (drawn again, not clipped), so the
    gaps have a larger mean and a smaller spread than `mean` and `std` say where these
    are comparable.

    Args:
        mean: scalar or one per entry (m,), in the unit of what is drawn.
        std: standard deviation > 0, likewise.

    Raises:
        ValueError: not finite, std <= 0.

    >>> import jimpact as ji
    >>> ji.Normal(1e-5, 1e-6)
    Normal(mean=1e-05, std=1e-06)
    """

    mean: jax.Array
    std: jax.Array

    def __init__(self, mean: Any, std: Any):
        """Check both parameters."""
        self.mean = as_numbers("mean", mean)
        self.std = as_numbers("std", std, low=0.0, open_low=True)

    def sample(
        self, key: jax.Array, size: int, dtype: Any, non_negative: bool
    ) -> jax.Array:
        """One draw (size,): `mean + std z`, z normal; `non_negative`: truncated at
        0.
        """
        mean = jnp.broadcast_to(self.mean, (size,)).astype(dtype)
        std = jnp.broadcast_to(self.std, (size,)).astype(dtype)
        if not non_negative:
            z = jax.random.normal(key, (size,), dtype)
            return mean + std * z
        lowest = -mean / std
        z = jax.random.truncated_normal(key, lowest, jnp.inf, (size,), dtype)
        return jnp.maximum(mean + std * z, 0)  # rounding only

    def check(self, name: str, size: int, non_negative: bool) -> None:
        """Raise a ValueError for another shape, and, where `non_negative`, for a mean
        below 0.
        """
        super().check(name, size, non_negative)
        if non_negative and np.any(np.asarray(self.mean) < 0):
            raise ValueError(
                f"Argument `{name}` is truncated at 0 and must have a mean of at least "
                f"0, but is {self!r}; {OVERLAP}"
            )


class GivenRows(eqx.Module):
    """Given samples, `count` of them: sample i is row i."""

    count: int

    def __repr__(self) -> str:
        """The number of rows."""
        return f"{self.count} given rows"


class RandomLaw(eqx.Module):
    """A law some of whose parameters are drawn anew for every sample: `key -> Law`.

    Args:
        law: everything that is not drawn.
        parameters: by field, `restitution=Uniform(0.8, 0.9)`; entries are independent
            (give the law a scalar to have one value for all contacts).

    Raises:
        TypeError: no law. ValueError: no such field, or a distribution that leaves its
            domain (as a Normal does where the domain is bounded; a function
            `key -> Law` may do anything).

    >>> import jax
    >>> import jimpact as ji
    >>> drawn = ji.RandomLaw(ji.Newton(0.5), restitution=ji.Uniform(0.8, 0.9))(
    ...     jax.random.key(0)
    ... )
    >>> 0.8 <= float(drawn.restitution) <= 0.9
    True
    """

    law: Law
    parameters: dict[str, Distribution]

    def __init__(self, law: Law, **parameters: Distribution):
        """Check that the law has such parameters, and that they stay in their
        domains.
        """
        if isinstance(law, type):
            raise TypeError(
                f"Argument `law` must be a law with its values, as in "
                f"`RandomLaw(LZB(0.9), restitution=Uniform(0.8, 0.9))`, but is the "
                f"class {law.__name__}."
            )
        check_kind("law", law, Law)
        known = free_parameters_of(law)
        if not parameters:
            raise ValueError(
                "Argument `parameters` must name one that is random or more, of "
                f"{', '.join(known)}."
            )
        for name, distribution in parameters.items():
            if name not in known:
                raise ValueError(
                    f"Parameters of {type(law).__name__} that can be random are "
                    f"{', '.join(known)}, but not `{name}`."
                    f"{suggestion(name, known, ABBREVIATIONS)}"
                )
            if not isinstance(distribution, Distribution):
                raise TypeError(
                    f"Argument `{name}` must be Uniform or Normal, but is "
                    f"{distribution!r}."
                )
            size = known[name].value.size
            distribution.check(name, size, non_negative=False)
            _check_domain(name, distribution, known[name].domain)
        self.law = law
        self.parameters = parameters

    def __repr__(self) -> str:
        """The law's name with its random parameters."""
        words = ", ".join(
            f"{name}={value!r}" for name, value in self.parameters.items()
        )
        return f"{type(self.law).__name__}({words})"

    def __call__(self, key: jax.Array) -> Law:
        """The law whose random parameters are drawn by this key.

        Each is drawn by a key of its own, in the order of their names: the draws do not
        depend on the order of the arguments.
        """
        law = self.law
        known = free_parameters_of(self.law)
        for i, (name, distribution) in enumerate(sorted(self.parameters.items())):
            old, path, _ = known[name]
            own_key = jax.random.fold_in(key, i)
            new = distribution.sample(own_key, old.size, old.dtype, non_negative=False)
            law = eqx.tree_at(operator.attrgetter(path), law, new.reshape(old.shape))
        return law


def as_source(name: str, value: Any, size: int, non_negative: bool) -> Any:
    """The argument `name` checked: a distribution, a function of a key, rows (S, size)
    or (size,).

    Raise a ValueError for another size, and, where `non_negative`, for negative
    entries; a TypeError for a function that gives no array.
    """
    if isinstance(value, Distribution):
        value.check(name, size, non_negative)
        return value
    if callable(value):
        drawn = value(jax.random.key(0, impl="threefry2x32"))
        if not eqx.is_array(drawn):
            raise TypeError(
                f"Argument `{name}` must give an array for a key, but gives {drawn!r}."
            )
        check_shape(f"{name}(key)", drawn, (size,), "one draw")
        warn_without_key(name, value)
        return value
    array = as_float_array(name, value)
    if array.ndim == 2:
        as_numbers(name, array, (len(array), size), "one sample a row")
    else:
        as_numbers(name, array, (size,), "or one sample a row")
    if non_negative and np.any(np.asarray(array) < 0):
        where = np.argwhere(np.asarray(array) < 0)[0].tolist()
        raise ValueError(
            f"Argument `{name}` must not be negative, but has value "
            f"{float(array[tuple(where)]):g} at index {where}; {OVERLAP}"
        )
    return array


def warn_without_key(name: str, function: Callable[[jax.Array], Any]) -> None:
    """Warn where a function draws without its key, so that it is the same in all
    samples.
    """
    program = jax.make_jaxpr(function)(jax.random.key(0, impl="threefry2x32")).jaxpr
    (key,) = program.invars
    read = [x for step in program.eqns for x in step.invars]
    if not any(x is key for x in read):
        warnings.warn(
            f"Argument `{name}` draws without its key: it is compiled once, and the "
            f"same in all samples, whatever numpy.random would give. Draw by "
            f"jax.random.uniform(key, ...), say.",
            stacklevel=2,
        )


def _check_domain(name: str, drawn: Distribution, domain: Domain) -> None:
    """Raise a ValueError where draws can leave the `domain`; a Normal can give any
    number.
    """
    low, high = domain.bounds
    smallest: Any = -np.inf
    largest: Any = np.inf
    if isinstance(drawn, Uniform):
        smallest = drawn.low
        largest = drawn.high
    if np.min(smallest) < low or np.max(largest) > high:
        raise ValueError(
            f"Argument `{name}` must lie in [{low:g}, {high:g}], but {drawn!r} can "
            f"leave it."
        )


def _short(value: jax.Array) -> str:
    """A number, or a list of numbers, as text."""
    entries = [f"{x:g}" for x in np.ravel(np.asarray(value))]
    if np.ndim(value) == 0:
        return entries[0]
    return f"[{', '.join(entries)}]"
