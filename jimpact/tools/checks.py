"""Host-side argument checks with one error template; tracers pass unchecked.

JAX is imported by those functions that need it: a study file is checked without.
"""

import importlib
import operator
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    import jax

Class = TypeVar("Class")

# where chunks of a Monte Carlo run are computed
EXECUTORS = ("threads", "serial", "devices", "dask")


def needed(module: str, how: str) -> ModuleType:
    """The module, or an ImportError that says how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{module} must be installed for this, but is not: {how}."
        ) from error


@contextmanager
def missing_room(name: str) -> Iterator[None]:
    """A room that this copy of the package lacks becomes an ImportError that says so of
    `name`.

    >>> with missing_room("ji.monte_carlo"):
    ...     importlib.import_module("jimpact.montekarlo")
    Traceback (most recent call last):
    ImportError: ji.monte_carlo needs the room jimpact/montekarlo, ...
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package, _, module = (error.name or "").partition(".")
        if package != "jimpact" or not module:
            raise
        room = module.partition(".")[0]
        said = f"{name} needs the room jimpact/{room}, which is missing here."
        raise ImportError(said, name=error.name) from error


def is_traced(value: Any) -> bool:
    """True where `value` is (or holds) an abstract value inside a JAX
    transformation.
    """
    if "jax" not in sys.modules:
        return False
    import jax

    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))


def _not_numeric(name: str, value: Any, kind: str = "") -> TypeError:
    """The TypeError for a value that is no array of real numbers; `kind`: letter of its
    dtype.
    """
    what = {
        "c": "must be real, but is complex",
        "M": (
            "must be numbers, but holds dates: give seconds, (t - t[0]) / "
            "np.timedelta64(1, 's')"
        ),
        "m": (
            "must be numbers, but holds durations: give seconds, t / "
            "np.timedelta64(1, 's')"
        ),
    }
    if kind in what:
        return TypeError(f"Argument `{name}` {what[kind]}.")
    return TypeError(
        f"Argument `{name}` must be numeric, but has value {short_repr(value)}."
    )


def _on_host(name: str, value: Any) -> np.ndarray:
    """`value` as an array of real numbers on the host."""
    try:
        host = np.asarray(value)
    except ValueError:  # rows of different lengths
        raise ValueError(
            f"Argument `{name}` must be an array, whose rows are equally long, but has "
            f"value {short_repr(value)}."
        ) from None
    if host.dtype.kind not in "fiubV":  # V: the short floats of JAX
        raise _not_numeric(name, value, host.dtype.kind)
    return host


def as_float_array(name: str, value: Any) -> "jax.Array":
    """`value` as a floating JAX array; text, truth values, objects, complex numbers are
    refused.
    """
    import jax
    import jax.numpy as jnp

    if isinstance(value, jax.Array):
        array = value
    elif is_traced(value):  # a list of numbers, some of them traced
        array = jnp.asarray(value)
    else:
        if _on_host(name, value).dtype.kind not in "fiu":
            raise _not_numeric(name, value)
        array = jnp.asarray(value)
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise _not_numeric(name, value, "c")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(float)
    return array


def as_numbers(
    name: str,
    value: Any,
    shape: tuple[int, ...] | None = None,
    meaning: str = "",
    *,
    contacts: int | None = None,
    low: float = -np.inf,
    high: float = np.inf,
    open_low: bool = False,
) -> "jax.Array":
    """`value` as a floating JAX array, checked: its shape or one entry a contact, and
    its range.
    """
    array = as_float_array(name, value)
    if shape is not None:
        check_shape(name, array, shape, meaning)
    if contacts is not None:
        check_per_contact(name, array, contacts)
    check_values(name, array, low=low, high=high, open_low=open_low)
    return array


def as_axis(name: str, value: Any) -> "jax.Array":
    """`value`, a scalar or with one axis, as a floating JAX array with one axis, not
    empty.
    """
    array = as_float_array(name, value)
    if array.ndim > 1 or array.size == 0:
        raise ValueError(
            f"Argument `{name}` must be a scalar or have one axis, but has shape "
            f"{array.shape}."
        )
    return array.reshape(-1)


