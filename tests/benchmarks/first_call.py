"""What one waits for before the first number, beside diffrax: CPU time of tracing and compiling.

Each row is a process of its own, without a compilation cache; what it imports and JAX's own start
are not counted. `python tests/benchmarks/first_call.py [repeats]` prints medians and their ratio
to one impact of three balls by diffrax (Dopri8, an Event at the end).
"""

import math
import resource
import statistics
import subprocess
import sys
from pathlib import Path

TARGETS = {  # times diffrax
    "diffrax": None,
    "impact": 1.4,
    "another number of balls": 0.1,
    "Jacobian": 2.5,
    "friction": 4.0,
    "fit": 3.5,
    "fit of five parameters": None,
    "motion": 2.0,
    "motion with friction": 6.0,
    "two blocks": 10.0,
}


def cpu():
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def measure(row):
    """CPU seconds of the first call of a row."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    import jimpact as ji

    sys.path.insert(0, str(Path(__file__).parent / "kernels"))
    import diffrax_event

    jnp.linalg.solve(jnp.eye(2), jnp.ones(2)).block_until_ready()
    balls, v, e = ji.chain([1.0] * 3), jnp.array([1.0, 0.0, 0.0]), jnp.full(2, 0.9)
    more, faster = ji.chain([1.0] * 4), jnp.array([1.0, 0.0, 0.0, 0.0])
    block = ji.Block(1.0, 2.0, corners="base").scene()
    shots = ji.Experiments(pre=[[1.0, 0, 0]], post=[[-0.0605, 0.1049, 0.9978]])
    five, before = (
        ji.chain([1.0, 1.2, 0.8, 1.1, 0.9], wall="right"),
        jnp.eye(5)[:4],
    )  # [m/s]
    after = [  # of LZB([0.9, 0.8, 0.85, 0.95, 0.7])
        [-0.40955, -0.13153, -0.12876, -0.1089, -0.01543],
        [-0.47155, -0.1287, -0.11991, -0.08727, -0.01935],
        [-0.42409, -0.14298, -0.10532, -0.04332, -0.00763],
        [-0.55423, -0.11257, -0.10354, -0.05199, -0.00377],
    ]
    if row == "another number of balls":
        ji.impact(ji.LZB(0.9), balls, v)
    ball, rocks = (
        ji.System(ji.Column([1.0]), gravity=True),
        ji.System(ji.Block(0.2, 0.6, corners="base"), gravity=True, friction=5.0),
    )
    blocks = ji.Bodies([ji.Block(1.0, 0.5), ji.Block(0.5, 0.25)])
    two = ji.System(blocks, gravity=True, friction=0.5)
    falling = [0.0, 0.26, 0.0, 0.1, 0.66, 0.05]  # [m], [rad]
    matrix = ji.RestitutionMatrix(ji.theory.rocking_matrix(0.85))
    tilted = [0.0, 0.1 * math.sin(0.15) + 0.3 * math.cos(0.15), 0.15]
    run = diffrax_event.dopri8()
    first = {
        "diffrax": lambda: run(jnp.ones((1, 2)), e[None], 1e-8),
        "impact": lambda: ji.impact(ji.LZB(0.9), balls, v).velocity,
        "another number of balls": lambda: (
            ji.impact(ji.LZB(0.9), more, faster).velocity
        ),
        "Jacobian": lambda: jax.jacfwd(
            lambda e: ji.impact(ji.LZB(e), balls, v).velocity
        )(e),
        "friction": lambda: ji.impact(ji.LZB(0.9, friction=0.3), block, v).velocity,
        "fit": lambda: (
            ji.fit(ji.LZB(0.9), balls, shots, free=("restitution",)).law.restitution
        ),
        "fit of five parameters": lambda: (
            ji.fit(
                ji.LZB([0.8] * 5),
                five,
                ji.Experiments(pre=before, post=after),
                free=("restitution",),
            ).value
        ),
        "motion": lambda: ji.simulate(ball, ji.Newton(0.8), [1.0], [0.0], 5.0).q,
        "two blocks": lambda: (
            ji.simulate(two, ji.Moreau(0.3), falling, [0.0] * 6, 0.5).q
        ),
        "motion with friction": lambda: (
            ji.simulate(rocks, matrix, tilted, [0.0] * 3, 4.0).q
        ),
    }[row]
    begun = cpu()
    jax.block_until_ready(first())
    return cpu() - begun


def main(repeats=3):
    times = {row: [] for row in TARGETS}
    for _ in range(repeats):
        for row in TARGETS:
            command = [sys.executable, __file__, "--row", row]
            out = subprocess.run(
                command, capture_output=True, text=True, check=True
            ).stdout
            times[row].append(float(out.split()[-1]))
    unit = statistics.median(times["diffrax"])
    for row, target in TARGETS.items():
        middle = statistics.median(times[row])
        wanted = "" if target is None else f"   wanted <= {target}"
        print(f"{row:26s} {middle:6.2f} s CPU   {middle / unit:5.2f} x diffrax{wanted}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--row"]:
        print(measure(sys.argv[2]))
    else:
        main(*map(int, sys.argv[1:]))
