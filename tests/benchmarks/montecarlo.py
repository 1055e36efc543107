"""Samples a second of `ji.monte_carlo`: `python tests/benchmarks/montecarlo.py [ROW]`.

Three balls (or five) with uniform gaps on the CPU at hand, computing and statistics together. Each
row is a process of its own: its largest memory is that of the row. Beside another commit: rows of
both in turn, `PYTHONPATH=FOLDER_OF_THE_OTHER python tests/benchmarks/montecarlo.py "Compliant, five balls"`.
"""

import json
import resource
import subprocess
import sys
import time
from functools import partial

from harness import RESULTS, show, write_csv

MASS = 0.067  # [kg], of 1-inch steel balls
STRIKE = 0.5  # [m/s], of the first one
ROWS = (
    *("Binary, 'earliest'", "the same, chunk=16384", "LZB, random stiffness"),
    *("Compliant, Hertz", "Compliant, five balls"),
)


def measured(name):
    """The row: samples a second without compiling, seconds with it, of processors, and MB."""
    import jimpact as ji

    balls = 5 if "five" in name else 3
    scene, strike = ji.chain([MASS] * balls), [STRIKE] + [0.0] * (balls - 1)
    gaps = None if "LZB" in name else ji.Uniform(0.0, 50e-6)  # [m]
    stiffness = ji.Uniform(0.5e10, 2e10)
    law = {
        "LZB, random stiffness": ji.RandomLaw(
            ji.LZB(0.9, [1e10, 1e10]), stiffness=stiffness
        ),
        **dict.fromkeys(ROWS[3:], ji.Compliant(ji.Hertz(1e10))),
    }.get(name, ji.Binary(0.9, "earliest"))
    samples = dict(zip(ROWS[2:], (200_000, 1_000_000, 150_000))).get(name, 4_000_000)
    run = partial(
        ji.monte_carlo, law, scene, strike, gaps=gaps, samples=samples, progress=False
    )
    begun, worked = time.perf_counter(), time.process_time()
    result = run(chunk=16384) if "chunk" in name else run()
    wall, cpu = time.perf_counter() - begun, time.process_time() - worked
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    row = {
        "law": name,
        "samples": samples,
        "rate": result.rate,
        "s": wall,
        "cpu_s": cpu,
    }
    return row | {"memory_MB": memory}


def main():
    """All rows, or the one that is named."""
    if len(sys.argv) > 1:
        print(json.dumps(measured(sys.argv[1])))
        return
    rows = []
    for name in ROWS:
        command = [sys.executable, __file__, name]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
    show("Monte Carlo over gaps", rows, list(rows[0]))
    write_csv(RESULTS / "montecarlo.csv", rows)


if __name__ == "__main__":
    main()
