"""Speed against accuracy: every way to compute an impact, on one chart."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_whole, check_choice, check_values, in_common_dtype
from jimpact.compiling import full_precision
from jimpact.files.records import fields_as_data, number, table
from jimpact.fits.parameters import with_entries
from jimpact.impacts import Impact, impact
from jimpact.law import Law, check_law
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders import METHODS, UNCOUNTED, Method, outcome
from jimpact.methods.timing import in_turns
from jimpact.progress import counting_bar
from jimpact.registry import registered_laws
from jimpact.scene import Scene, as_velocity, kinetic_energy
from jimpact.status import STATUS

QUANTITIES = ("velocity", "impulse", "energy", "duration", "gradient")
ALGEBRAIC = ("newton", "moreau", "poisson", "binary")

SPREAD = 10.0  # stiffnesses of a batch lie within this factor, half of it to either side
SAMPLE = 16  # impacts of the batch on which errors are measured: one alone may be right by chance
HOST_BATCH = 4  # impacts that a method without vmap does, in a loop, for its time in a batch
HOST = "host code: finite differences only"
FINEST, SECOND = 1e-14, 1e-12  # rtol of the reference, and of the second solution


class Timing(NamedTuple):
    """Median and quartiles of the time per impact [s]."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Point:
    """A method at one of its settings, or a law (`setting` None).

    `error[quantity]` is relative, the largest over the sample (of a law: its model error); NaN
    where there is none. `evaluations`: mean number of field evaluations an impact, NaN where there
    are none or they are not counted. `gradient` is None where there is none. `status`: the gravest.
    """

    label: str
    setting: float | None
    error: dict[str, float]
    evaluations: float
    status: str
    single: Timing
    batched: Timing
    gradient: Timing | None = None

    def cells(self) -> list[str]:
        """The cells of its row."""
        times = [_us(t and t.median) for t in (self.single, self.batched, self.gradient)]
        times[1] += f" ({_us(self.batched.low)}-{_us(self.batched.high)})"
        setting = "law" if self.setting is None else f"{self.setting:g}"
        errors = [number(self.error[q], ".1e") for q in QUANTITIES]
        return [setting, *errors, number(self.evaluations, ".0f"), *times]


def _us(seconds: float | None) -> str:
    """A time in microseconds."""
    return "" if seconds is None else f"{1e6 * seconds:.3g}"


@dataclass(frozen=True)
class Reference:
    """What errors are measured from: how it was computed, how uncertain it is (relative)."""

    how: str
    uncertainty: dict[str, float]
    velocity: np.ndarray
    impulse: np.ndarray
    duration: float


@dataclass(frozen=True)
class WorkPrecision:
    """Error against time and work; `print` gives a table, `ji.plot.work_precision` a picture.

    Attributes:
        velocity: v- (n,) [m/s].
        points: by method, from coarse to fine.
        reference: what errors are measured from.
        compile_time: [s] by method and program ('single', 'batched', 'gradient').
        left_out: why a method is missing.
        without_gradient: why a method has none.
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

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it (NaN: null)."""
        return fields_as_data(self)

    def __str__(self) -> str:
        """A table of all points, and how they were measured."""
        heads = ["method", "setting", "v+", "impulse", "energy", "time", "gradient", "evals"]
        heads += ["alone [us]", "batch", "with J", "compile [s]", "status"]
        rows = []
        for name, points in self.points.items():
            compiled = sum(self.compile_time[name].values())
            first = [name, f"{compiled:.1f}" if compiled else ""]
            for point in points:
                rows.append([first[0], *point.cells(), first[1], point.status])
                first = ["", ""]
        filled = [i for i, column in enumerate(zip(*rows)) if any(column)]
        heads, rows = [heads[i] for i in filled], [[row[i] for i in filled] for row in rows]
        uncertain = ", ".join(
            f"{k} {v:.0e}" for k, v in self.reference.uncertainty.items() if not np.isnan(v)
        )
        lines = [
            *table(heads, rows, left=["status"], keys=2),
            f"Reference: {self.reference.how}; uncertain by {uncertain}.",
            f"Errors: relative, the largest of {self.sample} impacts with stiffness spread over a "
            f"factor {self.spread:g}; of a law its model error.",
            f"Times: medians of {self.repeats} in turns, µs per impact: alone, in a batch of "
            f"{self.batch} (quartiles){', with the Jacobian' if 'with J' in heads else ''}.",
        ]
        lines += [f"left out: {name}: {why}." for name, why in self.left_out.items()]
        lines += [f"no gradient: {name}: {why}." for name, why in self.without_gradient.items()]
        return "\n".join(lines)


