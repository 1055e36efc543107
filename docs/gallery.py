"""The pictures of the docs, each a function: `python docs/gallery.py [NAME ...]` draws
them anew.

Run by hand, from a clone; `chart_three_balls` takes minutes. A docstring is the
caption.
"""

import subprocess
import sys
import textwrap
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jimpact as ji
from jimpact.plot.style import (
    COLOURS,
    GREY,
    SMALL,
    legend_below,
    logarithmic,
    new_figure,
    styled,
)

PICTURES = Path(__file__).parent / "pictures"
DRAWN: dict[str, Callable] = {}
CRADLE = ji.chain([1.0, 1.0, 1.0])
STRIKER = jnp.array([1.0, 0.0, 0.0])  # one ball strikes two that touch [m/s]


def picture(function: Callable) -> Callable:
    """Enter a function that returns a figure, or writes the file it is given."""
    DRAWN[function.__name__] = function
    return function


@styled()
def three_balls(
    make: Callable,
    values: np.ndarray,
    label: str,
    log: bool = False,
    shares: bool = False,
) -> Figure:
    """Velocities of three equal balls in a row after the first struck, against a
    parameter.

    `make` takes the parameter, and returns the law, or law, scene and velocity. Grey:
    the status is a failure. `shares`: velocities over the striker's.
    """

    def outcome(x):
        made = make(x)
        if not isinstance(made, tuple):
            made = (made, CRADLE, STRIKER)
        out = ji.impact(*made)
        return out.velocity / (made[2][0] if shares else 1.0), out.status

    velocity, status = jax.jit(jax.vmap(outcome))(jnp.asarray(values))
    failed = np.array([ji.STATUS[int(code)].failure for code in status])
    figure, axes = new_figure(3.4)
    for i in range(3):
        # where they coincide
        style = {"color": COLOURS[i], "lw": 2, "ls": "--" if i == 2 else "-"}
        axes.plot(values, velocity[:, i], label=f"ball {i + 1}", **style)
    if failed.any():
        across = axes.get_xaxis_transform()
        names = dict.fromkeys(ji.STATUS[int(code)].name for code in status[failed])
        why = f"flagged: {', '.join(names).replace('_', ' ')}"
        grey = {"color": "#dddddd", "lw": 0, "label": why}
        axes.fill_between(values, 0, 1, where=failed, transform=across, **grey)
    axes.axhline(0, color="black", lw=0.6)
    axes.set_xlim(values[0], values[-1])
    axes.set_xlabel(label)
    axes.set_ylabel("velocity after / before" if shares else "velocity after [m/s]")
    if log:
        logarithmic(axes, "x")
    legend_below(figure, 4)
    return figure


# ------------------------------------------------------------------------------- one
# for each law


@picture
def law_lzb():
    """Three touching Hertz balls, e = 0.9: the stiffness ratio decides which one moves
    on.
    """
    return three_balls(
        lambda ratio: ji.LZB(0.9, jnp.stack([1.0, ratio])),
        np.geomspace(0.1, 10, 121),
        "stiffness ratio k2/k1",
        log=True,
    )


def running(law: ji.Law) -> Figure:
    """Ball 1 strikes with 1 m/s while ball 3 approaches (< 0) or runs away (> 0)."""
    return three_balls(
        lambda v: (law, CRADLE, jnp.stack([1.0, 0.0, v])),
        np.linspace(-1, 1, 101),
        "velocity of ball 3 before [m/s]",
    )


@picture
def law_newton():
    """Newton's law, e = 0.5: where ball 3 runs away (> 0), it is pulled back, and
    flagged.
    """
    return running(ji.Newton(0.5))


@picture
def law_moreau():
    """Moreau's law, e = 0.5: Newton's, until contact 2 would pull; then it takes no
    impulse.
    """
    return running(ji.Moreau(0.5))


@picture
def law_poisson():
    """Poisson's law, e1 = 0.4: only e2 > e1 parts the two targets."""
    return three_balls(
        lambda e: ji.Poisson(jnp.stack([0.4, e])),
        np.linspace(0, 1, 101),
        "restitution e2",
    )


