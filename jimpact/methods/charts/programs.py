"""Compiled programs of a method or a law on one impact, and on a batch around it."""

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
from jimpact.methods.contenders import UNCOUNTED, Method, outcome
from jimpact.scene import Scene

HOST_BATCH = 4  # impacts that a method without vmap does for its time in a batch: a plain loop


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


def _told(out: Impact, duration: jax.Array, evaluations: jax.Array) -> Answer:
    return Answer(out.velocity, out.impulse, out.energy_change, duration, evaluations, out.status)


def of_method(method: Method, case: Case, gradients: bool, timed: bool = True) -> Programs:
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
        return _told(outcome(law, scene, v, found), found.duration, found.evaluations)

    def fast(*given: Any) -> Answer:
        told = whole(*given)
        return told._replace(duration=jnp.nan) if method.duration_apart else told

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
            answers.append(_told(out, found.duration, found.evaluations))
        return jax.tree.map(lambda *a: jnp.stack(a), *answers)

    return Programs(
        single=lambda setting: one(laws[0], setting),
        batched=lambda setting: [one(law, setting) for law in laws[:rows]],
        batch=rows,
        account=account,
        gradient=None,
        compile_time={},
    )


def of_law(law: Law, case: Case) -> Programs:
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
        return _told(out, unknown, jnp.asarray([UNCOUNTED]))

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
