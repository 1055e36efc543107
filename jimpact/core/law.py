"""The base of all laws: one method from `Contact` to impulses, and declared
parameters.
"""

import abc
import dataclasses
import inspect
import operator
from collections.abc import Callable, Sequence
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    NamedTuple,
    TypeVar,
    get_args,
    overload,
)

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact, contact_of
from jimpact.core.scene import Scene
from jimpact.tools.checks import (
    ABBREVIATIONS,
    as_float_array,
    check_choice,
    check_shape,
    check_square,
    check_values,
    is_traced,
    suggestion,
)
from jimpact.tools.status import CODE

# Largest exponent of a contact force that a fit tries: a cone has 2, rough surfaces
# about 3. With a larger one a contact is rigid almost at once, and no measured velocity
# determines it.
LARGEST_EXPONENT = 5.0

_KEY = "jimpact"  # of what a field declares, in its metadata

AnyLaw = TypeVar("AnyLaw", bound="Law")


@jax.tree_util.register_static
class StaticNumber(float):
    """A float that is part of the structure of a pytree: compiled in, not
    differentiated.
    """


@jax.tree_util.register_static
class StaticNumbers(tuple[float, ...]):
    """Floats, one per contact, that are part of the structure of a pytree."""


if TYPE_CHECKING:
    # What a parameter takes and what it is read as; type checkers see both in such a
    # descriptor.
    Numbers = jax.typing.ArrayLike | Sequence[Any]
    Taken = TypeVar("Taken", contravariant=True)
    Read = TypeVar("Read", covariant=True)

    class Declaration(Generic[Taken, Read]):
        """Takes one thing, is read as another."""

        @overload
        def __get__(self, module: None, owner: type) -> "Declaration[Taken, Read]": ...
        @overload
        def __get__(self, module: object, owner: type) -> Read: ...
        def __get__(self, module: object | None, owner: type) -> Any:
            """The value as it is read."""

        def __set__(self, module: object, value: Taken) -> None: ...

    Values = Declaration[Numbers, jax.Array]
    OptionalValues = Declaration[Numbers | None, jax.Array | None]
    StaticOrValues = Declaration[Numbers, float | tuple[float, ...] | jax.Array]
else:
    Values = jax.Array
    OptionalValues = jax.Array | None
    StaticOrValues = float | tuple[float, ...] | jax.Array


@dataclasses.dataclass(eq=False)
class Domain:
    """The domain that `parameter` declares of a field; equinox calls it to convert a
    value.
    """

    low: float = -np.inf
    high: float = np.inf
    open_low: bool = False
    log: bool = False
    static_numbers: bool = False
    matrix: bool = False
    per_contact: bool = True
    high_unless: str | None = None
    searched_high: float = np.inf
    name: str = "parameter"  # until the class that holds it is made

    def __call__(self, value: Any) -> Any:
        """The value as a float array (or static numbers); None stays None."""
        if value is None:
            return None
        if self.static_numbers and isinstance(value, (int, float)):
            return StaticNumber(value)
        if self.static_numbers and isinstance(value, tuple) and not is_traced(value):
            return StaticNumbers(float(x) for x in value)
        return as_float_array(self.name, value)

    def of(self, module: eqx.Module) -> "Domain":
        """The domain in this module, whose option may have lifted the upper end."""
        if self.high_unless is None or not getattr(module, self.high_unless):
            return self
        return dataclasses.replace(self, high=np.inf)

    def check(self, value: Any) -> None:
        """Raise a ValueError for a value outside."""
        if self.matrix and np.ndim(value) >= 2:
            check_square(self.name, value)
            check_values(self.name, value)
        else:
            check_values(
                self.name, value, low=self.low, high=self.high, open_low=self.open_low
            )

    def holds(self, value: Any) -> Any:
        """True () where all entries are finite and in [low, high] or (low, high], on
        the device.
        """
        if self.matrix and np.ndim(value) >= 2:
            low = -np.inf
            high = np.inf
        else:
            low, high = self.bounds
        if self.open_low:
            above = value > low
        else:
            above = value >= low
        return jnp.all(jnp.isfinite(value) & above & (value <= high))

    @property
    def bounds(self) -> tuple[float, float]:
        """(low, high)."""
        return self.low, self.high


