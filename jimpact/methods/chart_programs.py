"""Programs that a chart compares, compiled; their answers' errors, and their times."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.fits.parameters import with_entries
from jimpact.impacts import Impact, impact
from jimpact.law import Law
from jimpact.laws.lzb import LZB
from jimpact.methods.chart_record import QUANTITIES, Reference, Timing
from jimpact.methods.contenders import UNCOUNTED, Method, outcome
from jimpact.scene import Scene, kinetic_energy

HOST_BATCH = 4  # impacts that a method without vmap does for its time in a batch: a plain loop

FINEST, SECOND = 1e-14, 1e-12  # rtol of the reference, and of the other one it is compared with
SHORT = 2e-3  # seconds; what is faster is run several times for one measurement
MOST_RUNS = 20
LEAST_REPEATS = 3
BUDGET = 2.0  # seconds for one program, after which it is not repeated more than that


class Answer(NamedTuple):
    """v+ (..., n), p (..., m), energy change, duration, evaluations, status; JAX or numpy."""

    velocity: Any
    impulse: Any
    energy: Any
    duration: Any
    evaluations: Any
    status: Any


class Case(NamedTuple):
    """The impact, and stiffnesses (batch, m) around its own; row 0 is its own."""

    law: LZB
    scene: Scene
    velocity: jax.Array
    stiffness: jax.Array
    sample: int  # rows on which errors are measured

    def at(self, row: int) -> LZB:
        """The law with a row's stiffness."""
        return with_entries(self.law, ("stiffness",), self.stiffness[row])


@dataclass(frozen=True)
class Programs:
    """What can be run at a setting; `batched` gives whole batches, `account` the sample."""

    single: Callable[[Any], Any]
    batched: Callable[[Any], Any]
    batch: int
    account: Callable[[Any], Answer]
    gradient: Callable[[Any], Any] | None
    compile_time: dict[str, float]


def _answer(out: Impact, duration: jax.Array, evaluations: jax.Array) -> Answer:
    return Answer(out.velocity, out.impulse, out.energy_change, duration, evaluations, out.status)


def method_programs(method: Method, case: Case, gradients: bool, timed: bool = True) -> Programs:
    """Programs of a method; not `timed`: only those that errors need."""
    return _compiled(method, case, gradients, timed) if method.jax else _on_host(method, case)


def _compiled(method: Method, case: Case, gradients: bool, timed: bool) -> Programs:
    seconds: dict[str, float] = {}
    given = (case.law, case.scene, case.velocity)

    def program(name: str, function: Callable[..., Any], rows: int | None) -> Callable[[Any], Any]:
        k = case.stiffness[0] if rows is None else case.stiffness[:rows]
        whole = function if rows is None else jax.vmap(function, in_axes=(0, *[None] * 4))
        ready, seconds[name] = _compile(whole, (k, *given, _setting(method.ladder[0])))
        return lambda setting: ready(k, *given, _setting(setting))

    whole, fast, slopes = _functions(method)
    single = program("single", fast, None) if timed else _not_timed
    batched = program("batched", fast, len(case.stiffness)) if timed else _not_timed
    apart = method.duration_apart or not timed
    account = program("errors", whole, case.sample) if apart else batched
    count = _counter(method, program) if method.counting else None

    def accounted(setting: Any) -> Answer:
        answer = jax.tree.map(lambda a: a[: case.sample], account(setting))
        if count is None:
            return answer
        return answer._replace(evaluations=np.full(case.sample, count(setting)))

    return Programs(
        single=single,
        batched=batched,
        batch=len(case.stiffness),
        account=accounted,
        gradient=program("gradient", slopes, case.sample) if gradients else None,
        compile_time=seconds,
    )


def _not_timed(setting: Any) -> Any:
    raise AssertionError(setting)


def _functions(method: Method) -> tuple[Callable[..., Any], ...]:
    """The whole answer, what is timed of it, and the Jacobian of v+, of one impact."""

    def whole(k: jax.Array, law: LZB, scene: Scene, v: jax.Array, setting: jax.Array) -> Answer:
        law = with_entries(law, ("stiffness",), k)
        found = method.solve(law, scene, v, setting)
        return _answer(outcome(law, scene, v, found), found.duration, found.evaluations)

    def fast(*given: Any) -> Answer:
        answer = whole(*given)
        return answer._replace(duration=jnp.nan) if method.duration_apart else answer

    def slopes(k: jax.Array, law: LZB, scene: Scene, v: jax.Array, setting: jax.Array) -> Any:
        def velocity(stretch: jax.Array, e: jax.Array) -> jax.Array:
            moved = with_entries(law, ("restitution",), e)
            return fast(k * jnp.exp(stretch), moved, scene, v, setting).velocity

        both = jax.jacfwd(velocity, argnums=(0, 1))(jnp.zeros_like(k), law.restitution)
        return jnp.concatenate(both, axis=-1)

    return whole, fast, slopes


def _counter(method: Method, program: Callable[..., Callable[[Any], Any]]) -> Callable[[Any], int]:
    """Field evaluations of the impact itself, counted one by one."""
    evaluations = 0

    def tally() -> None:
        nonlocal evaluations
        evaluations += 1

    def counted(k: jax.Array, law: LZB, scene: Scene, v: jax.Array, setting: jax.Array) -> Any:
        assert method.counting is not None
        return method.counting(tally)(with_entries(law, ("stiffness",), k), scene, v, setting).code

    run = program("count", counted, None)

    def count(setting: Any) -> int:
        nonlocal evaluations
        evaluations = 0
        jax.block_until_ready(run(setting))
        jax.effects_barrier()
        return evaluations

    return count


def _setting(value: Any) -> jax.Array:
    return jnp.asarray(value, float)


