"""Friction in space: what the first call costs and what follows; and how thousands of impacts end.

    python tests/benchmarks/space.py [--scenes ...] [--methods ...] [--tasks ...]
    python tests/benchmarks/space.py --impacts 10000 [--kinds ...] [--methods ...]
    python tests/benchmarks/space.py --agreement [--methods ...]

Every entry of the first table is a process of its own, without a compilation cache, that may use
LIMIT seconds of the processor: tracing and compiling, without imports and JAX's own start. Ratios
are to one impact of three balls by diffrax, measured in the same run (see first_call.py). "then":
the median of calls that follow, processor time. e = .3, mu = .3, Hertz contacts.

`--impacts N` solves N random boxes and the measured cube's impacts at mu = .16, .3 and .6, each
alone (for its time) and in batches of BATCH: statuses, failures, the slowest, and Moreau's batch.

`--agreement`: v+ and its slopes in mu, e and ln k_1 beside an independent integration and its
differences, which `tests/held/friction_space.npz` holds (see space_reference.py): median and worst.
"""

import json
import os
import resource
import signal
import statistics
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import first_call
import numpy as np
from harness import arguments, show, write_csv

sys.path.insert(0, str(Path(__file__).parents[1] / "bodies"))
import spatial_scenes

E, MU = 0.3, 0.3
LIMIT = 100.0  # processor seconds of an entry
WALL = 20.0  # an entry may take this many times as long by the wall clock
IMPACT_LIMIT = 60  # processor seconds of one impact
RESTARTS = 3  # of a family of impacts, after one that did not end
BATCH, REPEATS, LEAST = 256, 7, 0.2  # impacts; calls, and seconds of them, for a median
METHODS = ("exact", "implicit", "moreau")
TASKS = ("value", "jacobian", "second", "gradient")
WANTED = {
    "value": 4.0,
    "jacobian": 8.0,
    "second": 20.0,
}  # first calls, in units of diffrax
ROBUST = 1.5  # first value of the implicit method
SCENES = (*spatial_scenes.NAMED, "plane, 2 contacts")
CUBES = {"cube corner": 1, "cube edge": 2, "cube flat": 4}
HELD = Path(__file__).parent.parent / "held" / "friction_space.npz"
SHARP = 1e-3  # slopes are compared where lower differences agree to this: no kink in between
KINDS = (*spatial_scenes.KINDS, *CUBES)


def laws(method):
    """(e, mu, and for LZB other arguments) -> law; None where the package has no such method."""
    import jimpact as ji
    from jimpact.events.impact_dynamics import METHODS as known

    if method == "moreau":
        return lambda e, mu: ji.Moreau(e, friction=mu)
    if method == "implicit":
        if "implicit" not in known:
            return None
        return lambda e, mu, **x: ji.LZB(e, friction=mu, method="implicit", **x)
    return lambda e, mu, **x: ji.LZB(e, friction=mu, method="time", **x)


# ------------------------------------------------------------------------------- the table


def scene_of(name):
    """Scene and v- of a row."""
    import jimpact as ji

    if name == "plane, 2 contacts":
        return ji.Block(1.0, 2.0, corners="base").scene(), np.array([1.0, -1.0, 0.1])
    mass, normals, tangents, velocity = spatial_scenes.NAMED[name]()
    return ji.Scene(mass, normals, tangents=tangents), velocity


def task_of(task, after):
    """The function of mu that an entry calls."""
    import jax

    total = lambda mu: after(mu)[0].sum()  # noqa: E731
    return {
        "value": lambda mu: after(mu),
        "jacobian": lambda mu: jax.jacfwd(after, has_aux=True)(mu),
        "gradient": lambda mu: (jax.grad(total)(mu), after(mu)[1]),
        "second": lambda mu: (jax.jacfwd(jax.grad(total))(mu), after(mu)[1]),
    }[task]


