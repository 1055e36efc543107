"""Figures of pages that no other script prints: `python tests/validation/figures.py [NAME ..]`.

Each function below prints what a page of `docs/` states; its docstring names the page. All of them
take a quarter of an hour on a busy core; none is a timing.
"""

import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jimpact as ji

RTOL = 1e-8  # of LZB by default
FINEST = 1e-12  # `rtol` of the outcomes that others are compared with


def relative(found: ji.Impact, exact: ji.Impact, before: np.ndarray) -> np.ndarray:
    """Errors of v+ (impacts,), the largest of a coordinate over the largest `|v-|`."""
    wrong = np.abs(np.asarray(found.velocity) - np.asarray(exact.velocity)).max(axis=1)
    return wrong / np.abs(before).max(axis=1)


def random_chains(bodies: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Errors of LZB over its default `rtol` on random chains, of those with status ok."""
    contacts = bodies - 1
    mass = 10 ** rng.uniform(-1, 1, (count, bodies))
    stiffness = 10 ** rng.uniform(-1, 1, (count, contacts))
    e, v = rng.uniform(0, 1, (count, contacts)), rng.normal(size=(count, bodies))
    v[:, 0] = np.abs(v).max(axis=1) + v[:, 1]  # the first two approach

    def impacts(rtol: float) -> ji.Impact:
        def one(mass: jax.Array, k: jax.Array, e: jax.Array, v: jax.Array) -> ji.Impact:
            return ji.impact(ji.LZB(e, k, rtol=rtol), ji.chain(mass), v)

        return jax.jit(jax.vmap(one))(mass, stiffness, e, v)

    found, exact = impacts(RTOL), impacts(FINEST)
    ended = (np.asarray(found.status) == 0) & (np.asarray(exact.status) == 0)
    return relative(found, exact, v)[ended] / RTOL


def chains() -> None:
    """speed_accuracy.md: errors of LZB at its default `rtol` on random chains of 2 to 6 bodies."""
    rng = np.random.default_rng(0)
    error = np.concatenate([random_chains(bodies, 100, rng) for bodies in range(2, 7)])
    print(f"{len(error)} of 500 chains with status ok, errors over rtol: ", end="")
    print(f"99 % below {np.quantile(error, 0.99):.1f}, the largest {error.max():.1f}")


def planar_scenes(n: int, contacts: int, coordinates: int) -> tuple:
    """Masses, normals, tangents, v-, e and mu of n random planar scenes."""
    rng = np.random.default_rng(0)
    mass = 10 ** rng.uniform(-0.5, 0.5, (n, coordinates))
    normals, tangents = rng.normal(size=(2, n, coordinates, contacts))
    overlap = np.einsum("nim,nim->nm", normals, tangents / mass[..., None])
    square = np.einsum("nim,nim->nm", normals, normals / mass[..., None])
    # at right angles in the metric of M^-1
    tangents -= normals * (overlap / square)[:, None]
    length = np.einsum("nim,nim->nm", tangents, tangents / mass[..., None])
    tangents *= np.sqrt(square / length)[:, None]
    v = rng.normal(size=(n, coordinates))
    e = rng.uniform(0, 1, (n, contacts))
    mu = rng.uniform(0, 3, (n, contacts))
    approach = np.einsum("nim,ni->nm", normals, v).min(axis=1)
    v *= np.where(approach < 0, 1.0, -1.0)[:, None]
    return mass, normals, tangents, v, e, mu


def planar_friction() -> None:
    """friction.md: errors of LZB with friction on random planar scenes."""
    for n, contacts, coordinates in ((2000, 2, 3), (200, 3, 5)):
        scenes = planar_scenes(n, contacts, coordinates)

        def impacts(rtol, scenes=scenes, contacts=contacts):
            def one(mass, normals, tangents, v, e, mu):
                law = ji.LZB(e, [1.0] * contacts, friction=mu, rtol=rtol)
                return ji.impact(law, ji.Scene(mass, normals, tangents=tangents), v)

            return jax.jit(jax.vmap(one))(*scenes)

        found = impacts(RTOL)
        exact = impacts(FINEST)
        names = [ji.STATUS[int(s)].name for s in found.status]
        counts = ", ".join(f"{names.count(x)} {x}" for x in sorted(set(names)))
        error = relative(found, exact, scenes[3]) / RTOL
        print(
            f"{n} scenes of {contacts} contacts: {counts}; errors over rtol: "
            f"99 % below {np.quantile(error, 0.99):.1f}, the largest {error.max():.1f}"
        )


def stacked_balls() -> None:
    """motions_reference.md: a tennis ball on a basketball, with a gap and without."""
    mass, height, g = [0.6, 0.06], 1.0, 9.81
    laws = {
        "Newton": ji.Newton(0.9),
        "Moreau": ji.Moreau(0.9),
        "Poisson": ji.Poisson(0.9),
    }
    laws |= {"LZB": ji.LZB(0.9, [1.0, 1.0]), "Binary": ji.Binary(0.9)}
    system = ji.System(
        lambda q: jnp.stack([q[0], q[1] - q[0]]),
        mass,
        potential=ji.gravity(jnp.asarray(mass), g),
    )
    for gap in (0.0, 1e-6, 1e-3, 1e-2):
        after = {}
        for name, law in laws.items():
            end = np.sqrt(2 * height / g) + 0.02
            motion = ji.simulate(system, law, [height, height + gap], [0.0, 0.0], end)
            last = motion.event_times("impact")[-1]
            speed = motion.velocity[-1, 1] + g * (end - last)
            after[name] = float(speed / np.sqrt(2 * g * height))
        print(
            f"gap {gap:.0e} m:",
            ", ".join(f"{name} {v:.4f}" for name, v in after.items()),
        )


def accumulations() -> None:
    """motions_reference.md: events until rest, and when rest begins, by two values of `slow`."""
    beads = ji.System(ji.Column([0.1] * 3, 0.01), gravity=True), ji.LZB(0.9)
    places = 0.1 + 0.01 * np.array([1.0, 3.0, 5.0])
    block = ji.System(ji.Block(0.2, 0.6), gravity=True), ji.LZB(0.3, friction=0.8)
    tilted = [0.0, 0.1 * np.sin(0.15) + 0.3 * np.cos(0.15), 0.15]
    for name, (system, law), q in (("beads", beads, places), ("block", block, tilted)):
        for slow in (1e-6, 1e-12):
            method = ji.EventDriven(slow=slow)
            motion = ji.simulate(system, law, q, [0.0] * 3, 3.0, method=method)
            last = int(motion.events.count) - 1
            time = float(motion.events.time[last])
            end = float(
                np.nanmax(np.asarray(motion.events.accumulation_end)[: last + 1])
            )
            print(
                f"{name}, slow {slow:.0e}: {last + 1} events, {time:.4f} to {end:.4f} s"
            )


def order_of_time_stepping() -> None:
    """motions_reference.md: mean errors of time stepping over its step, beside events."""
    ball = ji.System(lambda q: q, [1.0], potential=ji.gravity([1.0]))
    pair = ji.System(
        lambda q: jnp.stack([q[0], q[1] - q[0]]),
        [1.0, 1.0],
        potential=ji.gravity([1.0, 1.0]),
    )
    cradle = ji.System(ji.PendulumCradle([0.1] * 3, 0.15, 0.0125), gravity=True)
    cases = {
        "ball, two bounces [m]": (ball, ji.Newton(0.7), [1.0], 1.5),
        "cradle, one impact [rad]": (cradle, ji.LZB(0.9), [-0.5, 0.0, 0.0], 0.5),
        "two balls [m]": (pair, ji.Moreau(0.6), [0.5, 1.2], 0.9),
    }
    for name, (system, law, q0, t_end) in cases.items():
        v0 = np.zeros(len(q0))
        exact = ji.simulate(system, law, q0, v0, t_end)
        print(f"{name}, {len(exact.event_times('impact'))} impacts:", end="")
        for step in (1e-2, 1e-3, 1e-4):
            errors = []
            # one error jumps by where the impacts lie in their steps
            for share in np.linspace(0.75, 1.25, 20):
                method = ji.TimeStepping(step * share)
                found = ji.simulate(system, law, q0, v0, t_end, method=method)
                errors.append(np.abs(found.q[-1] - exact.q[-1]).max())
            print(f"  step {step:g}: {np.mean(errors):.1e}", end="")
        print()


def peak(time: np.ndarray, force: np.ndarray) -> tuple[float, float, float]:
    """Time and height of the largest force (parabola), time above half of it; as in waves.md."""
    i = int(force.argmax())
    before, top, after = force[i - 1 : i + 2]
    shift = 0.5 * (before - after) / (before - 2 * top + after)
    height = top - 0.25 * (before - after) * shift
    above = np.flatnonzero(force >= height / 2)
    first, last = above[0], above[-1]
    start = np.interp(
        height / 2, force[first - 1 : first + 1], time[first - 1 : first + 1]
    )
    end = np.interp(-height / 2, -force[last : last + 2], time[last : last + 2])
    return time[i] + shift * (time[1] - time[0]), height, end - start


def solitary_wave() -> None:
    """waves.md: sixty balls of 1 kg with k = 1, struck at 1 m/s."""
    n = 60
    h = ji.history(
        ji.LZB(1.0, np.ones(n - 1)), ji.chain(np.ones(n)), np.eye(n)[0], samples=1500
    )
    time, v = np.asarray(h.time), np.asarray(h.velocity)
    arrival, height, duration = np.transpose(
        [peak(time, f) for f in np.asarray(h.force).T]
    )
    i = int(v[:, 31].argmax())
    top, low, high = v[i, 31], v[i - 1, 31], v[i + 1, 31]
    fastest = top + (low - high) ** 2 / (16 * top - 8 * (low + high))  # of a parabola
    limit = float(ji.theory.nesterenko_speed(1.0, 1.0, fastest))
    print(f"fastest {fastest:.5f} m/s, Nesterenko's speed {limit:.5f} contacts/s")
    whole = np.pi / (
        2 * np.arccos(0.5 ** (1 / 6))
    )  # a pulse cos^6 over its time above half
    for contact in (11, 21, 31, 41):
        j = contact - 1
        speed = 2 / (arrival[j + 1] - arrival[j - 1])
        width = whole * duration[j] * speed
        print(
            f"contact {contact}: {speed:.5f} contacts/s, {speed / limit - 1:+.1%}, ",
            end="",
        )
        print(f"width {width:.3f} contacts, force {height[j]:.5f}")
    energy = v[i] ** 2
    print(
        f"outside five balls {1 - energy[29:34].sum() / energy[20:45].sum():.0e} of the energy"
    )


def correlated() -> None:
    """laws.md: `ImpulseCorrelation` and LZB, both fitted to the measured shot, on other strikes."""
    balls = ji.chain([1.0, 1.0, 1.0])
    shot = ji.Experiments(pre=[[1.0, 0, 0]], post=[[-0.0605, 0.1049, 0.9978]])
    both = ("restitution", "ratio")
    ratios = ji.fit(ji.ImpulseCorrelation(0.9, 0.9), balls, shot, free=both).law
    lzb = ji.fit(ji.LZB(0.9, [1.0, 1.0]), balls, shot).law
    print(ratios, lzb, sep="\n")
    for v in ([1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, -0.5]):
        a, b = (np.asarray(ji.impact(law, balls, v).velocity) for law in (ratios, lzb))
        print(
            v, f"differ by {np.linalg.norm(a - b) / np.linalg.norm(v):.3f} of the speed"
        )


FIGURES: dict[str, Callable[[], None]] = {
    made.__name__: made
    for made in (
        chains,
        planar_friction,
        stacked_balls,
        accumulations,
        order_of_time_stepping,
        solitary_wave,
        correlated,
    )
}

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name in sys.argv[1:] or FIGURES:
        print(f"-- {name}: {(FIGURES[name].__doc__ or '').splitlines()[0]}", flush=True)
        FIGURES[name]()
