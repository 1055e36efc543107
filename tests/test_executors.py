"""The same bits from every executor, from any number of devices, and when a worker dies."""

import os
import signal
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact import Binary, RandomLaw, Uniform, chain, monte_carlo
from jimpact.montecarlo.executors import Devices, Executor, Serial, as_executor
from jimpact.montecarlo.store import fingerprint

BALLS = chain([0.25, 1.0, 0.25])


def drawn_law():
    return RandomLaw(Binary(1.0, order="earliest"), restitution=Uniform(0.8, 1.0))


def run(executor, samples=1000, **options):
    gaps = Uniform(0.0, 1e-5)
    return monte_carlo(
        drawn_law(), BALLS, [1.0, 0.0, -1.0], gaps, samples, chunk=128, executor=executor, **options
    )


def digest(result):
    arrays = result.mean, result.covariance, result.gap_covariance, result.counts, result.edges
    return fingerprint((arrays, result.minimum, result.maximum, result.statuses, result.first))


@pytest.fixture(scope="module")
def wanted():
    return digest(run("serial"))


def test_names_and_protocol():
    assert isinstance(as_executor("serial"), Serial)
    assert isinstance(as_executor("devices"), Devices)
    serial = Serial()
    assert as_executor(serial) is serial
    assert isinstance(serial, Executor)
    with pytest.raises(ValueError, match="or an object with a method `run`, but is 3"):
        as_executor(3)


def test_any_order_of_the_chunks_gives_the_same_bits(wanted):
    class Backwards:
        def run(self, plan, tasks):
            yield from reversed([plan(task) for task in tasks])

    assert digest(run(Backwards())) == wanted


def test_devices_of_one_process(wanted):
    assert digest(run("devices")) == wanted


def test_errors_of_a_chunk_come_through():
    class Broken:
        def run(self, plan, tasks):
            for task in tasks:
                if task.number == 2:
                    raise ArithmeticError("chunk 2")
                yield plan(task)

    with pytest.raises(ArithmeticError, match="chunk 2"):
        run(Broken())


ON_FOUR_DEVICES = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
from test_executors import Devices, digest, run
assert len(jax.devices()) == 4
print(*[digest(run(Devices(jax.devices()[:count]))) for count in (1, 2, 4)])
"""


@pytest.mark.slow
def test_one_two_and_four_devices(wanted):
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    done = subprocess.run(
        [sys.executable, "-c", ON_FOUR_DEVICES, os.path.dirname(__file__)],
        env=os.environ | flags,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [wanted] * 3


# ------------------------------------------------------------------- shard_map


SHARDED = {
    "moreau": ji.Moreau(0.5),
    "poisson": ji.Poisson(0.5),
    "matrix": ji.RestitutionMatrix(0.5 * np.eye(2)),
    "binary": Binary(0.5),
    "velocity": ji.VelocityDependent(ji.Moreau(0.5), speed_exponent=0.25),
}


def on_a_mesh(function):
    """`function` of velocities shared out among all devices, and their sum over the devices."""
    mesh, axis = jax.sharding.Mesh(np.array(jax.devices()), ("shot",)), jax.sharding.PartitionSpec

    def part(parameter, velocities):
        here = jax.vmap(function, (None, 0))(parameter, velocities)
        return here, jax.lax.psum(here.sum(axis=0), "shot")

    return jax.shard_map(
        part, mesh=mesh, in_specs=(axis(), axis("shot")), out_specs=(axis("shot"), axis())
    )


@pytest.mark.parametrize("name", SHARDED)
def test_shard_map_traces_algebraic_laws(name):
    """With its default check of what varies among devices; nothing is compiled."""

    def after(_, velocity):
        return ji.impact(SHARDED[name], BALLS, velocity).velocity

    for mode in (after, jax.jacfwd(after, argnums=1)):
        each, total = jax.eval_shape(on_a_mesh(mode), jnp.ones(()), jnp.ones((4, 3)))
        assert each.shape[1:] == total.shape


ON_TWO_DEVICES = """
import sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
from test_executors import BALLS, ji, on_a_mesh
assert len(jax.devices()) == 2
v = jnp.array([[1.0, 0.0, -1.0], [1.0, 0.2, 0.1], [0.5, 0.0, -0.3], [2.0, 0.1, 0.0]])
for make in (ji.Binary, ji.Moreau):
    after = lambda e, v: ji.impact(make(e), BALLS, v).velocity
    each, total = jax.jit(on_a_mesh(after))(jnp.asarray(0.7), v)
    alone = jax.vmap(after, (None, 0))(jnp.asarray(0.7), v)
    np.testing.assert_allclose(each, alone, atol=1e-8)
    np.testing.assert_allclose(total, alone.sum(axis=0), atol=1e-8)
    slope = jax.jacfwd(after, argnums=1)
    each, total = jax.jit(on_a_mesh(slope))(jnp.asarray(0.7), v)
    np.testing.assert_allclose(each, jax.vmap(slope, (None, 0))(jnp.asarray(0.7), v), atol=1e-7)
"""


@pytest.mark.slow
def test_shard_map_on_two_devices():
    """Values, sums and forward derivatives are those of one device."""
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    done = subprocess.run(
        [sys.executable, "-c", ON_TWO_DEVICES, os.path.dirname(__file__)],
        env=os.environ | flags,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


# ------------------------------------------------------------------------ Dask


def dask_executor(client):
    from jimpact.montecarlo.executors import DaskExecutor

    return DaskExecutor(client)


def test_dask_in_this_process(wanted, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.Client(
        processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None
    ) as client:
        result = run(dask_executor(client), folder=tmp_path)
        assert digest(result) == wanted
        # the files are written here, and any executor goes on from them
        assert digest(run("serial", folder=tmp_path)) == wanted
        assert digest(run(dask_executor(client.scheduler.address))) == wanted


@pytest.mark.slow
def test_a_killed_dask_worker_changes_nothing(wanted, tmp_path):
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        processes=True, n_workers=2, threads_per_worker=1, dashboard_address=None
    )
    with cluster, distributed.Client(cluster) as client:
        victim = next(iter(client.run(os.getpid).values()))

        def kill_after_the_first_chunks():
            end = time.monotonic() + 120
            while len(list(tmp_path.glob("chunk-*.npz"))) < 3 and time.monotonic() < end:
                time.sleep(0.01)
            os.kill(victim, signal.SIGKILL)

        killer = threading.Thread(target=kill_after_the_first_chunks)
        killer.start()
        result = run(dask_executor(client), folder=tmp_path, samples=128 * 400)
        killer.join()
        survivors = set(client.run(os.getpid).values())
    assert victim not in survivors
    assert digest(result) == digest(run("serial", samples=128 * 400))