def measure(method, name, task):
    """First call [s], those that follow [s], and the status; of a process of its own."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    import jimpact as ji

    law, (scene, velocity) = laws(method), scene_of(name)
    jnp.linalg.solve(jnp.eye(2), jnp.ones(2)).block_until_ready()

    def after(mu):
        out = ji.impact(law(E, mu), scene, velocity)
        return out.velocity, out.status

    # what a user calls is not in a `jit` of his own; derivatives are
    run = task_of(task, after) if task == "value" else jax.jit(task_of(task, after))
    begun = first_call.cpu()
    _, status = jax.block_until_ready(run(MU))
    first, times = first_call.cpu() - begun, []
    while len(times) < REPEATS or (sum(times) < LEAST and len(times) < 100):
        begun = first_call.cpu()
        jax.block_until_ready(run(MU))
        times.append(first_call.cpu() - begun)
    return {
        "first_s": first,
        "then_ms": 1e3 * statistics.median(times),
        "status": ji.STATUS[int(status)].name,
    }


def limited():
    """In the child: the processor time it may use, twice the limit for imports and repeats."""
    most = int(2 * LIMIT)
    resource.setrlimit(resource.RLIMIT_CPU, (most, most))


def without_cache():
    """The environment of a process that compiles everything itself."""
    return {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}


def entry(*row):
    """What a child prints of a row; `status` says why nothing came."""
    command = [sys.executable, __file__, "--row", *row]
    options = {
        "capture_output": True,
        "text": True,
        "env": without_cache(),
        "preexec_fn": limited,
    }
    try:
        done = subprocess.run(command, timeout=WALL * LIMIT, **options)
    except subprocess.TimeoutExpired:
        return {"status": "none by the wall clock"}
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return {"status": f"none in {2 * LIMIT:.0f} s"}
    if done.returncode != 0:
        return {"status": done.stderr.strip().splitlines()[-1][:60]}
    found = json.loads(done.stdout.splitlines()[-1])
    if "very slow compile" in done.stderr.lower():
        found["status"] += ", slow-compile alarm"
    return found


def first_calls(options):
    """The table of first calls."""
    units, rows = [], []
    for name in options.scenes:
        for method in (m for m in options.methods if laws(m) is not None):
            for task in options.tasks:
                units.append(entry("diffrax")["first_s"])
                unit = statistics.median(units)
                found = entry(method, name, task)
                row = {"scene": name, "method": method, "task": task} | found
                row["diffrax_s"] = unit
                if "first_s" in found:
                    row["ratio"] = found["first_s"] / unit
                robust = method == "implicit" and task == "value"
                row["wanted"] = ROBUST if robust else WANTED.get(task)
                rows.append(row)
                print(row, file=sys.stderr, flush=True)
    keys = (
        "scene",
        "method",
        "task",
        "first_s",
        "ratio",
        "wanted",
        "then_ms",
        "status",
    )
    show("First call in a fresh process [CPU s], ratio to diffrax; then", rows, keys)
    write_csv(options.out / "space.csv", rows)


# ------------------------------------------------------------------------- many impacts


def draw_of(kind, count):
    """A `Draw` of `count` random boxes, or of all of the cube's impacts."""
    if kind not in CUBES:
        return spatial_scenes.random_boxes(kind, count)
    import jimpact as ji

    shots = ji.data.cube_impacts(CUBES[kind])
    each = [i for i in range(len(shots.pre)) for _ in spatial_scenes.CUBE_MU]
    mu = np.tile(spatial_scenes.CUBE_MU, len(shots.pre))[:count]
    each = each[:count]
    scenes = [shots.scenes[i] for i in each]
    mass = [np.diag(s.mass) if s.mass.ndim == 1 else s.mass for s in scenes]
    parts = (mass, [s.normals for s in scenes], [s.tangents for s in scenes])
    velocity = np.asarray(shots.pre)[each]
    return spatial_scenes.Draw(
        *map(np.stack, parts), velocity, np.full(len(mu), 0.27), mu
    )


def program_of(method):
    """(mass, normals, tangents, v-, e, mu) -> status."""
    import jimpact as ji

    law = laws(method)

    def one(mass, normals, tangents, velocity, e, mu):
        scene = ji.Scene(mass, normals, tangents=tangents)
        return ji.impact(law(e, mu), scene, velocity).status

    return one


