"""The same bits from every executor, from any number of devices, and when a worker dies."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import argument

import jimpact as ji
from jimpact import Binary, RandomLaw, Uniform, chain, monte_carlo

BALLS = chain([0.25, 1.0, 0.25])


def drawn_law():
    return RandomLaw(Binary(1.0, order="earliest"), restitution=Uniform(0.8, 1.0))


def run(executor, samples=1000, **options):
    gaps = Uniform(0.0, 1e-5)
    return monte_carlo(
        drawn_law(),
        BALLS,
        [1.0, 0.0, -1.0],
        gaps,
        samples,
        chunk=128,
        executor=executor,
        **options,
    )


def same(a, b):
    """Whether two results have the same bits."""
    names = [
        "mean",
        "covariance",
        "gap_covariance",
        "counts",
        "edges",
        "minimum",
        "maximum",
    ]
    parts = [(getattr(a, name), getattr(b, name)) for name in names]
    parts += [(a.first[name], b.first[name]) for name in a.first]
    return a.statuses == b.statuses and all(np.array_equal(*pair) for pair in parts)


@pytest.fixture(scope="module")
def wanted():
    return run("serial")


@pytest.mark.slow
def test_anything_with_a_map(wanted):
    with ThreadPoolExecutor(2) as pool:
        assert same(run(pool), wanted)
    assert same(run("devices"), wanted)


@pytest.mark.parametrize("workers", [None, 1, 3])
def test_threads_change_no_bit(wanted, workers):
    assert same(run("threads", workers=workers), wanted)


def test_what_was_finished_before_an_error_in_a_thread_is_kept(
    wanted, tmp_path, monkeypatch
):
    """The third chunk fails; the same call continues from the two before it."""
    import numpy

    stored, fails = [], numpy.savez

    def savez(file, **arrays):
        if len(stored) == 2:
            raise KeyboardInterrupt
        stored.append(int(arrays["number"]))
        return fails(file, **arrays)

    monkeypatch.setattr(numpy, "savez", savez)
    with pytest.raises(
        KeyboardInterrupt, match=r"stopped after 256 of 1,000 samples; .* continues"
    ):
        run("threads", workers=2, folder=tmp_path)
    monkeypatch.undo()
    assert stored == [0, 1]
    assert len(list(tmp_path.glob("chunk-*.npz"))) == 2
    assert same(run("threads", workers=2, folder=tmp_path), wanted)


def test_errors_of_a_chunk_come_through():
    class Broken:
        def map(self, work, tasks):
            for task in tasks:
                if task.number == 2:
                    raise ArithmeticError("chunk 2")
                yield work(task)

    with pytest.raises(ArithmeticError, match="chunk 2"):
        run(Broken())


@pytest.mark.parametrize("workers", [0, -1, 1.5, True, "all"])
def test_numbers_of_workers_that_are_none(workers):
    with pytest.raises(ValueError, match=argument("workers")):
        run("threads", workers=workers)


def test_an_error_in_a_thread_comes_through(tmp_path):
    """A law fails when it is drawn for the fifth time, in a worker: what was finished is kept."""
    calls = []

    def value():
        calls.append(threading.current_thread().name)
        if len(calls) == 5:
            raise ArithmeticError("this law cannot be drawn")
        return np.float64(0.9)

    def law(key):
        return Binary(
            jax.pure_callback(value, jax.ShapeDtypeStruct((), float)), "earliest"
        )

    with pytest.raises(Exception, match="this law cannot be drawn"):
        monte_carlo(
            law, BALLS, [1.0, 0.0, -1.0], Uniform(0.0, 1e-5), 2000, chunk=128, workers=2,
            folder=tmp_path,
        )  # fmt: skip
    assert 1 <= len(list(tmp_path.glob("chunk-*.npz"))) < 5


UNTIL_INTERRUPTED = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/.."]
from test_executors import run
run("threads", 1_000_000, workers=2, folder=sys.argv[2])
"""


