"""What the kind of a processor is: compiled programs run on no other. Without JAX."""

import platform
from pathlib import Path

INFO = Path("/proc/cpuinfo")  # where Linux describes it; elsewhere it does not exist
# the lines that name its kind and instruction set, on x86 and on ARM
KIND = ("flags", "Features", "model name", "CPU part")


def processor() -> str:
    """Machine, kind and instruction set of this processor, as far as they are known."""
    words = [platform.machine(), platform.processor()]
    if INFO.exists():
        lines = INFO.read_text(encoding="utf-8").splitlines()
        words += sorted({line for line in lines if line.startswith(KIND)})
    return " ".join(words)
