"""`impact`: the one place that turns a law's impulses into velocities, energy and
status.
"""

import dataclasses
import warnings
from typing import Any, NamedTuple, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact, Groups, contacts_of_groups, coupled_groups
from jimpact.core.law import (
    Impulses,
    Law,
    check_law,
    is_separable,
    restrict_law,
    within_domains,
)
from jimpact.core.scene import (
    Scene,
    as_velocity,
    gap_velocity,
    is_allowed,
    momentum,
    pad_scene,
    velocity_change,
)
from jimpact.numerics.derive import naming_the_adjoint
from jimpact.numerics.tridiagonal import diagonal
from jimpact.tools.checks import (
    check_kind,
    check_shape,
    check_values,
    in_common_dtype,
    in_numbers,
    is_traced,
    suggesting_names,
)
from jimpact.tools.compiling import full_precision, is_top_level_call, quick_jit
from jimpact.tools.precision import check_rtol, precision
from jimpact.tools.status import CODE, STATUS, raise_for, sign_tolerance

# Negative impulses are rounding up to this many times the impulse that would undo the
# noise of gamma-: a law removes up to twice the noise, and coupled contacts pass it on
# a few times. Ten times more would hide a contact that pulls slightly.
ROUNDING_PUSHES = 8

# Signs and gains of energy are violated beyond this multiple of the accuracy that a law
# allows itself: an error of a velocity counts twice in the energy. Ten times more: a
# law that misses its tolerance by 40 of them passes.
ACCURACIES = 4

# Number of contacts of the compiled program that single impacts of fewer contacts
# share. Compiling takes a second for each number of contacts; padding by open contacts
# costs a tenth of the impact. Ten times more would make every first impact slow.
SHARED = 8


@suggesting_names(v="velocity", p="impulse", p_t="tangential_impulse")
class Impact(eqx.Module):
    """Outcome of an impact; under `vmap` every field has the axes of the batch first.

    `velocity` v+ (n,) [m/s]; `impulse` p (m,) [N s]; `tangential_impulse` (t,), t = 0
    without friction [N s]; `energy_change` T+ - T- () [J]; `initial_energy` stored
    before () [J]; `status` () int32, a row of `jimpact.STATUS`, 0 = ok; `accuracy` (),
    the error of v+ that the law allows itself, relative to the size of the impact.
    """

    velocity: jax.Array
    impulse: jax.Array
    tangential_impulse: jax.Array
    energy_change: jax.Array
    initial_energy: jax.Array
    status: jax.Array
    accuracy: jax.Array | float = 0.0

    def __str__(self) -> str:
        """Velocities, impulses, energy and status, in numbers."""
        lines = [f"velocity        {in_numbers(self.velocity)} (m/s, of angles rad/s)"]
        lines.append(f"impulse         {in_numbers(self.impulse)} N s")
        if self.tangential_impulse.size:
            lines.append(f"tangential      {in_numbers(self.tangential_impulse)} N s")
        lines.append(f"energy change   {in_numbers(self.energy_change)} J")
        status = in_numbers(self.status)
        if self.status.ndim == 0 and status.isdigit():
            status = STATUS[int(status)].name
        return "\n".join([*lines, f"status          {status}"])


