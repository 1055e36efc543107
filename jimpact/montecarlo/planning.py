"""From the arguments of `monte_carlo` to a run, checked, in one precision, named by a hash.

A chunk is always computed at its full size, on one device, by the same program; the statistics are
numpy's, in float64. So they depend neither on the executor nor on the number of devices. (A program
that `shard_map` spreads over two devices has other last bits than that for one.)

Sample i is lane i % C of chunk i // C; its key is `fold_in(fold_in(key, chunk), lane)`. Draws and
impacts are two compiled programs, so that draws made again give the same bits.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jimpact
from jimpact._checks import as_whole, check_kind, in_common_dtype
from jimpact.compiling import precise_jit
from jimpact.impacts import impact
from jimpact.law import Law, within_domains
from jimpact.montecarlo.distributions import Distribution, Rows, Source, as_source
from jimpact.montecarlo.statistics import BAD_GAP, BAD_LAW, BAD_VELOCITY, Chunk, Task, reduced
from jimpact.montecarlo.store import fingerprint
from jimpact.scene import Scene, with_gaps

CHUNK = 4096  # samples: fast on a CPU for cheap and costly laws alike; a GPU wants more
_WRITTEN = 6  # velocities that the report lists
DELTA_C = "delta_c: how deep a contact is indented at the largest approach speed of the scene"
SAMPLES = 100_000  # default number of samples; ten times more: quantiles three times finer
BINS = 1000  # of a histogram; ten times more: quantiles finer than 100 000 samples determine them


class Sources(eqx.Module):
    """Where law, velocity and gaps come from; an array, a `Law` or None is a constant."""

    law: Any
    velocity: Source
    gaps: Source


class Drawn(eqx.Module):
    """Law, velocities and gaps of a chunk; what is random (`varies`) has a leading axis (C,)."""

    law: Law
    velocity: jax.Array
    gaps: jax.Array | None
    varies: tuple[bool, bool, bool] = eqx.field(static=True)


def is_random(source: Any) -> bool:
    """Whether it differs from sample to sample."""
    return not (source is None or isinstance(source, jax.Array | Law))


@precise_jit
def draw(
    sources: Sources,
    sizes: tuple[int, int],
    key: jax.Array,
    lanes: jax.Array,
    rows: dict[str, jax.Array],
) -> Drawn:
    """The chunk's law, velocities and gaps.

    `sizes` are (n, m), `key` is the chunk's, `rows` are those of given samples (C, n), (C, m).
    """
    keys = jax.vmap(lambda lane: jax.random.split(jax.random.fold_in(key, lane), 3))(lanes)
    varies = (is_random(sources.law), is_random(sources.velocity), is_random(sources.gaps))
    law = eqx.filter_vmap(sources.law)(keys[:, 0]) if varies[0] else sources.law
    velocity = _entries(sources.velocity, sizes[0], keys[:, 1], False)
    gaps = _entries(sources.gaps, sizes[1], keys[:, 2], True)
    return Drawn(law, rows.get("velocity", velocity), rows.get("gaps", gaps), varies)


def _entries(source: Source, size: int, keys: jax.Array, non_negative: bool) -> Any:
    """Draws (C, size) of a source, or its constant."""
    if isinstance(source, Distribution):
        dtype = jnp.result_type(*jax.tree.leaves(source))
        return jax.vmap(lambda key: source.sample(key, size, dtype, non_negative))(keys)
    return jax.vmap(source)(keys) if callable(source) else source


@precise_jit
def impacts(drawn: Drawn, scene: Scene, lanes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Velocities (C, n) and statuses (C,) of a chunk, those of bad draws included."""
    law_axis = eqx.if_array(0) if drawn.varies[0] else None
    axes = (law_axis, *(0 if each else None for each in drawn.varies[1:]), None)
    run = eqx.filter_vmap(_outcome, in_axes=axes, axis_size=len(lanes))
    return run(drawn.law, drawn.velocity, drawn.gaps, scene)


def _outcome(
    law: Law, velocity: jax.Array, gaps: jax.Array | None, scene: Scene
) -> tuple[jax.Array, jax.Array]:
    """v+ (n,) and status () of one sample; a bad draw has a code of its own."""
    code = jnp.where(within_domains(law), 0, BAD_LAW)
    code = jnp.where(jnp.all(jnp.isfinite(velocity)), code, BAD_VELOCITY)
    if gaps is not None:
        fine = jnp.isfinite(gaps) & (gaps >= 0)
        code = jnp.where(jnp.all(fine), code, BAD_GAP)
        scene = with_gaps(scene, jnp.where(fine, gaps, 0))
    out = impact(law, scene, jnp.where(code == 0, velocity, 0))  # at rest: over at once
    return out.velocity, jnp.where(code == 0, out.status, code.astype(jnp.int32))


