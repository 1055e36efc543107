"""What tests of paroxysms share."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jimpact as ji

G = 9.81  # of a rod of mass 1 and length 2, whose end slides on the floor


INERTIA = np.array([1.0, 1.0, 1 / 3])


MU, T_END = 2.0, 0.1


# e, mu of the law, angle, its rate, slip
STARTS = {
    "inconsistent": (0.5, MU, 0.7, 0.0, -1.0),
    "turning": (0.5, MU, 1.3, -2.0, -10.0),
    "elastic": (1.0, MU, 0.9, 1.0, -3.0),
    "indeterminate": (0.5, MU, 0.7, 5.0, -1.0),
    "regular": (0.5, MU, 0.7, 0.0, 1.0),
    "jamming": (0.0, MU, 0.6, 3.0, -8.0),
    "not supplied": (0.5, 0.0, 0.7, 0.0, -1.0),
}


def gap(q):
    return jnp.stack([q[1] - jnp.sin(q[2])])


def sliding(q):
    return jnp.stack([q[0] - jnp.cos(q[2])])


ROD = ji.System(
    gap,
    INERTIA,
    potential=ji.gravity([0.0, 1.0, 0.0], G),
    tangent_function=sliding,
    friction=MU,
)


def directions(theta):
    """Normal and tangent of the end (3, 2)."""
    return np.array([[0.0, 1.0], [1.0, 0.0], [-np.cos(theta), np.sin(theta)]])


def delassus(theta):
    """W_nn, W_nt, W_tt."""
    d = directions(theta)
    w = d.T @ (d / INERTIA[:, None])
    return w[0, 0], w[0, 1], w[1, 1]


def moves(given, law=ji.LZB):
    e, friction, theta, rate, slip = given
    q = jnp.stack([jnp.zeros_like(theta), jnp.sin(theta), theta])
    v = jnp.stack([slip - jnp.sin(theta) * rate, jnp.cos(theta) * rate, rate])
    return ji.simulate(
        ROD, law(e, friction=friction), q, v, T_END, samples=2, max_events=30
    )


@functools.cache
def motions():
    found = {name: moves(jnp.array(given)) for name, given in STARTS.items()}
    return jax.tree.map(np.asarray, found)