def _compile(function: Callable[..., Any], given: tuple[Any, ...]) -> tuple[Any, float]:
    begin = time.perf_counter()
    ready = jax.jit(function).lower(*given).compile()
    return ready, time.perf_counter() - begin


def _on_host(method: Method, case: Case) -> Programs:
    rows = min(HOST_BATCH, len(case.stiffness))
    laws = [case.at(row) for row in range(max(rows, case.sample))]

    def one(law: LZB, setting: Any) -> Any:
        return method.solve(law, case.scene, case.velocity, setting)

    def account(setting: Any) -> Answer:
        answers = []
        for law in laws[: case.sample]:
            found = one(law, setting)
            out = outcome(law, case.scene, case.velocity, found)
            answers.append(_answer(out, found.duration, found.evaluations))
        return jax.tree.map(lambda *a: jnp.stack(a), *answers)

    return Programs(
        single=lambda setting: one(laws[0], setting),
        batched=lambda setting: [one(law, setting) for law in laws[:rows]],
        batch=rows,
        account=account,
        gradient=None,
        compile_time={},
    )


def law_programs(law: Law, case: Case) -> Programs:
    """Programs of another law; it has no setting, and is accounted for at the impact itself."""
    batch = len(case.stiffness)
    velocities = jnp.tile(case.velocity[None, :], (batch, 1))
    seconds: dict[str, float] = {}
    one, seconds["single"] = _compile(impact, (law, case.scene, case.velocity))
    whole = jax.vmap(impact, in_axes=(None, None, 0))
    many, seconds["batched"] = _compile(whole, (law, case.scene, velocities))
    unknown = jnp.asarray([jnp.nan])

    def account(_: Any) -> Answer:
        out = jax.tree.map(lambda a: a[None], one(law, case.scene, case.velocity))
        return _answer(out, unknown, jnp.asarray([UNCOUNTED]))

    return Programs(
        single=lambda _: one(law, case.scene, case.velocity),
        batched=lambda _: many(law, case.scene, velocities),
        batch=batch,
        account=account,
        gradient=None,
        compile_time=seconds,
    )


def on_host(answer: Answer) -> Answer:
    """As numpy arrays; evaluations NaN where not counted."""
    host = Answer(*(np.asarray(a) for a in answer))
    counted = host.evaluations != UNCOUNTED
    return host._replace(evaluations=np.where(counted, host.evaluations, np.nan))


Moment = tuple[Answer, np.ndarray | None]  # answers of a sample, and their gradients


def moment_of(programs: Programs, setting: float | None) -> Moment:
    """What a method answers at a setting."""
    answer = on_host(programs.account(setting))
    return answer, None if programs.gradient is None else np.asarray(programs.gradient(setting))


def errors_of(case: Case, moment: Moment, truth: Moment) -> dict[str, float]:
    """Relative errors, the largest over as many impacts as `moment` has."""
    (found, slopes), (exact, exact_slopes) = moment, truth
    rows = len(found.velocity)
    fastest = float(jnp.max(jnp.abs(case.velocity))) or float(np.abs(exact.velocity).max())
    before = float(kinetic_energy(case.scene, case.velocity))
    before = before or float(np.abs(exact.energy).max())

    def largest(a: Any, b: Any) -> float:
        return float(np.abs(np.asarray(a) - np.asarray(b)[:rows]).max())

    impulse = np.abs(np.asarray(exact.impulse)).max()
    duration = np.abs(np.asarray(exact.duration)).max()
    error = {
        "velocity": largest(found.velocity, exact.velocity) / fastest,
        "impulse": largest(found.impulse, exact.impulse) / float(impulse),
        "energy": largest(found.energy, exact.energy) / before,
        "duration": largest(found.duration, exact.duration) / float(duration),
        "gradient": float("nan"),
    }
    if slopes is not None and exact_slopes is not None:
        error["gradient"] = largest(slopes, exact_slopes) / fastest
    return error


def reference_of(
    case: Case, exact: Method, second: Method, truth: Moment, other: Moment
) -> Reference:
    """The reference, and its distance from another solution."""
    answer = truth[0]
    uncertainty = errors_of(case, other, truth)
    assert list(uncertainty) == list(QUANTITIES)
    return Reference(
        how=f"{exact.name} at rtol {FINEST:g} against {second.name} at {SECOND:g}",
        uncertainty=uncertainty,
        velocity=np.asarray(answer.velocity[0]),
        impulse=np.asarray(answer.impulse[0]),
        duration=float(np.asarray(answer.duration)[0]),
    )


def in_turns(
    tasks: list[tuple[Callable[[], Any], int]], repeats: int, advance: Callable[[], None]
) -> list[Timing]:
    """Time per impact of each task `(run, impacts)`: quartiles over the repeats."""
    runs = [_runs(_seconds(run, 1)) for run, _ in tasks]
    taken: list[list[float]] = [[] for _ in tasks]
    for _ in range(repeats):
        for (run, _), count, kept in zip(tasks, runs, taken):
            if len(kept) < LEAST_REPEATS or count * sum(kept) < BUDGET:
                kept.append(_seconds(run, count))
            advance()
    per_impact = [np.array(kept) / impacts for kept, (_, impacts) in zip(taken, tasks)]
    return [Timing(*(float(q) for q in np.quantile(t, (0.5, 0.25, 0.75)))) for t in per_impact]


def _runs(seconds: float) -> int:
    return int(np.clip(SHORT / max(seconds, 1e-9), 1, MOST_RUNS))


def _seconds(run: Callable[[], Any], count: int) -> float:
    begin = time.perf_counter()
    for _ in range(count):
        jax.block_until_ready(run())
    return (time.perf_counter() - begin) / count
