"""Siconos 4.4 (Debian: `apt-get install libsiconos-kernel-dev`), where it is installed."""

import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from kernels import compiled

INCLUDE = Path("/usr/include/siconos")
LIBRARIES = ("-lsiconos_kernel", "-lsiconos_numerics", "-lsiconos_externals")
PARTS = (0.1, 0.5, 0.9)  # quantiles of the stiffness ratio that are run
STEP, QUICK_STEP = 9e-7, 1e-4  # of impulse: first order; the former reaches about 1e-6


def row(stiffness: np.ndarray, exact: np.ndarray, quick: bool) -> dict[str, Any] | None:
    """Seconds and largest error of a few impacts of the batch, as a row of the table."""
    if not INCLUDE.exists():
        print("skipped: Siconos is not installed (Debian: libsiconos-kernel-dev)")
        return None
    # the work is done in the library: the driver need not be optimised
    flags = [
        "-O0",
        *(f"-I{INCLUDE / sub}" for sub in ("", "kernel", "numerics")),
        *LIBRARIES,
    ]
    path = compiled.build("siconos_three_balls.cpp", "siconos_three_balls", flags)
    if path is None:
        return None
    step = QUICK_STEP if quick else STEP
    order = np.argsort(stiffness[:, 1])
    errors, seconds = [], []
    for part in PARTS:
        i = order[int(part * len(order))]
        command = [str(path), "0.9", repr(float(stiffness[i, 1])), repr(step)]
        out = subprocess.run(command, capture_output=True, text=True).stdout
        lines = [
            line.split()[1:] for line in out.splitlines() if line.startswith("result")
        ]
        if not lines:
            print("skipped: Siconos gave no result")
            return None
        values = [float(value) for value in lines[0]]
        errors.append(np.abs(values[:3] - exact[i]).max())
        seconds.append(values[3])
    low, middle, high = np.percentile(np.asarray(seconds) * 1e6, [25, 50, 75])
    return {
        "method": "Siconos",
        "setting": step,
        "error_max": float(np.max(errors)),
        "us": float(middle),
        "us_q1": float(low),
        "us_q3": float(high),
    }