@picture
def law_binary():
    """Pair collisions: for small e the targets are struck again and again, and move
    together.
    """
    return three_balls(ji.Binary, np.linspace(0, 1, 201), "restitution e")


@picture
def law_routh():
    """Routh's increments, e = 0.5: where ball 3 runs away (> 0), contact 2 is left
    approaching.
    """
    return running(ji.Routh(0.5))


@picture
def law_impulse_correlation():
    """Impulse correlation, e = 1: the ratio runs through all outcomes that conserve
    energy.
    """
    return three_balls(
        lambda ratio: ji.ImpulseCorrelation(1.0, ratio),
        np.linspace(0.5, 1, 101),
        "impulse correlation ratio of contact 2",
    )


@picture
def law_restitution_matrix():
    """A matrix with e = 0.5 on its diagonal: the entry E21 shares out the velocity."""
    return three_balls(
        lambda x: ji.RestitutionMatrix(
            jnp.array([[0.5, 0.0], [0.0, 0.5]]).at[1, 0].set(x)
        ),
        np.linspace(-1, 2, 151),
        "matrix entry E21",
    )


@picture
def law_compliant():
    """A heavy ball, struck from both sides: a gap of a tenth of its scale is as good as
    closed.
    """
    law = ji.Compliant(ji.Hertz(1e9))
    before = jnp.array([1.0, 0.0, -1.0])
    masses = [0.25, 1.0, 0.25]
    scale = ji.theory.gap_scale(ji.chain(masses), law, before).delta[1]
    return three_balls(
        lambda gap: (law, ji.chain(masses, gaps=jnp.stack([0.0, gap * scale])), before),
        np.geomspace(0.01, 10, 121),
        "gap 2 / gap scale",
        log=True,
    )


@picture
def law_velocity_dependent():
    """LZB with an e that falls with the speed: slow shots lose nothing, fast ones
    much.
    """
    law = ji.VelocityDependent(ji.LZB(0.8), speed_exponent=0.25, yield_speed=0.05)
    return three_balls(
        lambda speed: (law, CRADLE, speed * STRIKER),
        np.geomspace(0.01, 100, 121),
        "velocity of the striker before [m/s]",
        log=True,
        shares=True,
    )


# -------------------------------------------------------------------------------------
# and others


@picture
def compare_three_balls(path):
    """All laws with one coefficient of restitution on a measured shot of three
    balls.
    """
    subprocess.run(["jimpact", "compare", "--out", str(path)], check=True)


@picture
def force_histories():
    """The force between the last two of five touching balls, three restitutions of
    LZB.
    """
    # steel balls of one inch
    balls = ji.chain([0.0667] * 5)
    k = 1.2e10
    rows = {
        f"e = {e}": ji.history(ji.LZB(e, k), balls, [1.0, 0, 0, 0, 0])
        for e in (1.0, 0.9, 0.7)
    }
    return ji.plot.forces(rows)


@picture
def impact_history():
    """Inside an impact by LZB: forces, gap velocities and stored energy of three steel
    balls.
    """
    law = ji.LZB(0.9, 1.2e10)
    return ji.plot.history(ji.history(law, ji.chain([0.0667] * 3), STRIKER))


@picture
def unseen_combination():
    """One shot of three balls tells of restitution and stiffness ratio a region, not a
    point.
    """
    shots = ji.Experiments(pre=[STRIKER], post=[[-0.07, 0.14, 0.93]], sigma=0.02)
    fit = ji.fit(ji.LZB(0.95, [1.0, 1.0]), CRADLE, shots)
    return ji.plot.contour(ji.contour(fit, "restitution", "stiffness[2]"))


@picture
def outcomes_and_laws():
    """Outcomes that mechanics allows for three balls, and where laws put theirs."""
    laws = {"Newton": ji.Newton(0.9), "Binary": ji.Binary(0.9), "LZB": ji.LZB(0.9)}
    marked = {
        name: ji.impact(law, CRADLE, STRIKER).velocity for name, law in laws.items()
    }
    return ji.plot.admissible_set(ji.theory.admissible_set(CRADLE, STRIKER), marked)


