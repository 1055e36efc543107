"""Samples a second of `ji.monte_carlo`: `python tests/benchmarks/montecarlo.py [ROW]`.

Three balls with uniform gaps on the CPU at hand, computing and statistics together. Each row is a
process of its own: its largest memory is that of the row.
"""

import json
import resource
import subprocess
import sys
import time
from functools import partial

from harness import RESULTS, show, write_csv

BALLS = {"masses": [0.067, 0.067, 0.067]}  # [kg], 1-inch steel balls
STRIKE = [0.5, 0.0, 0.0]  # [m/s]
ROWS = ("Binary, 'earliest'", "the same, chunk=16384", "LZB, random stiffness", "Compliant, Hertz")


def measured(name):
    """The row: samples a second without compiling, seconds with it, and MB."""
    import jimpact as ji

    scene = ji.chain(**BALLS)
    gaps = None if "LZB" in name else ji.Uniform(0.0, 50e-6)  # [m]
    stiffness = ji.Uniform(0.5e10, 2e10)
    law = {
        "LZB, random stiffness": ji.RandomLaw(ji.LZB(0.9, [1e10, 1e10]), stiffness=stiffness),
        "Compliant, Hertz": ji.Compliant(ji.Hertz(1e10)),
    }.get(name, ji.Binary(0.9, "earliest"))
    samples = {"LZB, random stiffness": 200_000, "Compliant, Hertz": 1_000_000}.get(name, 4_000_000)
    run = partial(ji.monte_carlo, law, scene, STRIKE, gaps=gaps, samples=samples, progress=False)
    begun = time.perf_counter()
    result = run(chunk=16384) if "chunk" in name else run()
    wall = time.perf_counter() - begun
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"law": name, "samples": samples, "rate": result.rate, "s": wall, "memory_MB": memory}


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
