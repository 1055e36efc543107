"""The same bits from every executor, from any number of devices, and when a worker dies."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from jimpact import Binary, RandomLaw, Uniform, chain, monte_carlo
from jimpact.montecarlo.executors import Devices, Executor, Serial, as_executor
from jimpact.montecarlo.store import fingerprint

pytestmark = pytest.mark.slow  # they compile programs of their own

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


ON_FOUR_DEVICES = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/.."]
from test_executors_inside import Devices, digest, run
assert len(jax.devices()) == 4
print(*[digest(run(Devices(jax.devices()[:count]))) for count in (1, 2, 4)])
"""


@pytest.mark.release
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


@pytest.mark.release
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
