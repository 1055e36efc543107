# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3 (ipykernel)
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Robots from MuJoCo: a biped lands on both feet
#
# *Course, part 15. Before: [a block on a shaken base](14_a_shaken_block.ipynb). Next: [the
# chapter](16_the_chapter.ipynb).*
#
# You will take the contacts of a robot from MuJoCo, compare laws for its landing, differentiate the
# landing, and find the damping of a contact from the speed after a collision. The extra `mujoco` is
# necessary: `pip install "jimpact[mujoco]"`.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np

import jimpact as ji

LEG = """
<body name="{side} thigh" pos="0 {y} -.1"><joint name="{side} hip" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .1 0 -.4" size=".06" mass="7"/>
  <body name="{side} shank" pos=".1 0 -.4"><joint name="{side} knee" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 -.1 0 -.4" size=".05" mass="3"/>
    <body name="{side} foot" pos="-.1 0 -.4"><joint name="{side} ankle" axis="0 1 0"/>
      <geom name="{side} foot" type="box" pos=".05 0 -.06" size=".12 .05 .02" mass="1"/>
    </body></body></body>"""
BIPED = f"""
<mujoco><worldbody><geom name="floor" type="plane" size="2 2 .1"/>
<body name="torso" pos="0 0 .98"><freejoint/>
  <geom type="box" pos="0 0 .2" size=".1 .15 .25" mass="35"/>
  {LEG.format(side="left", y=0.12)}{LEG.format(side="right", y=-0.12)}
</body></worldbody></mujoco>"""
model = mujoco.MjModel.from_xml_string(BIPED)
data = mujoco.MjData(model)


def draw(axes, color):
    """The left half of the biped from the side: joints, and the outline of the foot and the torso."""
    mujoco.mj_kinematics(model, data)
    joints = [
        data.body(name).xpos
        for name in ("torso", "left thigh", "left shank", "left foot")
    ]
    axes.plot(*np.array(joints)[:, [0, 2]].T, "o-", color=color)
    for body in ("torso", "left foot"):
        geom = model.body(body).geomadr[0]
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        outline = np.zeros((5, 3))
        outline[:, [0, 2]] = corners * model.geom_size[geom][[0, 2]]
        outline = data.geom_xpos[geom] + outline @ data.geom_xmat[geom].reshape(3, 3).T
        axes.plot(outline[:, 0], outline[:, 2], color=color)


figure, axes = plt.subplots(figsize=(3.2, 4.2))
draw(axes, "C0")
axes.axhline(0, color="0.5")
axes.set(
    aspect="equal",
    xlim=(-0.5, 0.5),
    xlabel="x [m]",
    ylabel="z [m]",
    title="A biped, from the side",
)
# %% [markdown]
# ## From the model to a scene
#
# The biped falls at 1 m/s and touches the floor with the four corners of both feet. MuJoCo finds
# these eight contacts; `ji.from_mujoco` makes a scene of them. Its coordinates are those of
# `data.qvel`: velocity and angular velocity of the torso, then hip, knee and ankle of each leg.

# %%
data.qvel[2] = -1.0
biped = ji.from_mujoco(model, data)
print(len(biped.names), "contacts of", biped.scene.size, "coordinates")
print(sorted(set(biped.names)), "friction", set(biped.friction.tolist()))

# %% [markdown]
# ## Laws
#
# The legs are bent, so the landing folds them, and the torso still falls when the feet have stopped.
# Friction keeps the feet from slipping. Where contacts are redundant (four corners of a rigid foot)
# Moreau's law returns one of many distributions of the impulse, and says so by its status; the
# velocity is unique.

# %%
friction = biped.friction
laws = {
    "Moreau": ji.Moreau(0.2, friction=friction),
    "LZB": ji.LZB(0.2, 1.0, friction=friction),
    "LZB, no friction": ji.LZB(0.2, 1.0),
}
joints = [
    "torso x [m/s]",
    "torso z [m/s]",
    "torso pitch [rad/s]",
    "hip",
    "knee",
    "ankle",
]
shown = [0, 2, 4, 6, 7, 8]
figure, axes = plt.subplots(figsize=(6.4, 3.2))
for k, (name, law) in enumerate(laws.items()):
    out = ji.impact(law, biped.scene, biped.velocity)
    change = float(out.energy_change / ji.kinetic_energy(biped.scene, biped.velocity))
    print(f"{name:17} {ji.STATUS[int(out.status)].name:20} energy {change:+.1%}")
    axes.bar(
        np.arange(6) + 0.27 * (k - 1), np.asarray(out.velocity)[shown], 0.25, label=name
    )