@picture
def gaps_decide():
    """Three steel balls, the outer ones strike: gaps of up to 0.1 mm decide the
    outcome.
    """
    law = ji.Compliant(ji.Hertz(1.06e10))
    balls = ji.chain([0.0167, 0.0669, 0.0167])
    before = [1.0, 0.0, -1.0]
    gaps = ji.Uniform(0.0, 100e-6)
    result = ji.monte_carlo(law, balls, before, gaps=gaps, samples=20_000)
    return ji.plot.monte_carlo(
        result, "Two balls strike a third one at 1 m/s, from both sides"
    )


@picture
def motion_cradle():
    """Newton's cradle with three balls: angles, velocities, gaps and the energy
    ledger.
    """
    system = ji.System(ji.PendulumCradle([0.1, 0.1, 0.1], 0.15, 0.0125), gravity=True)
    motion = ji.simulate(system, ji.LZB(0.95), [-0.5, 0, 0], [0.0, 0.0, 0.0], 8.0)
    return ji.plot.motion(motion, system=system)


@picture
def rocking_dispersion():
    """A rocking block: how much of the impact reaches the far corner, against the
    kinetic angle.
    """
    mu = [0.0, 0.1, 0.3, 0.8]
    e = [0.1, 0.3, 0.5, 0.7, 0.9, 1.0]
    found = ji.theory.rocking_dispersion(np.linspace(0.35, 4.5, 60), mu, e)
    return ji.plot.rocking_dispersion(found)


@picture
def chart_three_balls(path):
    """Error against time and work: ways to integrate one impact of three balls."""
    subprocess.run(["jimpact", "chart", "--full", "--out", str(path)], check=True)


def chart_of_a_box(contacts: int, turned: list[float], title: str) -> Figure:
    """Error against time and work for a box that falls on its `contacts` lowest
    corners.
    """
    box = ji.Box([0.6, 0.4, 0.3])
    scene = box.scene(box.touching(np.array(turned) / np.linalg.norm(turned)))
    at = np.sort(np.argsort(scene.gaps)[:contacts])
    tangents = scene.tangents.reshape(6, 8, 2)[:, at].reshape(6, -1)
    closed = ji.Scene(scene.mass, scene.normals[:, at], tangents=tangents)
    velocity = [1.0, 0.3, -1.0, 0.5, -0.4, 0.2]
    mu = 0.3
    result = ji.work_precision(
        ji.LZB(0.3, friction=mu),
        closed,
        velocity,
        laws={"moreau": ji.Moreau(0.3, friction=mu)},
        batch=64,
        repeats=3,
        gradients=False,
        durations=False,
    )
    print(result)
    return ji.plot.work_precision(result, title)


@picture
def chart_box_corner():
    """Error against time and work: a box with friction that falls on a corner."""
    return chart_of_a_box(
        1, [0.9, 0.3, 0.2, 0.1], "A box on a corner, e = 0.3, mu = 0.3"
    )


@picture
def chart_box_edge():
    """Error against time and work: a box with friction that falls on an edge."""
    return chart_of_a_box(
        2, [0.95, 0.3, 0.0, 0.0], "A box on an edge, e = 0.3, mu = 0.3"
    )


@picture
def chart_box_flat():
    """Error against time and work: a box with friction that falls flat on four
    corners.
    """
    return chart_of_a_box(
        4, [1.0, 0.0, 0.0, 0.0], "A box flat on four corners, e = 0.3, mu = 0.3"
    )


@picture
def stability(path):
    """Where methods of integration fail, one axis of the map at a time."""
    subprocess.run(["jimpact", "stability", "--out", str(path)], check=True)


