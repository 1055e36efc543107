# /// script
# dependencies = ["mujoco==4.0.0"]
# ///
"""MuJoCo: no e. `solref` (-stiffness, -damping) sets a damped oscillator, `solimp` the impedance.

The default solref does not bounce by e; without damping the second setting is e = 1, so scenes
with another e are left out (`ji.mujoco_solref` finds a damping for them).
"""

import mujoco
from rows import RADIUS, TIME, print_rows


def after(masses, wall, restitution, solref, solimp, step):
    if restitution != 1:
        return None
    ball = '<body pos="{:g} 0 0"><joint type="slide" axis="1 0 0"/><geom size="{}" mass="{}"/></body>'
    balls = "".join(
        ball.format(2 * RADIUS * k, RADIUS, m) for k, m in enumerate(masses)
    )
    x = RADIUS * (2 * len(masses) - 1)
    plane = (
        f'<geom type="plane" size="1 1 1" pos="{x} 0 0" zaxis="-1 0 0"/>'
        if wall
        else ""
    )
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco><option timestep="{step}" gravity="0 0 0"/>
    <default><geom condim="1" solref="{solref}" solimp="{solimp}"/></default>
    <worldbody>{plane}{balls}</worldbody></mujoco>""")
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    for _ in range(round(TIME / step)):
        mujoco.mj_step(model, data)
    return data.qvel


if __name__ == "__main__":
    default = {"solref": "0.02 1", "solimp": "0.9 0.95", "step": 2e-3}
    hard = {"solref": "-1e5 0", "solimp": "0.9999 0.9999", "step": 2e-4}
    settings = {
        "default solref and solimp, step 2 ms": default,
        "solref (-1e5, 0), solimp .9999, step .2 ms": hard,
    }
    print_rows("mujoco", mujoco.__version__, settings, after)
