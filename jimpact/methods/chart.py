"""Speed against accuracy: every way to compute an impact, on one chart."""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.impacts import impact
from jimpact.core.law import Law, check_law, with_entries
from jimpact.core.registry import registered_laws
from jimpact.core.scene import Scene, as_velocity, kinetic_energy
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders import CONTENDERS, Contender, contenders_of, solved
from jimpact.methods.points import (
    UNCOUNTED,
    Outcomes,
    at_points,
    in_turns,
    left_out_notes,
    relative_error,
)
from jimpact.tools.checks import (
    as_axis,
    as_whole,
    check_choice,
    check_kind,
    check_values,
    in_common_dtype,
)
from jimpact.tools.compiling import full_precision, known_options
from jimpact.tools.progress import counting_bar
from jimpact.tools.records import Column, Table, Tabular, fields_as_data, microseconds
from jimpact.tools.status import STATUS

QUANTITIES = ("velocity", "impulse", "energy", "duration", "gradient")
ALGEBRAIC = ("newton", "moreau", "poisson", "binary")

# stiffnesses of a batch lie within this factor, half of it to either side
SPREAD = 10.0
# impacts of the batch on which errors are measured: one alone may be right by chance
SAMPLE = 16
# impacts that a method without vmap does, in a loop, for its time in a batch
HOST_BATCH = 4
HOST = "runs on the host: finite differences only"
# rtol of the reference, and of the second solution
FINEST = 1e-14
SECOND = 1e-12


class Timing(NamedTuple):
    """Median and quartiles of the time per impact [s]."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Point:
    """A contender at one of its settings, or a law (`setting` None).

    `error[quantity]` is relative, the largest over the sample (of a law: its model
    error); NaN where there is none. `evaluations`: mean number of field evaluations an
    impact, NaN where there are none or they are not counted. `gradient` is None where
    there is none. `status`: the gravest.
    """

    label: str
    setting: float | None
    error: dict[str, float]
    evaluations: float
    status: str
    single: Timing
    batched: Timing
    gradient: Timing | None = None


@dataclass(frozen=True)
class Reference:
    """Solution of the impact that errors are measured from."""

    how: str  # it was computed, in words
    uncertainty: dict[str, float]  # relative, by quantity
    velocity: np.ndarray  # v+ (n,) [m/s]
    impulse: np.ndarray  # p (m,) [N s]
    duration: float  # [s]


@dataclass(frozen=True)
class WorkPrecision(Tabular):
    """Error against time and work; `print` gives a table.

    Attributes:
        velocity: v- (n,) [m/s].
        points: by contender, from coarse to fine.
        reference: what errors are measured from.
        compile_time: [s] by contender and program ('single', 'batched', 'gradient').
        left_out: why a contender is missing.
        without_gradient: why a contender has none.
        batch: impacts in a batch.
        sample: impacts on which errors are measured.
        spread: factor within which their stiffnesses lie.
        repeats: of every time.
    """

    velocity: np.ndarray
    points: dict[str, tuple[Point, ...]]
    reference: Reference
    compile_time: dict[str, dict[str, float]]
    left_out: dict[str, str]
    without_gradient: dict[str, str]
    batch: int
    sample: int
    spread: float
    repeats: int

    picture = "work_precision"

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it (NaN: null)."""
        return fields_as_data(self)

    @property
    def table(self) -> Table:
        """Table: errors and times, a row for each point; notes say how they were
        measured.
        """
        heads = ("v+", "impulse", "energy", "time", "gradient")
        columns = (
            Column("method"),
            Column("setting", lambda x: "law" if x is None else f"{x:g}"),
            *(Column(name, ".1e", head) for name, head in zip(QUANTITIES, heads)),
            Column("evaluations", ".0f", "evals"),
            Column("alone_s", microseconds, "alone", "µs"),
            Column("batch_s", microseconds, "batch", "µs"),
            Column("batch_low_s", microseconds, "from"),
            Column("batch_high_s", microseconds, "to"),
            Column("gradient_s", microseconds, "with J", "µs"),
            Column("compile_s", ".1f", "compile", "s"),
            Column("status"),
        )
        rows = []
        every = itertools.chain.from_iterable(self.points.values())
        differentiated = any(x.gradient for x in every)
        for name, points in self.points.items():
            # said once
            seconds = self.compile_time.get(name, {}).values()
            compiled = sum(seconds) or None
            for x in points:
                errors = [x.error.get(q, np.nan) for q in QUANTITIES]
                gradient = x.gradient and x.gradient.median
                times = [x.single.median, *x.batched, gradient]
                before = [name, x.setting, *errors, x.evaluations]
                rows.append([*before, *times, compiled, x.status])
                compiled = None
        known = {k: v for k, v in self.reference.uncertainty.items() if not np.isnan(v)}
        uncertain = ", ".join(f"{k} {v:.0e}" for k, v in known.items())
        notes = [
            f"Reference: {self.reference.how}; uncertain by {uncertain}.",
            f"Errors: relative, the largest of {self.sample} impacts with stiffness "
            f"spread over a factor {self.spread:g}; of a law its model error.",
            f"Times: medians of {self.repeats} in turns, per impact: alone, in a batch "
            f"of {self.batch} (from, to: "
            f"quartiles){', with J: with the Jacobian' * differentiated}.",
        ]
        notes += left_out_notes(self.left_out)
        notes += left_out_notes(self.without_gradient, "has no gradient")
        return Table(columns, rows, notes=notes, keys=2)