@dataclass(frozen=True, eq=False)
class SamplingPlan:
    """Everything that determines the chunks; `plan(task)` computes one."""

    sources: Sources
    scene: Scene
    key: np.ndarray  # of the run: its raw data
    key_kind: str
    size: int  # samples a chunk
    bins: int
    keep_samples: bool
    x64: bool
    threefry_partitionable: bool

    def __call__(self, task: Task, device: jax.Device | None = None) -> Chunk:
        """Compute one chunk on a device (None: the default one)."""
        with self._flags():
            drawn, lanes, scene = self._drawn(task, device)
            velocity, status = impacts(drawn, scene, lanes)
        empty = np.zeros((self.size, 0))
        samples = {
            "velocity": np.asarray(velocity),
            "status": np.asarray(status),
            "velocity_before": np.asarray(drawn.velocity) if drawn.varies[1] else empty,
            "gaps": np.asarray(drawn.gaps) if drawn.varies[2] else empty,
        }
        return reduced(task, samples, self.bins, self.keep_samples)

    def sample(self, task: Task, lane: int) -> tuple[Law, jax.Array, jax.Array | None]:
        """Law, velocity and gaps of one sample, the same bits as in the run."""
        with self._flags():
            drawn, _, _ = self._drawn(task, None)

        def of_lane(part: Any, varies: bool) -> Any:
            """The entries of the sample, where they vary."""
            return jax.tree.map(lambda x: x[lane] if varies and eqx.is_array(x) else x, part)

        parts = (drawn.law, drawn.velocity, drawn.gaps)
        law, velocity, gaps = map(of_lane, parts, drawn.varies)
        return law, velocity, gaps

    @contextlib.contextmanager
    def _flags(self) -> Iterator[None]:
        """What precision and draws depend on, in this thread only: workers have their own."""
        with jax.enable_x64(self.x64), jax.threefry_partitionable(self.threefry_partitionable):
            yield

    def _drawn(self, task: Task, device: jax.Device | None) -> tuple[Drawn, jax.Array, Scene]:
        """The draws of the task; where its inputs are, there a program runs."""
        key = jax.random.wrap_key_data(jnp.asarray(self.key), impl=self.key_kind)
        key = jax.random.fold_in(key, np.uint32(task.number))
        lanes = np.arange(self.size, dtype=np.uint32)
        sources, scene, key, lanes, rows = jax.tree.map(
            lambda x: jax.device_put(x, device) if eqx.is_array_like(x) else x,
            (self.sources, self.scene, key, lanes, task.rows),
        )
        return draw(sources, (scene.size, scene.contacts), key, lanes, rows), lanes, scene