@dataclasses.dataclass(eq=False)
class Option:
    """The values that `option` allows in a static field; equinox calls it to check a
    value.
    """

    choices: tuple[Any, ...] | None = None
    low: float | None = None
    high: float = np.inf
    open_low: bool = False
    converter: Callable[[Any], Any] | None = None
    name: str = "option"

    def __call__(self, value: Any) -> Any:
        """The value that the converter gives, if there is one, which checks it; else
        the value itself, one of the choices, or within its bounds, or None.
        """
        if self.converter is not None:
            return self.converter(value)
        if self.choices is not None:
            check_choice(self.name, value, self.choices)
        if self.low is not None and value is not None:
            check_values(
                self.name, value, low=self.low, high=self.high, open_low=self.open_low
            )
        return value


def parameter(
    low: float = -np.inf,
    high: float = np.inf,
    *,
    open_low: bool = False,
    log: bool = False,
    static_numbers: bool = False,
    matrix: bool = False,
    per_contact: bool = True,
    high_unless: str | None = None,
    searched_high: float = np.inf,
    default: Any = dataclasses.MISSING,
    kw_only: bool = False,
) -> Any:
    """A field of a `Law` that is a parameter: a float array with a domain.

    The check of the constructor, the bounds and transforms of `fit`, the random laws of
    `monte_carlo`, studies and the command line all read this declaration.

    Args:
        low: smallest value.
        high: largest value.
        open_low: exclude `low`.
        log: fit the logarithm (for a stiffness, whose order of magnitude is unknown).
        static_numbers: a Python number or tuple is compiled in, an array is a
            parameter.
        matrix: also accept a square matrix, not checked against the bounds.
        per_contact: a scalar or one value per contact (m,), checked against the scene.
        high_unless: name of an option that, where true, lifts `high`.
        searched_high: upper bound in fits that start below it, unless `bounds` say
            otherwise: larger values are allowed, but no measurement could determine
            them.
        default: value if the constructor gets none; may be None (no such effect).
        kw_only: the constructor takes it by keyword only.

    Returns:
        What a class body assigns to the field.

    Raises:
        ValueError: by the law's constructor, where a value is out of the domain or of a
            wrong shape.

    >>> import jimpact as ji
    >>> class Lossy(ji.LZB):
    ...     loss: float = ji.parameter(low=0, high=1, default=0.1)
    >>> Lossy(0.9, loss=1.5)
    Traceback (most recent call last):
        ...
    ValueError: Argument `loss` must lie in [0, 1], but has value 1.5.
    """
    declared = Domain(
        low,
        high,
        open_low,
        log,
        static_numbers,
        matrix,
        per_contact,
        high_unless,
        searched_high,
    )
    return _field(declared, default, kw_only, static=False)


def option(
    default: Any,
    choices: tuple[Any, ...] | None = None,
    *,
    low: float | None = None,
    high: float = np.inf,
    open_low: bool = False,
    converter: Callable[[Any], Any] | None = None,
    kw_only: bool = True,
) -> Any:
    """A static field of a `Law`, how it is solved: one of `choices`, or in an interval.

    `converter` takes the place of these checks.

    Args:
        default: value where the constructor gets none.
        choices: allowed values; None: a number from `low` to `high`.
        low: smallest value; None: no limits.
        high: largest value.
        open_low: exclude `low`.
        converter: function of the value to the stored one, which may raise a
            ValueError; it takes the place of these checks.
        kw_only: the constructor takes it by keyword only.

    Returns:
        What a class body assigns to the field.

    Raises:
        ValueError: by the law's constructor, where the value is not allowed.

    >>> import jimpact as ji
    >>> ji.LZB(0.9, method="euler")
    Traceback (most recent call last):
        ...
    ValueError: Argument `method` must be one of auto, time, implicit, ...
    """
    declared = Option(choices, low, high, open_low, converter)
    return _field(declared, default, kw_only, static=True)


def _field(declared: Domain | Option, default: Any, kw_only: bool, static: bool) -> Any:
    """The dataclass field with this declaration in its metadata."""
    if default is dataclasses.MISSING:
        options = {}
    else:
        options = {"default": default}
    return eqx.field(
        converter=declared,
        static=static,
        kw_only=kw_only,
        metadata={_KEY: declared},
        **options,
    )


def _check_arguments(cls: type, *args: Any, **kwargs: Any) -> None:
    """Raise a TypeError that lists the arguments of `cls`, where these do not fit
    them.
    """
    signature = inspect.signature(cls)
    try:
        signature.bind(*args, **kwargs)
    except TypeError as why:
        names = ", ".join(
            f"`{name}`" if x.default is x.empty else f"`{name}` = {x.default!r}"
            for name, x in signature.parameters.items()
        )
        strange = "".join(
            (
                f" It has no "
                f"`{word}`.{suggestion(word, signature.parameters, ABBREVIATIONS)}"
            )
            for word in kwargs
            if word not in signature.parameters
        )
        raise TypeError(f"{cls.__name__} takes {names}: {why}.{strange}") from None