@full_precision
def work_precision(
    law: LZB,
    scene: Scene,
    velocity: Any,
    methods: Sequence[str | Contender] | None = None,
    settings: Mapping[str, Sequence[float]] | None = None,
    laws: Mapping[str, Law] | None = None,
    reference: str | None = None,
    *,
    batch: int = 256,
    repeats: int = 5,
    gradients: bool = True,
    durations: bool = True,
    progress: float | None = None,
) -> WorkPrecision:
    """Error against time and against field evaluations of ways to integrate an impact.

    Errors are relative, the largest over a sample of impacts with the stiffness of
    every contact spread at random over a factor of 10, the impact itself among them:
    `max |dv| / max |v-|`, `max |dp| / max |p|`, `|d(T+ - T-)| / T-`, duration, and the
    Jacobian `(d v+ / d ln k, d v+ / d e)`, with friction also `d v+ / d mu`, by forward
    mode, its error over `max |v-|`. Times are per impact, one alone and in a batch,
    taken in turns; compile times apart.

    Args:
        law: the `LZB` law; its `method` and `rtol` play no part, its `max_steps` does.
            With `friction` (scenes with tangents, planar or in space) methods without
            it are left out.
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s], at least one contact approaching.
        methods: names in `jimpact.methods.contenders.CONTENDERS`, or contenders of your
            own; None: all that support the impact. One that raises is left out, and the
            table says why.
        settings: settings by method, in place of its default ones.
        laws: algebraic laws by name, points with their *model* error against LZB on
            this impact; None: Newton, Moreau, Poisson and Binary with the law's
            restitution and friction.
        reference: method that errors are measured from, at rtol 1e-14; None: the
            event-aligned order 8. Its uncertainty is its distance from a second
            solution: order 8 at 1e-12.
        batch: impacts in a batch.
        repeats: of every time.
        gradients: measure those, too (with programs of their own).
        durations: likewise.
        progress: bar on stderr; None: on a terminal.

    Returns:
        `WorkPrecision`; `print` gives a table, `ji.plot.work_precision` the chart.

    Raises:
        ValueError: a method that is unknown or does not support the law, nothing
            approaches, single precision, bad sizes. TypeError: a law that is not LZB,
            or arguments in another order.

    >>> import jimpact as ji
    >>> pair, law, ladder = ji.chain([1.0, 2.0]), ji.LZB(0.5), {"verlet": [0.1, 0.01]}
    >>> options = {"laws": {}, "batch": 4, "gradients": False}
    >>> chart = ji.work_precision(law, pair, [1.0, 0.0], ["verlet"], ladder, **options)
    >>> [f"{point.error['velocity']:.0e}" for point in chart.points["verlet"]]
    ['2e-04', '4e-06']
    """
    check_kind("scene", scene, Scene, "work_precision(law, scene, velocity, ...)")
    repeats = as_whole("repeats", repeats, 1)
    case = _case(scene, velocity, law, as_whole("batch", batch, 1))
    chosen, left_out = _chosen(methods, settings or {}, case)
    exact = _reference(reference, case)
    second = CONTENDERS["time"]
    if laws is None:
        laws, _ = registered_laws(shared_parameters(law), ALGEBRAIC)
    check_kind("laws", laws, Mapping)

    # of one name one program, which the reference shares with its own row
    different = {m.name: m for m in (exact, second, *chosen)}
    _check_names(laws, different)
    measured = partial(_method_programs, case=case, gradients=gradients)
    programs = {n: measured(m, durations=durations) for n, m in different.items()}
    programs |= {name: _law_programs(other, case) for name, other in laws.items()}
    of_methods: dict[str, Any] = {m.name: m.ladder for m in chosen}
    ladders = of_methods | dict.fromkeys(laws, (None,))
    truth = programs[exact.name].at(FINEST)
    other_truth = programs[second.name].at(SECOND)
    solutions, raised = _solutions(programs, ladders, progress)
    rows = [
        (name, *of_setting)
        for name, row in solutions.items()
        for of_setting in zip(ladders[name], row)
    ]
    runs = [(programs[name], setting) for name, setting, _ in rows]
    times = _times(runs, repeats, progress)
    labels = {m.name: m.label or m.name for m in chosen}
    labels |= {name: f"law: {name}" for name in laws}
    points: dict[str, list[Point]] = {name: [] for name in solutions}
    for (name, setting, found), timings in zip(rows, times):
        off = _errors(case, found, truth)
        point = _point(labels[name], setting, off, found, timings)
        points[name].append(point)
    return WorkPrecision(
        velocity=np.asarray(case.velocity),
        points={name: tuple(row) for name, row in points.items()},
        reference=_as_reference(exact.name, second.name, case, truth, other_truth),
        compile_time={name: programs[name].compile_time for name in points},
        left_out=left_out | raised,
        without_gradient={m.name: HOST for m in chosen if gradients and not m.jax},
        batch=batch,
        sample=case.sample,
        spread=SPREAD,
        repeats=repeats,
    )


