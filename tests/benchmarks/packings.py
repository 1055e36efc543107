"""Packings of spheres and scenes from MuJoCo: what an impact or a step costs, beside MuJoCo.

    python tests/benchmarks/packings.py impacts [--counts 10 100 1000 3000] [--names moreau ...]
    python tests/benchmarks/packings.py steps [--counts 100 300 1000 3000]
    python tests/benchmarks/packings.py models

`impacts`: one sphere strikes a packing from outside. Spheres of radius 1/2 on a cubic close-packed
lattice, of which a part is smaller and touches nothing: 2.5 contacts a sphere. Every entry is a
process of its own: the first call (tracing, compiling, running; without a compilation cache), the
median of the calls that follow, and the largest memory of the process. `steps`: the same packings,
and discs, and discs with squares, fall onto a floor. `models`: `from_mujoco` and an impact, first and second call. Times
are processor seconds. MuJoCo's rows: `mj_step` of the same bodies without friction (condim 1), at
its defaults; it is another problem, a step of soft contacts.
"""

import argparse
import json
import resource
import subprocess
import sys
import time

import numpy as np
from harness import show, write_csv

LAWS = ("moreau", "poisson", "lzb", "lzb implicit", "compliant", "mujoco")
TOUCHING = (
    0.72  # part of the spheres that is not smaller: 2.5 contacts a sphere at 1000
)
SMALLER = 0.9
REPEATS = 2
COARSE = 1e-4  # rtol of the steps without events
MODELS = (
    "cradle",
    "box on an edge",
    "biped",
    "arm with a ball",
    "double pendulum (URDF)",
)


def packing(count, seed=0):
    """Centres (k, 3) and radii (k,); the last one strikes from above."""
    cells = np.arange(int(np.ceil((count / 4) ** (1 / 3))))
    corners = np.stack(
        np.meshgrid(cells, cells, cells, indexing="ij"), axis=-1
    ).reshape(-1, 1, 3)
    base = np.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])
    at = np.sqrt(2) * (corners + base).reshape(-1, 3)
    at = at[np.argsort(at[:, 2], kind="stable")][: count - 1]
    radii = np.where(
        np.random.default_rng(seed).random(count - 1) < TOUCHING, 0.5, 0.5 * SMALLER
    )
    middle = at.mean(axis=0)
    # the sphere that is hit: among those that touch others, the one nearest to the middle of the top
    apart = np.linalg.norm(at[:, None] - at[None], axis=2)
    touch = (apart < 1 + 1e-9) & (radii[:, None] + radii[None] > 1 - 1e-9)
    below = (touch & (at[None, :, 2] < at[:, None, 2] - 0.1)).sum(axis=1)
    score = np.linalg.norm((at - middle)[:, :2], axis=1) - at[:, 2] - 0.2 * below
    hit = at[int(np.argmin(np.where(below > 0, score, np.inf)))]
    return np.concatenate([at, hit[None] + [[0, 0, 1.0]]]), np.append(radii, 0.5)


def timed(run):
    """Processor seconds of the first call, of the next ones (median), and the last result."""
    seconds, out = [], None
    for _ in range(1 + REPEATS):
        start = time.process_time()
        out = run()
        seconds.append(time.process_time() - start)
    return seconds[0], float(np.median(seconds[1:])), out


def spheres_in_mujoco(at, radii, dimensions=3, floor=False):
    """Model and data of free spheres, or of discs as spheres that move in a plane."""
    import mujoco

    joints = "<freejoint/>"
    if dimensions == 2:
        joints = "".join(
            f'<joint type="{kind}" axis="{axis}"/>'
            for kind, axis in (
                ("slide", "1 0 0"),
                ("slide", "0 0 1"),
                ("hinge", "0 1 0"),
            )
        )
    bodies = "".join(
        f'<body pos="{x} {y} {z}">{joints}<geom size="{r}" mass="1"/></body>'
        for (x, y, z), r in zip(at, radii)
    )
    ground = '<geom type="plane" size="1 1 1" pos="0 0 -0.5"/>' if floor else ""
    gravity = "0 0 -9.81" if floor else "0 0 0"
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="{gravity}"/><size memory="8G"/>'
        f'<default><geom condim="{3 if floor else 1}" margin="1e-9"/></default>'
        f"<worldbody>{ground}{bodies}</worldbody></mujoco>"
    )
    return model, mujoco.MjData(model)


def impact_in_mujoco(count):
    """A step of MuJoCo in which the packing is struck."""
    import mujoco

    at, radii = packing(count)
    model, data = spheres_in_mujoco(at, radii)

    def run():
        """The first step."""
        mujoco.mj_resetData(model, data)
        data.qvel[-4] = -1.0
        mujoco.mj_step(model, data)
        return data

    first, later, data = timed(run)
    return {
        "contacts": data.ncon,
        "first_s": first,
        "later_s": later,
        "status": "a step",
    }


