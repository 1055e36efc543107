"""Beside what users would take instead: `python tests/benchmarks/peers.py`.

Three impacts of unit masses, contacts of Hertz, e = 1, |v| = 1: c1, three touching balls; c2, five;
c3, two balls and a wall. Of each the error of v+ (largest of 16 impacts with stiffnesses spread
over a factor of 10), the time of one impact alone, in a batch and with its Jacobian: by jimpact, by
solvers of diffrax and scipy on the same equations, by laws without stiffness, and by MuJoCo (if it
is installed), whose contacts are other ones: its error is that of the model. Two minutes.
"""

import functools
import itertools

import numpy as np
from harness import arguments, save_figure, stage

import jimpact as ji
from jimpact.methods.contenders import Contender, Solution
from jimpact.tools.records import Column, Table

SCENES = {
    "c1: three balls": (ji.chain([1.0] * 3), [1.0, 0.0, 0.0]),
    "c2: five balls": (ji.chain([1.0] * 5), [1.0, 0.0, 0.0, 0.0, 0.0]),
    "c3: two balls, wall": (ji.chain([1.0] * 2, wall=True), [1.0, 0.0]),
}
METHODS = ("time", "rk4", "verlet", "dopri8", "tsit5", "scipy_dop853", "scipy_lsoda")
RADIUS = 0.05  # [m] of the balls in MuJoCo
STEP, STEPS = 2e-5, 50_000  # [s] of MuJoCo, and how many at most
STIFF = 1e5  # [N/m] of a contact of stiffness 1 in MuJoCo: some 10 ms for an impact
SPRINGS = "solimp='0.01 0.01 0.001'"  # impedance at which contacts are independent linear springs


@functools.cache
def model_of(balls, wall, options):
    """MuJoCo's balls on a line, with a pair for each contact."""
    import mujoco

    bodies = "".join(
        f"<body pos='{2 * RADIUS * i} 0 0'><joint type='slide' axis='1 0 0'/>"
        f"<geom name='g{i}' type='sphere' size='{RADIUS}' mass='1'/></body>"
        for i in range(balls)
    )
    if wall:
        place = 2 * RADIUS * balls - RADIUS
        bodies += f"<geom name='g{balls}' type='plane' size='1 1 1' pos='{place} 0 0' zaxis='-1 0 0'/>"
    pairs = "".join(
        f"<pair geom1='g{j}' geom2='g{j + 1}' condim='1' {options}/>"
        for j in range(balls - 1 + wall)
    )
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><option timestep='{STEP}' gravity='0 0 0'/><worldbody>{bodies}</worldbody>"
        f"<contact>{pairs}</contact></mujoco>"
    )


def by_mujoco(options, law, scene, velocity, _setting):
    """Impulses of an impact, from the momenta after it."""
    import mujoco

    v, wall = np.asarray(velocity, float), bool(scene.walls[1])
    model = model_of(len(v), wall, options)
    if options == SPRINGS:
        model.pair_solref[:] = np.stack(
            [-STIFF * np.asarray(law.stiffness), 0 * law.stiffness], 1
        )
    state = mujoco.MjData(model)
    state.qvel[:] = v
    for _ in range(STEPS // 10):
        mujoco.mj_step(model, state, nstep=10)
        after = np.append(state.qvel, [0.0] * wall)
        if not state.ncon and (np.diff(after) >= 0).all():
            break
    return Solution(np.cumsum(v - state.qvel)[: scene.contacts])


def contenders():
    """Those of jimpact, and MuJoCo's two sorts of contacts if it is installed."""
    try:
        import mujoco  # noqa: F401
    except ImportError:
        print("skipped: MuJoCo is not installed")
        return list(METHODS)
    sorts = {"mujoco default": "", "mujoco springs": SPRINGS}
    return [
        *METHODS,
        *(
            Contender(
                name,
                functools.partial(by_mujoco, options),
                "step",
                (1.0,),
                divides=False,
                jax=False,
            )
            for name, options in sorts.items()
        ),
    ]


def main():
    options = arguments(__doc__)
    rows, charts = [], {}
    for name, (scene, velocity) in SCENES.items():
        with stage(name):
            charts[name] = ji.work_precision(
                ji.LZB(1.0),
                scene,
                velocity,
                contenders()[:2] if options.quick else contenders(),
                batch=16 if options.quick else 1024,
                repeats=1 if options.quick else 5,
                progress=False,
            )
        rows += [[name, *row] for row in charts[name].table.rows]
        print(name, charts[name], sep="\n")
    columns = [Column("scene"), *next(iter(charts.values())).table.columns]
    table = Table(columns, rows)
    table.to_csv(options.out / "peers.csv")
    save_figure(picture(table.to_dict()), options.out / "peers.png")


def picture(rows):
    """Error of v+ over the time of one impact, a panel for each scene; laws are grey."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        1,
        len(SCENES),
        figsize=(11, 4.6),
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    colours, markers = (
        itertools.cycle(f"C{i}" for i in (0, 1, 2, 3, 4, 5, 6, 8, 9)),
        itertools.cycle("sD^v"),
    )
    styles = {}
    for panel, scene in zip(axes, SCENES):
        for method in dict.fromkeys(row["method"] for row in rows):
            points = [r for r in rows if (r["scene"], r["method"]) == (scene, method)]
            if method not in styles and points[0]["setting"] is None:
                styles[method] = {
                    "color": "0.45",
                    "marker": next(markers),
                    "linestyle": "none",
                }
            elif method not in styles:
                styles[method] = {"color": next(colours), "marker": "o"}
            times = [1e6 * row["alone_s"] for row in points]
            errors = [row["velocity"] for row in points]
            panel.loglog(times, errors, label=method, **styles[method])
        panel.set_title(scene)
        panel.set_xlabel("time of one impact [µs]")
    axes[0].set_ylabel("error of v+")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=7
    )
    return figure


if __name__ == "__main__":
    main()