def _solutions(
    programs: Mapping[str, Any], ladders: Mapping[str, Any], progress: float | None
) -> tuple[dict[str, Any], dict[str, str]]:
    """Solutions by name at each setting of its ladder; why others were left out."""
    total = sum(map(len, ladders.values()))
    with counting_bar(total, "errors", progress) as advance:
        climbed = {
            name: partial(_outcomes_over_ladder, programs[name], name, advance)
            for name in ladders
        }
        return at_points(climbed, ladders)


def _as_reference(
    name: str, other_name: str, case: "Case", truth: Any, other_truth: Any
) -> Reference:
    """The reference solution of the impact itself, and its distance from the other
    one, by the methods of these names.
    """
    duration = np.ravel(truth.duration)[0]
    return Reference(
        how=f"{name} at rtol {FINEST:g} against {other_name} at {SECOND:g}",
        uncertainty=_errors(case, other_truth, truth),
        velocity=np.asarray(truth.velocity[0]),
        impulse=np.asarray(truth.impulse[0]),
        duration=float(duration),
    )


def _check_names(laws: Mapping[str, Law], methods: Mapping[str, Contender]) -> None:
    """Raise a ValueError where a law has the name of a method: both have a row in the
    chart.
    """
    for name in laws:
        if name in methods:
            raise ValueError(
                f"Argument `laws` must have names that no method has, but has {name!r}."
            )


def shared_parameters(law: LZB) -> dict[str, Any]:
    """Parameters that algebraic laws share with LZB: `restitution`, and `friction` if
    any.
    """
    if law.friction is None:
        friction = {}
    else:
        friction = {"friction": law.friction}
    return {"restitution": law.restitution} | friction


# -------------------------------------------------------------- the impact, and the
# contenders


class Case(NamedTuple):
    """The impact, and stiffnesses (batch, m) around the law's, which are row 0."""

    law: LZB
    scene: Scene
    velocity: jax.Array
    stiffness: jax.Array
    sample: int  # rows on which errors are measured