def impact_of(name, count):
    """The impact of a law on a packing."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jimpact as ji

    force = ji.Bistiffness(1e6, 1.5, 0.9)
    law = {
        "moreau": ji.Moreau(0.5),
        "poisson": ji.Poisson(0.5),
        "lzb": ji.LZB(0.9, 1e6),
        "lzb implicit": ji.LZB(0.9, 1e6, method="implicit", rtol=COARSE),
        "compliant": ji.Compliant(force, method="implicit", rtol=COARSE),
    }[name]
    at, radii = packing(count)
    spheres = ji.Bodies(
        [ji.Sphere(r) for r in radii], (), room=7 * count
    )  # as many have
    scene = spheres.closed_scene(spheres.at(at))
    v = np.zeros(6 * count)
    v[-4] = -1.0
    first, later, out = timed(lambda: jax.block_until_ready(ji.impact(law, scene, v)))
    p = np.asarray(out.impulse)
    return {
        "contacts": scene.contacts,
        "at_work": int((p > 1e-6 * p.max()).sum()),
        "first_s": first,
        "later_s": later,
        "status": ji.STATUS[int(out.status)].name,
        "energy_kept": float(1 + 2 * out.energy_change),
    }


def grid(count, dimensions):
    """Centres (k, 3) of a loose grid above a floor, in the plane y = 0 or in space."""
    side = int(np.ceil(count ** (1 / dimensions)))
    axes = np.meshgrid(*[np.arange(side)] * dimensions, indexing="ij")
    at = 1.05 * np.stack(axes, axis=-1).reshape(-1, dimensions)[:count]
    at = at + 0.01 * np.random.default_rng(0).random(at.shape)
    return at if dimensions == 3 else np.insert(at, 1, 0.0, axis=1)


def steps_of(dimensions, count, steps=100, step=1e-3, mixed=False):
    """Steps of time of bodies that fall; `mixed`: every second disc is a square in its circle."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jimpact as ji

    at = grid(count, dimensions)
    kind, floor = (
        (ji.Sphere, [0, 0, 1.0, -0.5]) if dimensions == 3 else (ji.Disc, [0, 1.0, -0.5])
    )
    shapes = (
        [ji.Disc(0.5), ji.Block(np.sqrt(0.5), np.sqrt(0.5))] if mixed else [kind(0.5)]
    )
    body = ji.Bodies(
        [shapes[i % len(shapes)] for i in range(count)],
        [floor],
        room=(4, 7)[dimensions - 2] * count,
    )
    system = ji.System(body, gravity=9.81)
    law, start = (
        ji.Moreau(0.3, friction=0.5),
        body.at(at[:, :3] if dimensions == 3 else at[:, ::2]),
    )

    def run():
        """A fall."""
        still = np.zeros(body.mass.shape)
        options = dict(samples=2, method="time_stepping", step=step)
        return jax.block_until_ready(
            ji.simulate(system, law, start, still, steps * step, **options)
        )

    first, later, motion = timed(run)
    return {
        "first_s": first,
        "later_s": later / steps,
        "status": ji.STATUS[int(motion.status)].name,
        "lowest": float(
            np.asarray(motion.q[-1]).reshape(count, -1)[:, dimensions - 1].min()
        ),
    }


def steps_in_mujoco(dimensions, count, steps=100, step=1e-3):
    """The same in MuJoCo."""
    import mujoco

    at = grid(count, dimensions)
    model, data = spheres_in_mujoco(at, 0.5 * np.ones(count), dimensions, floor=True)
    model.opt.timestep = step

    def run():
        """A fall."""
        mujoco.mj_resetData(model, data)
        for _ in range(steps):
            mujoco.mj_step(model, data)
        return data

    first, later, data = timed(run)
    lowest = data.xpos[1:, 2].min()
    return {
        "first_s": first,
        "later_s": later / steps,
        "status": "",
        "lowest": float(lowest),
    }


FLOOR = '<geom name="floor" type="plane" size="9 9 1" friction=".5"/>'
BALL = '<body pos="{} 0 0"><joint type="slide" axis="1 0 0"/><geom size=".05" mass="1"/></body>'
LEG = """<body pos="0 {} -.1"><joint axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .1 0 -.4" size=".06" mass="7"/>
  <body pos=".1 0 -.4"><joint axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 -.1 0 -.4" size=".05" mass="3"/>
    <body pos="-.1 0 -.4"><joint axis="0 1 0"/>
      <geom type="box" pos=".05 0 -.06" size=".12 .05 .02" mass="1"/></body></body></body>"""
ARM = """<body pos="0 0 1"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".04"/>
  <body pos=".5 0 0"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".04"/>
  </body></body><body pos=".7 0 1.09"><freejoint/><geom size=".05" mass=".3"/></body>"""
URDF = """<robot name="pendulum"><link name="base"/>{}</robot>"""
LINK = """<link name="{0}"><inertial><origin xyz="0 0 -.25"/><mass value="1"/>
  <inertia ixx=".02" iyy=".02" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 0 -.45"/><geometry><sphere radius=".05"/></geometry></collision></link>
  <joint name="{0} joint" type="continuous"><parent link="{1}"/><child link="{0}"/>
  <origin xyz="{2}"/><axis xyz="0 1 0"/></joint>"""


