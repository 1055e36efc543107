"""MuJoCo's row of the cube's table: spheres at the corners, soft contacts, no gravity."""

from typing import Any

import mujoco
import numpy as np
from cube import BOX, NEAR, ROUNDING, Impacts, Model, cube

SCENE = """
<mujoco><option timestep="5e-5" gravity="0 0 0" cone="elliptic" integrator="implicitfast"/>
<worldbody><geom type="plane" size="1 1 1"/><body><freejoint/>
<inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia}"/>{corners}</body></worldbody></mujoco>"""
LONGEST = (
    100  # steps of an impact, 20 ms; a contact takes 1 to 5 ms, ten times more changes nothing
)


def scene() -> Any:
    """The cube above a plane; its frame is that of the inertia, at the centre of mass."""
    spheres = [
        f'<geom type="sphere" size="{ROUNDING}" pos="{x} {y} {z}"/>' for x, y, z in cube().points
    ]
    inertia = " ".join(map(str, BOX[2]))
    text = SCENE.format(mass=BOX[1], inertia=inertia, corners="".join(spheres))
    return mujoco.MjModel.from_xml_string(text)


def after(model: Any, state: Any, q: np.ndarray, part: np.ndarray, v: np.ndarray) -> np.ndarray:
    """v+ of an impact: until none of the corners that take part touches or approaches."""
    model.geom_contype[1:] = model.geom_conaffinity[1:] = part
    mujoco.mj_resetData(model, state)
    state.qpos[:], state.qvel[:] = q, v
    mujoco.mj_forward(model, state)
    state.qpos[2] -= (state.geom_xpos[1:, 2] - ROUNDING).min()
    for _ in range(LONGEST):
        mujoco.mj_step(model, state)
        mujoco.mj_forward(model, state)
        arms = state.geom_xpos[1:][part] - state.xpos[1]
        spin = state.xmat[1].reshape(3, 3) @ state.qvel[3:]
        if not state.ncon and (state.qvel[2] + np.cross(spin, arms)[:, 2] >= 0).all():
            break
    return np.array(state.qvel)


def of_mujoco(impacts: Impacts, heights: np.ndarray) -> Model:
    """Three numbers: solref = (time constant, damping ratio), and mu."""
    model = scene()
    state, part = mujoco.MjData(model), heights <= NEAR
    pre, post, sigma = (
        np.asarray(x) for x in (impacts.data.pre, impacts.data.post, impacts.data.sigma)
    )

    def residual(x: np.ndarray) -> np.ndarray:
        """Of all impacts."""
        model.geom_solref[:], model.geom_friction[:, 0] = x[:2], x[2]
        found = [after(model, state, *each) for each in zip(impacts.q, part, pre)]
        return ((np.array(found) - post) / sigma).ravel()

    bounds = np.array([1e-3, 0.02, 0.0]), np.array([0.05, 3.0, 2.0])
    names = ("time constant", "damping ratio", "mu")
    return Model(names, np.array([2.5e-3, 0.65, 0.16]), bounds, residual, "2-point")