@full_precision
def impact(
    law: Law,
    scene: Scene,
    velocity: Any,
    noise: Any = None,
    approach: Any = None,
    rtol: Any = None,
) -> Impact:
    """Velocities after the impact of `law` on `scene`: pure, for jit, vmap and grad.

    Equation: `v+ = v- + M^-1 (N p + H p_t)`, `T+ - T- = (a + b) / 2`,
    `a = (gamma+ + gamma-)^T p`, `b = (u+ + u-)^T p_t`; N (n, m) holds the contact
    normals, H (n, t) the tangents, u = H^T v are the slip velocities.

    Independent groups of contacts (two pairs of balls in one scene) are solved
    separately if the scene is known, not traced, and the law allows it
    (`Law.separable`); the outcome is the same. Approach within the rounding of v- (or
    within `noise`) counts as 0.

    Args:
        law: its parameters are scalars or (m,); a restitution matrix is (m, m).
        scene: n coordinates, m contacts; contacts with gap > 0 take no part in
            instantaneous laws.
        velocity: v- (n,) [m/s], [rad/s] for rotations.
        noise: speed () [m/s] up to which an approach counts as rounding: in a motion v-
            has the rounding of the largest earlier speeds. None: the rounding of v-.
        approach: speed () [m/s] subtracted from every gap velocity before the law is
            applied; a small value starts an impact without collision. None: 0.
        rtol: tolerance () on v+ for a law whose option `rtol` is None, at most 1 and at
            least what the type holds (3.6e-15, in single precision 1.9e-6); unlike that
            option it may be traced. None: the law's default.

    Returns:
        `Impact` with `velocity` (n,), `impulse` (m,), `tangential_impulse`,
        `energy_change` (), `initial_energy` (), `status` () int32, 0 = ok
        (`raise_on_failure`, `jimpact.STATUS`).

    Raises:
        ValueError: shapes or ranges, on the host. Where they are traced, the status
            reports them: `not_finite` (NaN in the velocity, a gap, `noise`, `approach`
            or `rtol`), or `out_of_range` (a parameter outside its domain, a normal that
            is 0, a mass that is asymmetric or not positive, a negative gap, `noise` or
            `approach`, an `rtol` beyond its range, a velocity that breaks a bilateral
            constraint). An energy of the impact,
            `sum gamma-^2 / W_jj`, that the floating type takes for 0 or infinite is
            `out_of_range` on the host, too: choose other units.

    Warns:
        UserWarning: only open contacts approach, and the law leaves those out.

    >>> import jimpact as ji
    >>> out = ji.impact(
    ...     ji.LZB(0.9, stiffness=1.0, exponent=1.5), ji.chain([1, 1, 1]), [1, 0, 0]
    ... )
    >>> [round(float(v), 4) for v in out.velocity]
    [-0.0086, 0.1041, 0.9045]
    """
    check_kind("law", law, Law)
    check_kind("scene", scene, Scene)
    v = as_velocity(scene, velocity, finite=True)
    if scene.constraints is not None:
        check_constrained(scene, v)
    law, scene, v = in_common_dtype(law, scene, v)
    check_law(law, scene, v.dtype)
    for name, speed in (("noise", noise), ("approach", approach)):
        check_values(name, speed, low=0.0)
        if speed is not None:
            check_shape(name, speed, (), "one speed")
    if rtol is not None:
        check_values("rtol", rtol, low=0.0, high=1.0, open_low=True)
        check_shape("rtol", rtol, (), "one tolerance")
        if not is_traced(rtol):
            check_rtol(float(rtol), v.dtype)
    given = _Given(
        noise=_as_given(noise, v.dtype),
        approach=_as_given(approach, v.dtype),
        rtol=_as_given(rtol, v.dtype),
    )
    if scene.gaps is not None and not law.uses_gaps:
        _warn_of_unused_gaps(law, scene, v)
    groups = None
    if is_separable(law):
        groups = coupled_groups(scene)
    # small scenes are padded to common sizes, so that few programs serve all
    if groups is None and _shares_a_program(law, scene, v, given):
        return _impact_of_padded_scene(law, scene, v, given)
    with naming_the_adjoint():
        return _impact(law, scene, v, groups, given, Traced.of(law, scene, v, given))


def _as_given(value: Any, dtype: Any) -> jax.Array | None:
    """A number of the caller's as an array (); None if it is not given."""
    if value is None:
        return None
    return jnp.asarray(value, dtype)


def _warn_of_unused_gaps(law: Law, scene: Scene, v: jax.Array) -> None:
    """Warn where only open contacts approach, and the law leaves these out."""
    if is_traced((scene, v)):
        return
    with jax.ensure_compile_time_eval():  # inside jit, too, where scene and v are known
        approaches = np.asarray(gap_velocity(scene, v)) < 0
        stored = law.stored
    closed = np.asarray(scene.gaps) == 0
    nothing = approaches.any() and not (approaches & closed).any()
    if nothing and not is_traced(stored) and not np.any(stored):
        warnings.warn(
            f"Nothing happens: only open contacts (gap > 0) approach, and "
            f"{type(law).__name__} leaves them out. Laws that use gaps are Compliant "
            f"and Binary.",
            stacklevel=4,  # the line that calls `impact`, through `full_precision`
        )


