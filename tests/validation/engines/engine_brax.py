# /// script
# dependencies = ["brax==0.14.2"]
# ///
"""Brax: `elasticity` of geoms (a custom numeric of the MJCF model); a pair has the mean of both."""

from importlib.metadata import version

import jax
from brax.io import mjcf
from brax.positional import pipeline as positional
from brax.spring import pipeline as spring
from rows import RADIUS, print_rows

TIME = 0.2  # [s]
PIPELINES = {"positional": positional, "spring": spring}


def after(masses, wall, restitution, pipeline, step):
    if wall:
        return None
    ball = '<body pos="{} 0 0"><freejoint/><geom type="sphere" size="{}" mass="{}"/></body>'
    balls = "".join(
        ball.format(2 * RADIUS * k, RADIUS, m) for k, m in enumerate(masses)
    )
    system = mjcf.loads(f"""
    <mujoco><option timestep="{step}" gravity="0 0 0"/>
    <default><geom friction="0 0 0"/></default>
    <custom><numeric name="elasticity" data="{restitution}"/></custom>
    <worldbody>{balls}</worldbody></mujoco>""")
    run = PIPELINES[pipeline]
    speeds = jax.numpy.zeros(system.qd_size()).at[0].set(1.0)
    state = run.init(system, system.init_q, speeds)
    one = jax.jit(
        lambda state: run.step(system, state, jax.numpy.zeros(system.act_size()))
    )
    for _ in range(round(TIME / step)):
        state = one(state)
    return state.xd.vel[:, 0]


if __name__ == "__main__":
    for name in PIPELINES:
        settings = {"step 2 ms": {"pipeline": name, "step": 2e-3}}
        print_rows(f"brax-{name}", version("brax"), settings, after)
