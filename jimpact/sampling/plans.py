"""What determines a run, and how one chunk of it is computed.

A chunk is always computed at its full size, on one device, by the same compiled programs; the
statistics are numpy's, in float64. So they depend neither on the executor nor on the devices.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.laws.base import Law
from jimpact.sampling.chunks import Chunk, Task, reduced
from jimpact.sampling.distributions import Rows
from jimpact.sampling.drawing import Drawn, Sources, draw, impacts, is_random, with_gaps
from jimpact.scene import Scene


@dataclass(frozen=True)
class Started:
    """A chunk under way on a device."""

    task: Task
    drawn: Drawn
    velocity: jax.Array
    status: jax.Array


@dataclass(frozen=True, eq=False)
class Plan:
    """Everything that determines the chunks; `finish(start(task))` computes one."""

    sources: Sources
    scene: Scene
    key: np.ndarray  # of the run: its raw data
    key_kind: str
    size: int  # samples a chunk
    bins: int
    keep_samples: bool
    x64: bool
    threefry_partitionable: bool

    def __call__(self, task: Task) -> Chunk:
        """Compute one chunk."""
        return self.finish(self.start(task))

    def start(self, task: Task, device: jax.Device | None = None) -> "Started":
        """Enqueue a chunk on a device; returns at once."""
        with self._flags():
            drawn, lanes, scene = self._drawn(task, device)
            return Started(task, drawn, *impacts(drawn, scene, lanes))

    def sample(self, task: Task, lane: int) -> tuple[Law, jax.Array, jax.Array | None]:
        """Law, velocity and gaps of one sample, the same bits as in the run."""
        with self._flags():
            drawn = self._drawn(task, None)[0]
        parts = (drawn.law, drawn.velocity, drawn.gaps)
        own = [
            jax.tree.map(lambda leaf: leaf[lane] if eqx.is_array(leaf) else leaf, part)
            if varies
            else part
            for varies, part in zip(drawn.varies, parts)
        ]
        return own[0], own[1], own[2]

    @contextlib.contextmanager
    def _flags(self) -> Iterator[None]:
        """What precision and draws depend on, in this thread only: workers have their own."""
        partitionable = jax.threefry_partitionable(self.threefry_partitionable)
        with jax.enable_x64(self.x64), partitionable:
            yield

    def _drawn(self, task: Task, device: Any) -> tuple[Drawn, jax.Array, Scene]:
        """The draws of the task; placing one input on the device places the computation."""
        sources = self.sources
        for name, rows in task.rows.items():
            at = {"velocity": lambda s: s.velocity, "gaps": lambda s: s.gaps}[name]
            sources = eqx.tree_at(at, sources, Rows(rows), is_leaf=lambda x: isinstance(x, Rows))
        key = jax.random.wrap_key_data(jnp.asarray(self.key), impl=self.key_kind)
        key = jax.random.fold_in(key, np.uint32(task.number))
        lanes = np.arange(self.size, dtype=np.uint32)
        sources, key, lanes, scene = jax.tree.map(
            lambda x: jax.device_put(x, device) if eqx.is_array_like(x) else x,
            (sources, key, lanes, self.scene),
        )
        sizes = (self.scene.size, self.scene.contacts)
        return draw(sources, sizes, key, lanes), lanes, scene

    def finish(self, started: "Started") -> Chunk:
        """Wait for a chunk and reduce it."""
        task, size = started.task, self.size
        m = self.scene.contacts if is_random(self.sources.gaps) else 0
        samples = {"velocity": np.asarray(started.velocity), "status": np.asarray(started.status)}
        drawn = started.drawn
        samples["gaps"] = np.asarray(drawn.gaps) if m else np.zeros((size, 0))
        before = np.asarray(drawn.velocity)
        samples["velocity_before"] = before if drawn.varies[1] else np.zeros((size, 0))
        return reduced(task, samples, self.bins, self.keep_samples)


@dataclass(frozen=True, eq=False)
class Run:
    """A plan, how many samples, and the rows of given samples, which travel with the tasks."""

    plan: Plan
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
            own = values[number * size : (number + 1) * size]
            rows[name] = np.pad(own, ((0, size - len(own)), (0, 0)), mode="edge")
        return Task(number, count, ends, rows)

    def sample(self, index: int) -> tuple[Law, Scene, jax.Array]:
        """Law, scene and velocity of sample `index`, the same bits as in the run."""
        number, lane = divmod(index, self.plan.size)
        law, velocity, gaps = self.plan.sample(self.task(number), lane)
        scene = self.plan.scene
        return law, scene if gaps is None else with_gaps(scene, gaps), velocity
