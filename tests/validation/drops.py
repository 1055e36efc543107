"""Whole drops of a square, predicted: `python tests/validation/drops.py` writes `docs/drops.md`.

Run by hand. With MuJoCo (extra `mujoco`), its predictions of the same drops stand beside.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares
from when_written import written

import jimpact as ji

PAGE = Path(__file__).parents[2] / "docs" / "drops.md"
NUMBERS = PAGE.parents[1] / "tests" / "held" / "drops.npz"  # what docs/gallery.py draws
SIDE, FRAME, GRAVITY = 0.06, 0.004, 9.81  # [m], [s], [m/s^2]
ARM = SIDE / 6**0.5  # radius of gyration [m]: an angle times it is a length
BLOCK = ji.Block(SIDE, SIDE)
NEAR = 2e-3  # [m] the square touches if a corner is nearer; noise is .04 mm, corners dip to -3 mm
ARC = 7  # frames; poses that give a state, and the shortest flight that gives one. 70 are none
LEAD, TAIL = (
    2,
    8,
)  # frames before and after a hit that a fit sees; 100 are several impacts
STEP = 4e-4  # [s] of time stepping, .4 mm of fall; ten times more is a frame
EVENTS = 200  # of a drop, at most; a drop has some 60
SOFT = 0.003  # [m] beyond, an error pulls as its absolute value; ten times more: scatter decides
FOLDS = 5
RESAMPLES = 2000  # of the drops
MEMBERS = (
    8  # simulations of a start from slightly other states; ten times more: finer shares
)
# Standard errors of a state from an arc: position [m, m, rad], velocity [m/s, m/s, rad/s].
ERRORS = np.array([[1e-5, 3e-5, 5e-4], [7e-3, 6e-3, 0.1]])
OFF = -5e-3  # [m] a corner lower than that is beside the table
ON = 1e-3  # [m] the square turns about a corner that is nearer; noise is .04 mm
WINDOW = 4  # frames before and after a hit while rocking; ten times more is the whole rocking
SLOWEST = 4.0  # [rad/s] of them; .13 rad/s is noise
HORIZON = 100  # frames after a hit in which predictions are compared; nearly all drops have them
MUS = 0.1, 0.3, 0.6  # of the chapter's block beside measured rocking
LAST = 199  # the last frame of a drop
KINDS = {"first flight": 0, "flight after an impact": 1}


class Hit(NamedTuple):
    """The end of a flight: state (2, 3) by the flight's arc at frame `start`, hit at `frame`."""

    drop: int
    start: int
    frame: int
    state: np.ndarray


def lowest(q: np.ndarray) -> np.ndarray:
    """Height of the lowest corner [m] of poses (..., 3)."""
    sine, cosine = np.abs(np.sin(q[..., 2])), np.abs(np.cos(q[..., 2]))
    return q[..., 1] - SIDE / 2 * (sine + cosine)


def drops() -> np.ndarray:
    """Poses (K, S, 3) of the drops that stay on the table."""
    poses = ji.data.square_drops()[2]
    return poses[lowest(poses).min(axis=1) > OFF]


def state(flight: np.ndarray, at: int) -> np.ndarray:
    """Position and velocity (2, 3) at a frame, by the arc through the poses (N, 3) of a flight."""
    t = FRAME * (np.arange(len(flight)) - at)
    straight = flight + np.array([0, GRAVITY / 2, 0]) * t[:, None] ** 2
    return np.linalg.lstsq(
        np.stack([np.ones(len(t)), t], axis=1), straight, rcond=None
    )[0]


def flights(poses: np.ndarray) -> list[tuple[int, int]]:
    """(first frame, frame of the hit) of flights of at least ARC frames in a record (S, 3)."""
    edges = np.flatnonzero(np.diff(np.r_[0, lowest(poses) > NEAR, 0]))
    return [(a, b) for a, b in edges.reshape(-1, 2) if b - a >= ARC and b < len(poses)]


def hits(poses: np.ndarray) -> list[Hit]:
    """All hits after flights, of all drops (K, S, 3)."""
    found = []
    for k, q in enumerate(poses):
        for a, b in flights(q):
            at = state(q[a:b], b - LEAD - a)
            if (
                b + TAIL <= LAST and lowest(at[0]) > 0
            ):  # else no arc: a hit between two frames
                found.append(Hit(k, b - LEAD, b, at))
    return found