@pytest.mark.slow
def test_ctrl_c_ends_threads_soon_and_keeps_their_chunks(tmp_path, wanted):
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # an ignored one would be inherited
    command = [
        sys.executable,
        "-c",
        UNTIL_INTERRUPTED,
        os.path.dirname(__file__),
        str(tmp_path),
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        while len(list(tmp_path.glob("chunk-*.npz"))) < 8:
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        message = process.communicate(timeout=20)[1]  # two chunks take milliseconds
    finally:
        process.kill()
    assert process.returncode not in (0, -signal.SIGKILL)
    assert "of 1,000,000 samples; they are in" in message
    assert not list(tmp_path.glob("*.tmp"))
    again = run("serial", folder=tmp_path)
    assert again.resumed >= 7 * 128
    assert same(again, wanted)


ON_FOUR_DEVICES = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/.."]
from test_executors import run, same
assert len(jax.devices()) == 4
assert same(run("devices"), run("serial"))
"""


@pytest.mark.release
def test_four_devices():
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    command = [sys.executable, "-c", ON_FOUR_DEVICES, os.path.dirname(__file__)]
    subprocess.run(command, env=os.environ | flags, check=True)


@pytest.mark.slow
def test_dask_in_this_process(wanted, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.Client(
        processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None
    ) as client:
        assert same(run(client, folder=tmp_path), wanted)
        # the files are written here, and any executor goes on from them
        assert same(run("serial", folder=tmp_path), wanted)
        assert same(run(client.scheduler.address), wanted)


@pytest.mark.release
def test_a_killed_dask_worker_changes_nothing(tmp_path):
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        processes=True, n_workers=2, threads_per_worker=1, dashboard_address=None
    )
    with cluster, distributed.Client(cluster) as client:
        victim = next(iter(client.run(os.getpid).values()))

        def kill_after_the_first_chunks():
            while len(list(tmp_path.glob("chunk-*.npz"))) < 3:
                time.sleep(0.01)
            os.kill(victim, signal.SIGKILL)

        killer = threading.Thread(target=kill_after_the_first_chunks, daemon=True)
        killer.start()
        result = run(client, folder=tmp_path, samples=128 * 400)
        killer.join()
        survivors = set(client.run(os.getpid).values())
    assert victim not in survivors
    assert same(result, run("serial", samples=128 * 400))


# A body in space on two contacts with friction, and in the plane.
IN_SPACE = ji.Scene(
    np.array([1.0, 1.0, 1.0, 0.2, 0.2, 0.2]),
    np.array([[0, 0], [0, 0], [1, 1], [0.5, 0.5], [-0.5, 0.4], [0, 0.0]]),
    np.array(
        [
            [1, 0, 1, 0],
            [0, 1, 0, 1],
            [0, 0, 0, 0],
            [0, 0.5, 0, 0.5],
            [-0.5, 0, -0.5, 0],
            [0.5, 0.1, -0.4, 0.1],
        ]
    ),
)


IN_PLANE = ji.Scene(
    np.array([1.0, 1.0, 0.1]),
    np.array([[0, 0], [1, 1], [-0.5, 0.6]]),
    # contacts that stick redundantly have derivatives with the rounding of a square root
    np.array([[1, 1], [0, 0], [0.1, 0.13]]),
)


V_SPACE, V_PLANE = [0.6, 0.3, -1.0, 0.1, 0.2, 0.05], [0.5, -1.0, 0.3]


V_BALLS = [1.0, 0.0, -0.8]


SHARDED = {
    "moreau": (ji.Moreau, BALLS, V_BALLS),
    "poisson": (ji.Poisson, BALLS, V_BALLS),
    "matrix": (lambda e: ji.RestitutionMatrix(e * jnp.eye(2)), BALLS, V_BALLS),
    "binary": (Binary, BALLS, V_BALLS),
    "velocity": (
        lambda e: ji.VelocityDependent(ji.Moreau(e), speed_exponent=0.25),
        BALLS,
        V_BALLS,
    ),
    "lzb": (ji.LZB, BALLS, V_BALLS),
    "compliant": (lambda e: ji.Compliant(ji.KelvinVoigt(1e4, e)), BALLS, V_BALLS),
    "friction-moreau": (lambda e: ji.Moreau(e, friction=0.4), IN_SPACE, V_SPACE),
    "friction-binary": (lambda e: Binary(e, friction=0.4), IN_PLANE, V_PLANE),
    "friction-lzb": (
        lambda e: ji.LZB(e, friction=0.4, method="time"),
        IN_PLANE,
        V_PLANE,
    ),
    "friction-implicit": (
        lambda e: ji.LZB(e, friction=0.4, method="implicit"),
        IN_SPACE,
        V_SPACE,
    ),
}


def sharded(name):
    """Of a restitution and velocities (K, n) shared out among all devices: velocities after."""
    make, scene, velocity = SHARDED[name]

    def after(e, v):
        return ji.impact(make(e), scene, v).velocity

    velocities = jnp.outer(jnp.linspace(0.7, 1.3, 4), jnp.asarray(velocity))
    return after, jnp.asarray(0.6), velocities


def on_a_mesh(function, batch=(None, 0)):
    """`function` of velocities shared out among all devices, and its sum over the devices.

    The law is on all of them, or with `batch` (0, 0) shared out as well.
    """
    mesh, axis = (
        jax.sharding.Mesh(np.array(jax.devices()), ("shot",)),
        jax.sharding.PartitionSpec,
    )
    specs = tuple(axis() if first is None else axis("shot") for first in batch)

    def part(parameter, velocities):
        here = jax.vmap(function, batch)(parameter, velocities)
        return here, jax.tree.map(lambda x: jax.lax.psum(x.sum(axis=0), "shot"), here)

    return jax.shard_map(
        part, mesh=mesh, in_specs=specs, out_specs=(axis("shot"), axis())
    )


@pytest.mark.release
@pytest.mark.parametrize(
    "name",
    ["binary", "friction-moreau"]
    + [pytest.param(x, marks=pytest.mark.slow) for x in ("lzb", "friction-implicit")],
)
def test_shard_map_takes_laws(name):
    """With its default check of what varies among devices; nothing is compiled."""
    after, e, velocities = sharded(name)
    reverse = on_a_mesh(jax.jacrev(after, (0, 1)))
    each, total = jax.eval_shape(reverse, e, velocities)
    assert each[1].shape == (*velocities.shape, velocities.shape[1])
    assert total[1].shape == each[1].shape[1:]
    if name == "lzb":
        jax.jit(on_a_mesh(after)).lower(e, velocities)


ON_FOUR_DEVICES_SHARDED = """
import sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/.."]
from test_executors import SHARDED, on_a_mesh, sharded
assert len(jax.devices()) == 4
for name in sys.argv[2:] or SHARDED:
    after, e, v = sharded(name)
    def both(e, v):
        return after(e, v), jax.jacfwd(after, (0, 1))(e, v), jax.jacrev(after, (0, 1))(e, v)
    each = jnp.linspace(0.3, 0.9, 4)
    got = jax.jit(on_a_mesh(both, (0, 0)))(each, v)[0]
    alone = jax.jit(jax.vmap(both))(each, v)
    # steps without events wait for each other, so they depend on those beside them
    atol = 2e-3 if "implicit" in name else 1e-9
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), got, alone)
    # one law on all devices: its gradient is the sum over them
    slope = jax.grad(lambda e: jnp.sum(on_a_mesh(after)(e, v)[1] ** 2))
    wanted = jax.grad(lambda e: jnp.sum(jax.vmap(after, (None, 0))(e, v).sum(axis=0) ** 2))
    np.testing.assert_allclose(jax.jit(slope)(e), jax.jit(wanted)(e), rtol=1e-9 + atol)
"""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            x, marks=pytest.mark.slow if x == "moreau" else pytest.mark.release
        )
        for x in SHARDED
    ],
)
def test_shard_map_on_four_devices(name):
    """Values and derivatives in both modes are those of one device."""
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            ON_FOUR_DEVICES_SHARDED,
            os.path.dirname(__file__),
            name,
        ],
        env=os.environ | flags,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
