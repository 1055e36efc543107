"""MuJoCo's predictions of a square's drops: spheres at the corners of a body in the plane."""

import mujoco
import numpy as np
from drops import FRAME, GRAVITY, SIDE, Simulator

STEP = 1e-4  # [s]; ten times more is half a contact
SPHERE = 1e-4  # [m] radius, as good as a sharp corner
INERTIA = SIDE**2 / 6  # of mass 1 [m^2]
SCENE = """
<mujoco><option timestep="{step}" gravity="0 0 -{g}" cone="elliptic" integrator="implicitfast"/>
<worldbody><geom type="plane" size="9 9 1"/><body>
<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 -1 0"/>
<inertial pos="0 0 0" mass="1" diaginertia="{i} {i} {i}"/>{corners}</body></worldbody></mujoco>"""


def of_mujoco() -> Simulator:
    """Three numbers: time constant and damping ratio of `solref`, and mu."""
    half = SIDE / 2 - SPHERE
    corners = "".join(
        f'<geom type="sphere" size="{SPHERE}" pos="{x} 0 {z}"/>'
        for x in (-half, half) for z in (-half, half)
    )  # fmt: skip
    text = SCENE.format(step=STEP, g=GRAVITY, i=INERTIA, corners=corners)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)

    def simulate(x: np.ndarray, states: np.ndarray, frames: int) -> np.ndarray:
        """One after the other."""
        poses = np.empty((len(states), frames + 1, 3))
        for numbers, state, own in zip(x, states, poses):
            model.geom_solref[:], model.geom_friction[:, 0] = numbers[:2], numbers[2]
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = own[0], _ = state
            for k in range(frames):
                mujoco.mj_step(model, data, nstep=round(FRAME / STEP))
                own[k + 1] = data.qpos
        return poses

    starts = np.array([[6e-3, 0.3, 0.1], [2e-3, 0.3, 0.3]])
    names = ("time constant [s]", "damping ratio", "mu")
    return Simulator(names, starts, ([2 * STEP, 0.01, 0], [0.05, 3, 2]), simulate)