def begins(poses: np.ndarray, kind: int) -> list[Hit]:
    """Where predictions begin: first frame of the first flight, or of the first one after it."""
    found = []
    for k, q in enumerate(poses):
        if len(runs := flights(q)) > kind:
            a, b = runs[kind]
            at = state(q[a : a + ARC], 0)
            if lowest(at[0]) > 0:
                found.append(Hit(k, a, b, at))
    return found


@dataclass
class Simulator:
    """`simulate(x (K, P), states (K, 2, 3), frames)` gives poses (K, frames + 1, 3)."""

    names: tuple[str, ...]
    starts: np.ndarray
    bounds: tuple[Any, Any]
    simulate: Callable[[np.ndarray, np.ndarray, int], np.ndarray]

    def errors(self, x: np.ndarray, found: list[Hit], poses: np.ndarray) -> np.ndarray:
        """Of the poses after each hit (K, TAIL, 3) [m]."""
        states = np.stack([hit.state for hit in found])
        own = np.stack(
            [poses[hit.drop, hit.frame + 1 : hit.frame + 1 + TAIL] for hit in found]
        )
        simulated = self.simulate(
            np.broadcast_to(x, (len(found), len(x))), states, LEAD + TAIL
        )
        return (simulated[:, LEAD + 1 :] - own) * np.array([1, 1, ARM])

    def fitted(
        self, found: list[Hit], poses: np.ndarray, starts: np.ndarray
    ) -> np.ndarray:
        """Numbers with which poses after hits are predicted best, of several starts."""
        fits = [
            least_squares(
                lambda x: self.errors(x, found, poses).ravel(), start, "2-point", self.bounds,
                loss="soft_l1", f_scale=SOFT, x_scale=np.abs(start), xtol=1e-3, ftol=1e-5,
                diff_step=0.02, max_nfev=20,
            )
            for start in starts
        ]  # fmt: skip
        return min(fits, key=lambda fit: fit.cost).x


def of_jimpact() -> Simulator:
    """Moreau's law, one e and one mu for all corners, by time stepping."""
    system = ji.System(BLOCK, gravity=GRAVITY)

    def one(x: jax.Array, state: jax.Array, frames: int) -> jax.Array:
        """Poses (frames + 1, 3)."""
        options = {"samples": frames + 1, "step": STEP, "max_events": EVENTS}
        law = ji.Moreau(x[0], friction=x[1])
        ends = frames * FRAME
        return ji.simulate(
            system, law, *state, ends, method="time_stepping", **options
        ).q

    run = jax.jit(jax.vmap(one, in_axes=(0, 0, None)), static_argnums=2)

    def simulate(x: np.ndarray, states: np.ndarray, frames: int) -> np.ndarray:
        """All at once."""
        return np.asarray(run(jnp.asarray(x), jnp.asarray(states), frames))

    return Simulator(("e", "mu"), np.array([[0.5, 0.3]]), ([0, 0], [1, 2]), simulate)


def simulators() -> dict[str, Simulator]:
    """What is compared."""
    made = {"jimpact": of_jimpact()}
    try:
        from drops_mujoco import of_mujoco

        made["MuJoCo"] = of_mujoco()
    except ImportError:
        print("MuJoCo is not installed: its rows are left out.")
    return made


def sides(q: np.ndarray) -> np.ndarray:
    """Which side is below, 0 to 3: the angle in quarter turns."""
    return np.round(q[..., 2] / (np.pi / 2)) % 4


def misses(simulated: np.ndarray, begin: Hit, poses: np.ndarray) -> dict[str, float]:
    """One prediction beside its drop; NaN where either has no such hit."""
    own = poses[begin.drop, begin.start :]
    simulated = simulated[: len(own)]
    result = {"right side": 100.0 * (sides(simulated[-1]) == sides(own[-1]))}
    measured, predicted = flights(own), flights(simulated)
    for n in (1, 2):
        both = len(measured) > n and len(predicted) > n
        i, j = (measured[n][1], predicted[n][1]) if both else (0, 0)
        off = [1e3 * FRAME * abs(i - j), 1e3 * abs(own[i, 0] - simulated[j, 0])]
        time, place = off if both else [np.nan, np.nan]
        result |= {f"hit {n + 1} [ms]": time, f"hit {n + 1} [mm]": place}
    return result | {"rest [mm]": 1e3 * abs(own[-1, 0] - simulated[-1, 0])}


def centre(name: str, values: np.ndarray) -> float:
    """Share of right sides, median of the others."""
    return float(np.mean(values) if name == "right side" else np.nanmedian(values))


