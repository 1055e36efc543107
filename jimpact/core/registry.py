"""The registry of laws that studies, comparisons and the command line know by name."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from jimpact.core.law import Law, options_of
from jimpact.tools.checks import check_choice, check_kind, check_word

EVERY_PROPERTY = frozenset(
    {"impulse_sign", "gap_velocity_sign", "energy", "velocity_scaling", "mass_scaling"}
)


class Row(NamedTuple):
    """A registered law, what it promises on every scene, and where it comes from.

    `promises` names the properties the contract suite holds it to; where the law breaks
    another one of them, its status must say so.
    """

    law: type[Law]
    summary: str
    right_when: str
    fails_when: str
    promises: frozenset[str]
    source: str
    bibtex: str
    # from plain numbers, where the class takes others
    make: Callable[..., Law] | None = None
    simplicity: float | None = None  # place in the order of `simplest_first`

    @property
    def arguments(self) -> dict[str, inspect.Parameter]:
        """Arguments of `build`, by name."""
        return dict(inspect.signature(self.make or self.law).parameters)

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the arguments that say how the law is solved."""
        return options_of(self.law)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(name for name in self.arguments if name not in self.options)

    @property
    def in_python(self) -> str:
        """The call of the class as text, without options: studies may give other
        parameters.
        """
        names = [
            x for x in inspect.signature(self.law).parameters if x not in self.options
        ]
        return f"ji.{self.law.__name__}({', '.join(names)})"

    @property
    def required(self) -> tuple[str, ...]:
        """Parameters without a default."""
        empty = inspect.Parameter.empty
        return tuple(name for name, x in self.arguments.items() if x.default is empty)

    def build(self, **parameters: Any) -> Law:
        """The law with these parameters."""
        return (self.make or self.law)(**parameters)


REGISTRY: dict[str, Row] = {}

# Parameters of contacts that `advise` knows.
ADVISED = ("restitution", "stiffness", "exponent", "friction", "tangential_stiffness")


def simplest_first() -> tuple[str, ...]:
    """Names of the laws that `advise` tries: first those that need to know least of the
    contacts.

    >>> import jimpact as ji
    >>> from jimpact.core.registry import simplest_first
    >>> "newton" in ji.REGISTRY and simplest_first()[0]
    'newton'
    """
    places = {
        name: row.simplicity
        for name, row in REGISTRY.items()
        if row.simplicity is not None
    }
    return tuple(sorted(places, key=lambda name: places[name]))


def register(
    name: str,
    law: Any = None,
    *,
    summary: str = "",
    right_when: str = "",
    fails_when: str = "",
    promises: Iterable[str] = (),
    source: str = "",
    bibtex: str = "",
    make: Callable[..., Law] | None = None,
    simplicity: float | None = None,
) -> Any:
    """Enter a law in `ji.REGISTRY`, where `compare`, studies and the CLI find it.

    Args:
        name: in small letters; what a study calls it.
        law: the class; None: `register` is used as a decorator of it.
        summary, right_when, fails_when: a line each, for `jimpact laws`.
        promises: properties it keeps on every scene, of 'impulse_sign',
            'gap_velocity_sign', 'energy', 'velocity_scaling', 'mass_scaling'.
        source, bibtex: where it comes from.
        make: builds it from plain numbers, where the class takes other things.
        simplicity: place in the order in which `advise` tries laws, the simplest first:
            newton 1, moreau 2, poisson 3, binary 4, lzb 5, compliant 6; None: `advise`
            leaves it out.

    Returns:
        The class, or the decorator.

    Raises:
        TypeError: no Law. ValueError: a name that another law has, an unknown promise,
            a law that `advise` cannot make.

    >>> import jimpact as ji
    >>> @ji.register("gentle", summary="half of Newton's impulse")
    ... class Gentle(ji.Newton):
    ...     def impulses(self, contact):
    ...         p, side, status = super().impulses(contact)
    ...         return ji.Impulses(0.5 * p, side, status)
    >>> ji.REGISTRY["gentle"].parameters
    ('restitution', 'friction', 'tangential_restitution')
    >>> del ji.REGISTRY["gentle"]
    """

    check_kind("name", name, str)
    kept = tuple(promises)  # an iterator has them once

    def enter(law: Any) -> Any:
        """Enter the class in `REGISTRY` under its name, after checks, and return it."""
        if not (isinstance(law, type) and issubclass(law, Law)):
            raise TypeError(f"Argument `law` must be a class of Law, but is {law!r}.")
        if name != name.lower() or not name:
            raise ValueError(
                f"Argument `name` must be in small letters, but has value {name!r}."
            )
        for promise in kept:
            check_choice("promises", promise, sorted(EVERY_PROPERTY))
        other = REGISTRY.get(name)  # of the same place: a module that is read again
        if other is not None and _place(other.law) != _place(law):
            raise ValueError(
                f"Argument `name` must be new, but {name!r} is "
                f"{other.law.__qualname__} of {other.law.__module__}."
            )
        row = Row(
            law=law,
            summary=summary,
            right_when=right_when,
            fails_when=fails_when,
            promises=frozenset(kept),
            source=source,
            bibtex=bibtex,
            make=make,
            simplicity=simplicity,
        )
        unknown = [key for key in row.required if key not in ADVISED]
        if simplicity is not None and unknown:
            raise ValueError(
                f"Argument `simplicity` must be None for a law that needs "
                f"`{unknown[0]}`: `advise` knows only {', '.join(ADVISED)}."
            )
        REGISTRY[name] = row
        return law

    if law is None:
        return enter
    return enter(law)


def _place(law: type[Law]) -> tuple[str, str]:
    """Module and name of a class."""
    return law.__module__, law.__qualname__


def registered_laws(
    values: Mapping[str, Any], names: Iterable[str] | None = None
) -> tuple[dict[str, Law], dict[str, str]]:
    """Laws by name, made from `values` of parameters by name, and the reasons others
    are left out.

    `names`: those in the registry to make, in this order; None: all. A law without a
    value for a required parameter is left out. Raise a ValueError for a parameter that
    no law has.

    >>> import jimpact as ji
    >>> from jimpact.core.registry import registered_laws
    >>> assert ji.REGISTRY  # our own laws are registered where they are imported
    >>> laws, left_out = registered_laws({"restitution": 0.9})
    >>> laws["newton"]
    Newton(restitution=0.9, friction=None, tangential_restitution=None)
    >>> left_out["restitution_matrix"]
    'needs `matrix`'
    """
    taken = sorted({key for row in REGISTRY.values() for key in row.arguments})
    for key in values:
        check_word("A parameter of laws", key, taken)
    laws = {}
    left_out = {}
    for name in REGISTRY if names is None else names:
        row = REGISTRY[name]
        missing = [f"`{key}`" for key in row.required if key not in values]
        if missing:
            left_out[name] = f"needs {', '.join(missing)}"
        else:
            laws[name] = row.build(
                **{key: values[key] for key in row.arguments if key in values}
            )
    return laws, left_out
