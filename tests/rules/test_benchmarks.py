"""The first benchmark runs: tiny batches, in processes of their own."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.release
def test_three_balls_run(tmp_path):
    """The one that all others are measured against; `all.py --quick` runs the others, too."""
    command = [
        sys.executable,
        str(FOLDER / "three_balls.py"),
        "--quick",
        "--out",
        str(tmp_path),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert {path.name for path in tmp_path.iterdir()} == {
        "three_balls.csv",
        "three_balls.png",
    }
    with (tmp_path / "three_balls.csv").open() as file:
        rows = list(csv.DictReader(file))
    errors = {(row["method"], row["target"]): float(row["error_max"]) for row in rows}
    tuned = {key: value for key, value in errors.items() if key[1] != "default"}
    assert ("jimpact", "3e-08") in tuned
    for (method, target), error in tuned.items():
        if method != "Siconos":  # its quick run is far too coarse
            assert error <= float(target), method
    assert errors["jimpact", "default"] < 1e-7


@pytest.mark.release
def test_compiled_impacts_agree():
    """The C++ yardstick solves the same problem as jimpact, for other e and stiffness too."""
    code = """
import jax
jax.config.update("jax_enable_x64", True)
import sys
sys.path.insert(0, sys.argv[1])
import numpy as np, jax.numpy as jnp, jimpact as ji
from kernels import compiled
run = compiled.three_balls()
if run is None:
    raise SystemExit(7)
rng = np.random.default_rng(1)
k, e = 10 ** rng.uniform(-2, 2, (64, 2)), rng.uniform(0.5, 1.0, (64, 2))
one = lambda k, e: ji.impact(ji.LZB(e, k, 1.5, rtol=1e-11), ji.chain(jnp.ones(3)), jnp.array([1.0, 0, 0]))
exact = jax.jit(jax.vmap(one))(k, e).velocity
print(float(np.abs(run(k, e, 1e-10)[0] - exact).max()))
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(FOLDER)], capture_output=True, text=True
    )
    if done.returncode == 7:
        pytest.skip(done.stdout)
    assert done.returncode == 0, done.stderr[-2000:]
    assert float(done.stdout.split()[-1]) < 1e-8