def _case(scene: Scene, velocity: Any, law: LZB, batch: int) -> Case:
    """The impact in double precision, one parameter per contact, with a batch around
    it.
    """
    v = as_velocity(scene, velocity, finite=True)
    if not isinstance(law, LZB):
        raise TypeError(
            f"Argument `law` must be an LZB law, but is {type(law).__name__}."
        )
    law, scene, v = in_common_dtype(law, scene, v)
    if v.dtype != jnp.float64:
        raise ValueError(
            f"Argument `velocity` must be in double precision, but has dtype "
            f"{v.dtype}: enable jax_enable_x64."
        )
    check_law(law, scene, v.dtype)
    if not bool(law.contact(scene, v).happens):
        raise ValueError("Argument `velocity` must let a closed contact approach.")
    m = scene.contacts
    fields = ("stiffness", *shared_parameters(law))
    each = [jnp.broadcast_to(getattr(law, field), (m,)) for field in fields]
    law = eqx.tree_at(lambda x: [getattr(x, name) for name in fields], law, each)
    generator = np.random.default_rng(0)
    exponents = generator.uniform(-0.5, 0.5, (batch, m))
    exponents[0] = 0.0  # the impact itself
    stiffness = law.stiffness[None, :] * jnp.asarray(SPREAD**exponents)
    return Case(law, scene, v, stiffness, min(SAMPLE, batch))


def _chosen(
    methods: Sequence[str | Contender] | None,
    settings: Mapping[str, Sequence[float]],
    case: Case,
) -> tuple[list[Contender], dict[str, str]]:
    """Contenders with the ladders of settings to run, and reasons why others are left
    out, by name.

    `methods` None: all that support the law of the case; `settings` replaces ladders by
    name.
    """
    left_out: dict[str, str] = {}
    if methods is None:
        reasons = {name: m.supports(case.law) for name, m in CONTENDERS.items()}
        left_out = {name: why for name, why in reasons.items() if why is not None}
        methods = [name for name in CONTENDERS if name not in left_out]
    chosen = _supporting("methods", methods, case)
    check_kind("settings", settings, Mapping)
    for name, values in settings.items():
        check_choice("settings", name, [each.name for each in chosen])
        ladder = f"settings[{name!r}]"
        check_values(ladder, as_axis(ladder, values), low=0.0, open_low=True)
    asked = [settings.get(m.name, m.ladder) for m in chosen]
    ladders = [np.ravel(x).tolist() for x in asked]
    with_ladders = [m._replace(ladder=tuple(x)) for m, x in zip(chosen, ladders)]
    return with_ladders, left_out


def _supporting(
    argument: str, methods: Sequence[str | Contender], case: Case
) -> list[Contender]:
    """Contenders by name, checked that they support the law of the case."""
    chosen = contenders_of(argument, methods, CONTENDERS)
    for contender in chosen:
        reason = contender.supports(case.law)
        if reason is not None:
            raise ValueError(
                f"Argument `{argument}` must be able to solve the impact, but has "
                f"{contender.name!r}: it {reason}."
            )
    return chosen


def _reference(name: str | None, case: Case) -> Contender:
    """The contender that errors are measured from, one with an rtol; None: 'time'."""
    (contender,) = _supporting("reference", [name or "time"], case)
    if contender.setting != "rtol":
        raise ValueError(f"Argument `reference` must take an rtol, but is {name!r}.")
    return contender


# -------------------------------------------------------------------------------
# programs


@dataclass(frozen=True)
class Programs:
    """The programs of a contender, functions of its setting, or of a law.

    `single` solves one impact, `batched` a number `batch` of them, `sampled` those on
    which errors are measured; `compile_time` [s] by program, filled in by the first
    calls.
    """

    single: Callable[[Any], Any]
    batched: Callable[[Any], Any]
    batch: int
    sampled: Callable[[Any], Outcomes]
    gradient: Callable[[Any], Any] | None = None
    compile_time: dict[str, float] = field(default_factory=dict)

    def at(self, setting: float | None) -> Outcomes:
        """Outcomes (S,) of the sampled impacts at a setting, with Jacobians if known,
        in NumPy.

        Evaluations are NaN where they are not counted.
        """
        outcomes = jax.tree.map(np.asarray, self.sampled(setting))
        evaluations = np.where(
            outcomes.evaluations == UNCOUNTED, np.nan, outcomes.evaluations
        )
        if self.gradient is None:
            jacobian = None
        else:
            jacobian = np.asarray(self.gradient(setting))
        return outcomes._replace(evaluations=evaluations, jacobian=jacobian)


def _outcomes_over_ladder(
    programs: Programs,
    name: str,
    advance: Callable[[int], None],
    ladders: Mapping[str, Any],
) -> list[Outcomes]:
    """Outcomes of the sampled impacts at every setting of the ladder of contender
    `name`.

    `advance` is called with the number of settings, even if the contender raises.
    """
    try:
        return [programs.at(setting) for setting in ladders[name]]
    finally:
        advance(len(ladders[name]))


