"""Runs all benchmarks of speed and writes `results/`: `python tests/benchmarks/all.py`.

About ten minutes on two quiet cores. `--quick` only shows that everything runs.
"""

import datetime
import importlib.metadata
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

from harness import arguments
from kernels import compiled
from rich.console import Console

SCRIPTS = ("three_balls", "peers", "derivatives", "economy", "long_chains", "motions")
PACKAGES = (
    "jimpact",
    "jax",
    "jaxlib",
    "equinox",
    "diffrax",
    "numpy",
    "scipy",
    "numba",
    "mujoco",
)


def processor():
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [
        line.split(":")[1].strip() for line in lines if line.startswith("model name")
    ]
    return names[0] if names else platform.processor() or "unknown"


def version(package):
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def readme(seconds, load, verdicts):
    """What ran, where and when, and what was aimed at beside what was measured."""
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    rows = "\n".join(
        f"| `{name}.py` | {taken:.0f} |" for name, taken in seconds.items()
    )
    return f"""# Benchmark results

Written by `python tests/benchmarks/all.py`; one script alone: `python tests/benchmarks/NAME.py`.
Needs g++ for the C++ yardstick, numba for its loops, and Siconos (Debian: `apt-get install
libsiconos-kernel-dev`) for its row; what is missing is skipped, and said to be.

- date: {datetime.date.today().isoformat()}
- machine: {processor()}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}
- Python {platform.python_version()}, {versions}; {compiled.compiler_version()}
- load average before the run: {load:.2f} (the runs themselves add about 1; every row of the tables
  holds its own). Times of a busy machine are distorted; ratios less so.

Files: `NAME.csv` all figures, `NAME.png` the chart. Times are medians of alternating repeats with
quartiles, compilation apart, ratios are taken repeat by repeat; `cpu` is processor time.

| script | seconds |
|---|---|
{rows}

Aims beside measurements:

```
{chr(10).join(verdicts)}
```
"""


def main():
    options = arguments(__doc__)
    console = Console(stderr=True)
    load, seconds, verdicts, failed = os.getloadavg()[0], {}, [], []
    for place, name in enumerate(SCRIPTS, 1):
        console.rule(f"{place} of {len(SCRIPTS)}: {name}")
        command = [sys.executable, str(Path(__file__).with_name(f"{name}.py"))]
        command += ["--out", str(options.out)] + (["--quick"] if options.quick else [])
        start = time.perf_counter()
        run = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        for line in run.stdout:
            print(line, end="", flush=True)
            if "aim:" in line or line.startswith("skipped:"):
                verdicts.append(line.rstrip())
        seconds[name] = time.perf_counter() - start
        if run.wait() != 0:
            failed.append(name)
    (options.out / "README.md").write_text(readme(seconds, load, verdicts))
    console.print(
        f"all: {sum(seconds.values()):.0f} s; written: {options.out / 'README.md'}"
    )
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
