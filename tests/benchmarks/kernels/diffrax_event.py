"""Three Hertz balls under the LZB law in diffrax: Dopri8, an Event at the end, no phase alignment."""

import diffrax
import jax
import jax.numpy as jnp

SCALE = 0.05  # first step, in the time scale of the stiffer contact
LONGEST = 1e4  # time by which every impact is over


def dopri8():
    """Jitted `run(stiffness (B, 2), restitution (B, 2), rtol) -> v+ (B, 3)`; atol = rtol."""
    w = jnp.array([[2.0, -1.0], [-1.0, 2.0]])
    before = jnp.array([-1.0, 0.0])

    def field(t, y, args):
        k, e = args
        x, g = y
        positive = x > 0
        safe = jnp.where(positive, x, 0.0)
        force = k * safe * jnp.sqrt(safe)
        c = jnp.where(g <= 0, 1.0, 1 / e**2)
        return jnp.where(positive | (g < 0), -c * g, 0.0), w @ force

    def over(t, y, args, **kwargs):
        x, g = y
        return jnp.all((x <= 0) & (g >= 0))

    def impact(k, e, rtol):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            t0=0.0,
            t1=LONGEST,
            dt0=SCALE * jnp.max(k) ** -0.4,
            y0=(jnp.zeros(2), before),
            args=(k, e),
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
            event=diffrax.Event(over),
            adjoint=diffrax.ForwardMode(),  # a plain while loop: the fastest of its adjoints
            max_steps=100_000,
            throw=False,
        )
        g = solution.ys[1][-1]
        p = jnp.linalg.solve(w, g - before)
        return jnp.stack([1 - p[0], p[0] - p[1], p[1]])

    return jax.jit(jax.vmap(impact, in_axes=(0, 0, None)))