def _jacobian(
    names: tuple[str, ...],
    run: Callable[..., Outcomes],
    k: jax.Array,
    case: Case,
    setting: jax.Array,
) -> Any:
    """(d v+ / d ln k, d v+ / d e) (n, 2 m), with friction also d v+ / d mu (n, 3
    m).
    """

    def velocity(at: dict[str, jax.Array]) -> jax.Array:
        """v+ (n,) [m/s] at the parameters `at` (m,) by name; 'ln k' is a change of
        ln k.
        """
        law = case.law
        for name in names:
            law = with_entries(law, (name,), at[name])
        factor = jnp.exp(at["ln k"])
        return run(k * factor, case._replace(law=law), setting).velocity

    at = {"ln k": jnp.zeros_like(k)}
    at |= {name: getattr(case.law, name) for name in names}
    parts = jax.jacfwd(velocity)(at)
    return jnp.concatenate([parts[name] for name in at], axis=-1)


def _method_programs(
    contender: Contender, case: Case, gradients: bool, durations: bool
) -> Programs:
    """Programs of a contender over the stiffnesses (batch, m) of the case, jitted and
    vmapped.
    """
    if not contender.jax:
        return _host_programs(contender, case)
    names = tuple(shared_parameters(case.law))
    apart = contender.duration_apart

    def solve(k: jax.Array, case: Case, setting: jax.Array) -> Outcomes:
        """Outcome of the case's impact with stiffness k (m,)."""
        law = with_entries(case.law, ("stiffness",), k)
        return solved(contender, law, case.scene, case.velocity, setting)[1]

    def timed(k: jax.Array, case: Case, setting: jax.Array) -> Outcomes:
        """Outcome with a duration of NaN where it costs a run of its own or is not
        wanted.
        """
        solution = solve(k, case, setting)
        if apart or not durations:
            return solution._replace(duration=jnp.nan)
        return solution

    k = case.stiffness
    compile_time = dict[str, float]()

    def batch(
        name: str, function: Callable[..., Any], rows: int
    ) -> Callable[[Any], Any]:
        """Program of a setting: the function at each of the first `rows`
        stiffnesses.
        """
        each = jax.vmap(function, in_axes=(0, None, None))
        return _compiled(compile_time, name, each, k[:rows], case)

    gradient = None
    if gradients:
        jacobian = partial(_jacobian, names, timed)
        gradient = batch("gradient", jacobian, case.sample)
    batched = batch("batched", timed, len(k))
    # errors need the duration, times do not: two programs if it takes a run of its own
    if durations and apart:
        complete = batch("errors", solve, case.sample)
    else:
        complete = batched
    return Programs(
        single=_compiled(compile_time, "single", timed, k[0], case),
        batched=batched,
        batch=len(k),
        sampled=lambda setting: jax.tree.map(
            lambda a: a[: case.sample], complete(setting)
        ),
        gradient=gradient,
        compile_time=compile_time,
    )


def _compiled(
    compile_time: dict[str, float],
    name: str,
    function: Callable[..., Any],
    *arguments: Any,
) -> Callable[[Any], Any]:
    """`setting -> function(*arguments, setting)`, compiled at its first call.

    That call enters the time of compiling [s] in `compile_time` under `name`.
    """

    @cache
    def compiled() -> Callable[..., Any]:
        """The compiled program of the arguments and a setting."""
        begin = time.perf_counter()
        quick = jax.jit(function, compiler_options=known_options())
        program = quick.lower(*arguments, jnp.ones((), float)).compile()
        compile_time[name] = time.perf_counter() - begin
        return program

    return lambda setting: compiled()(
        *arguments, jnp.asarray(np.nan if setting is None else setting, float)
    )


def _host_programs(contender: Contender, case: Case) -> Programs:
    """Programs of a contender that JAX cannot trace: loops over stiffnesses on the
    host.
    """
    laws = [with_entries(case.law, ("stiffness",), k) for k in case.stiffness[:SAMPLE]]
    rows = min(HOST_BATCH, len(laws))

    def sampled(setting: Any) -> Outcomes:
        """Outcomes of the sampled impacts, one after the other."""
        each = [
            solved(contender, law, case.scene, case.velocity, setting)[1]
            for law in laws
        ]
        return jax.tree.map(lambda *a: jnp.stack(a), *each)

    def alone(setting: Any, count: int = 1) -> list[Any]:
        """Solutions of the first `count` impacts, without checks: for the time of the
        solver.
        """
        return [
            contender.solve(law, case.scene, case.velocity, setting)
            for law in laws[:count]
        ]

    batched = partial(alone, count=rows)
    return Programs(single=alone, batched=batched, batch=rows, sampled=sampled)


