"""MuJoCo's rows of the cube's table: spheres at the corners, soft contacts, no gravity."""

from typing import Any

import mujoco
import numpy as np
from cube import BOX, NEAR, ROUNDING, Impacts, Model, cube

SCENE = """
<mujoco><option timestep="5e-5" gravity="0 0 0" cone="elliptic" integrator="implicitfast"/>
<worldbody><geom type="plane" size="1 1 1"/><body><freejoint/>
<inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia}"/>{corners}</body></worldbody></mujoco>"""
# Runs of steps of an impact, 20 ms together. One corner takes 1 to 5 ms, the second one may strike 10 ms
# later: a quarter loses it (7.5 % instead of 6.3 in the median of two corners), ten times more changes nothing.
RUNS, STEPS = 40, 10
# Where fits begin. `solref`: time constant [s], damping ratio; sliding friction; `solimp`: least and largest
# impedance and width [m]; torsional friction [m]. From MuJoCo's own `solimp` (.9, .95, 1e-3) seven numbers
# end in a minimum that is not the lowest one.
STARTS = np.array([
    [1.0e-3, 0.60, 0.16, 0.01, 0.10, 3e-4, 3e-3],
    [3.0e-3, 0.80, 0.16, 0.01, 0.10, 1e-3, 3e-3],
    [2.5e-3, 0.65, 0.16, 0.60, 0.95, 1e-4, 1e-3],
    [5.0e-3, 0.40, 0.16, 0.30, 0.90, 1e-3, 1e-3],
])  # fmt: skip
NAMES = ("time constant", "damping ratio", "mu", "dmin", "dmax", "width", "torsion")
LOW = np.array([1e-4, 0.02, 0.0, 1e-3, 1e-3, 1e-6, 0.0])
HIGH = np.array([0.05, 3.0, 2.0, 0.9999, 0.9999, 0.02, 0.1])


def scene() -> Any:
    """The cube above a plane; its frame is that of the inertia, at the centre of mass."""
    spheres = [
        f'<geom type="sphere" size="{ROUNDING}" pos="{x} {y} {z}"/>'
        for x, y, z in cube().points[0]
    ]
    inertia = " ".join(map(str, BOX[2]))
    text = SCENE.format(mass=BOX[1], inertia=inertia, corners="".join(spheres))
    return mujoco.MjModel.from_xml_string(text)


def after(
    model: Any, state: Any, q: np.ndarray, part: np.ndarray, v: np.ndarray
) -> np.ndarray:
    """v+ of an impact: until none of the corners that take part touches or approaches."""
    model.geom_contype[1:] = model.geom_conaffinity[1:] = part
    mujoco.mj_resetData(model, state)
    state.qpos[:], state.qvel[:] = q, v
    mujoco.mj_forward(model, state)
    state.qpos[2] -= (state.geom_xpos[1:, 2] - ROUNDING).min()
    for _ in range(RUNS):
        mujoco.mj_step(model, state, nstep=STEPS)
        mujoco.mj_forward(model, state)
        arms = state.geom_xpos[1:][part] - state.xpos[1]
        spin = state.xmat[1].reshape(3, 3) @ state.qvel[3:]
        if not state.ncon and (state.qvel[2] + np.cross(spin, arms)[:, 2] >= 0).all():
            break
    return np.array(state.qvel)


def of_mujoco(impacts: Impacts, heights: np.ndarray, numbers: int) -> Model:
    """Three numbers, `solref` and mu, or seven: with `solimp` and torsional friction, too."""
    model = scene()
    state, part = mujoco.MjData(model), heights <= NEAR
    pre, post, sigma = (
        np.asarray(x) for x in (impacts.data.pre, impacts.data.post, impacts.data.sigma)
    )
    more = numbers > 3
    model.geom_condim[:] = 4 if more else 3

    def residual(x: np.ndarray) -> np.ndarray:
        """Of all impacts."""
        model.geom_solref[:], model.geom_friction[:, 0] = x[:2], x[2]
        if more:
            model.geom_solimp[:, :3], model.geom_friction[:, 1] = x[3:6], x[6]
        found = [after(model, state, *each) for each in zip(impacts.q, part, pre)]
        return ((np.array(found) - post) / sigma).ravel()

    bounds = LOW[:numbers], HIGH[:numbers]
    return Model(NAMES[:numbers], STARTS[:, :numbers], bounds, residual, "2-point")