def solve_each(method, kind, count, start):
    """In a child: a line `index status seconds` for each impact, alone."""
    import jax

    jax.config.update("jax_enable_x64", True)
    run, draw = jax.jit(program_of(method)), draw_of(kind, int(count))
    run(*(x[0] for x in draw)).block_until_ready()
    for i in range(int(start), len(draw.friction)):
        signal.setitimer(signal.ITIMER_PROF, IMPACT_LIMIT)  # ends the process
        begun = time.process_time()
        status = int(run(*(x[i] for x in draw)))
        print(i, status, time.process_time() - begun, flush=True)


def solve_batches(method, kind, count):
    """In a child: seconds an impact, the mean and the worst of the batches after the first."""
    import jax

    jax.config.update("jax_enable_x64", True)
    run, draw = jax.jit(jax.vmap(program_of(method))), draw_of(kind, int(count))
    seconds = []
    for begin in [0, *range(0, len(draw.friction), BATCH)]:
        at = np.arange(begin, begin + BATCH) % len(draw.friction)
        given, begun = [x[at] for x in draw], time.process_time()
        run(*given).block_until_ready()
        seconds.append(time.process_time() - begun)
    print(np.mean(seconds[1:]) / BATCH, np.max(seconds[1:]) / BATCH)


def child(*arguments, seconds=None):
    """Lines that a process with a limit has printed before it ended."""
    command = [sys.executable, __file__, *arguments]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    process = subprocess.Popen(command, **options)
    try:
        said, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        said, _ = process.communicate()
    return said.splitlines()


def alone(method, kind, count):
    """Status (-1: none) and seconds of each impact that was tried."""
    status, seconds = {}, {}
    for _ in range(1 + RESTARTS):
        for line in child("--each", method, kind, str(count), str(len(status))):
            i, code, taken = line.split()
            status[int(i)], seconds[int(i)] = int(code), float(taken)
        if len(status) == count:
            break
        stuck = len(status)  # the process has ended in this one
        status[stuck], seconds[stuck] = -1, float(IMPACT_LIMIT)
    return np.array(list(status.values())), np.array(list(seconds.values()))