if TYPE_CHECKING:
    # a `__call__` of our own would hide the constructors' signatures from type checkers
    _Signed = type(eqx.Module)
else:

    class _Signed(type(eqx.Module)):
        """The metaclass of equinox, with errors that list the arguments of a class."""

        def __call__(cls, *args: Any, **kwargs: Any) -> Any:
            """An instance."""
            try:
                return super().__call__(*args, **kwargs)
            except TypeError:
                _check_arguments(cls, *args, **kwargs)
                raise


class Declared(eqx.Module, metaclass=_Signed):  # type: ignore[metaclass]
    """A module whose fields are parameters and options: laws, contact forces."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Declarations get the names of their fields, for messages."""
        super().__init_subclass__(**options)
        for name, value in vars(cls).items():
            if isinstance(value, dataclasses.Field) and _KEY in value.metadata:
                value.metadata[_KEY].name = name

    def __repr__(self) -> str:
        """The call that makes it, with numbers; `(static)`: compiled in, never a
        derivative.
        """
        words = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            default = (
                field.default is not dataclasses.MISSING and value is field.default
            )
            if not (default and isinstance(field.metadata.get(_KEY), Option)):
                words.append(f"{field.name}={_in_words(value)}")
        return f"{type(self).__name__}({', '.join(words)})"

    def __check_init__(self) -> None:
        """Raise a ValueError for a parameter outside its domain."""
        for field in dataclasses.fields(self):
            declared = field.metadata.get(_KEY)
            if isinstance(declared, Domain):
                value = getattr(self, field.name)
                optional = field.default is None or type(None) in get_args(field.type)
                if value is None and not optional:
                    as_float_array(field.name, value)  # raises
                declared.of(self).check(value)


def _in_words(value: Any) -> str:
    """The numbers of a field; of what is traced its shape."""
    if isinstance(value, StaticNumber | StaticNumbers):
        return f"{value!r} (static)"
    if eqx.is_array(value) and not is_traced(value):
        digits: Any = {"float_kind": lambda x: f"{x:.6g}"}
        text = np.array2string(
            np.asarray(value), separator=", ", threshold=20, formatter=digits
        )
        return " ".join(text.split())
    if eqx.is_array(value):
        return eqx.tree_pformat(value)
    return repr(value)


class Parameter(NamedTuple):
    """A parameter of a law: its value, its path in the law, and its domain."""

    value: Any
    path: str
    domain: Domain


def parameters_of(module: eqx.Module) -> dict[str, Parameter]:
    """Parameters by name, those of a law's parts (the force of `Compliant`) included.

    Float arrays that a class does not declare are parameters without bounds.
    """
    parameters: dict[str, Parameter] = {}
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        declared = field.metadata.get(_KEY)
        if isinstance(value, Declared):
            inner = parameters_of(value)
            parameters |= {
                k: x._replace(path=f"{field.name}.{x.path}") for k, x in inner.items()
            }
        elif isinstance(declared, Domain):
            parameters[field.name] = Parameter(value, field.name, declared.of(module))
        elif eqx.is_inexact_array(value):
            parameters[field.name] = Parameter(
                value, field.name, Domain(per_contact=False)
            )
    return parameters


def free_parameters_of(module: eqx.Module) -> dict[str, Parameter]:
    """Parameters that are arrays, not None or static numbers: they can be fitted and
    sampled.
    """
    known = parameters_of(module)
    return {name: x for name, x in known.items() if eqx.is_inexact_array(x.value)}


def with_parameter(module: Any, name: str, value: Any) -> Any:
    """The law with another value of one of its parameters, or of those of its parts."""
    path = parameters_of(module)[name].path
    return eqx.tree_at(operator.attrgetter(path), module, value)


def value_of(law: "Law", field: str) -> Any:
    """A parameter of a law, or of its parts (the force of a compliant one); None if it
    has none.
    """
    return getattr(parameters_of(law).get(field), "value", None)


def entries(law: "Law", fields: tuple[str, ...]) -> np.ndarray:
    """All entries (Q,) of these fields of a law, one field after the other."""
    values = [np.asarray(value_of(law, field), float) for field in fields]
    return np.concatenate([np.ravel(value) for value in values])


def with_entries(law: AnyLaw, fields: tuple[str, ...], values: Any) -> AnyLaw:
    """The law with `values` (Q,) as the entries of these fields, one field after the
    other.
    """
    start = 0
    for field in fields:
        old = value_of(law, field)
        end = start + old.size
        new = values[start:end].reshape(old.shape).astype(old.dtype)
        law = with_parameter(law, field, jnp.asarray(new))
        start = end
    return law