class _Given(NamedTuple):
    """The arguments `noise` [m/s], `approach` [m/s] and `rtol` of `impact`; None: its
    default.
    """

    noise: jax.Array | None = None
    approach: jax.Array | None = None
    rtol: jax.Array | None = None

    def applied(self, contact: Contact) -> Contact:
        """The contacts with gamma 0 within `noise`, then less `approach`, integrated to
        `rtol`.
        """
        if self.noise is not None:
            contact = contact.within(self.noise)
        if self.rtol is not None:
            contact = contact.integrated_to(self.rtol)
        if self.approach is None:
            return contact
        return contact.approaching(self.approach)


NOTHING_GIVEN = _Given()


class Traced(NamedTuple):
    """True for each argument of `impact` that is traced, so that the host could not
    check it.
    """

    law: bool = False
    scene: bool = False
    constrained: bool = False  # that the velocity satisfies the bilateral constraints
    given: bool = False

    @classmethod
    def of(
        cls, law: Law, scene: Scene, v: jax.Array, given: _Given = NOTHING_GIVEN
    ) -> "Traced":
        """The flags of these arguments; the constraints are checked with the
        velocity.
        """
        constrained = scene.constraints is not None and is_traced(
            (scene.constraints, v)
        )
        return cls(is_traced(law), is_traced(scene), constrained, is_traced(given))

    def status(
        self,
        arguments: tuple[Law, Scene, jax.Array, _Given],
        code: jax.Array,
        size: jax.Array,
        finite: jax.Array,
    ) -> jax.Array:
        """Status code () of an impact: `code`, or the reason why it has no outcome.

        `arguments` are its law, scene, v- and given values; `size` () [sqrt(J)] is the
        root of its energy `sum gamma-^2 / W_jj`; `finite` () is True where its results
        are finite.
        """
        _, _, v, _ = arguments
        code = jnp.where(finite, code, CODE["not_finite"])
        code = jnp.where(_has_scale(size, v), code, CODE["out_of_range"])
        if any(self):
            refused = self._refusal(*arguments)
            code = jnp.where(refused > CODE["ok"], refused, code)
        return code.astype(jnp.int32)

    def _refusal(
        self, law: Law, scene: Scene, v: jax.Array, given: _Given
    ) -> jax.Array:
        """`not_finite` where a traced argument holds a NaN, `out_of_range` where one is
        not allowed, infinite ones included, else `ok`.
        """
        traced: list[Any] = []
        allowed = [jnp.asarray(True)]
        if self.law:
            traced.append(law)
            allowed.append(within_domains(law))
        if self.scene:
            traced.append(scene)
            allowed.append(is_allowed(scene))
        if self.constrained:
            allowed.append(jnp.all(_keeps_constraints(scene.constraints, v)))
        if self.given:
            traced.append(given)
            some = [x for x in given if x is not None]
            allowed += [(x >= 0) & (x < jnp.inf) for x in some]
        if self.given and given.rtol is not None:
            resolved = given.rtol >= precision(v.dtype).noise
            allowed.append(resolved & (given.rtol <= 1))
        numbers = [x for x in jax.tree.leaves(traced) if eqx.is_inexact_array(x)]
        unknown = [jnp.any(jnp.isnan(x)) for x in numbers]
        all_allowed = jnp.all(jnp.asarray(allowed))
        any_unknown = jnp.any(jnp.asarray(unknown, bool))
        code = jnp.where(all_allowed, CODE["ok"], CODE["out_of_range"])
        return jnp.where(any_unknown, CODE["not_finite"], code)


def _shares_a_program(law: Law, scene: Scene, v: jax.Array, given: _Given) -> bool:
    """Whether an impact runs by the program for SHARED contacts, so that it need not be
    compiled.

    The law allows it, the scene has at most that many contacts, no friction and not two
    walls, and nothing is traced or inside another program: what surrounds an impact
    sees its true sizes.
    """
    allowed = is_separable(law) and law.pads_scenes
    plain = scene.walls != (True, True) and scene.tangents is None
    if not allowed or not plain or scene.contacts > SHARED:
        return False
    return not is_traced((law, scene, v, given)) and is_top_level_call()


