"""What determines a run, and how one chunk of it is computed.

A chunk is always computed at its full size, on one device, by the same program; the statistics are
numpy's, in float64. So they depend neither on the executor nor on the number of devices. (A program
that `shard_map` spreads over two devices has other last bits than that for one.)
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.law import Law
from jimpact.montecarlo.chunks import Chunk, Task, reduced
from jimpact.montecarlo.drawing import Drawn, Sources, draw, impacts
from jimpact.scene import Scene, with_gaps


@dataclass(frozen=True)
class Started:
    """A chunk under way on a device."""

    task: Task
    drawn: Drawn
    velocity: jax.Array
    status: jax.Array


@dataclass(frozen=True, eq=False)
class Plan:
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
        return self.finish(self.start(task, device))

    def start(self, task: Task, device: jax.Device | None = None) -> Started:
        """Enqueue a chunk on a device."""
        with self._flags():
            drawn, lanes, scene = self._drawn(task, device)
            return Started(task, drawn, *impacts(drawn, scene, lanes))

    def finish(self, started: Started) -> Chunk:
        """Wait for a chunk and reduce it."""
        drawn, empty = started.drawn, np.zeros((self.size, 0))
        samples = {
            "velocity": np.asarray(started.velocity),
            "status": np.asarray(started.status),
            "velocity_before": np.asarray(drawn.velocity) if drawn.varies[1] else empty,
            "gaps": np.asarray(drawn.gaps) if drawn.varies[2] else empty,
        }
        return reduced(started.task, samples, self.bins, self.keep_samples)

    def sample(self, task: Task, lane: int) -> tuple[Law, jax.Array, jax.Array | None]:
        """Law, velocity and gaps of one sample, the same bits as in the run."""
        with self._flags():
            drawn, _, _ = self._drawn(task, None)

        def own(part: Any) -> Any:
            return jax.tree.map(lambda leaf: leaf[lane] if eqx.is_array(leaf) else leaf, part)

        law, velocity, gaps = drawn.law, drawn.velocity, drawn.gaps
        one, two, three = drawn.varies
        return (
            own(law) if one else law,
            own(velocity) if two else velocity,
            own(gaps) if three else gaps,
        )

    @contextlib.contextmanager
    def _flags(self) -> Iterator[None]:
        """What precision and draws depend on, in this thread only: workers have their own."""
        partitionable = jax.threefry_partitionable(self.threefry_partitionable)
        with jax.enable_x64(self.x64), partitionable:
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