def within_domains(law: eqx.Module) -> jax.Array:
    """True () where all parameters are finite and in their domains, on the device."""
    holds = [x.domain.holds(x.value) for x in free_parameters_of(law).values()]
    return jnp.all(jnp.asarray(holds, bool))


def declarations_of(kind: type[eqx.Module]) -> dict[str, Domain | Option]:
    """The `Domain` or `Option` that each field of a class declares, by name."""
    return {
        f.name: f.metadata[_KEY] for f in dataclasses.fields(kind) if _KEY in f.metadata
    }


def options_of(kind: type[eqx.Module]) -> tuple[str, ...]:
    """Names of the fields that say how a law is solved."""
    return tuple(k for k, x in declarations_of(kind).items() if isinstance(x, Option))


class Impulses(NamedTuple):
    """Impulses of m contacts, as `Law.impulses` returns them.

    Args:
        normal: p (m,) [N s], >= 0 pushes.
        tangential: p_t (t,) [N s], along the scene's tangents; None: none.
        status: code () of `jimpact.STATUS`; 0: ok.

    >>> import jimpact as ji
    >>> ji.Impulses([1.0, 0.5]).tangential is None
    True
    """

    normal: jax.Array
    tangential: jax.Array | None = None
    status: Any = CODE["ok"]


class Law(Declared):
    """An impact law: parameters and the one method `impulses`.

    A law is a pytree: grad of a law is a law, vmap over a law is a batch. Fields are
    declared with `ji.parameter`; two of them mean the same in every law: `friction`,
    Coulomb's mu (the scene must have tangents unless it is None), and `initial_energy`,
    stored in the contacts before the impact [J]. `impact` always calls `impulses`. If
    no contact approaches or stores energy, it passes gamma- = -1 and discards the
    result, so that gradients stay finite. It decouples open contacts and gives them no
    impulse (unless `uses_gaps`), sets gap velocities within rounding to 0, and adds its
    own checks to the status (not finite, negative impulse, inadmissible velocity,
    energy gain).

    A law declares what else it can do; by default it only returns impulses.

    Class attributes:
        uses_gaps: open contacts take part, at their gaps.
        pulls: separating contacts take part, too, if any contact approaches or stores
            energy.
        separable: contacts that W does not couple may be solved separately: the law
            itself couples none, and its parameters are scalars or (m,).
        pads_scenes: open contacts may be added, so that small scenes share one compiled
            program.
        accuracy: relative error of v+ that it allows itself at a `Contact`; signs and
            energy are judged beyond it.
        contact_force: the `Force` of its contacts (`gap_scale`, `crossover`).
        has_history: whether `dynamics` may be sampled over the impact's time
            (`history`).
        joins_step: True if the law is Moreau's, with `restitution` and
            `tangential_restitution` of each contact; time stepping then solves it
            together with the equations of motion.
        only_stiffness_ratios: whether a common factor of all stiffnesses changes
            nothing (`fit` then fixes the first one).

    >>> import jax.numpy as jnp
    >>> import jimpact as ji
    >>> class Plastic(
    ...     ji.Law
    ... ):  # all contacts of a pair of bodies stop, without friction
    ...     def impulses(self, contact):
    ...         w = contact.normal_delassus
    ...         return ji.Impulses(jnp.linalg.solve(w, -contact.gap_velocity))
    >>> ji.impact(Plastic(), ji.chain([1.0, 1.0]), [1.0, 0.0]).velocity.tolist()
    [0.5, 0.5]
    """

    uses_gaps: ClassVar[bool] = False
    pulls: ClassVar[bool] = False
    separable: ClassVar[bool] = False
    pads_scenes: ClassVar[bool] = False
    has_history: ClassVar[bool] = False
    joins_step: ClassVar[bool] = False
    only_stiffness_ratios: ClassVar[bool] = False

    @abc.abstractmethod
    def impulses(self, contact: Contact) -> Impulses:
        """Impulses from what `contact` holds, and the law's own status code."""

    @staticmethod
    def _instead_of(value: Any) -> str:
        """Advice for a value that is no law, ending the message of `check_kind`."""
        if isinstance(value, Scene):
            return " The law comes before the scene."
        if isinstance(value, str):
            return " A law is an object, as ji.LZB(0.9)."
        return ""

    def contact(self, scene: Scene, velocity: jax.Array) -> Contact:
        """The argument of `impulses`: contacts of a scene at the velocity v- (n,).

        To override by a law that needs more.
        """
        return contact_of(scene, velocity, self.stored, self.uses_gaps)

    def check(self, scene: Scene, dtype: jnp.dtype) -> None:
        """To override: raise where the law does not fit the scene, or the precision
        `dtype`.
        """

    def dynamics(self, contact: Contact) -> Any:
        """To override where `has_history`: the impact dynamics at `contact`
        (`jimpact.events`).
        """
        raise NotImplementedError

    @property
    def contact_force(self) -> Any:
        """The `Force` of its contacts; None: they are rigid."""
        return None

    def accuracy(self, contact: Contact) -> float:
        """Relative error of v+ at this `contact`: `impact` judges signs and energy
        beyond it.
        """
        return 0.0

    @property
    def stored(self) -> jax.Array:
        """Energy stored in the contacts before the impact, () or (m,) [J]."""
        stored = getattr(self, "initial_energy", None)
        if stored is None:
            return jnp.zeros(())
        return stored