axes.set_xticks(range(6), joints, rotation=20)
axes.set_ylabel("velocity after the impact")
axes.legend()

# %% [markdown]
# ## Derivatives
#
# One forward derivative gives the effect of the friction and of the restitution of each foot. Both
# feet act alike on the torso, and turn it in opposite directions.


# %%
def landing(restitution, mu):
    """Velocities after the landing, by restitution (2,) and friction (2,) of left and right foot."""
    law = ji.LZB(jnp.repeat(restitution, 4), 1.0, friction=jnp.repeat(mu, 4))
    return ji.impact(law, biped.scene, biped.velocity).velocity


slopes = jax.jacfwd(landing, argnums=(0, 1))(jnp.full(2, 0.2), jnp.full(2, 0.3))
for name, slope in zip(("restitution", "friction"), slopes, strict=True):
    print(f"by {name} of the left and the right foot")
    for joint, row in zip(
        [*joints[:2], "torso roll [rad/s]"], slope[jnp.array([0, 2, 3])]
    ):
        print(f"  {joint:20} {row[0]:+.4f} {row[1]:+.4f}")

# %% [markdown]
# ## In a simulation
#
# MuJoCo moves the biped; where bodies approach each other in a contact, a law of jimpact gives the
# velocity after the impact, and MuJoCo goes on. MuJoCo alone, with its default contact, brakes the
# feet within some milliseconds; how much they rebound depends on its time step.

# %%
law = ji.LZB(0.2, 1.0, friction=1.0)


def fall(with_law):
    """Time and height of the left foot during a fall from 50 mm."""
    mujoco.mj_resetData(model, data)
    data.qpos[2] += 0.05
    heights = []
    while data.time < 0.25:
        mujoco.mj_step(model, data)
        if with_law and data.ncon == 8:
            biped = ji.from_mujoco(model, data)
            if (
                float(ji.gap_velocity(biped.scene, biped.velocity).min()) < -0.05
            ):  # [m/s]
                out = ji.raise_on_failure(ji.impact(law, biped.scene, biped.velocity))
                data.qvel[:] = out.velocity
        heights.append((data.time, data.geom("left foot").xpos[2] - 0.02))
    return np.array(heights).T


figure, axes = plt.subplots(figsize=(6.4, 3))
for with_law, name in ((False, "MuJoCo's contact"), (True, "impacts by LZB, e = 0.2")):
    time, height = fall(with_law)
    axes.plot(1e3 * time, 1e3 * height, label=name)
axes.set(xlabel="time [ms]", ylabel="height of the left sole [mm]")
axes.legend()
# %% [markdown]
# ## Damping from the speed after a collision
#
# A ball of .3 kg hits a plate with 1 m/s and leaves it with .62 m/s; how large is the damping c of
# the contact? Simulated steps of a contact have no useful derivative with respect to c. An impact
# has, so Newton's method needs a few steps.

# %%
ball = ji.Scene(mass=[0.3], normals=[[1.0]])


def leaving(damping):
    """Speed after the collision by c [N s/m]."""
    contact = ji.KelvinVoigt(1e5, damping)
    return ji.impact(ji.Compliant(contact), ball, [-1.0]).velocity[0]


speed_and_slope = jax.jit(jax.value_and_grad(leaving))
damping = 10.0
for step in range(5):
    speed, slope = speed_and_slope(damping)
    print(f"step {step}: c = {damping:.6f} N s/m, leaves at {speed:.9f} m/s")
    damping += float((0.62 - speed) / slope)

# %% [markdown]
# `ji.mujoco_solref` turns such a coefficient into MuJoCo's parameters at your time step; the page
# `docs/mujoco.md` says which law its contacts obey.

# %%
first, second = ji.mujoco_solref(0.62, timestep=0.002)
print(f"solref = {first:.6g} {second:.6g}")

# %% [markdown]
# *Next: [the chapter that the laws are from](16_the_chapter.ipynb).*