def _impact_of_padded_scene(
    law: Law, scene: Scene, v: jax.Array, given: _Given
) -> Impact:
    """The impact by the program for SHARED contacts: those that are added are open."""
    padded = pad_scene(scene, SHARED)
    velocity: Any = np.zeros(padded.scene.size, v.dtype)
    velocity[padded.coordinates] = v
    on_host = restrict_law(jax.tree.map(np.asarray, law), padded.copied)
    out = _impact(on_host, padded.scene, velocity, None, given, Traced())
    v_plus = np.asarray(out.velocity)[padded.coordinates]
    p = np.asarray(out.impulse)[padded.contacts]
    return dataclasses.replace(
        out, velocity=jnp.asarray(v_plus), impulse=jnp.asarray(p)
    )


def check_constrained(scene: Scene, velocity: jax.Array) -> None:
    """A velocity that breaks a bilateral constraint is an error."""
    if is_traced((scene.constraints, velocity)):
        return
    h = np.asarray(scene.constraints)
    v = np.asarray(velocity)
    keeps = _keeps_constraints(h, v)
    if not keeps.all():
        j = int(np.argmin(keeps))
        raise ValueError(
            f"Argument `velocity` must satisfy the bilateral constraints, grad h^T v = "
            f"0, but constraint {j + 1} has the rate {(h.T @ v)[j]:g}."
        )


def _keeps_constraints(constraints: Any, velocity: Any) -> Any:
    """True (b,) where `|h^T v| <= tolerance |h|^T |v|`, h (n, b): gradients of
    constraints.
    """
    size = abs(constraints).T @ abs(velocity)
    return abs(constraints.T @ velocity) <= sign_tolerance(velocity.dtype) * size


@quick_jit
def _impact(
    law: Law,
    scene: Scene,
    v: jax.Array,
    groups: Groups | None,
    given: _Given,
    traced: Traced,
) -> Impact:
    """The outcome from the law's impulses p: velocities, energy and status.

    Equation: `v+ = v- + M^-1 (N p + H p_t)`, `T+ - T- = (v+ - v-)^T M (v+ + v-) / 2`,
    which may exceed the stored energy by the noise of the outcome only.
    """
    if groups is None:
        contact = given.applied(law.contact(scene, v))
        happens = contact.happens
        outcome = _resolved(law, contact, happens)
        stored = contact.stored
    else:
        outcome, happens, stored = _in_groups(law, scene, v, groups, given)
    p = outcome.normal
    tangential = outcome.tangential
    jump = velocity_change(scene, p, tangential)
    v_plus = v + jump
    # over bodies, not as p . (gamma- + gamma+) / 2 over contacts: next to a much
    # lighter body the terms of gamma+ = gamma- + W p cancel
    change = 0.5 * momentum(scene, jump) @ (v + v_plus)
    total = jnp.sum(stored)
    code = jnp.where(change > total + outcome.noise, CODE["energy_gain"], CODE["ok"])
    code = jnp.where(happens, jnp.maximum(code, outcome.status), CODE["ok"])
    finite = jnp.all(jnp.isfinite(v_plus)) & jnp.all(jnp.isfinite(p))
    finite = finite & jnp.isfinite(change)
    # no scale can be out of range without an impact
    size = jnp.where(happens, outcome.size, 1.0)
    code = traced.status((law, scene, v, given), code, size, finite)
    return Impact(v_plus, p, tangential, change, total, code, outcome.accuracy)


def _has_scale(size: jax.Array, v: jax.Array) -> jax.Array:
    """True () where the energy `size^2` of an impact is neither 0 nor infinite to the
    precision.

    True as well where the velocity v (n,) is not finite, and the energy can have no
    value.
    """
    tiny = precision(size.dtype).tiny
    inside = (size**2 >= tiny) & (size**2 < jnp.inf)
    return inside | ~jnp.all(jnp.isfinite(v))