def open_tolerance(law: Law, scene: Scene, velocity: jax.Array) -> float | None:
    """The default tolerance of a law that takes the `rtol` of `impact` in its place;
    None: it has a tolerance of its own, or none.
    """
    found: list[Any] = []  # filled while JAX traces `look`: nothing is computed

    def look(velocity: jax.Array) -> jax.Array:
        """Enter in `found` the law's accuracy, and if it is the contact's rtol where
        one is set.
        """
        contact = law.contact(scene, velocity)
        other = contact.integrated_to(jnp.ones((), velocity.dtype))
        taken: Any = law.accuracy(other)
        found[:] = [law.accuracy(contact), taken is other.rtol]
        return velocity

    jax.eval_shape(look, velocity)
    default, takes_another = found
    if eqx.is_array(default) or not takes_another:
        return None
    return default


def forwards_to_law(around: type[AnyLaw]) -> type[AnyLaw]:
    """Class decorator of a law around another one, its field `law`.

    Members of `Law` that the class does not define itself become those of the other
    law.
    """
    for name in vars(Law):
        if not name.startswith("_") and name not in vars(around):
            setattr(around, name, _forwarded(name))
    return around


def _forwarded(name: str) -> property:
    """The property that is this member of the field `law`."""
    return property(lambda self: getattr(self.law, name), doc="That of the law within.")


def with_option(law: AnyLaw, name: str, chosen: Any) -> AnyLaw:
    """The law, and laws within it, with this value of an option where they have it."""
    values = {f.name: getattr(law, f.name) for f in dataclasses.fields(law)}
    has_laws = any(isinstance(value, Law) for value in values.values())
    if name not in values and not has_laws:
        return law
    new = object.__new__(type(law))
    for field, value in values.items():
        if isinstance(value, Law):
            value = with_option(value, name, chosen)
        if field == name:
            value = chosen
        object.__setattr__(new, field, value)
    return new


def forward_only(law: AnyLaw) -> AnyLaw:
    """The law, and laws within it, with `adjoint` 'forward' where they have this
    option.
    """
    return with_option(law, "adjoint", "forward")


def check_law(law: Law, scene: Scene, dtype: jnp.dtype) -> None:
    """Raise a ValueError where parameters, or the law as a whole, do not fit the
    scene.
    """
    for name, (value, _, domain) in parameters_of(law).items():
        ndim = np.ndim(value)
        is_matrix = domain.matrix and ndim == 2
        if value is None or not domain.per_contact or ndim == 0 or is_matrix:
            continue
        check_shape(
            name, value, (scene.contacts,), "one entry per contact, or a scalar"
        )
    if getattr(law, "friction", None) is not None and scene.tangents is None:
        raise ValueError(
            f"Argument `scene` must have tangents where {type(law).__name__} has "
            f"`friction`: give Scene(..., tangents=...), or friction=None."
        )
    law.check(scene, dtype)


def is_separable(law: Law) -> bool:
    """True where contacts that W does not couple may be solved separately.

    The law says so, its parameters are scalars or (m,), and open contacts take no part.
    """

    def of_contacts(x: Parameter) -> bool:
        """True for a scalar, or an array with one entry a contact."""
        plain = np.ndim(x.value) < 2 and not isinstance(x.value, tuple)
        return x.domain.per_contact and plain

    known = all(of_contacts(x) for x in parameters_of(law).values())
    return law.separable and known and not law.uses_gaps


def restrict_law(law: Law, contacts: jax.Array) -> Law:
    """The law of the contacts with these indices (k,): their entries of parameters
    (m,).
    """

    def restricted(x: Any) -> Any:
        """The entries of these contacts of an array (m,); all else as it is."""
        if eqx.is_array(x) and x.ndim == 1:
            return x[contacts]
        return x

    return jax.tree.map(restricted, law)
