"""Inputs that determine the samples of a run: checked, in one precision, named by a
hash.

A chunk is always computed at its full size, on one device, by the same program; the
statistics are numpy's, in float64. So they depend neither on the executor nor on the
number of devices. (A program that `shard_map` spreads over two devices has other last
bits than that for one.)

Sample i is lane i % C of chunk i // C; its key is `fold_in(fold_in(key, chunk), lane)`.
Draws and impacts are two compiled programs, so that draws made again give the same
bits.
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
from jimpact.core.distributions import (
    Distribution,
    GivenRows,
    as_source,
    warn_without_key,
)
from jimpact.core.impacts import impact
from jimpact.core.law import Law, within_domains
from jimpact.core.scene import Scene, rounded_gaps, with_gaps
from jimpact.montecarlo.statistics import (
    AS_THE_LAW,
    BAD_GAP,
    BAD_LAW,
    BAD_VELOCITY,
    Chunk,
    Task,
    Tolerance,
    reduced,
)
from jimpact.montecarlo.store import fingerprint
from jimpact.tools.checks import as_whole, check_kind, in_common_dtype
from jimpact.tools.compiling import precise_jit
from jimpact.tools.records import counted

_WRITTEN = 6  # velocities that the report lists
# default number of samples; ten times more: quantiles three times finer
SAMPLES = 100_000


class Sources(eqx.Module):
    """Law, velocity and gaps of the samples: sources, or what was drawn from them for a
    chunk.

    A source is a distribution, a function of a key, `GivenRows`, or a constant (array,
    `Law`, None). Of a chunk, what is random has a leading axis (C,).
    """

    law: Any
    velocity: Any
    gaps: Any

    @property
    def random(self) -> dict[str, bool]:
        """True by name of a source, 'law', 'velocity' or 'gaps', that differs between
        samples.
        """
        return {
            name: not (x is None or isinstance(x, Law) or getattr(x, "ndim", 0) == 1)
            for name, x in vars(self).items()
        }


@precise_jit
def draw(
    sources: Sources,
    scene: Scene,
    key: jax.Array,
    lanes: jax.Array,
    rows: dict[str, jax.Array],
) -> Sources:
    """Law, velocities (C, n) and gaps (C, m) of a chunk; what is constant has no axis
    of samples.

    `key` is the chunk's, `lanes` (C,) are 0, 1, ...; `rows` holds given samples by
    name.
    """
    # (C, 3): for law, velocity and gaps of each sample
    keys = jax.vmap(lambda lane: jax.random.split(jax.random.fold_in(key, lane), 3))(
        lanes
    )

    def entries(name: str, size: int, each: jax.Array, non_negative: bool) -> Any:
        """Draws (C, size) of a source by the keys `each` (C,); else its given rows or
        constant.
        """
        source = getattr(sources, name)
        if isinstance(source, Distribution):
            dtype = jnp.result_type(*jax.tree.leaves(source))
            return jax.vmap(lambda key: source.sample(key, size, dtype, non_negative))(
                each
            )
        if callable(source):
            return jax.vmap(source)(each)
        return rows.get(name, source)

    if sources.random["law"]:
        law = eqx.filter_vmap(sources.law)(keys[:, 0])
    else:
        law = sources.law
    velocity = entries("velocity", scene.size, keys[:, 1], non_negative=False)
    gaps = entries("gaps", scene.contacts, keys[:, 2], non_negative=True)
    return Sources(law, velocity, gaps)


@precise_jit
def impacts(
    drawn: Sources,
    scene: Scene,
    random: dict[str, bool],
    size: int,
    rtol: np.ndarray | None,
) -> tuple[jax.Array, jax.Array]:
    """Velocities v+ (C, n) and statuses (C,) of the C = `size` samples of a chunk.

    A bad draw has a code of its own, see `OUTCOMES`. `random` tells which sources have
    an axis of samples; `rtol` () is that of `impact`, None: the law's own.
    """

    def one(
        law: Law, velocity: jax.Array, gaps: jax.Array | None
    ) -> tuple[jax.Array, jax.Array]:
        """v+ (n,) and status () of one sample with v- `velocity` (n,) and gaps (m,)."""
        code = jnp.where(within_domains(law), 0, BAD_LAW)
        finite = jnp.all(jnp.isfinite(velocity))
        code = jnp.where(finite, code, BAD_VELOCITY)
        one_scene = scene
        if gaps is not None:
            fine = jnp.isfinite(gaps) & (rounded_gaps(gaps) >= 0)
            code = jnp.where(jnp.all(fine), code, BAD_GAP)
            one_scene = with_gaps(scene, jnp.where(fine, gaps, 0))
        velocity = jnp.where(code == 0, velocity, 0)  # at rest: over at once
        out = impact(law, one_scene, velocity, rtol=rtol)
        status = jnp.where(code == 0, out.status, code.astype(jnp.int32))
        return out.velocity, status

    axes = tuple(eqx.if_array(0) if random[name] else None for name in vars(drawn))
    lanes = eqx.filter_vmap(one, in_axes=axes, axis_size=size)
    return lanes(*vars(drawn).values())


@dataclass(frozen=True, eq=False)
class Run:
    """Everything that determines the samples; `run(task)` computes a chunk of them.

    Given samples travel with the tasks: what computes chunks elsewhere needs no `rows`.
    """

    sources: Sources
    rows: dict[str, np.ndarray]
    scene: Scene
    samples: int
    key: np.ndarray  # of the run: its raw data
    key_kind: str
    size: int  # samples a chunk
    bins: int
    keep_samples: bool
    x64: bool
    threefry_partitionable: bool

    def __call__(self, task: Task, device: jax.Device | None = None) -> Chunk:
        """Compute one chunk on a device (None: the default one)."""
        return self.reduced(task, self.outcomes(task, device))

    def reduced(self, task: Task, outcomes: Chunk) -> Chunk:
        """Statistics of the outcomes (C samples) of a task."""
        return reduced(task, outcomes, self.bins, self.keep_samples)

    def outcomes(self, task: Task, device: jax.Device | None = None) -> Chunk:
        """Samples of a chunk by name: v- and gaps that were drawn, v+ `velocity`,
        `status`.

        Arrays (C, n), (C, m), (C, n), (C,); without columns for what is constant.
        """
        random = self.sources.random
        rtol = task.tolerance.rtol
        with self.flags():
            drawn, scene = self._drawn(task, device)
            tolerance = np.asarray(rtol) if rtol else None
            velocity, status = impacts(drawn, scene, random, self.size, tolerance)
        constant = np.zeros((self.size, 0))
        samples: dict[str, Any] = {
            "velocity": velocity,
            "status": status,
            "velocity_before": drawn.velocity if random["velocity"] else constant,
            "gaps": drawn.gaps if random["gaps"] else constant,
        }
        return {name: np.asarray(x) for name, x in samples.items()}

    @property
    def chunks(self) -> int:
        """Number of chunks, the last one perhaps not used whole."""
        return -(-self.samples // self.size)

    def count(self, number: int) -> int:
        """Number of samples of a chunk that are used: fewer than its size in the last
        one.
        """
        return min(self.size, self.samples - number * self.size)

    def task(
        self,
        number: int,
        tolerance: Tolerance = AS_THE_LAW,
        ends: np.ndarray | None = None,
    ) -> Task:
        """Task of chunk `number`; `ends` (n, 2) of its histograms, None: from its own
        samples.

        Given rows of the last chunk are filled up with copies of the last row.
        """
        size = self.size
        rows = {}
        for name, values in self.rows.items():
            own = values[number * size : (number + 1) * size]
            missing = size - len(own)
            rows[name] = np.pad(own, ((0, missing), (0, 0)), mode="edge")
        return Task(number, self.count(number), ends, rows, tolerance)

    def sample(self, index: int) -> tuple[Law, Scene, jax.Array]:
        """Law, scene and v- of sample `index`, by the same draws as in the run, bit by
        bit.
        """
        number, lane = divmod(index, self.size)
        with self.flags():
            drawn, _ = self._drawn(self.task(number), None)
        # random sources have an axis of samples
        law, velocity, gaps = (
            jax.tree.map(
                lambda x: x[lane] if eqx.is_array(x) else x, getattr(drawn, name)
            )
            if random
            else getattr(drawn, name)
            for name, random in self.sources.random.items()
        )
        return (
            law,
            self.scene if gaps is None else with_gaps(self.scene, gaps),
            velocity,
        )

    @contextlib.contextmanager
    def flags(self) -> Iterator[None]:
        """Set precision and kind of random bits of the run in JAX, in this thread,
        while open.
        """
        bits = jax.threefry_partitionable(self.threefry_partitionable)
        with jax.enable_x64(self.x64), bits:
            yield

    def _drawn(self, task: Task, device: jax.Device | None) -> tuple[Sources, Scene]:
        """Draws of a task's chunk, and the scene, on a device: programs run where
        inputs are.
        """
        raw = jnp.asarray(self.key)
        key = jax.random.wrap_key_data(raw, impl=self.key_kind)
        key = jax.random.fold_in(key, np.uint32(task.number))
        lanes = np.arange(self.size, dtype=np.uint32)
        sources, scene, key, lanes, rows = jax.tree.map(
            lambda x: jax.device_put(x, device) if eqx.is_array_like(x) else x,
            (self.sources, self.scene, key, lanes, task.rows),
        )
        return draw(sources, scene, key, lanes, rows), scene

    @property
    def identity(self) -> dict[str, str]:
        """Hashes by name of all that determines the chunks; the number of samples does
        not.
        """
        parts = {
            "law": self.sources.law,
            "scene": self.scene,
            "velocity": (self.sources.velocity, self.rows.get("velocity")),
            "gaps": (self.sources.gaps, self.rows.get("gaps")),
            "key": (self.key, self.key_kind, self.threefry_partitionable),
            "chunk": self.size,
            "bins": self.bins,
            "precision": self.x64,
        }
        versions = {
            "version of jimpact": jimpact.__version__,
            "version of jax": jax.__version__,
        }
        hashes = {name: fingerprint(value) for name, value in parts.items()}
        return hashes | versions

    @property
    def description(self) -> str:
        """Law, sizes of the scene, random sources and v- of the run in one line."""
        sources = self.sources
        scene = self.scene
        if isinstance(sources.law, Law):
            law = type(sources.law).__name__
        else:
            law = _named(sources.law)
        size = counted(scene.size, "coordinate"), counted(scene.contacts, "contact")
        text = ", ".join([law, *size])
        for what in ("gaps", "velocity"):
            if sources.random[what]:
                text += f"; {what}: {_named(getattr(sources, what))}"
        if not sources.random["velocity"]:
            entries = [f"{x:g}" for x in np.asarray(sources.velocity)]
            if len(entries) > _WRITTEN:
                more = [f"... {len(entries)} entries"]
            else:
                more = []
            if scene.walls is not None:
                unit = "m/s"
            else:
                unit = "m/s, rad/s"
            text += f"; v- = ({', '.join(entries[:_WRITTEN] + more)}) {unit}"
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
    """Run of these arguments, as of `monte_carlo`, checked; `chunk` is the size of a
    chunk.
    """
    check_kind("scene", scene, Scene)
    sources = _checked_sources(sources, scene)
    rows = {
        name: np.asarray(x)
        for name, x in vars(sources).items()
        if getattr(x, "ndim", 1) == 2
    }
    chunk = as_whole("chunk", chunk, 1)
    bins = as_whole("bins", bins, 1)
    fewest = min(map(len, rows.values()), default=SAMPLES)
    samples = as_whole("samples", fewest if samples is None else samples, 1)
    for name, values in rows.items():
        if len(values) < samples:
            raise ValueError(
                f"Argument `samples` must be at most {len(values)}, the rows of "
                f"`{name}`, but has value {samples}."
            )
    data, kind = _key(key)
    return Run(
        sources=Sources(
            **vars(sources) | {name: GivenRows(len(x)) for name, x in rows.items()}
        ),
        rows=rows,
        scene=scene,
        samples=samples,
        key=data,
        key_kind=kind,
        size=chunk,
        bins=bins,
        keep_samples=bool(keep_samples),
        x64=jax.config.jax_enable_x64,  # type: ignore[attr-defined]
        threefry_partitionable=jax.config.jax_threefry_partitionable,  # type: ignore[attr-defined]
    )


def _checked_sources(sources: Sources, scene: Scene) -> Sources:
    """Sources of law, velocity and gaps, checked, with numbers in the widest float type
    of all.
    """
    law = sources.law
    gaps = sources.gaps
    is_law = isinstance(law, Law) or callable(law)
    if isinstance(law, type) or not is_law:
        raise TypeError(
            f"Argument `law` must be a Law or a function key -> Law, but is {law!r}."
        )
    velocity = as_source("velocity", sources.velocity, scene.size, non_negative=False)
    if gaps is not None:
        gaps = as_source("gaps", gaps, scene.contacts, non_negative=True)
    checked = Sources(law, velocity, gaps)
    if gaps is None and not any(checked.random.values()):
        raise ValueError(
            "Argument `gaps` must be given where neither the velocity nor the law is "
            "random: all samples would be the same."
        )
    # a function of a key is called once, to look at its law
    if isinstance(law, Law):
        drawn = law
    else:
        drawn = law(jax.random.key(0, impl="threefry2x32"))
    if not isinstance(drawn, Law):
        raise TypeError(
            f"Argument `law` must give a Law for a key, but gives {drawn!r}."
        )
    if drawn is not law:
        warn_without_key("law", law)
    if gaps is not None and not drawn.uses_gaps:
        raise ValueError(
            f"Argument `gaps` must be None for {type(drawn).__name__}, which leaves "
            f"open contacts out: laws that use gaps are Compliant and Binary."
        )
    return in_common_dtype(checked, scene, drawn)[0]


def _named(source: Any) -> str:
    """Text on a source: the distribution with its parameters, or the name of a
    function.
    """
    if isinstance(source, eqx.Module):
        return repr(source)
    return f"function {getattr(source, '__qualname__', type(source).__name__)}"


def _key(key: Any) -> tuple[np.ndarray, str]:
    """Raw data and kind of a JAX random key; an integer is a seed of a threefry key."""
    if not isinstance(key, bool) and isinstance(key, int | np.integer):
        if not -(2**63) <= key < 2**63:
            raise ValueError(f"Argument `key` must have at most 64 bits, but is {key}.")
        key = jax.random.key(int(key), impl="threefry2x32")
    elif (
        isinstance(key, np.ndarray | jax.Array)
        and key.dtype == np.uint32
        and key.shape == (2,)
    ):
        key = jax.random.wrap_key_data(jnp.asarray(key), impl="threefry2x32")
    of_keys = jax.dtypes.prng_key
    if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, of_keys)):
        raise TypeError(
            f"Argument `key` must be a JAX random key or an integer, but is {key!r}."
        )
    if key.shape != ():
        raise ValueError(f"Argument `key` must be one key, but has shape {key.shape}.")
    data = jax.random.key_data(key)
    return np.asarray(data), str(jax.random.key_impl(key))