class _Resolved(NamedTuple):
    """Impulses of contacts, the status of the law and of their signs, and two
    scales.
    """

    normal: jax.Array
    tangential: jax.Array
    status: jax.Array
    size: jax.Array  # () of the impact, square root of an energy
    # () energy that the rounding of v- and the law's accuracy leave unknown
    noise: jax.Array
    accuracy: jax.Array  # () see `Impact`


def judged_beyond(dtype: Any, accuracy: Any) -> Any:
    """Share of the impact's size beyond which a wrong sign or a gain of energy is a
    violation.

    Equation: `max(rounding of the type, ACCURACIES accuracy)`.
    """
    return jnp.maximum(sign_tolerance(dtype), ACCURACIES * accuracy)


def _resolved(law: Law, contact: Contact, happens: jax.Array) -> _Resolved:
    """The law's impulses; 0 without an impact (`happens` false), and at open
    contacts.
    """
    gamma = contact.gap_velocity
    # without an impact the law gets gamma- = -1 and its result is discarded: gradients
    # stay finite
    harmless = jnp.where(happens, gamma, -jnp.ones_like(gamma))
    approaching = eqx.tree_at(lambda c: c.gap_velocity, contact, harmless)
    impulses = _impulses_of(law, law.impulses(approaching), contact)
    part = happens & (contact.closed | law.uses_gaps)
    p = jnp.where(part, impulses.normal, 0.0)
    tangential = jnp.zeros(contact.tangents * contact.contacts, p.dtype)
    if impulses.tangential is not None:
        rows = jnp.repeat(part, contact.tangents)
        tangential = jnp.where(rows, impulses.tangential, 0.0)
    accuracy = law.accuracy(contact)
    tolerance = judged_beyond(p.dtype, accuracy)
    signs = _signs(contact, p, tangential, tolerance * contact.size)
    code = jnp.maximum(impulses.status, signs)
    code = jnp.where(happens, code, CODE["ok"])
    noise = jnp.sum(contact.noise * jnp.abs(p)) + tolerance * contact.size**2
    return _Resolved(
        normal=p,
        tangential=tangential,
        status=code,
        size=contact.size,
        noise=noise,
        accuracy=jnp.asarray(accuracy, p.dtype),
    )


def _impulses_of(law: Law, returned: Any, contact: Contact) -> Impulses:
    """The impulses that `law.impulses` returned, or an error unless they fit these
    contacts.

    These are `normal` (m,), `tangential` (t,) or None, and a `status` of `ji.STATUS`.
    """
    name = f"`{type(law).__name__}.impulses`"
    if not isinstance(returned, tuple):  # an array would pass for its entries
        raise TypeError(
            f"{name} must return `ji.Impulses`, but returns {type(returned).__name__}."
        )
    impulses = Impulses(*returned)
    t = contact.tangents * contact.contacts
    for part, size in (("normal", contact.contacts), ("tangential", t)):
        value = getattr(impulses, part)
        if value is not None and jnp.shape(value) != (size,):
            raise ValueError(
                f"{name} must return `{part}` of shape ({size},), but returns one of "
                f"shape {jnp.shape(value)}."
            )
    if isinstance(impulses.status, int) and impulses.status not in CODE.values():
        raise ValueError(
            f"{name} must return `status` of a row of `ji.STATUS`, below "
            f"{len(STATUS)}, but returns {impulses.status}."
        )
    return impulses._replace(normal=jnp.asarray(impulses.normal))