@dataclass(frozen=True, eq=False)
class Run:
    """A plan, how many samples, and the rows of given samples, which travel with the tasks."""

    plan: SamplingPlan
    samples: int
    rows: dict[str, np.ndarray]

    @property
    def chunks(self) -> int:
        """Number of chunks, the last one perhaps not used whole."""
        return -(-self.samples // self.plan.size)

    def task(self, number: int, ends: np.ndarray | None = None) -> Task:
        """The task of a chunk."""
        size = self.plan.size
        count = min(size, self.samples - number * size)
        rows = {}
        for name, values in self.rows.items():
            part = values[number * size : (number + 1) * size]
            rows[name] = np.pad(part, ((0, size - len(part)), (0, 0)), mode="edge")
        return Task(number, count, ends, rows)

    def sample(self, index: int) -> tuple[Law, Scene, jax.Array]:
        """Law, scene and velocity of sample `index`, the same bits as in the run."""
        number, lane = divmod(index, self.plan.size)
        law, velocity, gaps = self.plan.sample(self.task(number), lane)
        scene = self.plan.scene
        return law, scene if gaps is None else with_gaps(scene, gaps), velocity

    @property
    def identity(self) -> dict[str, str]:
        """A hash of each thing that determines the chunks; the number of samples does not."""
        plan = self.plan
        versions = {"jimpact": jimpact.__version__, "jax": jax.__version__}
        parts = {
            "law": plan.sources.law,
            "scene": plan.scene,
            "velocity": (plan.sources.velocity, self.rows.get("velocity")),
            "gaps": (plan.sources.gaps, self.rows.get("gaps")),
            "key": (plan.key, plan.key_kind, plan.threefry_partitionable),
            "chunk": plan.size,
            "bins": plan.bins,
            "precision": plan.x64,
        }
        hashes = {name: fingerprint(value) for name, value in parts.items()}
        return hashes | {f"version of {name}": value for name, value in versions.items()}

    @property
    def description(self) -> str:
        """The run in one line."""
        sources, scene = self.plan.sources, self.plan.scene
        law = sources.law
        name = type(law).__name__ if isinstance(law, Law) else _source(law)
        text = f"{name}, {scene.size} coordinates, {scene.contacts} contacts"
        for what in ("gaps", "velocity"):
            source = getattr(sources, what)
            if is_random(source):
                rows = self.rows.get(what)
                drawn = _source(source) if rows is None else f"{len(rows)} given rows"
                text += f"; {what}: {drawn}"
        if not is_random(sources.velocity):
            unit = "m/s" if scene.walls is not None else "m/s, rad/s"
            text += f"; v- = {_in_brackets(sources.velocity)} {unit}"
        return text


def planned_run(
    sources: Sources,
    scene: Scene,
    samples: int | None,
    key: Any,
    chunk: int,
    bins: int,
    keep_samples: bool,
) -> Run:
    """The run of these arguments; raises where one of them is bad."""
    check_kind("scene", scene, Scene)
    sources = _checked_sources(sources, scene)
    chunk = as_whole("chunk", chunk, 1)
    bins = as_whole("bins", bins, 1)
    rows = {
        name: np.asarray(source.values)
        for name in ("velocity", "gaps")
        if isinstance(source := getattr(sources, name), Rows)
    }
    fewest = min((len(values) for values in rows.values()), default=None)
    if samples is None:
        samples = SAMPLES if fewest is None else fewest
    samples = as_whole("samples", samples, 1)
    for name, values in rows.items():
        if len(values) < samples:
            raise ValueError(
                f"Argument `samples` must be at most {len(values)}, the rows of `{name}`, but has "
                f"value {samples}."
            )
    data, kind = _key(key)
    plan = SamplingPlan(
        sources=eqx.tree_at(_row_values, sources, replace_fn=lambda x: x[:0]),
        scene=scene,
        key=data,
        key_kind=kind,
        size=chunk,
        bins=bins,
        keep_samples=bool(keep_samples),
        x64=_flag("jax_enable_x64"),
        threefry_partitionable=_flag("jax_threefry_partitionable"),
    )
    return Run(plan, samples, rows)


def _row_values(sources: Sources) -> list[Any]:
    """The arrays of given samples: they travel with the tasks, not with the plan."""
    return [s.values for s in (sources.velocity, sources.gaps) if isinstance(s, Rows)]


def _checked_sources(sources: Sources, scene: Scene) -> Sources:
    """Checked sources, all floating-point values in the widest type among them."""
    law, gaps = sources.law, sources.gaps
    if not isinstance(law, Law) and not callable(law):
        raise TypeError(f"Argument `law` must be a Law or a function key -> Law, but is {law!r}.")
    velocity = as_source("velocity", sources.velocity, scene.size, non_negative=False)
    if gaps is not None:
        gaps = as_source("gaps", gaps, scene.contacts, non_negative=True)
    elif not (is_random(law) or is_random(velocity)):
        raise ValueError(
            "Argument `gaps` must be given where neither the velocity nor the law is random: all "
            "samples would be the same."
        )
    drawn = law if isinstance(law, Law) else law(jax.random.key(0, impl="threefry2x32"))
    if not isinstance(drawn, Law):
        raise TypeError(f"Argument `law` must give a Law for a key, but gives {drawn!r}.")
    if gaps is not None and not drawn.uses_gaps:
        raise ValueError(
            f"Argument `gaps` must be None for {type(drawn).__name__}, which leaves open contacts "
            "out: laws that use gaps are Compliant and Binary."
        )
    return in_common_dtype(Sources(law, velocity, gaps), scene, drawn)[0]


def _source(source: Any) -> str:
    """A source in words."""
    if isinstance(source, eqx.Module):
        return repr(source)
    return f"function {getattr(source, '__qualname__', type(source).__name__)}"


def _key(key: Any) -> tuple[np.ndarray, str]:
    """Raw data and kind of a key; an integer is a seed."""
    if not isinstance(key, bool) and isinstance(key, int | np.integer):
        key = jax.random.key(int(key), impl="threefry2x32")
    elif isinstance(key, np.ndarray | jax.Array) and key.dtype == np.uint32 and key.shape == (2,):
        key = jax.random.wrap_key_data(jnp.asarray(key), impl="threefry2x32")
    if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise TypeError(f"Argument `key` must be a JAX random key or an integer, but is {key!r}.")
    if key.shape != ():
        raise ValueError(f"Argument `key` must be one key, but has shape {key.shape}.")
    return np.asarray(jax.random.key_data(key)), str(jax.random.key_impl(key))


def _in_brackets(velocity: Any) -> str:
    """Velocities as (1, 0, -1), the first few of many."""
    entries = [f"{x:g}" for x in np.asarray(velocity)]
    more = [f"... {len(entries)} entries"] if len(entries) > _WRITTEN else []
    return f"({', '.join(entries[:_WRITTEN] + more)})"


def _flag(name: str) -> bool:
    """The setting of JAX."""
    return bool(getattr(jax.config, name))