def check_values(
    name: str,
    value: Any,
    *,
    low: float = -np.inf,
    high: float = np.inf,
    open_low: bool = False,
    nan_allowed: bool = False,
) -> None:
    """Raise a ValueError unless all entries lie between `low` and `high`; TypeError: no
    numbers.
    """
    if value is None or is_traced(value):
        return
    entries = _on_host(name, value).astype(float)
    finite = np.isfinite(entries) | (np.isnan(entries) & nan_allowed)
    inside = (entries > low if open_low else entries >= low) & (entries <= high)
    bad = ~(finite & (inside | np.isnan(entries)))
    if not bad.any():
        return
    index = tuple(int(i) for i in np.argwhere(np.atleast_1d(bad))[0])
    if entries.ndim:
        where = f" at index {index[0] if len(index) == 1 else index}"
    else:
        where = ""
    if open_low:
        bracket = "("
    else:
        bracket = "["
    if np.isfinite(low) or np.isfinite(high):
        allowed = (
            f"lie in {bracket}{low:g}, {high:g}{']' if np.isfinite(high) else ')'}"
        )
    else:
        allowed = "be finite"
    raise ValueError(
        f"Argument `{name}` must {allowed}, but has value "
        f"{np.atleast_1d(entries)[index]:g}{where}."
    )


def as_whole(name: str, value: Any, low: int) -> int:
    """`value` as an int; raise a ValueError unless it is one of at least `low`."""
    if (
        isinstance(value, bool)
        or not hasattr(value, "__index__")
        or operator.index(value) < low
    ):
        raise ValueError(
            f"Argument `{name}` must be an int >= {low}, but has value {value!r}."
        )
    return operator.index(value)


def check_choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """Raise a ValueError unless `value` is one of `choices`."""
    if value not in choices:
        known = ", ".join(map(str, choices))
        raise ValueError(
            f"Argument `{name}` must be one of {known}, but has value {value!r}."
            f"{suggestion(value, choices)}"
        )


def check_word(what: str, word: Any, choices: Iterable[Any]) -> None:
    """Raise a ValueError that begins with `what` unless the word is one of
    `choices`.
    """
    if word not in choices:
        known = ", ".join(map(str, choices))
        raise ValueError(
            f"{what} must be one of {known}, but is {word!r}."
            f"{suggestion(word, choices, ABBREVIATIONS)}"
        )


# What parameters are called in papers.
ABBREVIATIONS = {
    "e": "restitution",
    "k": "stiffness",
    "mu": "friction",
    "eta": "exponent",
}


def suggestion(
    word: Any, choices: Iterable[Any], abbreviations: Mapping[str, str] | None = None
) -> str:
    """' Did you mean X?' for the choice that is spelled most like the word, '' if none
    is alike.
    """
    import difflib

    known = {str(x).lower(): x for x in choices}
    full = (abbreviations or {}).get(str(word).lower())
    if full in known:
        return f" Did you mean {known[full]}?"
    close = difflib.get_close_matches(str(word).lower(), known, n=1)
    if close:
        return f" Did you mean {known[close[0]]}?"
    return ""


def suggesting_names(**short: str) -> Callable[[type[Class]], type[Class]]:
    """Class decorator: the AttributeError for a name that objects lack suggests one.

    `short` are words and letters of papers, and what to write for them, as 'velocity'
    or 'law.restitution'. Without one the attribute spelled most like the name is
    suggested, if any is. An AttributeError of a property that exists is raised as it
    is.

    >>> from jimpact.tools.checks import suggesting_names
    >>> @suggesting_names(v="velocity")
    ... class Outcome:
    ...     velocity = 1.0
    >>> Outcome().v
    Traceback (most recent call last):
    AttributeError: Outcome has no attribute `v`. Did you mean velocity?
    """

    def decorated(named: type[Class]) -> type[Class]:
        def missing(self: Class, name: str) -> Any:
            if name.startswith("_") or name in dir(named):
                return object.__getattribute__(self, name)
            annotated = getattr(named, "__dataclass_fields__", ())
            public = {x for x in (*annotated, *dir(named)) if not x.startswith("_")}
            if name in short:
                advice = f" Did you mean {short[name]}?"
            else:
                advice = suggestion(name, sorted(public))
            raise AttributeError(f"{named.__name__} has no attribute `{name}`.{advice}")

        type.__setattr__(named, "__getattr__", missing)
        return named

    return decorated


_MOST_NUMBERS = 8  # of an array that are printed
_ROUNDING = 1e-12  # share of the largest that is printed as 0