def _in_groups(
    law: Law, scene: Scene, v: jax.Array, groups: Groups, given: _Given
) -> tuple[_Resolved, jax.Array, jax.Array]:
    """Impulses of groups of contacts that W does not couple, each group solved by
    itself.

    Signs are judged on the scale of their group. A group without an impact gets p = 0,
    unless the law also pulls at separating contacts.

    Returns:
        The impulses of all contacts, `happens` () True if there is an impact in any
        group, and the stored energy (m,) [J].
    """
    m = scene.contacts
    stored = jnp.broadcast_to(law.stored, (m,)).astype(v.dtype)
    stored = jnp.where(scene.closed, stored, 0.0)
    batches = [given.applied(c) for c in contacts_of_groups(scene, v, stored, groups)]
    active = [
        jax.vmap(lambda contact: contact.happens)(contacts) for contacts in batches
    ]
    happens = jnp.any(jnp.concatenate(active))
    p = jnp.zeros(m, v.dtype)
    tangents = 0  # of a contact
    if scene.tangents is not None:
        tangents = scene.tangents.shape[1] // m
    tangential = jnp.zeros((m, tangents), v.dtype)
    code = jnp.asarray(CODE["ok"])
    square = jnp.zeros((), v.dtype)
    noise = jnp.zeros((), v.dtype)
    accuracy = jnp.zeros((), v.dtype)
    for padded, contacts, acts in zip(groups, batches, active):
        index = jnp.asarray(padded % m)
        acts = happens & (acts | law.pulls)

        def resolve_group(
            index: jax.Array, contact: Contact, acts: jax.Array
        ) -> _Resolved:
            """The impulses of one group."""
            return _resolved(restrict_law(law, index), contact, acts)

        if len(index) == 1:  # without the cost of a batch
            group = jax.tree.map(lambda x: x[0], (index, contacts, acts))
            resolved = resolve_group(*group)
            part = jax.tree.map(lambda x: jnp.asarray(x)[None], resolved)
        else:
            part = jax.vmap(resolve_group)(index, contacts, acts)
        members = padded.reshape(-1)
        p = p.at[members].set(part.normal.reshape(-1), mode="drop")
        rows = part.tangential.reshape(len(members), tangents)
        tangential = tangential.at[members].set(rows, mode="drop")
        code = jnp.maximum(code, jnp.max(part.status))
        square = square + jnp.sum(part.size**2)
        noise = noise + jnp.sum(part.noise)
        accuracy = jnp.maximum(accuracy, jnp.max(part.accuracy))
    outcome = _Resolved(
        normal=p,
        tangential=tangential.reshape(-1),
        status=code,
        size=jnp.sqrt(square),
        noise=noise,
        accuracy=accuracy,
    )
    return outcome, happens, stored


def _signs(
    contact: Contact, p: jax.Array, tangential: jax.Array, tolerance: jax.Array
) -> jax.Array:
    """Status code () `negative_impulse` or `inadmissible_velocity`, else `ok`.

    Equation: `p_j sqrt(W_jj) < -tolerance` (the impulse pulls), or
    `gamma+_j / sqrt(W_jj) < -tolerance` at a closed contact (it still approaches)
    [sqrt(J)].
    """
    root = jnp.sqrt(diagonal(contact.delassus))
    # the sign of an impulse that only undoes the rounding of v- is not judged
    rounding = ROUNDING_PUSHES * contact.noise / root
    floor = tolerance + jnp.sqrt(jnp.sum(rounding**2))
    pull = jnp.any(p * root < -floor)
    after = contact.gap_velocity_after(p, tangential) + contact.rounding(p, tangential)
    approach = jnp.any(contact.closed & (after / root < -tolerance))
    code = jnp.where(approach, CODE["inadmissible_velocity"], CODE["ok"])
    return jnp.where(pull, CODE["negative_impulse"], code)


class _Outcome(Protocol):
    """A result with a status: an `Impact` or a `Motion`, one or a batch."""

    @property
    def status(self) -> Any:
        """Codes () or of a batch."""


OutcomeT = TypeVar("OutcomeT", bound=_Outcome)


def raise_on_failure(out: OutcomeT) -> OutcomeT:
    """Raise a RuntimeError naming every failed impact or motion; else return it.

    Codes that only inform (`plastic_limit`, `ill_conditioned`, `order_dependent`, ..)
    pass.

    Args:
        out: what `impact` or `simulate` returned, one or a batch.

    Returns:
        `out` itself.

    Raises:
        RuntimeError: a status that is a failure; with the places in the batch.
        TypeError: a traced status: inside jit read `out.status`.

    >>> import jimpact as ji
    >>> apart = ji.impact(ji.Newton(0.5), ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 1.0])
    >>> ji.raise_on_failure(apart)
    Traceback (most recent call last):
        ...
    RuntimeError: Failed impacts among 1:
      negative_impulse: a contact would have to pull (p < 0) (1)
    """
    explain = getattr(out, "explain_failure", lambda row, lanes: "")
    raise_for(out.status, STATUS, f"{type(out).__name__.lower()}s", explain)
    return out
