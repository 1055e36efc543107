"""What tests of motion share."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jimpact as ji

G = 9.80665


def status(motion):
    return motion.to_dict()["status"]


def dropped(e, q0, slow):
    return ji.simulate(
        ji.System(ji.Column([1.0]), gravity=True), ji.Newton(e), q0[None], jnp.zeros(1), 5.0, samples=101, max_events=100,
        method=ji.EventDriven(slow=slow),
    )  # fmt: skip


def bounce_times(e, n=20):
    first = np.sqrt(2 / G)
    return first + 2 * first * jnp.concatenate(
        [jnp.zeros(1), jnp.cumsum(e ** jnp.arange(1.0, n))]
    )


def height(e, t):
    """Closed form of the bouncing ball dropped from 1 m, within 20 bounces."""
    times = bounce_times(e)
    i = jnp.searchsorted(jax.lax.stop_gradient(times), t) - 1
    s = t - times[jnp.maximum(i, 0)]
    v = np.sqrt(2 * G) * e ** (i.astype(float) + 1.0)
    return jnp.where(i < 0, 1 - G * t * t / 2, v * s - G * s * s / 2)


class Pull(eqx.Module):
    """Weights, and a force between the outer two of three bodies."""

    weight: jax.Array
    between: jax.Array

    def __call__(self, q):
        return self.weight * jnp.sum(q) + self.between * (q[2] - q[0])


def stack_gaps(q):
    return jnp.stack([q[0], q[1] - q[0], q[2] - q[1]])


def stack(e, q, v, t_end, between=0.0, **options):
    """Three bodies in a column, on the host: one program for many tests."""
    system = ji.System(
        stack_gaps, [1.0] * 3, potential=Pull(*jnp.array([10.0, between]))
    )
    return ji.simulate(
        system, ji.Moreau(jnp.asarray(e)), q, v, t_end, samples=2, **options
    )
