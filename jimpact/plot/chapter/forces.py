"""Figures of forces during an impact: at the wall under columns, around a contact's loop."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from jimpact.laws.histories import History, history
from jimpact.laws.lzb import LZB
from jimpact.plot.laws import contact_loop as loop_of
from jimpact.plot.style import COLOURS, finish, legend_within, new_figure
from jimpact.scene import chain, column, with_gaps

# The column of beads of 6.1.1: mass [kg], stiffness between beads and at the wall [N/m^1.5], their
# energetic coefficients of restitution, and acceleration of gravity [m/s^2].
BEAD = 2.05e-3
STIFFNESS = (6.9716e9, 9.858e9)
RESTITUTION = (0.96, 0.92)
GRAVITY = 9.80665
DROPS = {3.1e-3: (1, 2, 4, 8), 5.1e-3: (5, 8, 12)}  # height [m]: numbers of beads
_AWAY = 1.0  # gap [m] and speed [m/s] of beads that take no part; any other would do
_SAMPLES = 400  # of a force over time


def wall_histories(drops: dict[float, tuple[int, ...]]) -> dict[tuple[float, int], History]:
    """Impacts of columns of N beads that fall from a height: all of one program.

    Columns shorter than the longest have open contacts above, to beads that fly away.
    """
    cases = [(height, n) for height, beads in drops.items() for n in beads]
    most = max(n for _, n in cases)
    k, e = (np.array([x[0]] * (most - 1) + [x[1]]) for x in (STIFFNESS, RESTITUTION))
    law, scene = LZB(e, k), column([BEAD] * most, gaps=[0.0] * most)
    absent = np.stack([np.arange(most) < most - n for _, n in cases])
    speed = np.sqrt(2 * GRAVITY * np.array([height for height, _ in cases]))[:, None]
    leaving = -_AWAY * np.arange(most, 0, -1.0)[None]
    before = jnp.asarray(np.where(absent, leaving, speed))

    def one(gaps: jax.Array, velocity: jax.Array) -> History:
        """One column."""
        return history(law, with_gaps(scene, gaps), velocity, _SAMPLES)

    gaps = jnp.asarray(np.where(absent, _AWAY, 0.0))
    rows = eqx.filter_jit(jax.vmap(one))(gaps, before)
    return {case: jax.tree.map(lambda x, i=i: x[i], rows) for i, case in enumerate(cases)}


def wall_forces() -> Figure:
    """Figure 6.2: longer columns press longer, not harder."""
    figure = new_figure(6.4)
    panels = figure.subplots(2, 1, sharex=True)
    found = wall_histories(DROPS)
    for axes, (height, beads) in zip(panels, DROPS.items(), strict=True):
        for i, n in enumerate(beads):
            h = found[height, n]
            at, force = np.asarray(h.time) * 1e6, np.asarray(h.force[:, -1])
            axes.plot(at, force, color=COLOURS[i], label=f"N = {n}")
        axes.set_ylabel("force at the wall [N]")
        axes.set_title(f"drop height {1e3 * height:g} mm", loc="left", fontsize="medium")
        axes.set_ylim(bottom=0)
        legend_within(axes)
    panels[-1].set_xlabel("impact time [us]")
    finish(*panels)
    return figure


def contact_loop() -> Figure:
    """Figure 6.6: the wall under two balls, which compress it twice."""
    law = LZB([0.9, 0.8], [1.0, 2**0.5], 1.5)
    return loop_of(history(law, chain([1.0, 1.0], wall=True), [1.0, 1.0], _SAMPLES))