@picture
def force_chains():
    """Impulses in a packing of 290 discs, some of which are smaller, that another disc
    strikes.
    """
    rows = 17
    radius = 0.5
    at = [(i + j % 2 / 2, j * np.sqrt(0.75)) for j in range(rows) for i in range(rows)]
    small = np.random.default_rng(1).random(len(at)) < 0.2
    at = np.array([*at, (rows // 2, rows * np.sqrt(0.75))]) + np.array([0, radius])
    at[-1, 0] += (rows % 2) / 2
    radii = np.append(np.where(small, 0.9 * radius, radius), radius)
    discs = ji.Bodies([ji.Disc(r) for r in radii])
    q = discs.at(at)
    packing = discs.closed_scene(q)
    velocity = np.zeros(packing.size)
    velocity[-2] = -1.0
    law = ji.LZB(0.9, method="implicit")
    out = ji.raise_on_failure(ji.impact(law, packing, velocity))
    title = (
        f"{discs.count} discs, {packing.contacts} contacts: impulses of an impact "
        f"from above (LZB)"
    )
    return ji.plot.force_chains(discs, q, packing, out.impulse, title)


@picture
@styled()
def drops():
    """Drops of a square: median error of the predicted angle after a hit, from two
    flights.
    """
    with np.load(Path(__file__).parents[1] / "tests" / "held" / "drops.npz") as stored:
        curves = {name: stored[name] for name in stored.files}
    figure, panels = new_figure(3.0, "", 1, 2, sharey=True)
    for axes, kind in zip(panels, ("first flight", "flight after an impact")):
        for colour, name in zip(COLOURS, ("jimpact", "MuJoCo")):
            error = curves[f"{kind}, {name}"]
            axes.plot(4 * np.arange(len(error)), error, color=colour, lw=2, label=name)
        axes.set_title(f"from the {kind}")
        axes.set_xlabel("time after the hit [ms]")
    figure.axes[0].set_ylabel("error of the angle [deg]")
    legend_below(figure, 2)
    return figure


# An engine of each group -> where its label stands (energy ratio, dispersion), what it
# begins with
ENGINE_LABELS = {
    ("siconos", "MoreauJeanOSI, step 10 ms"): (1.07, 0.36, "all contacts at once: "),
    ("chipmunk", "step 1/60 s, 1 m/s"): (0.53, 1.66, "one contact after another: "),
    ("simbody", "HuntCrossleyForce, accuracy 1e-6"): (1.16, 1.28, "Hertz contacts: "),
    ("drake", "continuous, dissipation 0"): (1.0, 1.10, "linear springs: "),
    ("jolt", "step 1/60 s, 1 m/s"): (0.42, 0.03, "below a threshold: "),
    ("rapier2d", "step 1/60 s, 1 m/s"): (0.87, 0.95, ""),
    ("box2d3-wasm", "step 1/60 s, 1 m/s"): (0.54, 0.80, ""),
    ("havok", "step 1/60 s, 1 m/s"): (0.80, 0.72, ""),
    ("cannon-es", "step 1/60 s, 1 m/s"): (1.22, 1.50, ""),
    ("brax-spring", "step 2 ms"): (1.13, 1.62, ""),
    ("matter-js", "step 1/60 s, 3 m/s"): (0.28, 1.50, ""),
    ("phaser-box2d", "step 1/60 s, 1 m/s"): (0.42, 0.14, ""),
    ("mujoco", "default solref and solimp, step 2 ms"): (0.45, 0.28, "soft contacts: "),
    ("pybullet", "step 1/2400 s"): (0.82, 0.38, ""),
    ("newton-XPBD", "step 1/60 s"): (0.51, 0.47, ""),
    ("drake", "SAP, dissipation 0, relaxation time 0, step .1 ms"): (
        0.64,
        1.16,
        "step .1 ms: ",
    ),
}


def energy_and_dispersion(velocity: np.ndarray) -> np.ndarray:
    """Energy ratio and dispersion (..., 2) of velocities (..., 3) of the cradle."""
    share = np.asarray(velocity) ** 2
    return np.stack([share.sum(-1), share.std(-1) / share.mean(-1)], axis=-1)


def engine_groups() -> list[tuple[np.ndarray, str, tuple[float, float]]]:
    """Point, label and its place for each group of engines; every row is in the nearest
    one.
    """
    rows = {
        (row.engine, row.setting): row
        for row in ji.data.engine_impacts(scene="S1").rows
    }
    points = energy_and_dispersion([row.velocity for row in rows.values()])
    centres = energy_and_dispersion([rows[key].velocity for key in ENGINE_LABELS])
    nearest = np.linalg.norm(points[:, None] - centres, axis=2).argmin(1)
    groups = []
    for k, (x, y, head) in enumerate(ENGINE_LABELS.values()):
        names = dict.fromkeys(
            engine for (engine, _), group in zip(rows, nearest) if group == k
        )
        groups.append((centres[k], head + ", ".join(names), (x, y)))
    return groups


@picture
@styled()
def engines() -> Figure:
    """Three balls at e = 1: what engines make of them, beside laws and a
    measured shot.
    """
    figure, axes = new_figure(6.4)
    laws = {
        "Moreau": ji.Moreau,
        "Binary": ji.Binary,
        "LZB, Hertz": ji.LZB,
        "LZB, linear springs": lambda e: ji.LZB(e, exponent=1.0),
    }
    for k, (name, make) in enumerate(laws.items()):
        run = jax.jit(
            jax.vmap(lambda e, make=make: ji.impact(make(e), CRADLE, STRIKER).velocity)
        )
        line = energy_and_dispersion(run(jnp.linspace(0.1, 1, 91)))
        axes.plot(
            *line.T, color=COLOURS[k], lw=1.4, label=f"{name}, e from .1 to 1", zorder=0
        )
    for point, text, place in engine_groups():
        axes.plot(*point, "o", color="black", ms=4)
        words = textwrap.fill(text, 32, break_on_hyphens=False)
        style = {"fontsize": SMALL, "va": "center", "ha": "left"}
        arrow = {"arrowstyle": "-", "color": GREY, "lw": 0.6, "shrinkB": 3}
        axes.annotate(words, point, place, arrowprops=arrow, **style)
    measured = ji.read_experiments(files("jimpact") / "data" / "three_balls.csv").post[
        0
    ]
    axes.plot(
        *energy_and_dispersion(measured), "*", color=COLOURS[5], ms=12, label="measured"
    )
    axes.set(xlim=(0.2, 1.55), ylim=(-0.05, 1.85))
    axes.set(
        xlabel="energy ratio K_ER = T+/T-",
        ylabel="energy dispersion C_KE (0: equal shares)",
    )
    legend_below(figure, 3)
    return figure


@picture
@styled()
def oblique_rebounds() -> Figure:
    """A sphere obliquely on a plane: its tangential spring returns slip at small
    angles.
    """
    normals = [[0.0], [1.0], [0.0]]
    tangents = [[1.0], [0.0], [1.0]]
    sphere = ji.Scene([1.0, 1.0, 0.4], normals, tangents=tangents)
    angles = np.radians(np.linspace(0.5, 80.0, 160))
    before = np.stack([np.sin(angles), -np.cos(angles), 0 * angles], axis=1)
    figure, axes = new_figure(3.6)
    for kappa in (None, 0.4, 0.8, 1.2):
        law = ji.LZB(0.95, friction=0.15, tangential_stiffness=kappa)
        run = jax.jit(jax.vmap(lambda v, law=law: ji.impact(law, sphere, v).velocity))
        slip = run(before) @ np.asarray(tangents)[:, 0]
        if kappa is None:
            label = "Coulomb alone"
        else:
            label = f"kappa = {kappa}"
        axes.plot(np.tan(angles), slip / np.cos(angles), label=label)
    axes.axhline(0.0, color=GREY, lw=0.6)
    axes.set(xlim=(0, 2.0), ylim=(-0.5, 1.0))
    axes.set(
        xlabel="tangent of the angle of incidence",
        ylabel="slip after, over the approach",
    )
    legend_below(figure, 4)
    return figure


def main(names: list[str]) -> None:
    """Draw these, or all."""
    jax.config.update("jax_enable_x64", True)
    for name in names or DRAWN:
        path = PICTURES / f"{name}.png"
        draw = DRAWN[name]
        if draw.__code__.co_argcount:
            draw(path)
        else:
            draw().savefig(path, dpi=150)
        print(path)


if __name__ == "__main__":
    main(sys.argv[1:])