def in_numbers(values: Any) -> str:
    """An array as people read it: its first numbers; of a traced one the shape.

    Numbers within rounding of the largest finite one are shown as 0.

    >>> import numpy as np
    >>> from jimpact.tools.checks import in_numbers
    >>> in_numbers(np.array([0.1, 2.0])), in_numbers(np.arange(20)), in_numbers(0.25)
    ('(0.1, 2)', '(0, 1, 2, 3, 4, 5, 6, 7, ...; 20 in all)', '0.25')
    """
    try:
        array = np.asarray(values)
    except Exception:  # a tracer has no numbers
        return f"shape {tuple(values.shape)}"
    if array.ndim == 0:
        return f"{array.item():.6g}"
    if array.dtype.kind == "f":
        array = _without_rounding(array)
    numbers = [f"{x:.6g}" for x in array.ravel()[:_MOST_NUMBERS].tolist()]
    if array.size > _MOST_NUMBERS:
        numbers.append(f"...; {array.size} in all")
    return f"({', '.join(numbers)})"


def _without_rounding(array: np.ndarray) -> np.ndarray:
    """The array with 0 for entries within rounding of the largest finite one."""
    sizes = np.abs(array[np.isfinite(array)])
    if not sizes.size:
        return array
    return np.where(np.abs(array) <= _ROUNDING * sizes.max(), 0.0, array)


def check_kind(name: str, value: Any, kind: type, call: str = "") -> None:
    """Raise a TypeError unless `value` is an instance of `kind`; it shows the `call`,
    if given.
    """
    if isinstance(value, kind):
        return
    hint = ""
    if call:
        hint = f" The call is {call}."
    elif kind is Mapping:
        hint = " Give each a name, as in {'a': ...}."
    elif isinstance(value, type) and issubclass(value, kind):
        hint = f" That is the class; {value.__name__}(...) makes an object of it."
    elif hasattr(kind, "_instead_of"):
        hint = kind._instead_of(value)
    raise TypeError(
        f"Argument `{name}` must be of type {kind.__name__}, but is "
        f"{short_repr(value)}.{hint}"
    )


def check_function(name: str, value: Any) -> None:
    """Raise a TypeError unless `value` can be called."""
    if not callable(value):
        raise TypeError(
            f"Argument `{name}` must be a function, but is {short_repr(value)}."
        )


def short_repr(value: Any) -> str:
    """The value as messages show it: its type where it takes more than 80
    characters.
    """
    text = repr(value)
    kind = type(value).__name__
    if kind[0] in "AEIOaeio":
        article = "an"
    else:
        article = "a"
    if "\n" not in text and len(text) < 80:
        return text
    return f"{article} {kind}"


def check_concrete(name: str, value: Any) -> None:
    """Raise a TypeError where `value` is traced: what a fit needs are numbers."""
    if is_traced(value):
        raise TypeError(
            f"Argument `{name}` must hold numbers, but is traced: fits run on the "
            f"host, not under jit, vmap or grad. For these, `FitProblem.residual` and "
            f"`jacobian` are pure functions of the parameters."
        )


def check_shape(name: str, value: Any, shape: tuple[int, ...], meaning: str) -> None:
    """Raise a ValueError unless `value` has exactly this shape."""
    if np.shape(value) != shape:
        raise ValueError(
            f"Argument `{name}` must have shape {shape} ({meaning}), "
            f"but has shape {tuple(np.shape(value))}."
        )


def check_square(name: str, value: Any) -> None:
    """Raise a ValueError unless `value` is a square matrix."""
    shape = np.shape(value)
    if len(shape) != 2 or shape[0] != shape[1]:
        raise ValueError(
            f"Argument `{name}` must be a square matrix, but has shape {shape}."
        )


def check_per_contact(name: str, value: Any, contacts: int) -> None:
    """Raise a ValueError unless `value` is a scalar or has one entry per contact."""
    if np.shape(value) not in ((), (contacts,)):
        raise ValueError(
            f"Argument `{name}` must be a scalar or have shape ({contacts},), one "
            f"value per contact, but has shape {tuple(np.shape(value))}."
        )


def in_common_dtype(*trees: Any) -> Any:
    """Pytrees with all floating arrays in the widest floating type among them."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    leaves = [x for x in jax.tree.leaves(trees) if eqx.is_inexact_array(x)]
    if len({x.dtype for x in leaves}) == 1:
        return trees
    dtype = jnp.result_type(*leaves)
    return jax.tree.map(
        lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, trees
    )


def check_executor(executor: Any) -> None:
    """Raise a ValueError unless chunks of a Monte Carlo run can be computed with it."""
    known = callable(getattr(executor, "map", None))
    if isinstance(executor, str):
        known = executor in EXECUTORS or ":" in executor  # host and port of a scheduler
    if not known:
        raise ValueError(
            f"Argument `executor` must be one of {', '.join(EXECUTORS)}, the address "
            f"of a Dask scheduler, or an object with a method `map`, but is "
            f"{executor!r}."
        )
