# /// script
# dependencies = ["mujoco-mjx==3.17.0", "mujoco==4.0.0", "diffrax==0.7.2"]
# ///
"""Derivatives of a bounce by MJX, diffrax and jimpact: a table of docs/engines.md.

Run `python tests/validation/engines/derivatives.py` where jimpact and these packages are installed (a
minute).

A ball of radius R = .1 m, 5 mm above the ground, falls at s = 1 m/s, with gravity and e = 1, and is
seen at t = 20 ms. Closed form, with the impact speed w = sqrt(s^2 + 2 g h): v(t) = 2 w - g t - s,
so that dv/ds = 2 s / w - 1 and dv/dR = -2 g / w. Each row: v, its derivatives by automatic
differentiation, and central differences of the same program.
"""

from importlib.metadata import version

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import optimistix
from mujoco import mjx

import jimpact as ji

G, RADIUS, SPEED, HEIGHT, END = 9.81, 0.1, 1.0, 5e-3, 0.02  # SI
PLACE = RADIUS + HEIGHT
CHANGE = 1e-5  # of s [m/s] and R [m] in central differences


def closed_form(speed, radius):
    """v(t) [m/s]."""
    return 2 * jnp.sqrt(speed**2 + 2 * G * (PLACE - radius)) - G * END - speed


def by_mjx(stiffness, step):
    """MJX without damping: e = 1 up to the error of the step."""
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco><option timestep="{step}" gravity="0 0 {-G}" iterations="1" ls_iterations="4"/>
    <default><geom condim="1" solref="-{stiffness} 0" solimp="0.9999 0.9999"/></default>
    <worldbody><geom type="plane" size="1 1 1"/>
    <body pos="0 0 {PLACE}"><joint type="slide" axis="0 0 1"/><geom size="{RADIUS}" mass="1"/>
    </body></worldbody></mujoco>""")
    there = mjx.put_model(model)
    start = mjx.put_data(model, mujoco.MjData(model))

    def after(speed, radius):
        changed = there.replace(geom_size=there.geom_size.at[1].set(radius))
        state = start.replace(qvel=start.qvel.at[0].set(-speed))
        kinds = jax.eval_shape(
            mjx.step, changed, state
        )  # in x64 the first step changes types
        state = jax.tree.map(lambda x, kind: jnp.asarray(x, kind.dtype), state, kinds)
        run = jax.lax.scan(
            lambda x, _: (mjx.step(changed, x), None), state, length=round(END / step)
        )
        return run[0].qvel[0]

    return after


def by_diffrax(speed, radius):
    """Two flights with an event between them."""
    flight = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -G * jnp.ones(())]))
    event = diffrax.Event(
        lambda t, y, args, **_: y[0] - args, optimistix.Newton(rtol=1e-10, atol=1e-12)
    )
    control = {"stepsize_controller": diffrax.PIDController(rtol=1e-10, atol=1e-12)}
    control |= {"adjoint": diffrax.ForwardMode()}
    start = jnp.stack([jnp.asarray(PLACE), -speed])
    solve = diffrax.diffeqsolve
    down = solve(
        flight, diffrax.Tsit5(), 0.0, END, 1e-4, start, radius, event=event, **control
    )
    hit = down.ys[-1] * jnp.array([1.0, -1.0])
    return solve(
        flight, diffrax.Tsit5(), down.ts[-1], END, 1e-4, hit, radius, **control
    ).ys[-1, 1]


class Ground(eqx.Module):
    """Height of the ball's lowest point."""

    radius: jax.Array

    def __call__(self, q):
        return q - self.radius


def by_jimpact(speed, radius):
    """Event-driven motion."""
    system = ji.System(Ground(radius), [1.0], potential=ji.gravity([1.0], G))
    start = jnp.array([PLACE])
    motion = ji.simulate(system, ji.Moreau(1.0), start, -speed[None], END, samples=2)
    return motion.velocity[-1, 0]


def main():
    jax.config.update("jax_enable_x64", True)
    rows = {"closed form": closed_form}
    own, other = (
        f"MJX {version('mujoco-mjx')}",
        f"diffrax {version('diffrax')}, with an event",
    )
    rows |= {
        f"{own}, stiffness 1e5 1/s^2, step 2 ms": by_mjx("1e5", 2e-3),
        f"{own}, the same, step .2 ms": by_mjx("1e5", 2e-4),
        f"{own}, 1e6 1/s^2, step .02 ms": by_mjx("1e6", 2e-5),
        other: by_diffrax,
        "jimpact": by_jimpact,
    }
    print("| program | v [m/s] | dv/ds | difference | dv/dR [1/s] | difference |")
    print("|---|---|---|---|---|---|")
    at = jnp.asarray(SPEED), jnp.asarray(RADIUS)
    for name, function in rows.items():
        run = jax.jit(function)
        slopes = jax.jit(jax.jacfwd(function, (0, 1)))(*at)
        cells = [float(run(*at))]
        for k in (0, 1):
            more, less = list(at), list(at)
            more[k], less[k] = more[k] + CHANGE, less[k] - CHANGE
            cells += [float(slopes[k]), float(run(*more) - run(*less)) / (2 * CHANGE)]
        print(
            f"| {name} | " + " | ".join(f"{cell:.4f}" for cell in cells) + " |",
            flush=True,
        )


if __name__ == "__main__":
    main()