def compared(name: str, tables: np.ndarray, drops: int) -> list[str]:
    """Cells: of each simulator, and of the difference, with 95 % intervals; drops are drawn."""
    rng = np.random.default_rng(0)
    draws = rng.integers(drops, size=(RESAMPLES, drops))

    def cell(of: Callable[[Any], float], sign: str) -> str:
        """Value and interval."""
        low, high = np.quantile([of(draw) for draw in draws], [0.025, 0.975])
        return f"{of(slice(None)):{sign}.3g} ({low:{sign}.3g} to {high:{sign}.3g})"

    cells = [cell(lambda draw, t=t: centre(name, t[draw]), "") for t in tables]
    if len(tables) > 1:
        a, b = tables[:2]
        cells.append(
            cell(lambda draw: centre(name, b[draw]) - centre(name, a[draw]), "+")
        )
    return cells


def held_out(
    made: Simulator, found: list[Hit], poses: np.ndarray
) -> tuple[Any, np.ndarray]:
    """Numbers fitted to all drops, and (FOLDS, P) to those of the other groups each."""
    whole = made.fitted(found, poses, made.starts)
    parts = [[hit for hit in found if hit.drop % FOLDS != k] for k in range(FOLDS)]
    return whole, np.array([made.fitted(part, poses, whole[None]) for part in parts])


def ensemble(made: Simulator, x: np.ndarray, begin: list[Hit]) -> np.ndarray:
    """Poses (MEMBERS, K, S, 3) from states that the noise of the poses allows."""
    rng = np.random.default_rng(1)
    states = np.stack([hit.state for hit in begin])
    drawn = states + ERRORS * rng.normal(size=(MEMBERS, *states.shape))
    return np.stack([made.simulate(x, each, LAST) for each in drawn])


def spread(simulated: np.ndarray, begin: list[Hit], poses: np.ndarray) -> np.ndarray:
    """Median over drops (HORIZON,) of |angle simulated - measured| [degrees], from the hit on."""
    errors = np.full((len(begin), HORIZON), np.nan)
    for row, q, hit in zip(errors, simulated, begin):
        own = poses[hit.drop, hit.frame :][:HORIZON]
        row[: len(own)] = np.degrees(
            np.abs(q[hit.frame - hit.start :][: len(own), 2] - own[:, 2])
        )
    return np.nanmedian(errors, axis=0)


def agreement(simulated: np.ndarray, begin: list[Hit], poses: np.ndarray) -> np.ndarray:
    """Of each start (K, 2): share of its members (M, K, S, 3) on the commonest side, is it right."""
    rows = []
    for k, hit in enumerate(begin):
        counts = np.bincount(
            sides(simulated[:, k, LAST - hit.start]).astype(int), minlength=4
        )
        right = counts.argmax() == sides(poses[hit.drop, LAST])
        rows.append((counts.max() / len(simulated), right))
    return np.array(rows)


class Rocking(NamedTuple):
    """Impacts of a square that turns about one corner and hits with the other, arrays (N,)."""

    drop: np.ndarray
    before: np.ndarray  # angular velocity [rad/s]
    after: np.ndarray
    rebound: np.ndarray  # gap velocity after over approach, of the corner that hits
    left: np.ndarray  # the same of the corner that it turned about


def accelerations(q: np.ndarray) -> np.ndarray:
    """(x'', y'', theta'') of a square that turns about its lower corner, which sticks [m/s^2]."""
    angle = (q[2] + np.pi / 4) % (
        np.pi / 2
    ) + np.pi / 4  # from the lower corner to the centre
    radius = SIDE / 2**0.5
    turn = -GRAVITY * radius * np.cos(angle) / (ARM**2 + radius**2)
    return turn * np.array([-radius * np.sin(angle), radius * np.cos(angle), 1.0])