@full_precision
def work_precision(
    scene: Scene,
    velocity: Any,
    law: LZB,
    methods: Sequence[str] | None = None,
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
    """Error against time and against field evaluations of many ways to integrate one impact.

    Errors are relative, the largest over a sample of impacts with the stiffness of every contact
    spread at random over a factor of 10, the impact itself among them: `max |dv| / max |v-|`,
    `max |dp| / max |p|`, `|d(T+ - T-)| / T-`, duration, and the Jacobian
    `(d v+ / d ln k, d v+ / d e)`, with friction also `d v+ / d mu`, by forward mode, its error over
    `max |v-|`. Times are per impact, one alone and in a batch, taken in turns; compile times apart.

    Args:
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s], at least one contact approaching.
        law: the `LZB` law; its `method` and `rtol` play no part, its `max_steps` does. With
            `friction` (scenes with tangents, planar or in space) methods without it are left out.
        methods: names in `jimpact.methods.contenders.METHODS`; None: all that support the impact.
        settings: settings by method, in place of its default ones.
        laws: algebraic laws by name, points with their *model* error against LZB on this impact;
            None: Newton, Moreau, Poisson and Binary with the law's restitution and friction.
        reference: method that errors are measured from, at rtol 1e-14; None: the
            event-aligned order 8. Its uncertainty is its distance from
            a second solution: order 8 at 1e-12.
        batch: impacts in a batch.
        repeats: of every time.
        gradients: measure those, too (with programs of their own).
        durations: likewise.
        progress: bar on stderr; None: on a terminal.

    Returns:
        `WorkPrecision`; `print` gives a table, `ji.plot.work_precision` the chart.

    Raises:
        ValueError: a method that is unknown or does not support the law, nothing approaches,
            single precision, bad sizes. TypeError: a law that is not LZB.

    >>> import jimpact as ji
    >>> pair, law, ladder = ji.chain([1.0, 2.0]), ji.LZB(0.5), {"verlet": [0.1, 0.01]}
    >>> options = {"laws": {}, "batch": 4, "gradients": False}
    >>> chart = ji.work_precision(pair, [1.0, 0.0], law, ["verlet"], ladder, **options)
    >>> [f"{point.error['velocity']:.0e}" for point in chart.points["verlet"]]
    ['2e-04', '4e-06']
    """
    repeats = as_whole("repeats", repeats, 1)
    case = _case(scene, velocity, law, as_whole("batch", batch, 1))
    chosen, left_out = _chosen(methods, case)
    ladders = _ladders(chosen, settings or {})
    exact, second = _reference(reference, case), METHODS["dop853"]
    if laws is None:
        built = registered_laws(shared_parameters(law))[0]
        laws = {name: built[name] for name in ALGEBRAIC}
    needed = {m.name: m for m in (*chosen, exact, second)}
    programs = {n: _method_programs(m, case, gradients, durations) for n, m in needed.items()}
    programs |= {name: _law_programs(other, case) for name, other in laws.items()}
    rows: list[tuple[str, float | None]] = [(n, x) for n, row in ladders.items() for x in row]
    rows += [(name, None) for name in laws]
    truth, other_truth = programs[exact.name].at(FINEST), programs[second.name].at(SECOND)
    solutions = []
    with counting_bar(len(rows), "errors", progress) as advance:
        for name, value in rows:
            solutions.append(programs[name].at(value))
            advance(1)
    times = _times([(programs[name], value) for name, value in rows], repeats, progress)
    labels = {m.name: m.label for m in chosen} | {name: f"law: {name}" for name in laws}
    points: dict[str, list[Point]] = {name: [] for name, _ in rows}
    for (name, value), solution, timings in zip(rows, solutions, times):
        status = STATUS[int(np.max(solution.out.status))].name
        work = float(np.mean(solution.evaluations))
        error = _errors(case, solution, truth)
        points[name].append(Point(labels[name], value, error, work, status, *timings))
    return WorkPrecision(
        velocity=np.asarray(case.velocity),
        points={name: tuple(row) for name, row in points.items()},
        reference=Reference(
            how=f"{exact.name} at rtol {FINEST:g} against {second.name} at {SECOND:g}",
            uncertainty=_errors(case, other_truth, truth),
            velocity=np.asarray(truth.out.velocity[0]),
            impulse=np.asarray(truth.out.impulse[0]),
            duration=float(np.ravel(truth.duration)[0]),
        ),
        compile_time={name: programs[name].compile_time for name in points},
        left_out=left_out,
        without_gradient={m.name: HOST for m in chosen if gradients and not m.jax},
        batch=batch,
        sample=case.sample,
        spread=SPREAD,
        repeats=repeats,
    )


def shared_parameters(law: LZB) -> dict[str, Any]:
    """What an algebraic law has in common with it: restitution, and friction where there is any."""
    friction = {} if law.friction is None else {"friction": law.friction}
    return {"restitution": law.restitution} | friction


# ------------------------------------------------------------------ the impact, and methods


class Case(NamedTuple):
    """The impact, and stiffnesses (batch, m) around the law's, which are row 0."""

    law: LZB
    scene: Scene
    velocity: jax.Array
    stiffness: jax.Array
    sample: int  # rows on which errors are measured


def _case(scene: Scene, velocity: Any, law: LZB, batch: int) -> Case:
    """The impact in double precision, one parameter per contact, with a batch around it."""
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    if not isinstance(law, LZB):
        raise TypeError(f"Argument `law` must be an LZB law, but is {type(law).__name__}.")
    law, scene, v = in_common_dtype(law, scene, v)
    if v.dtype != jnp.float64:
        raise ValueError(
            f"Argument `velocity` must be in double precision, but has dtype {v.dtype}: "
            "enable jax_enable_x64."
        )
    check_law(law, scene, v.dtype)
    if not bool(law.contact(scene, v).happens):
        raise ValueError("Argument `velocity` must let a closed contact approach.")
    m = scene.contacts
    fields = ("stiffness", *shared_parameters(law))
    each = [jnp.broadcast_to(getattr(law, field), (m,)) for field in fields]
    law = eqx.tree_at(lambda old: [getattr(old, field) for field in fields], law, each)
    exponents = np.random.default_rng(0).uniform(-0.5, 0.5, (batch, m))
    exponents[0] = 0.0  # the impact itself
    stiffness = law.stiffness[None, :] * jnp.asarray(SPREAD**exponents)
    return Case(law, scene, v, stiffness, min(SAMPLE, batch))


def _chosen(names: Sequence[str] | None, case: Case) -> tuple[list[Method], dict[str, str]]:
    """Methods by name; without names all that support the law, and why others do not."""
    if names is not None:
        return [_supported("methods", name, case) for name in names], {}
    left_out = {n: why for n, m in METHODS.items() if (why := m.supports(case.law)) is not None}
    return [m for n, m in METHODS.items() if n not in left_out], left_out


def _supported(argument: str, name: str, case: Case) -> Method:
    """The method of this name, if it supports the law."""
    check_choice(argument, name, METHODS)
    reason = METHODS[name].supports(case.law)
    if reason is not None:
        raise ValueError(
            f"Argument `{argument}` must be able to solve the impact, but has {name!r}: {reason}."
        )
    return METHODS[name]


def _ladders(
    chosen: list[Method], settings: Mapping[str, Sequence[float]]
) -> dict[str, tuple[float, ...]]:
    """Settings by method."""
    for name, values in settings.items():
        check_choice("settings", name, [method.name for method in chosen])
        check_values(f"settings[{name!r}]", values, low=0.0, open_low=True)
    return {m.name: tuple(settings.get(m.name, m.ladder)) for m in chosen}


def _reference(name: str | None, case: Case) -> Method:
    """The method that errors are measured from."""
    method = _supported("reference", name or "dop853", case)
    if method.setting != "rtol":
        raise ValueError(f"Argument `reference` must take an rtol, but is {name!r}.")
    return method


# ------------------------------------------------------------------------------- programs


class Solved(NamedTuple):
    """An outcome or a batch of them, duration [s], field evaluations, Jacobian; JAX or numpy."""

    out: Impact
    duration: Any
    evaluations: Any
    jacobian: Any = None


@dataclass(frozen=True)
class Programs:
    """The programs of a method, functions of its setting, or of a law.

    `single` solves one impact, `batched` a number `batch` of them, `sampled` those on which errors
    are measured; `compile_time` [s] by program, filled in by the first calls.
    """

    single: Callable[[Any], Any]
    batched: Callable[[Any], Any]
    batch: int
    sampled: Callable[[Any], Solved]
    gradient: Callable[[Any], Any] | None
    compile_time: dict[str, float]

    def at(self, setting: float | None) -> Solved:
        """Solution and Jacobian of the sample, as numpy; evaluations NaN where not counted."""
        solution = jax.tree.map(np.asarray, self.sampled(setting))
        work = np.where(solution.evaluations == UNCOUNTED, np.nan, solution.evaluations)
        jacobian = None if self.gradient is None else np.asarray(self.gradient(setting))
        return solution._replace(evaluations=work, jacobian=jacobian)


def _method_programs(method: Method, case: Case, gradients: bool, durations: bool) -> Programs:
    """Programs of a method at the stiffnesses of the case."""
    if not method.jax:
        return _host_programs(method, case)

    def solve(k: jax.Array, law: LZB, scene: Scene, v: jax.Array, setting: jax.Array) -> Solved:
        """The impact with stiffness k (m,)."""
        law = with_entries(law, ("stiffness",), k)
        result = method.solve(law, scene, v, setting)
        return Solved(outcome(law, scene, v, result), result.duration, result.evaluations)

    def timed(*arguments: Any) -> Solved:
        """The same, without a duration that would cost a run of its own."""
        solution = solve(*arguments)
        without = method.duration_apart or not durations
        return solution._replace(duration=jnp.nan) if without else solution

    def jacobian(k: jax.Array, law: LZB, scene: Scene, v: jax.Array, setting: jax.Array) -> Any:
        """(d v+ / d ln k, d v+ / d e) (n, 2 m), with friction also d v+ / d mu (n, 3 m)."""
        names = tuple(shared_parameters(law))

        def velocity(log_factor: jax.Array, *values: jax.Array) -> jax.Array:
            """v+ (n,)."""
            changed = law
            for name, value in zip(names, values):
                changed = with_entries(changed, (name,), value)
            return timed(k * jnp.exp(log_factor), changed, scene, v, setting).out.velocity

        at = (jnp.zeros_like(k), *(getattr(law, name) for name in names))
        parts = jax.jacfwd(velocity, argnums=tuple(range(len(at))))(*at)
        return jnp.concatenate(parts, axis=-1)

    seconds: dict[str, float] = {}
    constant = (case.law, case.scene, case.velocity)

    def program(name: str, function: Callable[..., Any], rows: int | None) -> Callable[[Any], Any]:
        """The function of a setting, over the first stiffnesses; None: over the law's alone."""
        k = case.stiffness[0] if rows is None else case.stiffness[:rows]
        each = function if rows is None else jax.vmap(function, in_axes=(0, *[None] * 4))
        return _compiled(seconds, name, each, k, *constant)

    batched = program("batched", timed, len(case.stiffness))
    complete = batched
    if durations and method.duration_apart:
        complete = program("errors", solve, case.sample)
    return Programs(
        single=program("single", timed, None),
        batched=batched,
        batch=len(case.stiffness),
        sampled=lambda setting: jax.tree.map(lambda a: a[: case.sample], complete(setting)),
        gradient=program("gradient", jacobian, case.sample) if gradients else None,
        compile_time=seconds,
    )


def _compiled(
    seconds: dict[str, float], name: str, function: Callable[..., Any], *arguments: Any
) -> Callable[[Any], Any]:
    """The function of a setting; its first call enters the time of compiling in `seconds`."""

    @functools.cache
    def compiled() -> Callable[..., Any]:
        """The compiled function."""
        begin = time.perf_counter()
        program = jax.jit(function).lower(*arguments, jnp.ones((), float)).compile()
        seconds[name] = time.perf_counter() - begin
        return program

    return lambda setting: compiled()(
        *arguments, jnp.asarray(np.nan if setting is None else setting, float)
    )


def _host_programs(method: Method, case: Case) -> Programs:
    """The same of a method that runs on the host: loops."""
    rows = min(HOST_BATCH, len(case.stiffness))
    laws = [
        with_entries(case.law, ("stiffness",), k)
        for k in case.stiffness[: max(HOST_BATCH, case.sample)]
    ]

    def one(law: LZB, setting: Any) -> Any:
        """One impact."""
        return method.solve(law, case.scene, case.velocity, setting)

    def sampled(setting: Any) -> Solved:
        """The impacts on which errors are measured."""
        solutions = []
        for law in laws[: case.sample]:
            result = one(law, setting)
            out = outcome(law, case.scene, case.velocity, result)
            solutions.append(Solved(out, result.duration, result.evaluations))
        return jax.tree.map(lambda *a: jnp.stack(a), *solutions)

    return Programs(
        single=lambda setting: one(laws[0], setting),
        batched=lambda setting: [one(law, setting) for law in laws[:rows]],
        batch=rows,
        sampled=sampled,
        gradient=None,
        compile_time={},
    )


def _law_programs(law: Law, case: Case) -> Programs:
    """Programs of another law: it has no setting, and its sample is the impact itself."""
    law, batch = in_common_dtype(law, case.velocity)[0], len(case.stiffness)
    seconds: dict[str, float] = {}

    def run(v: jax.Array, law: Law, scene: Scene, setting: jax.Array) -> Solved:
        """One impact."""
        return Solved(impact(law, scene, v), jnp.nan, UNCOUNTED)

    many = jax.vmap(run, in_axes=(0, None, None, None))
    velocities = jnp.tile(case.velocity[None, :], (batch, 1))
    one = _compiled(seconds, "single", run, case.velocity, law, case.scene)
    return Programs(
        single=one,
        batched=_compiled(seconds, "batched", many, velocities, law, case.scene),
        batch=batch,
        sampled=lambda _: jax.tree.map(lambda a: a[None], one(None)),
        gradient=None,
        compile_time=seconds,
    )


# ------------------------------------------------------------------------- errors and times


def _errors(case: Case, solution: Solved, truth: Solved) -> dict[str, float]:
    """Relative errors, the largest over the impacts that were solved."""
    out, exact = solution.out, truth.out
    fastest = float(jnp.max(jnp.abs(case.velocity))) or np.abs(exact.velocity).max()
    before = float(kinetic_energy(case.scene, case.velocity)) or np.abs(exact.energy_change).max()

    def largest(a: Any, b: Any, scale: Any = None) -> float:
        """Largest difference over the scale, that of the truth by default."""
        scale = np.abs(b).max() if scale is None else scale
        return float(np.abs(a - b[: len(out.velocity)]).max() / scale)

    errors = {
        "velocity": largest(out.velocity, exact.velocity, fastest),
        "impulse": largest(out.impulse, exact.impulse),
        "energy": largest(out.energy_change, exact.energy_change, before),
        "duration": largest(solution.duration, truth.duration),
        "gradient": float("nan"),
    }
    if solution.jacobian is not None and truth.jacobian is not None:
        errors["gradient"] = largest(solution.jacobian, truth.jacobian, fastest)
    return errors


def _times(
    rows: list[tuple[Programs, float | None]], repeats: int, progress: float | None
) -> list[list[Timing]]:
    """Single and batched time of each row, and with its gradient if it has one; all in turns."""
    tasks = []
    for row, (programs, value) in enumerate(rows):
        for run, impacts in (
            (programs.single, 1),
            (programs.batched, programs.batch),
            (programs.gradient, min(SAMPLE, programs.batch)),
        ):
            if run is not None:
                tasks.append((row, impacts, functools.partial(run, value)))
    with counting_bar(len(tasks) * repeats, "timings", progress) as advance:
        times_of_tasks = in_turns([run for *_, run in tasks], repeats, lambda: advance(1))
    times: list[list[Timing]] = [[] for _ in rows]
    for (row, impacts, _), seconds in zip(tasks, times_of_tasks):
        quartiles = np.quantile(seconds / impacts, (0.5, 0.25, 0.75))
        times[row].append(Timing(*quartiles.tolist()))
    return times
