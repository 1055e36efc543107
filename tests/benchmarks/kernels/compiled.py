"""Builds the C++ yardsticks in a temporary folder; None where something needed is missing."""

import atexit
import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from jimpact.numerics.tableaux import DOP853

HERE = Path(__file__).parent
FLAGS = ("-O3", "-march=native", "-std=c++17")


@cache
def _folder() -> Path:
    path = tempfile.mkdtemp(prefix="jimpact-benchmark-")
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    return Path(path)


def compiler_version() -> str:
    """First line of `g++ --version`."""
    if shutil.which("g++") is None:
        return "no g++"
    out = subprocess.run(
        ["g++", "--version"], capture_output=True, text=True, check=True
    )
    return out.stdout.splitlines()[0]


def build(source: str, target: str, flags: Sequence[str] = ()) -> Path | None:
    """The compiled file, or None, with a message, where there is no compiler or library."""
    if shutil.which("g++") is None:
        print(f"skipped: {source} needs g++")
        return None
    path = _folder() / target
    command = [
        "g++",
        *FLAGS,
        "-I",
        str(_folder()),
        str(HERE / source),
        "-o",
        str(path),
        *flags,
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if "error" in line] or ["?"]
        print(f"skipped: {source} does not compile here: {lines[0]}")
        return None
    return path


def _tableau() -> str:
    stages = len(DOP853.c)

    def row(values: Sequence[float]) -> str:
        padded = [*values, *[0.0] * (stages - len(values))]
        return "{" + ", ".join(repr(float(x)) for x in padded) + "}"

    lines = [f"constexpr int STAGES = {stages};"]
    entries = ",\n    ".join(row(values) for values in DOP853.a)
    lines.append(f"constexpr double A[{stages}][{stages}] = {{\n    {entries}}};")
    named = {
        "B": DOP853.b,
        "C": DOP853.c,
        "HIGH": DOP853.error_high,
        "LOW": DOP853.error_low,
    }
    lines += [
        f"constexpr double {name}[{stages}] = {row(v)};" for name, v in named.items()
    ]
    return "\n".join(lines) + "\n"


def three_balls() -> Callable[..., tuple[np.ndarray, float]] | None:
    """`run(stiffness (B, 2), restitution (B, 2), rtol) -> (v+ (B, 3), passes per impact)`."""
    (_folder() / "tableau.h").write_text(_tableau())
    path = build("three_balls.cpp", "three_balls.so", ["-shared", "-fPIC"])
    if path is None:
        return None
    impacts = ctypes.CDLL(str(path)).impacts
    array = np.ctypeslib.ndpointer(float, flags="C")
    count = ctypes.POINTER(ctypes.c_long)
    impacts.argtypes = [ctypes.c_int, *[array] * 4, ctypes.c_double, array, count]
    impacts.restype = None
    masses, velocity = np.ones(3), np.array([1.0, 0.0, 0.0])

    def run(stiffness: np.ndarray, restitution: np.ndarray, rtol: float):
        out, passes = np.empty((len(stiffness), 3)), ctypes.c_long()
        given = (masses, velocity, stiffness, restitution)
        impacts(len(stiffness), *given, rtol, out, ctypes.byref(passes))
        return out, passes.value / len(stiffness)

    return run