def share(kind, count):
    """Impacts of a kind: an equal part of the boxes, three of each shot of the cube."""
    cubes = {"cube corner": 1131, "cube edge": 63, "cube flat": 6}
    each = -(-count // len(spatial_scenes.KINDS))
    return min(cubes[kind], count) if kind in cubes else each


def impact_row(method, kind, count):
    """One row: how the impacts of a kind end, and what they cost."""
    from jimpact.tools.status import STATUS

    status, seconds = alone(method, kind, count)
    mu = draw_of(kind, count).friction[: len(status)]
    failed = np.array([s < 0 or STATUS[s].failure for s in status])
    names = Counter("none" if s < 0 else STATUS[s].name for s in status)
    batch = child(
        "--batch", method, kind, str(min(count, 4 * BATCH)), seconds=WALL * LIMIT
    )
    mean, worst = map(float, batch[-1].split()) if batch else (np.nan, np.nan)
    return {
        "kind": kind,
        "method": method,
        "impacts": len(status),
        "failed": int(failed[mu <= 1].sum()),
        "failed_beyond_mu_1": int(failed[mu > 1].sum()),
        "median_ms": 1e3 * float(np.median(seconds)),
        "slowest_ms": 1e3 * float(seconds.max()),
        "batch_ms": 1e3 * mean,
        "worst_batch_ms": 1e3 * worst,
        "statuses": ", ".join(f"{name} {n}" for name, n in names.most_common()),
    }


def many_impacts(options):
    """The table of statuses."""
    rows = []
    for kind in options.kinds:
        for method in (m for m in options.methods if laws(m) is not None):
            rows.append(impact_row(method, kind, share(kind, options.impacts)))
            print(rows[-1], file=sys.stderr, flush=True)
    keys = ("kind", "method", "impacts", "failed", "failed_beyond_mu_1", "median_ms")
    keys = (*keys, "slowest_ms", "batch_ms", "worst_batch_ms", "statuses")
    show("Impacts alone and in batches [CPU ms each]", rows, keys)
    write_csv(options.out / "space_impacts.csv", rows)


# ---------------------------------------------------------------------------- agreement


def agree(method, contacts):
    """In a child: errors of v+ and of its slopes where impacts end, and the statuses."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    import jimpact as ji

    with np.load(HELD) as file:
        held = {name[:-2]: file[name] for name in file if name.endswith(f"_{contacts}")}
    law = laws(method)

    def one(mass, normals, tangents, velocity, e, mu, k):
        scene = ji.Scene(mass, normals, tangents=tangents)

        def after(change):
            factor = jnp.ones_like(k).at[0].set(jnp.exp(change[2]))
            out = ji.impact(
                law(e + change[1], mu + change[0], stiffness=k * factor),
                scene,
                velocity,
            )
            return out.velocity, (out.velocity, out.status)

        slopes, (v, status) = jax.jacfwd(after, has_aux=True)(jnp.zeros(3))
        return v, slopes.T, status

    v, slopes, status = jax.jit(jax.vmap(one))(
        *(held[name] for name in spatial_scenes.INPUTS)
    )
    ends = ~np.array([ji.STATUS[int(s)].failure for s in status])
    error = np.abs(v - held["after"]).max(axis=1)[ends]
    wrong = np.abs(slopes - held["slopes"]).max(axis=2)
    names = Counter(ji.STATUS[int(s)].name for s in status)
    known = (np.nan_to_num(held["slope_uncertainty"], nan=np.inf) < SHARP) & ends[
        :, None
    ]
    row = {"impacts": len(status), "error": np.median(error), "worst": error.max()}
    for i, name in enumerate(("mu", "e", "k")):
        at = wrong[known[:, i], i]
        row[f"slope_{name}"] = np.median(at) if len(at) else np.nan
        row[f"worst_{name}"] = at.max(initial=0.0) if len(at) else np.nan
    row = {name: float(x) for name, x in row.items()}
    return row | {"statuses": ", ".join(f"{name} {n}" for name, n in names.items())}


def agreement(options):
    """The table of errors."""
    rows = []
    for contacts in ("1", "2", "4"):
        for method in (
            m for m in options.methods if m != "moreau" and laws(m) is not None
        ):
            said = child("--agree", method, contacts, seconds=WALL * LIMIT)
            found = json.loads(said[-1]) if said else {"statuses": "none"}
            rows.append({"contacts": contacts, "method": method} | found)
            print(rows[-1], file=sys.stderr, flush=True)
    keys = (
        "contacts",
        "method",
        "impacts",
        "error",
        "worst",
        "slope_mu",
        "worst_mu",
        "slope_e",
    )
    keys = (*keys, "worst_e", "slope_k", "worst_k", "statuses")
    show("Difference from an independent integration", rows, keys)
    write_csv(options.out / "space_agreement.csv", rows)


def add_options(parser):
    """The choices of the tables."""
    parser.add_argument("--agreement", action="store_true", help="the table of errors")
    parser.add_argument(
        "--impacts", type=int, default=0, help="so many impacts, not the table"
    )
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS[:2])


def main():
    """One of the tables."""
    options = arguments(__doc__, add_options)
    if options.quick:
        options.scenes, options.kinds = options.scenes[:1], options.kinds[:1]
        options.impacts = min(options.impacts, 16)
    if options.agreement:
        agreement(options)
    else:
        (many_impacts if options.impacts else first_calls)(options)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--row"]:
        row = sys.argv[2:]
        found = (
            {"first_s": first_call.measure("diffrax")}
            if row == ["diffrax"]
            else measure(*row)
        )
        print(json.dumps(found))
    elif sys.argv[1:2] == ["--each"]:
        solve_each(*sys.argv[2:])
    elif sys.argv[1:2] == ["--agree"]:
        print(json.dumps(agree(*sys.argv[2:])))
    elif sys.argv[1:2] == ["--batch"]:
        solve_batches(*sys.argv[2:])
    else:
        main()