def rates(q: np.ndarray, at: float) -> np.ndarray:
    """Velocity (3,) at a frame, from poses (N, 3) on a corner or in flight."""
    rests = lowest(q).max() < ON
    turn = accelerations(q[len(q) // 2]) if rests else np.array([0, -GRAVITY, 0])
    t = FRAME * (np.arange(len(q)) - at)
    straight = q - turn * t[:, None] ** 2 / 2
    return np.linalg.lstsq(
        np.stack([np.ones(len(t)), t], axis=1), straight, rcond=None
    )[0][1]


def rocking(poses: np.ndarray) -> Rocking:
    """Passages through a flat pose: on one corner before, nothing else hits for WINDOW frames."""
    rows = []
    for k, q in enumerate(poses):
        tilt = (q[:, 2] + np.pi / 4) % (np.pi / 2) - np.pi / 4
        for i in range(WINDOW, len(q) - WINDOW - 1):
            before, after = q[i - WINDOW : i], q[i + 1 : i + 1 + WINDOW]
            if (
                lowest(before).max() > ON
                or abs(tilt[i]) > np.abs(tilt[[i - 1, i + 1]]).min()
            ):
                continue
            start = rates(before, WINDOW)
            at = (
                -tilt[i - 1] / start[2] / FRAME - 1 if start[2] else 9.0
            )  # the hit, in frames from i
            if abs(start[2]) < SLOWEST or abs(at) > 1:
                continue
            end = rates(after, at - 1)
            arm = (
                SIDE / 2 * np.sign(start[2])
            )  # of the corner that hits: it is on the right if < 0
            hit = SIDE * abs(start[2])
            gaps = (end[1] + np.array([-1, 1]) * arm * end[2]) / hit
            rows.append((k, start[2], end[2], *gaps))
    return Rocking(*np.array(rows).T)


TEXT = """# Whole drops of a square

Written by `python tests/validation/drops.py`. The data are measured: {drops} drops of a square (side 60 mm, in the plane)
at 250 Hz, from the flight to rest (`ji.data.square_drops()`; one more leaves the table).

Moreau's law in `ji.simulate` and MuJoCo are fitted alike, to the poses in the 32 ms after each hit; the state before
it is that of an arc through the flight. *Held out*: the drops are divided into {folds} groups; each is predicted by a
fit to the others. A prediction begins with an arc through seven poses of a flight and goes on to rest. Hit n is the
end of the nth flight from there (hit 1 follows from the arc alone), the last rows compare where the square rests and
on which side (of four: 25 % by chance). Medians in ms and mm, shares in percent, with 95 % intervals of a bootstrap
over drops, of the starts for which both simulators predict such a hit. Differences are paired, MuJoCo minus
jimpact; a
difference whose interval contains 0 does not show which simulator is better. jimpact: time stepping, 0.4 ms.
MuJoCo: spheres at the corners,
one `solref` and mu, steps of 0.1 ms, the best of two starts.

{tables}

![median error of the angle after a hit, from the first flight and from the one after it](pictures/drops.png)

Right: after 150 ms about half of the drops turn to the right side, so the median lies somewhere between 0 and 90
degrees and does not show which simulator is better.

## How far a prediction reaches

From the first flight neither predicts the side much better than chance. The noise of the start is not the cause:
{members} simulations of each start, from states that differ by the standard errors of the arc, often agree on a side,
and where they all do they are right hardly more often. So the law is the limit: its e and mu are the same at every
hit, while those of the square scatter (see the quartiles below). After one more measured flight fewer impacts are to
come, and where all members agree the side is right more often.

{agree}

## Rocking

{impacts} times the square turns about one corner, hits with the other, and nothing else happens for 16 ms. Housner's
value for a square says that it goes on about the new corner with {housner:g} of its angular velocity. Measured, it
turns back. So says the chapter: with friction below 1/3 the kinetic angle of a square ({angle:.1f} degrees) is below
the critical one, and the hit presses the other corner to the ground. LZB (`ji.theory.rocking_dispersion`), with the
measured e of the corner that hits:

{rocking}

{edges}"""


def row(*cells: Any) -> str:
    """Of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def predictions(
    made: dict[str, Simulator], poses: np.ndarray
) -> tuple[list[str], dict[str, Any]]:
    """Tables of fits and of predictions, and the curves of the picture."""
    found, curves = hits(poses), {}
    numbers, lines = (
        {},
        [row("simulator", "numbers, fitted to all drops"), row("---", "---")],
    )
    for name, simulator in made.items():
        whole, numbers[name] = held_out(simulator, found, poses)
        lines.append(
            row(name, ", ".join(f"{n} {v:.3g}" for n, v in zip(simulator.names, whole)))
        )
    lines += [
        "",
        row("start", "what", "starts", *made, "difference"),
        row(*["---"] * (len(made) + 4)),
    ]
    for kind, number in KINDS.items():
        begin = begins(poses, number)
        states = np.stack([hit.state for hit in begin])
        group = np.array([hit.drop % FOLDS for hit in begin])
        tables = []
        for name, simulator in made.items():
            simulated = simulator.simulate(numbers[name][group], states, LAST)
            tables.append([misses(q, hit, poses) for q, hit in zip(simulated, begin)])
            curves[f"{kind}, {name}"] = spread(simulated, begin, poses)
        for what in tables[0][0]:
            values = np.array([[each[what] for each in table] for table in tables])
            values = values[
                :, np.isfinite(values).all(axis=0)
            ]  # hits that all simulators have
            count = values.shape[1]
            lines.append(row(kind, what, count, *compared(what, values, count)))
        drawn = ensemble(made["jimpact"], numbers["jimpact"][group], begin)
        curves[f"{kind}, agreement"] = agreement(drawn, begin, poses)
    return lines, curves


def agreements(curves: dict[str, Any]) -> list[str]:
    """Table: how often the side is right where nearby starts agree on it, and where not."""
    lines = [row("start", "members agree", "starts", "right [%]"), row(*["---"] * 4)]
    for kind in KINDS:
        share, right = curves[f"{kind}, agreement"].T
        for words, chosen in (("all", share == 1), ("not all", share < 1)):
            lines.append(
                row(kind, words, chosen.sum(), f"{100 * right[chosen].mean():.0f}")
            )
    return lines


def rocking_table(poses: np.ndarray, law: Any) -> list[str]:
    """Table: measured rocking impacts beside LZB of the chapter, at the e that was measured."""
    found = rocking(poses)
    measured = {
        "angular velocity, after over before": found.after / found.before,
        "corner that hits, gap velocity after over approach": found.rebound,
        "corner turned about, the same": found.left,
    }
    e = float(np.median(found.rebound))
    models = [ji.theory.rocking_dispersion(1.0, mu, e) for mu in law]
    values = [(m.angular_ratio[0, 0, 0], *m.gap_velocity[0, 0, 0]) for m in models]
    head = [f"LZB, mu = {mu:g}" for mu in law]
    lines = [
        row("quantity", "measured: median (quartiles)", *head),
        row(*["---"] * (2 + len(head))),
    ]
    for k, (what, x) in enumerate(measured.items()):
        low, middle, high = np.quantile(x, [0.25, 0.5, 0.75])
        theirs = [f"{float(v[k]):.2f}" for v in values]
        lines.append(row(what, f"{middle:.2f} ({low:.2f} to {high:.2f})", *theirs))
    return lines


def edges() -> list[str]:
    """Section: e and mu of impacts on an edge beside those on a corner."""
    square, lines = ji.data.square_impacts(), []
    for words, contacts in (("a corner", 1), ("an edge (two corners within 2 mm)", 2)):
        shots = square.only(square.contacts == contacts)
        plain = ji.Experiments(
            shots.pre, shots.post, scenes=shots.scenes, units=shots.units
        )
        law, free = ji.Moreau(0.5, friction=0.2), ("restitution", "friction")
        fit = ji.fit(law, None, plain, free, starts=1, search=ji.Search(loss="huber"))
        (e, mu), (d, dmu) = fit.value, fit.standard_error
        lines.append(
            row(words, len(plain.pre), f"{e:.2f} +- {d:.2f}", f"{mu:.2f} +- {dmu:.2f}")
        )
    head = [
        "Impacts cut out of the drops (`ji.data.square_impacts()`), Moreau's law:",
        "",
    ]
    return [*head, row("impact on", "shots", "e", "mu"), row(*["---"] * 4), *lines]


def main() -> None:
    """Write the page and the numbers of its picture."""
    poses = drops()
    tables, curves = predictions(simulators(), poses)
    parts = {
        "tables": tables,
        "agree": agreements(curves),
        "rocking": rocking_table(poses, MUS),
    }
    parts["edges"] = edges()
    text = {name: "\n".join(lines) for name, lines in parts.items()}
    theory = {
        "housner": float(ji.theory.housner_restitution(1.0)),
        "angle": np.degrees(float(ji.theory.rocking_kinetic_angle(1.0))),
    }
    counts = {"drops": len(poses), "impacts": len(rocking(poses).drop)}
    counts |= {"folds": FOLDS, "members": MEMBERS}
    page = TEXT.format(**counts, **theory, **text)
    PAGE.write_text(f"{page}\n{written()}", encoding="utf-8")
    np.savez_compressed(NUMBERS, **curves)
    print(f"written: {PAGE}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