def _law_programs(law: Law, case: Case) -> Programs:
    """Programs of an algebraic law, which has no setting; its sample is the impact
    itself.
    """
    law = in_common_dtype(law, case.velocity)[0]
    batch = len(case.stiffness)
    compile_time: dict[str, float] = {}

    def run(v: jax.Array, law: Law, scene: Scene, setting: jax.Array) -> Outcomes:
        """Outcome of one impact at v (n,); `setting` is not used."""
        return Outcomes.of(impact(law, scene, v))

    many = jax.vmap(run, in_axes=(0, None, None, None))
    v = case.velocity
    one = _compiled(compile_time, "single", run, v, law, case.scene)
    velocities = jnp.tile(v, (batch, 1))
    return Programs(
        single=one,
        batched=_compiled(compile_time, "batched", many, velocities, law, case.scene),
        batch=batch,
        sampled=lambda _: jax.tree.map(lambda a: a[None], one(None)),
        compile_time=compile_time,
    )


# ------------------------------------------------------------------------- errors and
# times


def _errors(case: Case, tried: Outcomes, truth: Outcomes) -> dict[str, float]:
    """Relative errors by quantity, the largest over the sampled impacts; NaN: not
    computed.

    Equation: `max |dv| / max |v-|`, `max |dp| / max |p|`, `|d(T+ - T-)| / T-`, duration
    over the longest, Jacobian over `max |v-|`. At rest the largest |v+| and |T+ - T-|
    take their places.
    """
    given = float(jnp.max(jnp.abs(case.velocity)))
    fastest = given or np.abs(truth.velocity).max()
    given_energy = float(kinetic_energy(case.scene, case.velocity))
    before = given_energy or np.abs(truth.energy_change).max()
    compared = {  # value, exact value, scale
        "velocity": (tried.velocity, truth.velocity, fastest),
        "impulse": (tried.impulse, truth.impulse, np.abs(truth.impulse).max()),
        "energy": (tried.energy_change, truth.energy_change, before),
        "duration": (tried.duration, truth.duration, np.abs(truth.duration).max()),
        "gradient": (tried.jacobian, truth.jacobian, fastest),
    }
    return {
        name: float("nan")
        if a is None or b is None
        else float(relative_error(np.ravel(a), np.ravel(b[: len(a)]), scale))
        for name, (a, b, scale) in compared.items()
    }


def _point(
    label: str,
    setting: float | None,
    error: dict[str, float],
    tried: Outcomes,
    timings: Sequence[Timing],
) -> Point:
    """Point of the chart: its errors, the gravest status, mean evaluations, times per
    impact.
    """
    status = STATUS[int(np.max(tried.status))].name
    evaluations = float(np.mean(tried.evaluations))
    return Point(label, setting, error, evaluations, status, *timings)


def _times(
    rows: list[tuple[Programs, float | None]], repeats: int, progress: float | None
) -> list[list[Timing]]:
    """Times per impact of each row (programs, setting): alone, in a batch, with
    gradient if any.

    All are measured in turns, `repeats` times.
    """
    tasks = [  # row, impacts of a call, the call
        (row, impacts, partial(run, value))
        for row, (programs, value) in enumerate(rows)
        for run, impacts in (
            (programs.single, 1),
            (programs.batched, programs.batch),
            (programs.gradient, min(SAMPLE, programs.batch)),
        )
        if run is not None
    ]
    with counting_bar(len(tasks) * repeats, "timings", progress) as advance:
        runs = [run for *_, run in tasks]
        times_of_tasks = in_turns(runs, repeats, lambda: advance(1))
    times: list[list[Timing]] = [[] for _ in rows]
    for (row, impacts, _), seconds in zip(tasks, times_of_tasks):
        quartiles = np.quantile(seconds / impacts, (0.5, 0.25, 0.75))
        times[row].append(Timing(*quartiles.tolist()))
    return times
