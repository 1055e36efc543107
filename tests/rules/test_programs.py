"""How often eleven calls are traced, how many programs they compile, and with which precision.

A process of its own makes each call, and makes it again with other numbers: then nothing is compiled
anew. JAX writes down what it compiles, so that the count depends on no clock and on no other test.
"""

import functools
import json
import subprocess
import sys

import pytest

# Of each call: how often JAX traces a function, how many programs it compiles, and how many of them
# are large. Single operations and JAX's own functions are small programs, whose number changes with
# its version: half as many more are allowed. Large ones are ours: they are as many as stated.
CALLS = {
    "impact": (6, 16, 1),
    "jacobian": (12, 14, 1),
    "batch": (4, 6, 1),
    "fit of one": (9, 11, 1),
    "fit of two": (8, 10, 1),
    "monte carlo": (10, 9, 2),
    "ball": (8, 10, 1),
    "block": (8, 8, 2),
    "compare": (4, 4, 4),
    "advise": (32, 45, 6),
    "track": (1, 1, 0),
}
MORE = 1.5
# traced again, not compiled: a Monte Carlo run and advice ask laws for their tolerance
TRACED_AGAIN = {"monte carlo": 1, "advise": 6}

SCRIPT = """
import json
import tempfile
from pathlib import Path

import jax

TEXTS = Path(tempfile.mkdtemp(prefix="programs-"))
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
jax.config.update("jax_dump_ir_to", str(TEXTS))

import jax.numpy as jnp
import numpy as np
import jimpact as ji
from programs import below_highest

LARGE = 200  # operations; a single operation that runs eagerly has a few
traces = []


def listen(event, duration, **_):
    if event == "/jax/core/compile/jaxpr_trace_duration":
        traces.append(event)


jax.monitoring.register_event_duration_secs_listener(listen)

BALLS, PAIR, STRIKE = ji.chain([1.0, 1.0, 1.0]), ji.chain([1.0, 1.0]), np.array([1.0, 0.0, 0.0])
STRIKES = np.outer([1.0, 2.0, 3.0], STRIKE)
BALL = ji.System(ji.Column([1.0]), gravity=True)
BLOCK = ji.System(ji.Block(0.3, 0.4, 1.3), gravity=True)
STIFFNESS = [1.0, 2.0]


def impact(e, v=STRIKE):
    return ji.impact(ji.LZB(e, STIFFNESS), BALLS, v).velocity


def shots(e):
    pre = np.array([[1.0, 0.0], [2.0, 0.0]])
    after = pre @ np.array([[1 - e, 1 + e], [1 + e, 1 - e]]) / 2
    return ji.Experiments(pre, after + [[0.01, -0.01], [-0.01, 0.01]])


def cradle(e):
    pre = STRIKES[:2]
    return ji.Experiments(pre, pre * 0 + [[0.0, 0.2, e], [0.0, 0.4, 2 * e]])


def fall(e, system, q):
    return ji.simulate(system, ji.Moreau(e), q, [0.0] * len(q), 0.5, samples=5)


def track(e):
    t = np.arange(40) / 100
    return ji.tracks.find_impacts(t, np.abs(t - e / 3), sigma=0.001)


GAPS = {"gaps": ji.Uniform(0.0, 1e-5), "samples": 64, "progress": False}
CALLS = {
    "impact": impact,
    "jacobian": jax.jacfwd(impact),
    "batch": lambda e: jax.vmap(lambda v: impact(e, v))(STRIKES),
    "fit of one": lambda e: ji.fit(ji.Newton(0.5), PAIR, shots(e), starts=1),
    "fit of two": lambda e: ji.fit(
        ji.LZB([0.5, 0.5], STIFFNESS), BALLS, cradle(e), ("restitution",), starts=1
    ),
    "monte carlo": lambda e: ji.monte_carlo(ji.Binary(e, "earliest"), BALLS, STRIKE, **GAPS),
    "ball": lambda e: fall(e, BALL, [1.0]),
    "block": lambda e: fall(e, BLOCK, [0.0, 0.4, 0.2]),
    "compare": lambda e: ji.compare(BALLS, STRIKE, {"a": ji.Newton(e), "b": ji.Poisson(e)}),
    "advise": lambda e: ji.advise(BALLS, STRIKE, restitution=e, samples=8, timing=False),
    "track": track,
}


def counted(call, e):
    for path in TEXTS.iterdir():
        path.unlink()
    traces.clear()
    jax.block_until_ready(call(e))
    texts = [path.read_text() for path in TEXTS.iterdir()]
    large = [text for text in texts if text.count(" = ") >= LARGE]
    coarse = [line for text in texts for line in below_highest(text)]
    return len(traces), len(texts), len(large), coarse


print(json.dumps({name: [counted(call, e) for e in (0.6, 0.7)] for name, call in CALLS.items()}))
"""


@pytest.fixture(scope="module")
def counts():
    """Of each call, the first time and with other numbers: traces, programs, large ones, coarse products."""
    run = functools.partial(subprocess.run, capture_output=True, text=True, check=False)
    path = f"import sys; sys.path[:0] = {sys.path!r}\n"
    done = run([sys.executable, "-c", path + SCRIPT])
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_a_call_is_traced_and_compiled_as_often_as_stated(counts, name):
    traces, programs, large = CALLS[name]
    found = counts[name][0]
    assert found[2] == large
    assert found[0] <= MORE * traces
    assert found[1] <= MORE * programs


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_the_same_call_with_other_numbers_compiles_nothing(counts, name):
    traces, programs, _, _ = counts[name][1]
    assert programs == 0
    assert traces <= TRACED_AGAIN.get(name, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_products_of_matrices_have_the_precision_of_their_numbers(counts, name):
    """As on a GPU, where JAX multiplies float32 matrices with 10 bits unless it is asked for more."""
    (*_, coarse), (*_, coarse_again) = counts[name]
    assert coarse == coarse_again == []