def model_of(name):
    """Model and data of one of MODELS, and the part of qvel that moves at first."""
    import mujoco

    text, moving = {
        "cradle": (
            "".join(BALL.format(0.1 * i) for i in range(5)).replace(
                'mass="1"', 'mass="1" condim="1"'
            ),
            {0: 1.0},
        ),
        "box on an edge": (
            f'{FLOOR}<body pos="0 0 .1414213562373095" euler="45 0 0"><freejoint/>'
            '<geom type="box" size=".1 .1 .1" mass="1"/></body>',
            {0: 0.5, 2: -1.0},
        ),
        "biped": (
            f'{FLOOR}<body pos="0 0 .98"><freejoint/><geom type="box" pos="0 0 .2" '
            f'size=".1 .15 .25" mass="35"/>{LEG.format(0.12)}{LEG.format(-0.12)}</body>',
            {2: -1.0},
        ),
        "arm with a ball": (ARM, {4: -1.0}),
        "double pendulum (URDF)": ("", {0: 1.0, 2: -1.0}),
    }[name]
    xml = f"<mujoco><worldbody>{text}</worldbody></mujoco>"
    if not text:  # two pendulums side by side whose ends touch
        links = LINK.format("left", "base", "0 0 0") + LINK.format(
            "lower", "left", "0 0 -.6"
        )
        xml = URDF.format(links + LINK.format("right", "base", ".1 0 0"))
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    for coordinate, speed in moving.items():
        data.qvel[coordinate] = speed
    return model, data


def model_row(name, _count):
    """`from_mujoco` and an impact of LZB on what it finds."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jimpact as ji

    model, data = model_of(name)
    loading = timed(lambda: ji.from_mujoco(model, data, margin=1e-4))
    world = loading[2]
    friction = world.friction
    law = ji.LZB(0.5, 1e6, friction=friction)
    moreau = ji.Moreau(0.5, friction=friction)
    velocity = world.velocity
    impact = timed(lambda: jax.block_until_ready(ji.impact(law, world.scene, velocity)))
    quick = timed(
        lambda: jax.block_until_ready(ji.impact(moreau, world.scene, velocity))
    )
    return {
        "velocities": world.scene.size,
        "contacts": world.scene.contacts,
        "scene_first_s": loading[0],
        "scene_later_s": loading[1],
        "lzb_first_s": impact[0],
        "lzb_later_s": impact[1],
        "moreau_first_s": quick[0],
        "moreau_later_s": quick[1],
        "status": f"{ji.STATUS[int(impact[2].status)].name}, {ji.STATUS[int(quick[2].status)].name}",
    }


ENTRIES = {
    "impacts": lambda name, count: (
        impact_in_mujoco(count) if name == "mujoco" else impact_of(name, count)
    ),
    "steps": lambda name, count: {
        "discs": lambda: steps_of(2, count),
        "discs and squares": lambda: steps_of(2, count, mixed=True),
        "spheres": lambda: steps_of(3, count),
        "discs, MuJoCo": lambda: steps_in_mujoco(2, count),
        "spheres, MuJoCo": lambda: steps_in_mujoco(3, count),
    }[name](),
    "models": model_row,
}
NAMES = {
    "impacts": LAWS,
    "steps": (
        "discs",
        "discs, MuJoCo",
        "discs and squares",
        "spheres",
        "spheres, MuJoCo",
    ),
    "models": MODELS,
}


def main():
    """The table of one kind; `--entry` runs one of its processes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=ENTRIES)
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 100, 1000, 3000])
    parser.add_argument("--names", nargs="+", default=None)
    parser.add_argument(
        "--limit", type=float, default=600.0, help="seconds of one entry"
    )
    parser.add_argument("--entry", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    names = options.names or NAMES[options.kind]
    if options.entry:
        row = ENTRIES[options.kind](names[0], options.counts[0])
        row["memory_MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        print(json.dumps(row))
        return
    rows = []
    for name in names:
        for count in options.counts if options.kind != "models" else [0]:
            command = [
                sys.executable,
                __file__,
                options.kind,
                "--entry",
                "--names",
                name,
            ]
            command += ["--counts", str(count)]
            row = {"name": name} | ({"count": count} if count else {})
            try:
                done = subprocess.run(
                    command, capture_output=True, text=True, timeout=options.limit
                )
                row |= json.loads(done.stdout.splitlines()[-1]) if done.stdout else {}
                if done.returncode:
                    row["status"] = done.stderr.splitlines()[-1]
            except subprocess.TimeoutExpired:
                row["status"] = f"more than {options.limit:g} s"
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
    show(options.kind, rows, list(dict.fromkeys(key for row in rows for key in row)))
    from harness import RESULTS

    write_csv(RESULTS / f"packings_{options.kind}.csv", rows)


if __name__ == "__main__":
    main()
