#!/usr/bin/env bash
# XLA's CPU: a loop of small kernels wakes a second thread where more than eight are ready at once.
#
# Guess: kernels of about a microsecond run on the calling thread, six in a loop's pass or twelve.
# Seen (jax and jaxlib 0.10.2, CPU): with six or eight independent arrays one thread does all the
# work; with twelve a second one takes a third to a half of it, and an array costs more CPU time.
# With six of the twelve in a branch of `lax.cond`, a sequence of its own, one thread does all again.
# It costs: batches of some hundred lanes took a third more CPU time than they need.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if [ ! -d /proc/self/task ] || [ "$(nproc)" -lt 2 ]; then
    echo "needs Linux and two cores: a process on one core has no second thread to wake"
    exit 0
fi
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "jax==0.10.2" "jaxlib==0.10.2"
cd "$folder"
JAX_PLATFORMS=cpu env/bin/python - <<'PYTHON'
import os
import time

import jax
import jax.numpy as jnp

UPDATES = 1_200_000  # of arrays in a run: about a second


def cpu_time_of_threads():
    """CPU time of the threads of this process, in ticks."""
    used = {}
    for thread in os.listdir("/proc/self/task"):
        with open(f"/proc/self/task/{thread}/stat") as file:
            fields = file.read().rsplit(")", 1)[1].split()
        used[thread] = int(fields[11]) + int(fields[12])
    return used


def updated(arrays):
    return tuple(x * 0.5 + jnp.sum(x * x) * 1e-3 for x in arrays)


def share_of_busiest(count, in_branch=0):
    """Part of a loop's CPU time on its busiest thread: `count` arrays a pass, so many of
    them in a branch that is always taken.
    """
    passes = UPDATES // count

    def one_pass(_, arrays):
        apart = arrays[:in_branch]
        if in_branch:
            always = arrays[0][0] > -1.0
            apart = jax.lax.cond(always, lambda: updated(apart), lambda: apart)
        return apart + updated(arrays[in_branch:])

    program = jax.jit(lambda arrays: jax.lax.fori_loop(0, passes, one_pass, arrays))
    arrays = tuple(jnp.arange(1024.0) + i for i in range(count))
    jax.block_until_ready(program(arrays))
    before = cpu_time_of_threads()
    start = time.process_time()
    jax.block_until_ready(program(arrays))
    cpu = time.process_time() - start
    used = [t - before.get(name, 0) for name, t in cpu_time_of_threads().items()]
    share = max(used) / sum(used)
    place = f"{count} arrays a pass, {in_branch} in a branch"
    print(f"{place}: {cpu / UPDATES * 1e6:.2f} us each, busiest thread {share:.2f} of it")
    return share


print("jax", jax.__version__)
few = [share_of_busiest(count) for count in (6, 8)]
# a busy machine may leave the second thread no core: the least of three
many = min(share_of_busiest(12) for _ in range(3))
apart = share_of_busiest(12, in_branch=6)
assert min(few) > 0.97, "the behaviour has changed: few kernels use a second thread"
assert many < 0.9, "the behaviour has changed: many kernels stay on one thread"
assert apart > 0.97, "the behaviour has changed: a branch does not keep them on one thread"
PYTHON
